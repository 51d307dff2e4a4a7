"""Vectors of float32 as values inside numba kernels.

numba's loops vectorise only when LLVM proves that nothing aliases; these say it. LLVM splits a vector wider than the
machine's registers, so the same source runs on AVX-512 (one register), AVX2 (two), SSE and NEON (four).
Addresses are an array and a flat index, unchecked: the callers lay out every buffer that they pass.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.typing import signature
from numba.extending import models, overload, register_model

intrinsic: Any = extending.intrinsic  # its own type takes the typing context for an argument of the call
_FLOAT, _INT = ir.FloatType(), ir.IntType(32)


class Vector(types.Type):
    """`width` float32 values; or, with `kind` 1, as many truth values."""

    def __init__(self, width: int, kind: str = "float32"):
        self.width, self.kind = width, kind
        super().__init__(f"simd.{kind}x{width}")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, vector: Vector):
        element = _FLOAT if vector.kind == "float32" else ir.IntType(1)
        super().__init__(manager, vector, ir.VectorType(element, vector.width))


F16, M16 = Vector(16), Vector(16, "bool")
WIDE = ir.VectorType(_FLOAT, 16)


def _data(context: Any, builder: Any, kind: Any, value: Any, index: Any, to: ir.Type) -> Any:
    """Pointer to element `index` of an array, as a pointer to type `to`."""
    data = context.make_array(kind)(context, builder, value).data
    return builder.bitcast(builder.gep(data, [index]), to.as_pointer())


def _splat(builder: Any, scalar: Any, width: int = 16) -> Any:
    vector = ir.VectorType(_FLOAT, width)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(_INT, 0))
    zeros = ir.Constant(ir.VectorType(_INT, width), [0] * width)
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), zeros)


def _fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c, fused where the machine can."""
    name = f"llvm.fmuladd.v{a.type.count}f32"
    function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(a.type, [a.type] * 3), name)
    return builder.call(function, [a, b, c])


@intrinsic
def splat(_typing, scalar):  # type: ignore[no-untyped-def]
    """All lanes equal to `scalar`."""
    return signature(F16, types.float32), lambda context, builder, sig, args: _splat(builder, args[0])


@intrinsic
def load(_typing, array, index):  # type: ignore[no-untyped-def]
    """array.flat[index : index + 16]."""

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load(_data(context, builder, sig.args[0], args[0], args[1], WIDE), align=4)

    return signature(F16, array, types.intp), build


@intrinsic
def store(_typing, array, index, value):  # type: ignore[no-untyped-def]
    """array.flat[index : index + 16] = value."""

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[2], _data(context, builder, sig.args[0], args[0], args[1], WIDE), align=4)
        return context.get_dummy_value()

    return signature(types.none, array, types.intp, F16), build


@intrinsic
def prefetch(_typing, array, index):  # type: ignore[no-untyped-def]
    """Ask for the cache line of array.flat[index]."""

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        byte = ir.IntType(8).as_pointer()
        place = builder.bitcast(_data(context, builder, sig.args[0], args[0], args[1], _FLOAT), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, _INT, _INT, _INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [place, _INT(0), _INT(3), _INT(1)])
        return context.get_dummy_value()

    return signature(types.none, array, types.intp), build


@intrinsic
def fma(_typing, a, b, c):  # type: ignore[no-untyped-def]
    """a b + c."""
    return signature(F16, F16, F16, F16), lambda context, builder, sig, args: _fma(builder, *args)


@intrinsic
def fnma(_typing, a, b, c):  # type: ignore[no-untyped-def]
    """c − a b."""

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _fma(builder, builder.fneg(args[0]), *args[1:])

    return signature(F16, F16, F16, F16), build


@intrinsic
def magnitude(_typing, value):  # type: ignore[no-untyped-def]
    """|value|."""

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(WIDE, [WIDE]), "llvm.fabs.v16f32")
        return builder.call(function, args)

    return signature(F16, F16), build


