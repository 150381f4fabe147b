"""Numbers that threads share: reads, writes and exchanges that happen at once and in order.

They act on one element of a contiguous array of int64.  What a thread wrote to any memory before
:func:`publish`, :func:`add` or :func:`exchange` another one finds there after it has read the new number
by :func:`observe`, :func:`add` or :func:`exchange`.
"""

import os

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

_WORD = types.Array(types.int64, 1, "C")
"""Type of the arrays, by definition: contiguous, of int64."""


def _place(context, builder, signature, args):
    """Address of an element."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return builder.gep(array.data, [args[1]])


def _observe(typing_context, array, index):
    """Read a number."""

    def generate(context, builder, signature, args):
        return builder.load_atomic(_place(context, builder, signature, args), "acquire", 8)

    return types.int64(_WORD, types.int64), generate


def _publish(typing_context, array, index, value):
    """Write a number."""

    def generate(context, builder, signature, args):
        place = _place(context, builder, signature, args)
        builder.store_atomic(args[2], place, "release", 8)
        return context.get_dummy_value()

    return types.void(_WORD, types.int64, types.int64), generate


def _add(typing_context, array, index, value):
    """Add to a number; returns what it was before."""

    def generate(context, builder, signature, args):
        place = _place(context, builder, signature, args)
        return builder.atomic_rmw("add", place, args[2], "acq_rel")

    return types.int64(_WORD, types.int64, types.int64), generate


def _exchange(typing_context, array, index, old, new):
    """Replace a number if it is ``old``; returns whether it was."""

    def generate(context, builder, signature, args):
        place = _place(context, builder, signature, args)
        found = builder.cmpxchg(place, args[2], args[3], "acq_rel", "acquire")
        return builder.extract_value(found, 1)

    return types.boolean(_WORD, types.int64, types.int64, types.int64), generate


def _give_way(typing_context):
    """Let another thread run on this core, if one waits for it."""

    def generate(context, builder, signature, args):
        name = "SwitchToThread" if os.name == "nt" else "sched_yield"
        kind = ir.FunctionType(ir.IntType(32), [])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [])
        return context.get_dummy_value()

    return types.void(), generate


if numba.config.DISABLE_JIT:

    def observe(array, index):
        return array[index]

    def publish(array, index, value):
        array[index] = value

    def add(array, index, value):
        before = array[index]
        array[index] += value
        return before

    def exchange(array, index, old, new):
        same = array[index] == old
        if same:
            array[index] = new
        return same

    def give_way():
        pass
else:
    observe, publish = intrinsic(_observe), intrinsic(_publish)
    add, exchange, give_way = intrinsic(_add), intrinsic(_exchange), intrinsic(_give_way)
