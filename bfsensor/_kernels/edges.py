"""Assignment of electrons to pixels by the displaced boundaries, evaluated where they land.

Boundaries are not stored.  The shift of a point of an edge is the sum of weights times
effective charges in a window of pixels around the edge; edges are polylines through their
displaced points.

Most electrons are further from any edge than edges can move (``margins``, a bound from
the range of charges nearby) and stay in the pixel they land in.  Next to an edge the
normal shift of the nearest point decides, unless the electron is closer than the error of
that shift (``Edges.doubts``, a bound as well); then the polyline itself decides.  The result is
that of the polylines in all cases.

Lines are numbered as in :mod:`bfsensor._kernels.shifts`.
"""

import numba
import numpy as np

from bfsensor._kernels.compile_options import INLINED, INNER
from bfsensor._kernels.hot import decide_hot
from bfsensor._kernels.shifts import (
    NORMAL,
    TANGENTIAL,
    find_layer,
    grid,
    point_shift,
    scale_at,
    shift_of,
)


@numba.njit(**INNER)
def _crossing(weights, sums, points, nearest, first, second, g, upright, layer, part, line,
              along, limit, scale, low_first, low_second):  # fmt: skip
    """Normal shift [pixel] of the polyline ``line`` where it passes ``along`` [pixel].

    The edges of a line follow one another; the search starts where the tangential shift of
    the nearest point suggests and goes to the segment whose displaced ends enclose
    ``along``.
    """
    last = points.size - 1
    bins = nearest.size
    other = min(max(int(np.floor(along)), -1), limit)
    point = nearest[np.uint64(min(max(int((along - other) * bins), 0), bins - 1))]
    moved = along - scale * shift_of(
        weights, sums, first, second, g, upright,
        layer + np.int64(part > np.float32(0.5)), point, TANGENTIAL, line, other, low_first,
        low_second,
    )  # fmt: skip
    other = min(max(int(np.floor(moved)), -1), limit)
    low = nearest[np.uint64(min(max(int((moved - other) * bins), 0), bins - 1))]
    low -= np.int64(low > 0 and points[low] > moved - other)
    low = min(low, last - 1)
    lower, shift = point_shift(
        weights, sums, first, second, g, upright, layer, part, low, line, other, scale,
        low_first, low_second,
    )  # fmt: skip
    below = other + points[low] + shift
    upper, shift = point_shift(
        weights, sums, first, second, g, upright, layer, part, low + 1, line, other, scale,
        low_first, low_second,
    )  # fmt: skip
    above = other + points[low + 1] + shift
    high = low + 1
    down = other
    steps = 0
    while along < below and steps <= last:
        steps += 1
        upper = lower
        above = below
        low -= 1
        if low < 0:
            down -= 1
            if down < -1:
                return lower
            low = last
        lower, shift = point_shift(
            weights, sums, first, second, g, upright, layer, part, low, line, down, scale,
            low_first, low_second,
        )  # fmt: skip
        below = down + points[low] + shift
    up = other
    while along > above and steps <= last:
        steps += 1
        lower = upper
        below = above
        high += 1
        if high > last:
            up += 1
            if up > limit:
                return upper
            high = 0
        upper, shift = point_shift(
            weights, sums, first, second, g, upright, layer, part, high, line, up, scale,
            low_first, low_second,
        )  # fmt: skip
        above = up + points[high] + shift
    if not below < above:
        return lower
    share = np.float32(min(max((along - below) / (above - below), 0.0), 1.0))
    return lower + share * (upper - lower)


@numba.njit(**INNER)
def collect(edges, charges, hot, x, y, z, lo, hi, near_x, near_y, out_i, out_j):
    """Find the pixels (i, j) of the electrons lo to hi; i = -1 for those outside the image or lost.

    ``near_x`` and ``near_y`` are scratch for hi - lo indices.
    """
    nx, ny = charges.nx, charges.ny
    margins = charges.margins
    share_x, share_y = edges.shares[0], edges.shares[1]
    tiles_x = (nx + 15) // 16
    # Not 0, of which numba would make a type and compile all below for it as well.
    count_x = np.int64(0)
    count_y = np.int64(0)
    # Where they land; who is near an edge is listed without a branch.
    for n in range(np.uint64(lo), np.uint64(hi)):
        ax = x[n]
        ay = y[n]
        here = z[n] >= 0.0 and -1.0 <= ax < nx + 1 and -1.0 <= ay < ny + 1
        ax = ax if here else -1.0
        ay = ay if here else -1.0
        # Truncation is the floor for what is not negative.
        i = np.int32(np.int32(ax + 1.0) - np.int32(1))
        j = np.int32(np.int32(ay + 1.0) - np.int32(1))
        out_i[n] = i
        out_j[n] = j
        column = min(max(i, np.int32(0)), np.int32(nx - 1)) >> 4
        row = min(max(j, np.int32(0)), np.int32(ny - 1)) >> 4
        margin = margins[np.uint64(row * tiles_x + column)]
        bx = abs(ax - i - 0.5)
        by = abs(ay - j - 0.5)
        near_x[np.uint64(count_x)] = n
        near_y[np.uint64(count_y)] = n
        count_x += here and bx > 0.5 - margin * share_x
        count_y += here and by > 0.5 - margin * share_y
    _decide(edges, charges, hot, np.bool_(True), x, y, z, near_x, count_x, out_i)
    _decide(edges, charges, hot, np.bool_(False), y, x, z, near_y, count_y, out_j)
    for n in range(np.uint64(lo), np.uint64(hi)):
        if not (0 <= out_i[n] < nx and 0 <= out_j[n] < ny):
            out_i[n] = -1