def _binary(name: str) -> Any:
    @intrinsic
    def apply(_typing, a, b):  # type: ignore[no-untyped-def]
        return signature(F16, F16, F16), lambda context, builder, sig, args: getattr(builder, name)(*args)

    return apply


def _compare(symbol: str) -> Any:
    @intrinsic
    def apply(_typing, a, b):  # type: ignore[no-untyped-def]
        return signature(M16, F16, F16), lambda context, builder, sig, args: builder.fcmp_ordered(symbol, *args)

    return apply


def _operate(function: Any, apply: Any) -> None:
    @overload(function, inline="always")
    def implement(a, b):  # type: ignore[no-untyped-def]
        if a == F16 and b == F16:
            return lambda a, b: apply(a, b)
        return None


for _function, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _operate(_function, _binary(_name))
for _function, _symbol in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _operate(_function, _compare(_symbol))


@intrinsic
def both(_typing, a, b):  # type: ignore[no-untyped-def]
    """a and b, lane by lane."""
    return signature(M16, M16, M16), lambda context, builder, sig, args: builder.and_(*args)


@intrinsic
def where(_typing, mask, a, b):  # type: ignore[no-untyped-def]
    """a where the mask holds, else b."""
    return signature(F16, M16, F16, F16), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def bits(_typing, mask):  # type: ignore[no-untyped-def]
    """The mask as an integer, lane 0 in the lowest bit."""

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.zext(builder.bitcast(args[0], ir.IntType(16)), ir.IntType(32))

    return signature(types.int32, M16), build


@intrinsic
def scale_by_power(_typing, value, shifted):  # type: ignore[no-untyped-def]
    """value · 2^k, where `shifted` is k + 1.5·2²³, which holds k in its low bits; no over- or underflow."""

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        whole = ir.VectorType(_INT, 16)
        power = builder.shl(builder.bitcast(args[1], whole), ir.Constant(whole, [23] * 16))
        return builder.bitcast(builder.add(builder.bitcast(args[0], whole), power), WIDE)

    return signature(F16, F16, F16), build


@intrinsic
def total(_typing, value):  # type: ignore[no-untyped-def]
    """Sum of the lanes, as a tree."""

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        name = "llvm.vector.reduce.fadd.v16f32"
        kind = ir.FunctionType(_FLOAT, [_FLOAT, WIDE])
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [ir.Constant(_FLOAT, 0.0), args[0]], fastmath=["reassoc"])

    return signature(types.float32, F16), build


def _interleave(builder: Any, a: Any, b: Any, order: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INT, len(order)), order))


@intrinsic
def to_lanes(_typing, out, out_at, a, a_at, a_step):  # type: ignore[no-untyped-def]
    """Transpose 16 rows of 4: out.flat[out_at + 16 c + lane] = a.flat[a_at + lane a_step + c] for c < 4."""
    four = ir.VectorType(_FLOAT, 4)

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        out, out_at, a, a_at, a_step = args
        parts = []
        for lane in range(16):
            at = builder.add(a_at, builder.mul(a_step, a_step.type(lane)))
            parts.append(builder.load(_data(context, builder, sig.args[2], a, at, four), align=4))
        while len(parts) > 4:
            n = 2 * parts[0].type.count
            parts = [_interleave(builder, parts[i], parts[i + 1], list(range(n))) for i in range(0, len(parts), 2)]
        for c in (0, 2):
            order = [4 * lane + k for k in (c, c + 1) for lane in range(8)]
            low, high = _interleave(builder, parts[0], parts[1], order), _interleave(builder, parts[2], parts[3], order)
            for k in range(2):
                both = _interleave(builder, low, high, [8 * k + i + j for j in (0, 16) for i in range(8)])
                at = builder.add(out_at, out_at.type(16 * (c + k)))
                builder.store(both, _data(context, builder, sig.args[0], out, at, WIDE), align=4)
        return context.get_dummy_value()

    return signature(types.none, out, types.intp, a, types.intp, types.intp), build


