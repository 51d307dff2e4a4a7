"""Small dense products, transposes and prefetching for the tiles' kernels, emitted so that sums stay in registers."""

from __future__ import annotations

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import signature

from chebsplat.kernels.simd import FLOAT, INT, WIDE, address, broadcast, intrinsic, multiply_add, shuffle


@intrinsic
def prefetch(_typing, array, index):
    """Ask for the cache line of array.flat[index]."""

    def build(context, builder, sig, args):
        byte = ir.IntType(8).as_pointer()
        pointer = builder.bitcast(address(context, builder, sig.args[0], args[0], args[1], FLOAT), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, INT(0), INT(3), INT(1)])
        return context.get_dummy_value()

    return signature(types.none, array, types.intp), build


@intrinsic
def to_lanes(_typing, out, out_at, a, a_at, a_step):
    """Transpose 16 rows of 4: out.flat[out_at + 16 c + lane] = a.flat[a_at + lane a_step + c] for c < 4."""
    four = ir.VectorType(FLOAT, 4)

    def build(context, builder, sig, args):
        out, out_at, a, a_at, a_step = args
        parts = []
        for lane in range(16):
            at = builder.add(a_at, builder.mul(a_step, a_step.type(lane)))
            parts.append(builder.load(address(context, builder, sig.args[2], a, at, four), align=4))
        while len(parts) > 4:
            n = 2 * parts[0].type.count
            parts = [shuffle(builder, parts[i], parts[i + 1], list(range(n))) for i in range(0, len(parts), 2)]
        for c in (0, 2):
            order = [4 * lane + k for k in (c, c + 1) for lane in range(8)]
            low, high = shuffle(builder, parts[0], parts[1], order), shuffle(builder, parts[2], parts[3], order)
            for k in range(2):
                both = shuffle(builder, low, high, [8 * k + i + j for j in (0, 16) for i in range(8)])
                at = builder.add(out_at, out_at.type(16 * (c + k)))
                builder.store(both, address(context, builder, sig.args[0], out, at, WIDE), align=4)
        return context.get_dummy_value()

    return signature(types.none, out, types.intp, a, types.intp, types.intp), build


@intrinsic
def from_lanes(_typing, out, out_at, out_step, a, a_at):
    """The way back of `to_lanes`: out.flat[out_at + lane out_step + c] = a.flat[a_at + 16 c + lane] for c < 4."""
    four = ir.VectorType(FLOAT, 4)

    def build(context, builder, sig, args):
        out, out_at, out_step, a, a_at = args
        rows = []
        for c in range(4):
            at = builder.add(a_at, a_at.type(16 * c))
            rows.append(builder.load(address(context, builder, sig.args[3], a, at, WIDE), align=4))
        for half in (0, 8):  # lanes half .. half + 7, as (lane, c mod 2)
            order = [half + lane + k for lane in range(8) for k in (0, 16)]
            even, odd = shuffle(builder, rows[0], rows[1], order), shuffle(builder, rows[2], rows[3], order)
            for lane in range(8):
                four_channels = [2 * lane, 2 * lane + 1, 16 + 2 * lane, 17 + 2 * lane]
                at = builder.add(out_at, builder.mul(out_step, out_step.type(half + lane)))
                value = shuffle(builder, even, odd, four_channels)
                builder.store(value, address(context, builder, sig.args[0], out, at, four), align=4)
        return context.get_dummy_value()

    return signature(types.none, out, types.intp, types.intp, a, types.intp), build


@intrinsic(prefer_literal=True)
def multiply(_typing, out, out_at, order, order_at, out_step, a, a_at, a_row, a_step, b, b_at, b_step, depth, rows,
             width, add):  # fmt: skip
    """out[order[i], :width] (+)= Σ_k a[i, k] b[k, :width] for i < rows, k < depth; the sums stay in registers.

    Args: rows, width (4, 8 or 16) and add (0 or 1) are literals. Row i of out is at out_at + order[order_at + i]
      out_step, element (i, k) of a at a_at + i a_row + k a_step, row k of b at b_at + k b_step; depth is at least 1.
    """
    n, wide, adds = rows.literal_value, width.literal_value, add.literal_value
    vector = ir.VectorType(FLOAT, wide)

    def build(context, builder, sig, args):
        out, out_at, order, order_at, out_step, a, a_at, a_row, a_step, b, b_at, b_step, depth = args[:13]
        integer = depth.type
        targets = []
        for i in range(n):
            entry = address(context, builder, sig.args[2], order, builder.add(order_at, integer(i)), integer)
            offset = builder.add(out_at, builder.mul(builder.load(entry), out_step))
            targets.append(address(context, builder, sig.args[0], out, offset, vector))
        start = [builder.load(t, align=4) if adds else ir.Constant(vector, [0.0] * wide) for t in targets]
        before, loop, after = builder.block, builder.append_basic_block("products"), builder.append_basic_block("end")
        builder.branch(loop)
        builder.position_at_end(loop)
        k, sums = builder.phi(integer), [builder.phi(vector) for _ in range(n)]
        row = builder.add(b_at, builder.mul(k, b_step))
        factor = builder.load(address(context, builder, sig.args[9], b, row, vector), align=4)
        column = builder.add(a_at, builder.mul(k, a_step))
        sums_after = []
        for i in range(n):
            offset = builder.add(column, builder.mul(a_row, integer(i)))
            entry = builder.load(address(context, builder, sig.args[5], a, offset, FLOAT))
            sums_after.append(multiply_add(builder, broadcast(builder, entry, wide), factor, sums[i]))
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