@numba.njit(**INLINED)
def _nearest_line(across, along, upright, columns, rows):
    """Line nearest to an electron, its distance beyond it, its row or column, and its tile."""
    line = np.int64(across + 1.5) - 1
    beyond = across - line
    other = np.int64(along + 1.0) - 1
    pixel = line - np.int64(beyond < 0.0)
    column = pixel if upright else other
    row = other if upright else pixel
    column = min(max(column >> 4, 0), columns)
    row = min(max(row >> 4, 0), rows)
    return line, beyond, other, np.uint64(row * (columns + 1) + column)


@numba.njit(**INNER)
def _decide(edges, charges, hot, upright, across, along, z, near, count, out):
    """Find the side of the nearest line on which the electrons listed in ``near`` are."""
    nx, ny = charges.nx, charges.ny
    g = grid(edges, charges)
    weights, sums, points, nearest = edges.weights, edges.sums, edges.points, edges.nearest
    doubts, first, second = edges.doubts, charges.first, charges.second
    scales, per_um = edges.scale, np.float32(edges.per_um)
    bins = nearest.size
    side = 0 if upright else 1
    lines, limit = (nx, ny) if upright else (ny, nx)
    log_z0, per_log = np.float32(edges.log_z0), np.float32(1.0 / edges.log_step)
    alike = edges.alike
    columns = np.int32((nx - 1) >> 4)
    rows = np.int32((ny - 1) >> 4)
    if hot.used[0] > 0:
        count = decide_hot(edges, charges, hot, upright, across, along, z, near, count, out)
    unsure = 0
    for m in range(np.uint64(count)):
        n = np.uint64(near[m])
        line, beyond, other, tile = _nearest_line(
            across[n], along[n], upright, columns, rows
        )
        layer, part = find_layer(log_z0, per_log, g.layers, z[n])
        place = along[n] - other
        bin_ = np.uint64(min(int(place * bins), bins - 1))
        level = np.uint64(min(charges.ranges[tile], doubts.shape[1] - 1))
        inside = 0 <= line <= lines
        shift = shift_of(
            weights, sums, first, second, g, upright,
            layer + np.int64(part > np.float32(0.5)), nearest[bin_], NORMAL,
            line if inside else 0, other, charges.low_first[tile], charges.low_second[tile],
        )  # fmt: skip
        shift *= scale_at(scales, per_um, z[n])
        out[n] = line - np.int64(beyond <= shift)
        # Listed without a branch, in the places already read.
        near[np.uint64(unsure)] = np.int32(n)
        doubt = doubts[side, level, bin_] + np.float32(2e-6)
        unsure += inside and abs(beyond - shift) <= doubt
    for m in range(np.uint64(unsure)):
        n = np.uint64(near[m])
        line, beyond, other, tile = _nearest_line(
            across[n], along[n], upright, columns, rows
        )
        layer, part = find_layer(log_z0, per_log, g.layers, z[n])
        if g.layers > 1 and (
            abs(part - np.float32(0.5)) > np.float32(0.499)
            or alike[np.uint64(layer)] > charges.ranges[tile]
        ):
            # In a layer, or between two so alike that the nearest will do.
            layer += np.int64(part > np.float32(0.5))
            part = np.float32(0.0)
        shift = _crossing(
            weights, sums, points, nearest, first, second, g, upright, layer, part, line,
            along[n], limit, scale_at(scales, per_um, z[n]), charges.low_first[tile],
            charges.low_second[tile],
        )  # fmt: skip
        out[n] = line - np.int64(beyond <= shift)
