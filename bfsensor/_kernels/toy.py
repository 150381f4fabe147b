"""Toy model: random darts at pixels whose areas follow the charge, one electron after the other.

Random words are counted (:mod:`bfsensor._kernels.counter_rng`) by dart and realisation, so
that a realisation is the same whatever others are thrown with it.  Chances are compared
with whole words: an error below 2^-32 for each dart.
"""

import numba
import numpy as np

from bfsensor._kernels.counter_rng import philox

LANES = 64
"""Number of realisations that are computed side by side, so that the compiler makes vector code.

Chosen: a multiple of all vector lengths; twice as large gives the same bits."""

_HALF = 2147483648.0
"""Exact: 2^31, half the range of a random word, below which it lies with probability 1/2."""


@numba.njit(cache=True, inline="always")
def _dart(word, left, alpha, difference):
    """Difference of the charges after one more dart, if one is left."""
    step = 1.0 if word < _HALF * (1.0 - alpha * difference) else -1.0
    return difference + (step if left > 0 else 0.0)


@numba.njit(cache=True, nogil=True)
def throw_pair(alpha, darts, key0, key1, out):
    """Throw ``darts[r]`` darts at two pixels with a moving partition.

    Parameters
    ----------
    alpha : float
        Area that a pixel loses for one electron more than the other has [1/e-].
    darts : int64 array, shape (realisations,)
        Electrons that fall on the pair.
    key0, key1 : uint32
        Key of the random words; the counter is (dart // 4, realisation, 0, 0).
    out : float64 array, shape (realisations,)
        Set to the difference of the charges, first less second [e-].

    Returns
    -------
    largest : float
        Largest absolute difference met [e-]; above ``1 / alpha`` a pixel had no area.
    """
    difference, peak = np.zeros(LANES), np.zeros(LANES)
    largest = 0.0
    for start in range(0, darts.size, LANES):
        lanes = min(LANES, darts.size - start)
        difference[:] = 0.0
        peak[:] = 0.0
        most = np.int64(0)
        for r in range(lanes):
            most = max(most, darts[start + r])
        for block in range((most + 3) // 4):
            c0 = np.uint32(block)
            for r in range(lanes):
                a, b, c, d = philox(
                    c0, np.uint32(start + r), np.uint32(0), np.uint32(0), key0, key1
                )
                left = darts[start + r] - 4 * block
                x = _dart(a, left, alpha, difference[r])
                y = _dart(b, left - 1, alpha, x)
                z = _dart(c, left - 2, alpha, y)
                last = _dart(d, left - 3, alpha, z)
                peak[r] = max(max(peak[r], abs(x)), max(max(abs(y), abs(z)), abs(last)))
                difference[r] = last
        for r in range(lanes):
            out[start + r] = difference[r]
            largest = max(largest, peak[r])
    return largest


@numba.njit(cache=True, nogil=True)
def throw_array(partners, weights, darts, key0, key1, out):
    """Throw ``darts[r]`` darts at an array whose areas change linearly with the charges.

    A dart picks a pixel, all alike, and stays with half its area as the chance; if not, it
    is thrown again.  So it lands in proportion to the areas, as long as none is above 2.

    Parameters
    ----------
    partners : int64 array, shape (pixels, lags)
        ``partners[p, k]`` is the pixel whose area an electron in p changes.
    weights : float64 array, shape (lags,)
        By how much [1/e-]: fraction of the nominal area.
    darts : int64 array, shape (realisations,)
        Electrons that fall on the array.
    key0, key1 : uint32
        Key of the random words; the counter is (throw // 2, realisation, its upper half, 0).
    out : int32 array, shape (realisations, pixels)
        Set to the charges [e-].

    Returns
    -------
    least, largest : float
        Extremes of the areas of the pixels picked; outside 0 to 2 the charges are wrong.
    """
    pixels, lags = partners.shape
    areas = np.empty(pixels)
    least, largest = 1.0, 1.0
    for r in range(darts.size):
        areas[:] = 1.0
        out[r, :] = 0
        left = darts[r]
        block = np.uint64(0)
        while left > 0:
            words = philox(
                np.uint32(block & np.uint64(0xFFFFFFFF)),
                np.uint32(r),
                np.uint32(block >> np.uint64(32)),
                np.uint32(0),
                key0,
                key1,
            )
            block += np.uint64(1)
            for half in range(2):
                pick = np.uint64(words[2 * half]) * np.uint64(pixels)
                p = np.int64(pick >> np.uint64(32))
                area = areas[p]
                least = min(least, area)
                largest = max(largest, area)
                if left > 0 and words[2 * half + 1] < _HALF * area:
                    left -= 1
                    out[r, p] += 1
                    for k in range(lags):
                        areas[partners[p, k]] += weights[k]
        if least < 0.0 or largest > 2.0:
            break
    return least, largest
