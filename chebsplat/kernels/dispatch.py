"""Choice between two twins: a compiled kernel, or plain torch for any device and float type."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

BACKENDS = ("auto", "cpu", "cuda", "reference")


def is_compiled(tensor: Tensor, backend: str = "auto") -> bool:
    """True where a compiled kernel takes a tensor: float32 on the CPU, `backend` not `reference`.

    Raises: ValueError on an unknown backend.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend {backend!r} is none of {', '.join(BACKENDS)}")
    return backend != "reference" and tensor.device.type == "cpu" and tensor.dtype == torch.float32


def gsplat() -> Any:
    """The package that computes on a GPU, imported on first use. Raises ImportError with remedy."""
    try:
        import gsplat as module
    except ImportError as error:
        raise ImportError(
            "torch sees a GPU, but gsplat, which renders on it, cannot be imported: make setup "
            "device=cuda; or move the tensors to the CPU, or pass backend='reference'"
        ) from error
    return module
