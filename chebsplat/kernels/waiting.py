"""Short waits without Python's lock: many a kernel ends before a thread that sleeps is awake."""

from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import signature

from chebsplat.kernels.jit import kernel
from chebsplat.kernels.simd import address, intrinsic

LOOKS = 50_000  # at most, of half a nanosecond and more


@intrinsic
def look(_typing, counters, at):
    """counters[at], i64, as another thread has just left it."""

    def build(context, builder, sig, args):
        place = address(context, builder, sig.args[0], args[0], args[1], ir.IntType(64))
        return builder.load_atomic(place, "acquire", 8)

    return signature(types.int64, counters, types.intp), build


@kernel
def wait_a_moment(counters, least):
    """Wait until all counters i64 are at least `least`, for no more than LOOKS at one of them."""
    for _ in range(LOOKS // max(len(counters), 1)):
        ready = True
        for k in range(len(counters)):
            ready &= look(counters, k) >= least
        if ready:
            return
