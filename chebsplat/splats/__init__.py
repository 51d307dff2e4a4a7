"""Gaussians as parameters: raw and activated values, rotations, spherical harmonics.

Raw parameters by name: `means` [N, 3] scene units, `log_scales` [N, 3], `quats` [N, 4] wxyz of any
length, `logit_opacities` [N], `sh0` [N, 1, 3] and `shN` [N, 15, 3]. May import kernels.
"""
