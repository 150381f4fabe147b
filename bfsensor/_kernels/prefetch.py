"""Request for memory that is used soon, so that many places of it are fetched at the same time."""

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _make():
    """Make the request: (array, index) -> None."""
    if numba.config.DISABLE_JIT:
        return lambda array, index: None

    @intrinsic
    def compiled(typingctx, array, index):
        signature = types.void(array, types.int64)

        def codegen(context, builder, sig, args):
            data = context.make_array(sig.args[0])(context, builder, args[0]).data
            byte = ir.IntType(8).as_pointer()
            number = ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
            request = builder.module.globals.get("llvm.prefetch.p0")
            if request is None:
                request = ir.Function(builder.module, kind, "llvm.prefetch.p0")
            place = builder.bitcast(builder.gep(data, [args[1]]), byte)
            # To be read, kept in all caches, data.
            builder.call(request, [place, number(0), number(3), number(1)])
            return context.get_dummy_value()

        return signature, codegen

    return compiled


prefetch = _make()
"""Ask for the memory of an element of a C-contiguous array, by its index in the flat array.

Nothing waits for it, and an index outside the array does no harm."""
