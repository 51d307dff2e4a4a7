"""Meaning: class codes, labels decoded from features, pseudo labels, channels of a teacher,
relevancy.

Features are [..., C] of any length, embeddings [L, C] unit; labels are indices into L names, -1 for
none. NumPy and SciPy alone; imports nothing of chebsplat.
"""
