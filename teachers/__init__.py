"""The embedded 2D teacher, a small dense image encoder that ships, and its training."""
