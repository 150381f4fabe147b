"""Options of kernels that only other kernels call, and how tests call them.

Code by which Python calls a kernel takes numba about as long to compile as the kernel itself.
"""

from types import FunctionType

import numba

from bfsensor._kernels.inner_compiler import EntryCompiler, InnerCompiler

ENTRY = {
    "cache": True, "nogil": True, "_nrt": False, "no_cfunc_wrapper": True,
    "error_model": "numpy", "pipeline_class": EntryCompiler,
}  # fmt: skip
"""For kernels that Python calls.  Divisions by zero give inf, nan or 0, as numpy's do, without code
that raises errors."""

INNER = {
    "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
    "error_model": "numpy", "pipeline_class": InnerCompiler,
}  # fmt: skip
"""For kernels without code to call them from Python: such a call raises an error.

Their code is made by the kernels that Python calls, and kept with these alone."""

INLINED = {**INNER, "forceinline": True}
"""For small ones, which the compiler copies into their callers; each is typed once."""


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
