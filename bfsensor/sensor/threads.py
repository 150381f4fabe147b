"""Choice of numba's threading layer and number of threads for the kernels.

Blocks of photons last a fraction of a millisecond, and a thread that sleeps takes as long
to wake.  Intel's TBB wakes threads in 2 us and survives a fork, by which GalSim's configuration
starts its processes; GNU OpenMP ends a forked child; numba's own work queue takes 0.1 to 0.25 ms.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
from collections.abc import Iterator

import numba


def _load_tbb() -> bool:
    """Load the library of the package ``tbb``, which is on no search path of the loader."""
    try:
        files = importlib.metadata.files("tbb") or []
    except importlib.metadata.PackageNotFoundError:
        return False
    for file in files:
        if file.name.startswith("libtbb.so"):
            with contextlib.suppress(OSError):
                ctypes.CDLL(str(file.locate()), mode=ctypes.RTLD_GLOBAL)
                return True
    return False


def _choose_layer() -> None:
    """Choose the threading layer, unless the user has chosen one."""
    if numba.config.THREADING_LAYER == "default":
        numba.config.THREADING_LAYER = "tbb" if _load_tbb() else "workqueue"


@contextlib.contextmanager
def threads_to_use(threads: int) -> Iterator[int]:
    """Let numba use some threads within a ``with`` statement.

    Parameters
    ----------
    threads : int
        Number of threads wanted, at least 1.

    Yields
    ------
    threads : int
        Number of threads used, at most as many as numba was started with.
    """
    _choose_layer()
    before = numba.get_num_threads()
    threads = min(threads, numba.config.NUMBA_NUM_THREADS)
    numba.set_num_threads(threads)
    # Pieces are handed out one by one, so that a thread that is done takes the next one.
    chunk = numba.set_parallel_chunksize(1)
    try:
        yield threads
    finally:
        numba.set_parallel_chunksize(chunk)
        numba.set_num_threads(before)
