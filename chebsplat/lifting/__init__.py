"""Features of a 2D teacher on the Gaussians of a finished scene, without training: one pass of α T
weights a view.

They are then smoothed and blended with knowledge of shape; the training views choose how far.

N Gaussians, V training views, C channels; weights are α T summed over pixels. May import kernels,
rasterize, splats.
"""
