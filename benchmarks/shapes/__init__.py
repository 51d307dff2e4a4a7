"""How well a simple classifier tells simple shapes from each descriptor."""
