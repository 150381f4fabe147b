"""Number of threads of a call."""

from __future__ import annotations

import galsim

MANY = 2**16
"""Number of photons of a call from which on more than one thread is used by default.

Chosen: fewer take 1.5 ms on one thread, where 0.1 ms are needed to start another; twice as large, a call
of as many photons takes up to 1 ms longer."""


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
