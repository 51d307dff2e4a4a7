"""Sixteen float32 at once, for kernels whose speed cannot be left to the compiler's vectoriser.

`f32x16` is a numba type; the functions here are instructions on it and on flat float32 arrays. An array argument is
contiguous, an index counts its elements and is not checked. LLVM splits a vector where the machine's are shorter, so
the results do not depend on the width; only a machine without fused multiply-add rounds differently.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model

instruction: Any = intrinsic
N_LANES = 16
_FLOATS = ir.VectorType(ir.FloatType(), N_LANES)
_INTS = ir.VectorType(ir.IntType(32), N_LANES)
# 2^f on [-½, ½] to 2e-8, by Chebyshev interpolation
_nodes = 0.5 * np.cos((np.arange(7) + 0.5) * np.pi / 7)
_EXP2 = np.polynomial.polynomial.polyfit(_nodes, 2.0**_nodes, 6)
_EXP2[0] = 1.0  # 2^0 is 1


class _Vector(types.Type):
    def __init__(self) -> None:
        super().__init__(name="f32x16")


f32x16 = _Vector()


@register_model(_Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _FLOATS)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [float(np.float32(value))] * N_LANES)


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _spread(builder: Any, scalar: Any) -> Any:
    first = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_INTS, [0] * N_LANES))


def _call(builder: Any, name: str, *values: Any) -> Any:
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * len(values))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{N_LANES}f32")
    return builder.call(function, values)


@instruction
def load(typing: Any, array: Any, index: Any) -> Any:
    """array[index : index + 16]."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], *args)
        return builder.load(builder.bitcast(address, _FLOATS.as_pointer()), align=4)

    return f32x16(array, types.intp), emit


@instruction
def store(typing: Any, array: Any, index: Any, vector: Any) -> Any:
    """array[index : index + 16] = vector."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], *args[:2])
        builder.store(args[2], builder.bitcast(address, _FLOATS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, f32x16), emit


@instruction
def spread(typing: Any, array: Any, index: Any) -> Any:
    """array[index] in every lane."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(builder, builder.load(_address(context, builder, signature.args[0], *args)))

    return f32x16(array, types.intp), emit


@instruction
def fill(typing: Any, value: Any) -> Any:
    """A float32 in every lane."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return f32x16(types.float32), emit


@instruction
def add(typing: Any, a: Any, b: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(*args)

    return f32x16(f32x16, f32x16), emit


@instruction
def sub(typing: Any, a: Any, b: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fsub(*args)

    return f32x16(f32x16, f32x16), emit


@instruction
def mul(typing: Any, a: Any, b: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(*args)

    return f32x16(f32x16, f32x16), emit


@instruction
def fma(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c, rounded once where the machine can."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _call(builder, "fmuladd", *args)

    return f32x16(f32x16, f32x16, f32x16), emit


@instruction
def exp2(typing: Any, x: Any) -> Any:
    """2^x to 1e-7 for x <= 100; 2^-120 below x = -120."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x = _call(builder, "maxnum", args[0], _constant(-120.0))
        whole = _call(builder, "nearbyint", x)
        f = builder.fsub(x, whole)
        value = _constant(_EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            value = _call(builder, "fmuladd", value, f, _constant(coefficient))
        power = builder.shl(builder.fptosi(whole, _INTS), ir.Constant(_INTS, [23] * N_LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, _INTS), power), _FLOATS)

    return f32x16(f32x16), emit


@instruction
def total(typing: Any, vector: Any) -> Any:
    """Sum of the lanes, halves first."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = args[0]
        for half in (8, 4, 2, 1):
            moved = ir.Constant(_INTS, [(lane + half) % N_LANES for lane in range(N_LANES)])
            value = builder.fadd(value, builder.shuffle_vector(value, value, moved))
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(f32x16), emit


@instruction
def transpose(typing: Any, array: Any, source: Any, target: Any, stride: Any) -> Any:
    """Copy the transpose of the 16×16 block that begins at `source` to the one at `target`; rows are `stride` apart."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, source, target, stride = args
        rows = []
        for row in range(N_LANES):
            index = builder.add(source, builder.mul(stride, ir.Constant(stride.type, row)))
            address = _address(context, builder, signature.args[0], array, index)
            rows.append(builder.load(builder.bitcast(address, _FLOATS.as_pointer()), align=4))
        for step in (8, 4, 2, 1):  # swap the off-diagonal quarters of ever smaller blocks
            low = [k if k & step == 0 else k - step + N_LANES for k in range(N_LANES)]
            high = [k + step if k & step == 0 else k + N_LANES for k in range(N_LANES)]
            swapped = list(rows)
            for row in range(N_LANES):
                if row & step == 0:
                    pair = rows[row], rows[row + step]
                    swapped[row] = builder.shuffle_vector(*pair, ir.Constant(_INTS, low))
                    swapped[row + step] = builder.shuffle_vector(*pair, ir.Constant(_INTS, high))
            rows = swapped
        for row in range(N_LANES):
            index = builder.add(target, builder.mul(stride, ir.Constant(stride.type, row)))
            address = _address(context, builder, signature.args[0], array, index)
            builder.store(rows[row], builder.bitcast(address, _FLOATS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, types.intp), emit
