"""Options of kernels that only other kernels call, and how tests call them.

Code by which Python calls a kernel takes numba about as long to compile as the kernel itself.
"""

from types import FunctionType

import numba

INNER = {
    "cache": True, "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
}  # fmt: skip
"""For kernels without code to call them from Python: such a call would end the process."""

INLINED = {**INNER, "forceinline": True}
"""For small ones, which the compiler copies into their callers.

Unlike ``inline="always"``, by which numba copies them before it finds types, each is typed once."""


def from_python(kernel):
    """Compile a kernel with the code to call it from Python, for tests and checks."""
    if numba.config.DISABLE_JIT:
        return kernel
    own = kernel.py_func
    # Under a name of its own: numba's cache knows functions by name and line.
    twin = FunctionType(own.__code__, own.__globals__, f"{own.__name__}_from_python")
    twin.__qualname__, twin.__module__ = twin.__name__, own.__module__
    options = {
        name: kernel.targetoptions[name]
        for name in ("_nrt", "error_model")
        if name in kernel.targetoptions
    }
    return numba.njit(cache=True, **options)(twin)
