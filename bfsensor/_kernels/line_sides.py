"""Values of boundary lines at points on the sides of pixels."""

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy")
def values_on_sides(lines, along, ends, points, out):
    """Interpolate lines linearly at points on each side between two ends.

    ``lines`` (n, seeds, 2) are ordered by the coordinate ``along``; ``ends`` (n, sides + 1) are the
    corners on it, and ``points`` parts of a side.  Of a line only seeds between two corners count on
    that side, its outermost ones up to the corners: ``out`` (n, sides, points) gets the other
    coordinate.  Returns line and side of the first side without a seed, or -1.
    """
    across = 1 - along
    for n in range(lines.shape[0]):
        at = lines[n, :, along]
        for p in range(ends.shape[1] - 1):
            a = np.searchsorted(at, ends[n, p])
            b = np.searchsorted(at, ends[n, p + 1])
            if a >= b:
                return n, p
            k = a
            for m in range(points.size):
                x = ends[n, p] + (ends[n, p + 1] - ends[n, p]) * points[m]
                if x <= at[a]:
                    out[n, p, m] = lines[n, a, across]
                    continue
                if x >= at[b - 1]:
                    out[n, p, m] = lines[n, b - 1, across]
                    continue
                while x > at[k + 1]:
                    k += 1
                slope = (lines[n, k + 1, across] - lines[n, k, across]) / (
                    at[k + 1] - at[k]
                )
                out[n, p, m] = lines[n, k, across] + slope * (x - at[k])
    return -1, -1
