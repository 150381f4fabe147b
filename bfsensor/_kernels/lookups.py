"""Reads and writes of arrays in loops that look numbers up in tables.

A loop that reads a table at places that depend on the data becomes vector code only if the compiler
knows that nothing it writes is in the table.  These functions promise that: what :func:`looked_up`
reads, :func:`put` must not write in the same loop, and all other reads there are by :func:`get`.
Indices are not checked, and negative ones do not count from the end.
"""

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


def _mark(builder, instruction, kind):
    """Mark a read or write as one of tables or of other arrays, as C compilers mark types."""
    module, zero = builder.module, ir.Constant(ir.IntType(64), 0)
    node = module.add_metadata([kind, module.add_metadata(["bfsensor"]), zero])
    instruction.set_metadata("tbaa", module.add_metadata([node, node, zero]))


def _address(context, builder, signature, args):
    """Address of an array's number."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return builder.gep(array.data, [args[1]])


def _contiguous(array):
    return isinstance(array, types.Array) and array.ndim == 1 and array.layout == "C"


def _reader(kind):
    def read(typing_context, array, index):
        """Number of a contiguous array of one dimension; no other is compiled."""
        if not _contiguous(array):
            return None

        def generate(context, builder, signature, args):
            value = builder.load(_address(context, builder, signature, args))
            _mark(builder, value, kind)
            return value

        return array.dtype(array, types.int64), generate

    return read


def _write(typing_context, array, index, value):
    """Write a number to a contiguous array of one dimension; no other is compiled."""
    if not _contiguous(array):
        return None

    def generate(context, builder, signature, args):
        store = builder.store(args[2], _address(context, builder, signature, args))
        _mark(builder, store, "array")
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), generate


if numba.config.DISABLE_JIT:

    def get(array, index):
        return array[index]

    def put(array, index, value):
        array[index] = value

    looked_up = get
else:
    get = intrinsic(_reader("array"))
    put = intrinsic(_write)
    looked_up = intrinsic(_reader("table"))
