"""Differentiable Gaussian rasterization behind one signature, in the words of gsplat."""
