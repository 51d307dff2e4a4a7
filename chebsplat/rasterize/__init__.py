"""Differentiable Gaussian rasterization behind one signature, in the words of gsplat."""

from chebsplat.rasterize.reference import rasterize

__all__ = ["rasterize"]