@intrinsic
def from_lanes(_typing, out, out_at, out_step, a, a_at):  # type: ignore[no-untyped-def]
    """The way back of `to_lanes`: out.flat[out_at + lane out_step + c] = a.flat[a_at + 16 c + lane] for c < 4."""
    four = ir.VectorType(_FLOAT, 4)

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        out, out_at, out_step, a, a_at = args
        rows = []
        for c in range(4):
            at = builder.add(a_at, a_at.type(16 * c))
            rows.append(builder.load(_data(context, builder, sig.args[3], a, at, WIDE), align=4))
        for half in (0, 8):  # lanes half .. half + 7, as (lane, c mod 2)
            order = [half + lane + k for lane in range(8) for k in (0, 16)]
            even, odd = _interleave(builder, rows[0], rows[1], order), _interleave(builder, rows[2], rows[3], order)
            for lane in range(8):
                four_channels = [2 * lane, 2 * lane + 1, 16 + 2 * lane, 17 + 2 * lane]
                at = builder.add(out_at, builder.mul(out_step, out_step.type(half + lane)))
                value = _interleave(builder, even, odd, four_channels)
                builder.store(value, _data(context, builder, sig.args[0], out, at, four), align=4)
        return context.get_dummy_value()

    return signature(types.none, out, types.intp, types.intp, a, types.intp), build


@intrinsic(prefer_literal=True)
def multiply(_typing, out, out_at, order, order_at, out_step, a, a_at, a_row, a_step, b, b_at, b_step, depth, rows,
             width, add):  # type: ignore[no-untyped-def]  # fmt: skip
    """out[order[i], :width] (+)= Σ_k a[i, k] b[k, :width] for i < rows, k < depth; the sums stay in registers.

    Args: rows, width (4, 8 or 16) and add (0 or 1) are literals. Row i of out is at out_at + order[order_at + i]
      out_step, element (i, k) of a at a_at + i a_row + k a_step, row k of b at b_at + k b_step; depth is at least 1.
    """
    n, wide, adds = rows.literal_value, width.literal_value, add.literal_value
    vector = ir.VectorType(_FLOAT, wide)

    def build(context, builder, sig, args):  # type: ignore[no-untyped-def]
        out, out_at, order, order_at, out_step, a, a_at, a_row, a_step, b, b_at, b_step, depth = args[:13]
        integer = depth.type
        targets = []
        for i in range(n):
            place = _data(context, builder, sig.args[2], order, builder.add(order_at, integer(i)), integer)
            offset = builder.add(out_at, builder.mul(builder.load(place), out_step))
            targets.append(_data(context, builder, sig.args[0], out, offset, vector))
        start = [builder.load(t, align=4) if adds else ir.Constant(vector, [0.0] * wide) for t in targets]
        before, loop, after = builder.block, builder.append_basic_block("products"), builder.append_basic_block("end")
        builder.branch(loop)
        builder.position_at_end(loop)
        k, sums = builder.phi(integer), [builder.phi(vector) for _ in range(n)]
        row = builder.add(b_at, builder.mul(k, b_step))
        factor = builder.load(_data(context, builder, sig.args[9], b, row, vector), align=4)
        column = builder.add(a_at, builder.mul(k, a_step))
        sums_after = []
        for i in range(n):
            place = builder.add(column, builder.mul(a_row, integer(i)))
            entry = builder.load(_data(context, builder, sig.args[5], a, place, _FLOAT))
            sums_after.append(_fma(builder, _splat(builder, entry, wide), factor, sums[i]))
        following = builder.add(k, integer(1))
        k.add_incoming(integer(0), before)
        k.add_incoming(following, loop)
        for i in range(n):
            sums[i].add_incoming(start[i], before)
            sums[i].add_incoming(sums_after[i], loop)
        builder.cbranch(builder.icmp_signed("<", following, depth), loop, after)
        builder.position_at_end(after)
        for i in range(n):
            builder.store(sums_after[i], targets[i], align=4)
        return context.get_dummy_value()

    at = types.intp
    sizes = (rows, width, add)
    return signature(types.none, out, at, order, at, at, a, at, at, at, b, at, at, at, *sizes), build
