"""Vectors of float32, of 16 and less, as values inside numba kernels.

numba's loops vectorise only when LLVM proves that nothing aliases; these need no proof. LLVM splits
a vector wider than the machine's registers, so the same source runs on AVX-512 (one register), AVX2
(two), SSE and NEON (four); only a machine without fused multiply-add rounds differently. An array
argument is contiguous float32; its index counts elements and is not checked.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.typing.templates import signature
from numba.extending import models, overload, register_model

# its own type takes the typing context for an argument of the call
intrinsic: Any = extending.intrinsic
FLOAT, INT = ir.FloatType(), ir.IntType(32)


class Vector(types.Type):
    """`count` values: `kind` is float32 or bool."""

    def __init__(self, kind: str, count: int):
        self.kind, self.count = kind, count
        super().__init__(f"simd.{kind}x{count}")

    def as_mask(self) -> Vector:
        """The type of its comparisons."""
        return Vector("bool", self.count)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector: Vector):
        element = FLOAT if vector.kind == "float32" else ir.IntType(1)
        super().__init__(manager, vector, ir.VectorType(element, vector.count))


F16 = Vector("float32", 16)
WIDE = ir.VectorType(FLOAT, 16)
# 2^f on [-½, ½] to 2e-8, by Chebyshev interpolation
_nodes = 0.5 * np.cos((np.arange(7) + 0.5) * np.pi / 7)
_EXP2 = np.polynomial.polynomial.polyfit(_nodes, 2.0**_nodes, 6)
_EXP2[0] = 1.0  # 2^0 is 1


def address(context: Any, builder: Any, kind: Any, value: Any, index: Any, to: ir.Type) -> Any:
    """Pointer to element `index` of an array, as a pointer to type `to`."""
    data = context.make_array(kind)(context, builder, value).data
    return builder.bitcast(builder.gep(data, [index]), to.as_pointer())


def broadcast(builder: Any, scalar: Any, width: int = 16) -> Any:
    """A vector of `width` lanes that all hold `scalar`."""
    vector = ir.VectorType(FLOAT, width)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(INT, 0))
    zeros = ir.Constant(ir.VectorType(INT, width), [0] * width)
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), zeros)


def multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c, fused where the machine can."""
    name = f"llvm.fmuladd.v{a.type.count}f32"
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(a.type, [a.type] * 3), name
    )
    return builder.call(function, [a, b, c])


