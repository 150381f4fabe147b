"""Inner loops on plain arrays, compiled by numba; imports numpy and numba only."""

from bfsensor._kernels import notice as _notice  # noqa: F401  the log says when numba compiles
