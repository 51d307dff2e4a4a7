"""What a process that compiles kernels begins with: one forked from it begins 2.5 processor seconds
further on.
"""

from __future__ import annotations

import numba
import torch  # noqa: F401 - nearly all that is rehearsed imports it


def first(x: int) -> int:
    """The first function that a process compiles waits for what numba knows of all types."""
    return x


numba.njit(first)(0)  # type: ignore[type-var]  # of numba's stubs
