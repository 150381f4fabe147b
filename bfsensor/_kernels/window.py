"""Vector code for the innermost sum of the sensor: weights times the charges in a pixel window.

LLVM does not vectorise these short rows by itself; written out with vectors of eight
floats the sum is four times as fast.  Eight partial sums are added pairwise, always in
the same order.
"""

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_EIGHT = ir.VectorType(ir.FloatType(), 8)
"""Type of eight single-precision numbers, by definition what AVX registers of 256 bits hold."""


def _make(blocks, streams):
    """Make the sums over rows of ``8 blocks`` lanes for several sets of weights at once."""
    lanes = 8 * blocks

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
            w = context.make_array(sig.args[0])(context, builder, args[0]).data
            c = context.make_array(sig.args[3])(context, builder, args[3]).data
            zero = ir.Constant(_EIGHT, [0.0] * 8)
            sums = [
                [cgutils.alloca_once_value(builder, zero) for _ in range(blocks)]
                for _ in range(streams)
            ]
            firsts = [args[1]]
            for _ in range(1, streams):
                firsts.append(builder.add(firsts[-1], args[2]))

            def load(pointer, index):
                at = builder.bitcast(builder.gep(pointer, [index]), _EIGHT.as_pointer())
                value = builder.load(at)
                value.align = 4
                return value

            with cgutils.for_range(builder, args[6], intp=wide) as loop:
                row_w = builder.mul(loop.index, ir.Constant(wide, lanes))
                at_c = builder.add(args[4], builder.mul(loop.index, args[5]))
                for block in range(blocks):
                    offset = ir.Constant(wide, 8 * block)
                    charge = load(c, builder.add(at_c, offset))
                    for stream in range(streams):
                        at_w = builder.add(builder.add(firsts[stream], row_w), offset)
                        product = builder.fmul(load(w, at_w), charge, flags=("contract",))
                        total = builder.fadd(
                            product, builder.load(sums[stream][block]), flags=("contract",)
                        )
                        builder.store(total, sums[stream][block])
            results = [_total(builder, stream) for stream in sums]
            if streams == 1:
                return results[0]
            return context.make_tuple(builder, sig.return_type, results)

        return signature, codegen

    return compiled


def _total(builder, blocks):
    """Add eight lanes pairwise."""
    narrow = ir.IntType(32)
    total = builder.load(blocks[0])
    for block in blocks[1:]:
        total = builder.fadd(total, builder.load(block))
    for half in (4, 2, 1):
        undefined = ir.Constant(total.type, ir.Undefined)
        pick = ir.VectorType(narrow, half)
        low = ir.Constant(pick, list(range(half)))
        high = ir.Constant(pick, list(range(half, 2 * half)))
        total = builder.fadd(
            builder.shuffle_vector(total, undefined, low),
            builder.shuffle_vector(total, undefined, high),
        )
    return builder.extract_element(total, ir.Constant(narrow, 0))


sum_8 = _make(1, 1)
"""Sum over rows of 8 lanes: (weights, first, 0, charges, start, stride, rows) -> float32.

``weights`` [rows, 8] from index ``first`` on, ``charges`` from ``start`` on with
``stride`` floats from row to row; flat float32 arrays, indices uint64.  Nothing is
checked: both arrays must hold all that is read.
"""

sum_16 = _make(2, 1)
"""The same with rows of 16 lanes."""

two_sums_8 = _make(1, 2)
"""Two sums with weights ``step`` (third argument) apart; the charges are read once."""

two_sums_16 = _make(2, 2)
"""The same with rows of 16 lanes."""
