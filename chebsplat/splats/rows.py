"""Rows of parameters, chosen by an index, with a cheap gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _Take(torch.autograd.Function):
    """Rows by an index without repeats: the gradient is one scatter, where plain indexing has to accumulate."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor) -> Tensor:
        ctx.save_for_backward(index)
        ctx.shape = values.shape
        return values.index_select(0, index)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (index,) = ctx.saved_tensors
        return grad.new_zeros(ctx.shape).index_copy_(0, index, grad), None


def take(values: Tensor, index: Tensor) -> Tensor:
    """values[index] for an index [V] that holds no row twice."""
    rows: Tensor = _Take.apply(values, index)
    return rows
