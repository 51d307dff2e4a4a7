"""The embedded 2D teacher: a small dense image encoder that ships with the package, and what it was
trained by.
"""
