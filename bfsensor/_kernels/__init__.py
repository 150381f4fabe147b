"""Inner loops on plain arrays, compiled by numba; imports numpy and numba only."""

# The log says when numba compiles, numba is not interrupted, and finds a place for its code.
from bfsensor._kernels import notice as _notice  # noqa: F401
from bfsensor._kernels import paused_collection as _paused_collection  # noqa: F401
from bfsensor._kernels.code_folder import find_code_folder as _find_code_folder

_find_code_folder()
