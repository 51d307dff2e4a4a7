"""Features of a 2D teacher on the Gaussians of a finished scene, without training: one pass of α T
weights a view.

What is made of them afterwards: smoothing, a blend with what is known beforehand, and how both are
  chosen.

N Gaussians, V training views, C channels; weights are α T summed over pixels. May import kernels,
rasterize, splats.
"""
