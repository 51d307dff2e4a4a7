"""What kernels give must not depend on how many threads they run on."""

import numpy as np

from chebsplat.kernels.threads import set_n_threads


def assert_same_bits(compute):
    """`compute()` gives arrays, the same bits with one thread, two and five."""
    found = []
    try:
        for threads in (1, 2, 5):
            set_n_threads(threads)
            found.append(compute())
    finally:
        set_n_threads(0)
    for other in found[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(found[0], other, strict=True))
