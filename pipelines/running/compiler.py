"""Imports of the process that compiles kernels: a fork of it saves 2.5 processor seconds."""

from __future__ import annotations

import numba
import torch  # noqa: F401 - nearly every compiled part imports it


def first(x: int) -> int:
    """A trivial kernel: compiling it makes numba initialise its type tables."""
    return x


numba.njit(first)(0)  # type: ignore[type-var]  # of numba's stubs
