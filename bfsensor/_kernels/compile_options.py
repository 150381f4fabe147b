"""Options of kernels that only other kernels call.

Code by which Python calls a kernel takes numba about as long to compile as the kernel itself.
"""

INNER = {
    "cache": True, "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True,
}  # fmt: skip
"""For kernels without code to call them from Python: such a call would end the process."""

INLINED = {**INNER, "forceinline": True}
"""For small ones, which the compiler copies into their callers.

Unlike ``inline="always"``, by which numba copies them before it finds types, each is typed once."""
