"""What kernels give must not depend on how many threads they run on."""

import numba
import numpy as np


def assert_same_bits(compute):
    """`compute()` gives arrays, the same bits with one thread, two and all."""
    before, found = numba.get_num_threads(), []
    try:
        for threads in sorted({1, min(2, before), before}):
            numba.set_num_threads(threads)
            found.append(compute())
    finally:
        numba.set_num_threads(before)
    for other in found[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(found[0], other, strict=True))
