"""Vector code for the innermost sum of the sensor: weights times the charges in a pixel window.

LLVM does not vectorise these short rows by itself; written out with vectors as long as a
row the sum is four times as fast.  Partial sums are added pairwise, always in the same
order.
"""

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def _make(lanes, streams):
    """Make the sums over rows of ``lanes`` (8 or 16) for several sets of weights at once."""
    if numba.config.DISABLE_JIT:

        def plain(weights, first, step, charges, start, stride, rows):
            sums = []
            for k in range(streams):
                total = np.zeros(lanes, np.float32)
                for r in range(int(rows)):
                    w = int(first) + k * int(step) + r * lanes
                    c = int(start) + r * int(stride)
                    total += weights[w : w + lanes] * charges[c : c + lanes]
                sums.append(np.float32(total.sum()))
            return sums[0] if streams == 1 else tuple(sums)

        return plain

    @intrinsic
    def compiled(typingctx, weights, first, step, charges, start, stride, rows):
        whole = types.uint64
        out = types.float32 if streams == 1 else types.UniTuple(types.float32, streams)
        signature = out(weights, whole, whole, charges, whole, whole, whole)

        def codegen(context, builder, sig, args):
            wide = ir.IntType(64)
            row_type = ir.VectorType(ir.FloatType(), lanes)
            w = context.make_array(sig.args[0])(context, builder, args[0]).data
            c = context.make_array(sig.args[3])(context, builder, args[3]).data
            zero = ir.Constant(row_type, [0.0] * lanes)
            sums = [cgutils.alloca_once_value(builder, zero) for _ in range(streams)]
            firsts = [args[1]]
            for _ in range(1, streams):
                firsts.append(builder.add(firsts[-1], args[2]))

            def load(pointer, index):
                at = builder.bitcast(builder.gep(pointer, [index]), row_type.as_pointer())
                value = builder.load(at)
                value.align = 4
                return value

            with cgutils.for_range(builder, args[6], intp=wide) as loop:
                row_w = builder.mul(loop.index, ir.Constant(wide, lanes))
                charge = load(c, builder.add(args[4], builder.mul(loop.index, args[5])))
                for first, total in zip(firsts, sums, strict=True):
                    weight = load(w, builder.add(first, row_w))
                    product = builder.fmul(weight, charge, flags=("contract",))
                    added = builder.fadd(product, builder.load(total), flags=("contract",))
                    builder.store(added, total)
            results = [_total(builder, builder.load(total), lanes) for total in sums]
            if streams == 1:
                return results[0]
            return context.make_tuple(builder, sig.return_type, results)

        return signature, codegen

    return compiled


def _total(builder, total, lanes):
    """Add the lanes pairwise."""
    narrow = ir.IntType(32)
    while lanes > 1:
        lanes //= 2
        undefined = ir.Constant(total.type, ir.Undefined)
        pick = ir.VectorType(narrow, lanes)
        low = ir.Constant(pick, list(range(lanes)))
        high = ir.Constant(pick, list(range(lanes, 2 * lanes)))
        total = builder.fadd(
            builder.shuffle_vector(total, undefined, low),
            builder.shuffle_vector(total, undefined, high),
        )
    return builder.extract_element(total, ir.Constant(narrow, 0))


sum_8 = _make(8, 1)
"""Sum over rows of 8 lanes: (weights, first, 0, charges, start, stride, rows) -> float32.

``weights`` [rows, 8] from index ``first`` on, ``charges`` from ``start`` on with
``stride`` floats from row to row; flat float32 arrays, indices uint64.  Nothing is
checked: both arrays must hold all that is read.
"""

sum_16 = _make(16, 1)
"""The same with rows of 16 lanes."""

two_sums_8 = _make(8, 2)
"""Two sums with weights ``step`` (third argument) apart; the charges are read once."""

two_sums_16 = _make(16, 2)
"""The same with rows of 16 lanes."""