def shuffle(builder: Any, a: Any, b: Any, order: list[int]) -> Any:
    """Elements of a and b, numbered through, in this order."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(order)), order))


def _call(builder: Any, name: str, *values: Any) -> Any:
    vector = values[0].type
    kind, full = ir.FunctionType(vector, [vector] * len(values)), f"llvm.{name}.v{vector.count}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, full), values)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(WIDE, [float(np.float32(value))] * 16)


def splat_of(count: int) -> Any:
    """Makes vectors of `count` lanes that are all equal to a scalar."""
    vector = Vector("float32", count)

    @intrinsic
    def splat(_typing, scalar):
        return signature(vector, types.float32), lambda context, builder, sig, args: broadcast(
            builder, args[0], count
        )

    return splat


def load_of(count: int) -> Any:
    """Reads array.flat[index : index + count]."""
    vector, plain = Vector("float32", count), ir.VectorType(FLOAT, count)

    @intrinsic
    def load(_typing, array, index):
        def build(context, builder, sig, args):
            return builder.load(
                address(context, builder, sig.args[0], args[0], args[1], plain), align=4
            )

        return signature(vector, array, types.intp), build

    return load


splat, load = splat_of(16), load_of(16)


@intrinsic
def store(_typing, array, index, value):
    """array.flat[index : index + count of value] = value."""

    def build(context, builder, sig, args):
        builder.store(
            args[2], address(context, builder, sig.args[0], args[0], args[1], args[2].type), align=4
        )
        return context.get_dummy_value()

    return signature(types.none, array, types.intp, value), build


@intrinsic
def fma(_typing, a, b, c):
    """a b + c."""
    return signature(a, a, a, a), lambda context, builder, sig, args: multiply_add(builder, *args)


@intrinsic
def fnma(_typing, a, b, c):
    """c − a b."""

    def build(context, builder, sig, args):
        return multiply_add(builder, builder.fneg(args[0]), *args[1:])

    return signature(a, a, a, a), build


@intrinsic
def magnitude(_typing, value):
    """|value|."""
    return signature(value, value), lambda context, builder, sig, args: _call(
        builder, "fabs", args[0]
    )


def _binary(name: str) -> Any:
    @intrinsic
    def apply(_typing, a, b):
        return signature(a, a, a), lambda context, builder, sig, args: getattr(builder, name)(*args)

    return apply


def _compare(symbol: str) -> Any:
    @intrinsic
    def apply(_typing, a, b):
        return signature(
            a.as_mask(), a, a
        ), lambda context, builder, sig, args: builder.fcmp_ordered(symbol, *args)

    return apply


def _operate(function: Any, apply: Any) -> None:
    @overload(function, inline="always")
    def implement(a, b):
        if isinstance(a, Vector) and a == b and a.kind == "float32":
            return lambda a, b: apply(a, b)
        return None


for _function, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _operate(_function, _binary(_name))
for _function, _symbol in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
):
    _operate(_function, _compare(_symbol))


@intrinsic
def where(_typing, mask, a, b):
    """a where the mask holds, else b."""
    return signature(a, mask, a, a), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def bits(_typing, mask):
    """The mask as an integer, lane 0 in the lowest bit."""

    def build(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(mask.count)), ir.IntType(32))

    return signature(types.int32, mask), build


@intrinsic
def scale_by_power(_typing, value, shifted):
    """value · 2^k, within range; `shifted` is k + 1.5·2²³, which holds k in its low bits."""

    def build(context, builder, sig, args):
        whole = ir.VectorType(INT, value.count)
        power = builder.shl(builder.bitcast(args[1], whole), ir.Constant(whole, [23] * value.count))
        return builder.bitcast(builder.add(builder.bitcast(args[0], whole), power), args[0].type)

    return signature(value, value, value), build


@intrinsic
def total(_typing, value):
    """Sum of the lanes, as a tree."""

    def build(context, builder, sig, args):
        name = f"llvm.vector.reduce.fadd.v{value.count}f32"
        kind = ir.FunctionType(FLOAT, [FLOAT, args[0].type])
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [ir.Constant(FLOAT, 0.0), args[0]], fastmath=["reassoc"])

    return signature(types.float32, value), build


@intrinsic
def spread(_typing, array, index):
    """array.flat[index] in every lane."""

    def build(context, builder, sig, args):
        return broadcast(
            builder, builder.load(address(context, builder, sig.args[0], args[0], args[1], FLOAT))
        )

    return signature(F16, array, types.intp), build


@intrinsic
def exp2(_typing, x):
    """2^x to 1e-7 for x <= 100; 2^-120 below x = -120."""

    def build(context, builder, sig, args):
        whole_numbers = ir.VectorType(INT, 16)
        x = _call(builder, "maxnum", args[0], _constant(-120.0))
        whole = _call(builder, "nearbyint", x)
        f, value = builder.fsub(x, whole), _constant(_EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            value = multiply_add(builder, value, f, _constant(coefficient))
        power = builder.shl(
            builder.fptosi(whole, whole_numbers), ir.Constant(whole_numbers, [23] * 16)
        )
        return builder.bitcast(builder.add(builder.bitcast(value, whole_numbers), power), WIDE)

    return signature(F16, F16), build


@intrinsic
def transpose(_typing, array, source, target, stride):
    """Copy the transposed 16×16 block at `source` to `target`; rows are `stride` apart."""

    def build(context, builder, sig, args):
        array, source, target, stride = args
        offsets = [builder.mul(stride, stride.type(row)) for row in range(16)]
        starts = [builder.add(source, offset) for offset in offsets]
        pointers = [address(context, builder, sig.args[0], array, start, WIDE) for start in starts]
        rows = [builder.load(pointer, align=4) for pointer in pointers]
        for step in (8, 4, 2, 1):  # swap the off-diagonal quarters of ever smaller blocks
            low = [k if k & step == 0 else k - step + 16 for k in range(16)]
            high = [k + step if k & step == 0 else k + 16 for k in range(16)]
            swapped = list(rows)
            for row in range(16):
                if row & step == 0:
                    pair = rows[row], rows[row + step]
                    swapped[row], swapped[row + step] = (
                        shuffle(builder, *pair, low),
                        shuffle(builder, *pair, high),
                    )
            rows = swapped
        for offset, row in zip(offsets, rows, strict=True):
            to = address(context, builder, sig.args[0], array, builder.add(target, offset), WIDE)
            builder.store(row, to, align=4)
        return context.get_dummy_value()

    return signature(types.none, array, types.intp, types.intp, types.intp), build
