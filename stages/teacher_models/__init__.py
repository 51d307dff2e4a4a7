"""2D teachers and their words."""
