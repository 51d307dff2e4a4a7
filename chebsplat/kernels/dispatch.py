"""Which of two twins computes: a compiled kernel, or plain torch, which takes any device and float
type.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

BACKENDS = ("auto", "cpu", "cuda", "reference")


def is_compiled(tensor: Tensor, backend: str = "auto") -> bool:
    """Whether a compiled kernel takes a tensor: float32 on the CPU, unless plain torch is asked for
    (`reference`).

    Raises: ValueError on an unknown backend.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend {backend!r} is none of {', '.join(BACKENDS)}")
    return backend != "reference" and tensor.device.type == "cpu" and tensor.dtype == torch.float32


def gsplat() -> Any:
    """The package that computes on a GPU, loaded when first asked for. Raises ImportError, with the
    remedy.
    """
    try:
        import gsplat as module
    except ImportError as error:
        raise ImportError(
            "torch sees a GPU, but gsplat, which renders on it, cannot be imported: make setup "
            "device=cuda; "
            "or move the tensors to the CPU, or pass backend='reference'"
        ) from error
    return module
