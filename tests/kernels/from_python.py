"""Kernels that only other kernels call, for tests to call them from Python."""

from types import FunctionType

import numba


def from_python(kernel):
    """Compile a kernel with the code to call it from Python, which it has not by itself."""
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
