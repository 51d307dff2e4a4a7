"""Choice between two twins: a compiled kernel, or plain torch for any device and float type."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch computes on one thread within the block, or the function that this decorates.

    Choices: threads of torch that wait for its next operation take cores from the kernels' threads,
      and these from torch's: short operations of both in turns are fastest on one thread of torch.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
