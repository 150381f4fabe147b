"""Choice of numba's threading layer and number of threads for the kernels.

Blocks of photons last a fraction of a millisecond, and a thread that sleeps takes as long
to wake.  Intel's TBB wakes threads in 2 us and survives a fork, by which GalSim's configuration
starts its processes; GNU OpenMP ends a forked child; numba's own work queue takes 0.1 to 0.25 ms.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import threading
from collections.abc import Iterator

import galsim
import numba

_BUSY = threading.Lock()
"""Held while kernels run on several threads: numba's own work queue ends a process that starts
them from two Python threads at once."""


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


MANY = 2**18
"""Number of photons of a call from which on more than one thread is used by default.

Chosen: fewer land in 6 ms on one thread, while the kernel for several takes half a minute to compile,
once; twice as large, two threads gain at most 6 ms less."""


def count_threads(threads: int | None, photons: int) -> int:
    """Return a number of threads, by default that of GalSim's OpenMP for a call of many photons.

    Parameters
    ----------
    threads : int, optional
        Number of threads; None: what ``galsim.get_omp_threads()`` says now, which is 1 in the
        processes that GalSim's configuration starts.

    photons : int
        Number of photons of the call; with less than :data:`MANY` the default is 1.

    Returns
    -------
    threads : int
        At least 1.
    """
    if threads is not None:
        return threads
    return max(int(galsim.get_omp_threads()), 1) if photons >= MANY else 1


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
        Number of threads used, at most as many as numba was started with; 1 while another Python
        thread uses several.
    """
    if min(threads, numba.config.NUMBA_NUM_THREADS) < 2 or not _BUSY.acquire(
        blocking=False
    ):
        yield 1
        return
    try:
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
    finally:
        _BUSY.release()
