"""Measures of scenes: image fidelity, segmentation, surfaces, statistics of studies, protocols of
data sets.

Images are u8 [H, W, 3], labels [H, W] with -1 ignored, figures fractions, not percent. Points and
Gaussians are in scene units. May import labels, rasterize, render, splats, views.
"""
