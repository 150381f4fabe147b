"""Inner loops on plain arrays, compiled by numba; imports numpy and numba only."""

# The log says when numba compiles, and numba is not interrupted.
from bfsensor._kernels import notice as _notice  # noqa: F401
from bfsensor._kernels import paused_collection as _paused_collection  # noqa: F401
