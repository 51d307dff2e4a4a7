"""Local shape: regions of Gaussians, their anisotropic Chebyshev descriptors, the encoder, and how
shape reaches Gaussians (Eqs 1-10).

Centres and standard deviations are in scene units, rotations are quaternions wxyz. M regions of n
members are padded with -1, or a false mask. May import kernels, settings, splats.
"""
