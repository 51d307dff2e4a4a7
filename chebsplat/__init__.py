"""Semantic 3D Gaussian Splatting that understands shape."""

import os

# Idle OpenMP threads must sleep: spinning ones cost an order of magnitude on a busy machine. Must precede torch.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"
