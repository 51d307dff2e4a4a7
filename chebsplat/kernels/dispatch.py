"""Which of two twins computes: a compiled kernel, or plain torch, which takes any device and float type."""

from __future__ import annotations

import torch
from torch import Tensor

BACKENDS = ("auto", "cpu", "cuda", "reference")


def is_compiled(tensor: Tensor, backend: str = "auto") -> bool:
    """Whether a compiled kernel takes a tensor: float32 on the CPU, unless plain torch is asked for (`reference`).

    Raises: ValueError on an unknown backend.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend {backend!r} is none of {', '.join(BACKENDS)}")
    return backend != "reference" and tensor.device.type == "cpu" and tensor.dtype == torch.float32