def _make_by_point():
    """Make the sum over a window for 16 points at once, of which each has two weights."""
    if numba.config.DISABLE_JIT:

        def plain(weights, first, charges, start, stride, rows, pairs, out, at):
            at, w = int(at), int(first)
            for r in range(int(rows)):
                for c in range(2 * int(pairs)):
                    charge = charges[int(start) + r * int(stride) + c]
                    out[at : at + 32] += charge * weights[w : w + 32]
                    w += 32

        return plain

    @intrinsic
    def compiled(typingctx, weights, first, charges, start, stride, rows, pairs, out, at):
        whole = types.uint64
        signature = types.void(
            weights, whole, charges, whole, whole, whole, whole, out, whole
        )

        def codegen(context, builder, sig, args):
            wide = ir.IntType(64)
            points = ir.VectorType(ir.FloatType(), 16)
            w, c, o = (
                context.make_array(sig.args[n])(context, builder, args[n]).data
                for n in (0, 2, 7)
            )

            def whole_number(number):
                return ir.Constant(wide, number)

            def pointer(array, index):
                return builder.bitcast(builder.gep(array, [index]), points.as_pointer())

            def load(array, index):
                value = builder.load(pointer(array, index))
                value.align = 4
                return value

            undefined = ir.Constant(points, ir.Undefined)
            all_first = ir.Constant(ir.VectorType(ir.IntType(32), 16), [0] * 16)
            zero = ir.Constant(points, [0.0] * 16)
            # Even and odd columns apart: each sum waits for its last addition.
            sums = [cgutils.alloca_once_value(builder, zero) for _ in range(4)]
            size_w = builder.mul(args[6], whole_number(64))
            with cgutils.for_range(builder, args[5], intp=wide) as row:
                row_w = builder.add(args[1], builder.mul(row.index, size_w))
                row_c = builder.add(args[3], builder.mul(row.index, args[4]))
                with cgutils.for_range(builder, args[6], intp=wide) as pair:
                    at_w = builder.add(row_w, builder.mul(pair.index, whole_number(64)))
                    at_c = builder.add(row_c, builder.mul(pair.index, whole_number(2)))
                    for n in (0, 1):
                        charge = builder.load(
                            builder.gep(c, [builder.add(at_c, whole_number(n))])
                        )
                        charge = builder.insert_element(
                            undefined, charge, ir.Constant(ir.IntType(32), 0)
                        )
                        charge = builder.shuffle_vector(charge, undefined, all_first)
                        for m in (0, 1):
                            total = sums[2 * n + m]
                            weight = load(
                                w, builder.add(at_w, whole_number(32 * n + 16 * m))
                            )
                            product = builder.fmul(weight, charge, flags=("contract",))
                            builder.store(
                                builder.fadd(
                                    product, builder.load(total), flags=("contract",)
                                ),
                                total,
                            )
            for m in (0, 1):
                place = builder.add(args[8], whole_number(16 * m))
                total = builder.fadd(builder.load(sums[m]), builder.load(sums[2 + m]))
                total = builder.fadd(total, load(o, place))
                builder.store(total, pointer(o, place)).align = 4
            return context.get_dummy_value()

        return signature, codegen

    return compiled


add_16_points = _make_by_point()
"""Add to 16 points' shifts: (weights, first, charges, start, stride, rows, pairs, out, at).

``weights`` [rows, 2 pairs, 2, 16] from index ``first`` on, ``charges`` as for :func:`sum_8`;
``out`` [2, 16] from index ``at`` on is changed.  All flat float32 arrays, indices uint64.
"""


def _make_by_kernel():
    """Make the sums over the windows around 16 pixels of a row for eight sets of weights at once."""
    if numba.config.DISABLE_JIT:

        def plain(weights, first, charges, start, stride, rows, columns, out):
            w = int(first)
            for r in range(int(rows)):
                for c in range(int(columns)):
                    at = int(start) + r * int(stride) + c
                    out += weights[w : w + 8, None] * charges[at : at + 16]
                    w += 8

        return plain

    @intrinsic
    def compiled(typingctx, weights, first, charges, start, stride, rows, columns, out):
        whole = types.uint64
        signature = types.void(weights, whole, charges, whole, whole, whole, whole, out)

        def codegen(context, builder, sig, args):
            wide = ir.IntType(64)
            number = context.get_value_type(sig.args[0].dtype)
            pixels = ir.VectorType(number, 16)
            single = ir.VectorType(ir.FloatType(), 16)
            w, c, o = (
                context.make_array(sig.args[n])(context, builder, args[n]).data
                for n in (0, 2, 7)
            )
            places = [
                builder.bitcast(
                    builder.gep(o, [ir.Constant(wide, 16 * k)]), pixels.as_pointer()
                )
                for k in range(8)
            ]

            def load(pointer, align):
                value = builder.load(pointer)
                value.align = align
                return value

            align = context.get_abi_sizeof(number)
            sums = [
                cgutils.alloca_once_value(builder, load(place, align)) for place in places
            ]
            undefined = ir.Constant(pixels, ir.Undefined)
            all_first = ir.Constant(ir.VectorType(ir.IntType(32), 16), [0] * 16)
            size_w = builder.mul(args[6], ir.Constant(wide, 8))
            with cgutils.for_range(builder, args[5], intp=wide) as row:
                row_w = builder.add(args[1], builder.mul(row.index, size_w))
                row_c = builder.add(args[3], builder.mul(row.index, args[4]))
                with cgutils.for_range(builder, args[6], intp=wide) as column:
                    at = builder.gep(c, [builder.add(row_c, column.index)])
                    charge = load(builder.bitcast(at, single.as_pointer()), 4)
                    if number != ir.FloatType():
                        charge = builder.fpext(charge, pixels)
                    at_w = builder.add(
                        row_w, builder.mul(column.index, ir.Constant(wide, 8))
                    )
                    for k, total in enumerate(sums):
                        weight = builder.load(
                            builder.gep(w, [builder.add(at_w, ir.Constant(wide, k))])
                        )
                        weight = builder.insert_element(
                            undefined, weight, ir.Constant(ir.IntType(32), 0)
                        )
                        weight = builder.shuffle_vector(weight, undefined, all_first)
                        product = builder.fmul(weight, charge, flags=("contract",))
                        added = builder.fadd(
                            product, builder.load(total), flags=("contract",)
                        )
                        builder.store(added, total)
            for total, place in zip(sums, places, strict=True):
                builder.store(builder.load(total), place).align = align
            return context.get_dummy_value()

        return signature, codegen

    return compiled


add_8_kernels = _make_by_kernel()
"""Add to 16 pixels' sums by 8 kernels: (weights, first, charges, start, stride, rows, columns, out).

``weights`` [rows, columns, 8] flat from index ``first`` on, of single or double precision as ``out``
[8, 16], which is changed; ``charges`` float32, flat, from ``start`` on with ``stride`` from row to row.
15 charges beyond the window of the last pixel that counts are read as well.  Indices are uint64.
"""
