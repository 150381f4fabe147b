"""``min`` and ``max`` of two numbers for kernels, in place of Python's, with the same results.

Of Python's, numba compiles one function for each pair of types, 50 ms each and some 25 of them for a
sensor; here each use is a few instructions of the kernel that it stands in.
"""

import builtins

import numba
from numba.core import types
from numba.extending import intrinsic


def _choose(sign):
    """Function for numba that gives the second of two numbers if it is ``sign`` (< or >) the first."""

    def choose(typing_context, first, second):
        """Smaller or larger of two numbers, of the type that holds both; the first if neither is."""
        number = typing_context.unify_types(types.unliteral(first), types.unliteral(second))
        if not isinstance(number, types.Integer | types.Float):
            return None

        def generate(context, builder, signature, args):
            a, b = (
                context.cast(builder, value, kind, number)
                for value, kind in zip(args, signature.args, strict=True)
            )
            if isinstance(number, types.Float):
                better = builder.fcmp_ordered(sign, b, a)
            elif number.signed:
                better = builder.icmp_signed(sign, b, a)
            else:
                better = builder.icmp_unsigned(sign, b, a)
            return builder.select(better, b, a)

        return number(first, second), generate

    return choose


if numba.config.DISABLE_JIT:
    min, max = builtins.min, builtins.max
else:
    min, max = intrinsic(_choose("<")), intrinsic(_choose(">"))
