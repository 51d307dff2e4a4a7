"""Blocks of the tiles' kernels: a queue, prefetching, products and transposes in registers."""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import signature

from chebsplat.kernels.simd import (
    FLOAT,
    INT,
    WIDE,
    address,
    broadcast,
    intrinsic,
    multiply_add,
    shuffle,
)

LONG = ir.IntType(64)


@intrinsic
def claim(_typing, counter):
    """The next number of a shared counter i64 [1]; each goes to one thread alone."""

    def build(context, builder, sig, args):
        place = address(
            context, builder, sig.args[0], args[0], context.get_constant(types.intp, 0), LONG
        )
        return builder.atomic_rmw("add", place, LONG(1), "monotonic")

    return signature(types.int64, counter), build


@intrinsic
def prefetch(_typing, array, index):
    """Ask for the cache line of array.flat[index]."""

    def build(context, builder, sig, args):
        byte = ir.IntType(8).as_pointer()
        pointer = builder.bitcast(
            address(context, builder, sig.args[0], args[0], args[1], FLOAT), byte
        )
        kind = ir.FunctionType(ir.VoidType(), [byte, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, INT(0), INT(3), INT(1)])
        return context.get_dummy_value()

    return signature(types.none, array, types.intp), build


@intrinsic
def to_lanes(_typing, out, out_at, a, a_at, a_step):
    """Transpose 16 rows of 4: out.flat[out_at + 16 c + lane] = a.flat[a_at + lane a_step + c]."""
    four = ir.VectorType(FLOAT, 4)

    def build(context, builder, sig, args):
        out, out_at, a, a_at, a_step = args
        parts = []
        for lane in range(16):
            at = builder.add(a_at, builder.mul(a_step, a_step.type(lane)))
            parts.append(builder.load(address(context, builder, sig.args[2], a, at, four), align=4))
        while len(parts) > 4:
            n = 2 * parts[0].type.count
            parts = [
                shuffle(builder, parts[i], parts[i + 1], list(range(n)))
                for i in range(0, len(parts), 2)
            ]
        for c in (0, 2):
            order = [4 * lane + k for k in (c, c + 1) for lane in range(8)]
            low, high = (
                shuffle(builder, parts[0], parts[1], order),
                shuffle(builder, parts[2], parts[3], order),
            )
            for k in range(2):
                both = shuffle(
                    builder, low, high, [8 * k + i + j for j in (0, 16) for i in range(8)]
                )
                at = builder.add(out_at, out_at.type(16 * (c + k)))
                builder.store(both, address(context, builder, sig.args[0], out, at, WIDE), align=4)
        return context.get_dummy_value()

    return signature(types.none, out, types.intp, a, types.intp, types.intp), build


@intrinsic
def from_lanes(_typing, out, out_at, out_step, a, a_at):
    """Inverse of `to_lanes`: out.flat[out_at + lane out_step + c] = a.flat[a_at + 16 c + lane]."""
    four = ir.VectorType(FLOAT, 4)

    def build(context, builder, sig, args):
        out, out_at, out_step, a, a_at = args
        rows = []
        for c in range(4):
            at = builder.add(a_at, a_at.type(16 * c))
            rows.append(builder.load(address(context, builder, sig.args[3], a, at, WIDE), align=4))
        for first in (0, 8):  # lanes first .. first + 7, as (lane, c mod 2)
            order = [first + lane + k for lane in range(8) for k in (0, 16)]
            even, odd = (
                shuffle(builder, rows[0], rows[1], order),
                shuffle(builder, rows[2], rows[3], order),
            )
            for lane in range(8):
                four_channels = [2 * lane, 2 * lane + 1, 16 + 2 * lane, 17 + 2 * lane]
                at = builder.add(out_at, builder.mul(out_step, out_step.type(first + lane)))
                value = shuffle(builder, even, odd, four_channels)
                builder.store(value, address(context, builder, sig.args[0], out, at, four), align=4)
        return context.get_dummy_value()

    return signature(types.none, out, types.intp, types.intp, a, types.intp), build


