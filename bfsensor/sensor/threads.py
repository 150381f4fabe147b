"""Which threads numba runs loops on.

Blocks of photons last a fraction of a millisecond, and a thread that sleeps takes as long
to wake.  Intel's TBB wakes threads in 2 us and survives a fork, as GalSim's configuration
makes them; GNU OpenMP ends a forked child; numba's own work queue takes 0.1 to 0.25 ms.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
from collections.abc import Iterator

import numba


def _load_tbb() -> bool:
    """Load the library of the package ``tbb``, which no search path knows of."""
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
    """Choose the threading layer, unless it has been chosen elsewhere."""
    if numba.config.THREADING_LAYER == "default":
        numba.config.THREADING_LAYER = "tbb" if _load_tbb() else "workqueue"


@contextlib.contextmanager
def threads_to_use(threads: int) -> Iterator[int]:
    """Let numba use so many threads, or as many as there are; gives their number."""
    _choose_layer()
    before = numba.get_num_threads()
    threads = min(threads, numba.config.NUMBA_NUM_THREADS)
    numba.set_num_threads(threads)
    # A thread that is done takes the next piece.
    chunk = numba.set_parallel_chunksize(1)
    try:
        yield threads
    finally:
        numba.set_parallel_chunksize(chunk)
        numba.set_num_threads(before)
