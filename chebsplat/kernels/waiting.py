"""Waits of a few microseconds without Python's lock: to put a thread to sleep and to wake it takes
as long as many a kernel.
"""

from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import signature

from chebsplat.kernels.jit import kernel
from chebsplat.kernels.simd import address, intrinsic

TURNS = 50_000  # of looking, about a nanosecond each


@intrinsic
def look(_typing, counters, at):
    """counters[at], i64, as another thread has just left it."""

    def build(context, builder, sig, args):
        place = address(context, builder, sig.args[0], args[0], args[1], ir.IntType(64))
        return builder.load_atomic(place, "acquire", 8)

    return signature(types.int64, counters, types.intp), build


@kernel
def wait_a_moment(counters, least):
    """Wait until all counters i64 are at least `least`, and no longer than TURNS."""
    for _ in range(TURNS):
        ready = True
        for k in range(len(counters)):
            ready &= look(counters, k) >= least
        if ready:
            return