@intrinsic
def hits_among(_typing, masks, at, n, bit, first, hits, count):
    """Pack numbers, from `first`, of those masks[at : at + min(n, 16)] that have a bit set into
    hits[count:].

    Args: masks u16, 16 more than n; hits u32, of which 16 from `count` on are written. Returns:
      count after.
    """
    words, flags = ir.VectorType(INT, 16), ir.VectorType(ir.IntType(1), 16)
    narrow = ir.VectorType(ir.IntType(16), 16)

    def filled(builder, scalar):
        one = builder.insert_element(
            ir.Constant(words, ir.Undefined), builder.trunc(scalar, INT), INT(0)
        )
        return shuffle(builder, one, one, [0] * 16)

    def build(context, builder, sig, args):
        masks, at, n, bit, first, hits, count = args
        counted = ir.Constant(words, list(range(16)))
        loaded = builder.load(address(context, builder, sig.args[0], masks, at, narrow), align=2)
        is_set = builder.trunc(
            builder.lshr(loaded, builder.trunc(filled(builder, bit), narrow)), flags
        )
        is_set = builder.and_(is_set, builder.icmp_signed("<", counted, filled(builder, n)))
        kind = ir.FunctionType(words, [words, flags, words])
        compress = cgutils.get_or_insert_function(
            builder.module, kind, "llvm.experimental.vector.compress.v16i32"
        )
        numbers = builder.add(counted, filled(builder, first))
        packed = builder.call(compress, [numbers, is_set, ir.Constant(words, ir.Undefined)])
        builder.store(packed, address(context, builder, sig.args[5], hits, count, words), align=4)
        return builder.add(
            count, builder.zext(builder.ctpop(builder.bitcast(is_set, ir.IntType(16))), count.type)
        )

    at = types.intp
    return signature(at, masks, at, at, at, at, hits, at), build


@intrinsic(prefer_literal=True)
def multiply(_typing, out, out_at, order, order_at, out_step, a, a_at, a_row, a_step, by, by_at,
             by_kind, b, b_at, b_step, depth, rows, width, add):  # fmt: skip
    """out[order[i], :width] (+)= Σ_k a[i, k] b[k, :width] for i < rows, k < depth; the sums stay in
    registers.

    Args: by_kind, rows, width (4, 8 or 16) and add (0 or 1) are literals. Row i of out is at out_at
      + order[order_at + i] out_step, element (i, k) of a at a_at + i a_row + k a_step, row k of b
      at b_at + k b_step; depth is at least 1. Where a is read, by[by_at + i] stands for i if
      by_kind is 1, by[by_at + k] for k if it is 2.
    """
    n, wide, adds, kind = (
        rows.literal_value,
        width.literal_value,
        add.literal_value,
        by_kind.literal_value,
    )
    vector = ir.VectorType(FLOAT, wide)

    def build(context, builder, sig, args):
        (
            out,
            out_at,
            order,
            order_at,
            out_step,
            a,
            a_at,
            a_row,
            a_step,
            by,
            by_at,
            _,
            b,
            b_at,
            b_step,
            depth,
        ) = args[:16]
        integer = depth.type

        def entry(kind, array, at):
            value = builder.load(
                address(context, builder, kind, array, at, context.get_value_type(kind.dtype))
            )
            return value if value.type == integer else builder.zext(value, integer)

        targets, starts = [], []
        for i in range(n):
            number = entry(sig.args[2], order, builder.add(order_at, integer(i)))
            offset = builder.add(out_at, builder.mul(number, out_step))
            targets.append(address(context, builder, sig.args[0], out, offset, vector))
            row = (
                entry(sig.args[9], by, builder.add(by_at, integer(i))) if kind == 1 else integer(i)
            )
            starts.append(builder.add(a_at, builder.mul(a_row, row)))
        start = [
            builder.load(t, align=4) if adds else ir.Constant(vector, [0.0] * wide) for t in targets
        ]
        before, loop, after = (
            builder.block,
            builder.append_basic_block("products"),
            builder.append_basic_block("end"),
        )
        builder.branch(loop)
        builder.position_at_end(loop)
        k, sums = builder.phi(integer), [builder.phi(vector) for _ in range(n)]
        row = builder.add(b_at, builder.mul(k, b_step))
        factor = builder.load(address(context, builder, sig.args[12], b, row, vector), align=4)
        column = builder.mul(
            entry(sig.args[9], by, builder.add(by_at, k)) if kind == 2 else k, a_step
        )
        sums_after = []
        for i in range(n):
            where = builder.add(starts[i], column)
            value = builder.load(address(context, builder, sig.args[5], a, where, FLOAT))
            sums_after.append(
                multiply_add(builder, broadcast(builder, value, wide), factor, sums[i])
            )
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

    at, sizes = types.intp, (rows, width, add)
    return signature(
        types.none, out, at, order, at, at, a, at, at, at, by, at, by_kind, b, at, at, at, *sizes
    ), build
