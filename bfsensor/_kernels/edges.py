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
from bfsensor._kernels.extremes import max, min
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
def _crossing(weights, sums, points, nearest, first, near_charges, g, upright, layer, part, line,
              along, limit, scale, lows, tile):  # fmt: skip
    """Normal shift [pixel] of the polyline ``line`` where it passes ``along`` [pixel].

    The edges of a line follow one another; the search starts where the tangential shift of
    the nearest point suggests and goes to the segment whose displaced ends enclose
    ``along``.
    """
    last = points.size - 1
    bins = nearest.size
    other = min(max(np.int64(np.floor(along)), -1), limit)
    point = nearest[np.uint64(min(max(np.int64((along - other) * bins), 0), bins - 1))]
    moved = along - scale * shift_of(
        weights, sums, first, near_charges, g, upright,
        layer + np.int64(part > np.float32(0.5)), point, TANGENTIAL, line, other, lows, tile,
    )  # fmt: skip
    other = min(max(np.int64(np.floor(moved)), -1), limit)
    low = nearest[np.uint64(min(max(np.int64((moved - other) * bins), 0), bins - 1))]
    low -= np.int64(low > 0 and points[low] > moved - other)
    low = min(low, last - 1)
    lower, shift = point_shift(
        weights, sums, first, near_charges, g, upright, layer, part, low, line, other, scale,
        lows, tile,
    )  # fmt: skip
    below = other + points[low] + shift
    upper, shift = point_shift(
        weights, sums, first, near_charges, g, upright, layer, part, low + 1, line, other, scale,
        lows, tile,
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
            weights, sums, first, near_charges, g, upright, layer, part, low, line, down, scale,
            lows, tile,
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
            weights, sums, first, near_charges, g, upright, layer, part, high, line, up, scale,
            lows, tile,
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
    last_i, last_j = np.int32(nx - 1), np.int32(ny - 1)
    # Loops that write one array each and look nothing up compile to vector code.
    first, count = np.uint64(lo), np.uint64(hi - lo)
    left, right, below, above = last_i, np.int32(0), last_j, np.int32(0)
    for m in range(count):
        # Truncation is the floor for what is not negative.
        ax = min(max(x[first + m], -1.0), nx + 1.0)
        i = np.int32(np.int32(ax + 1.0) - np.int32(1))
        out_i[first + m] = i
        left = min(left, i)
        right = max(right, i)
    for m in range(count):
        ay = min(max(y[first + m], -1.0), ny + 1.0)
        j = np.int32(np.int32(ay + 1.0) - np.int32(1))
        out_j[first + m] = j
        below = min(below, j)
        above = max(above, j)
    # A margin that holds for all of them, if they are in few tiles.
    left, right = max(left, np.int32(0)) >> 4, min(right, last_i) >> 4
    below, above = max(below, np.int32(0)) >> 4, min(above, last_j) >> 4
    smallest, largest = np.float32(0.0), np.float32(1.0)
    if 8 * np.int64(right - left + 1) * np.int64(above - below + 1) < 512 + hi - lo:
        smallest, largest = np.float32(1.0), np.float32(0.0)
        for row in range(below, above + 1):
            for column in range(left, right + 1):
                margin = margins[np.uint64(row * tiles_x + column)]
                smallest = min(smallest, margin)
                largest = max(largest, margin)
    half_x = 0.5 - largest * share_x
    half_y = 0.5 - largest * share_y
    for m in range(count):
        ax = x[first + m]
        ay = y[first + m]
        here = (z[first + m] >= np.float32(0.0)) & (ax >= -1.0) & (ay >= -1.0)
        here = here & (ax < nx + 1.0) & (ay < ny + 1.0)
        bx = here & (abs(ax - out_i[first + m] - 0.5) > half_x)
        by = here & (abs(ay - out_j[first + m] - 0.5) > half_y)
        near_x[m] = np.int32(bx) + np.int32(2) * np.int32(by)
    # Who is near an edge is listed without a branch.  Not 0, of which numba would make a type and
    # compile all below for it as well.
    count_x = np.int64(0)
    count_y = np.int64(0)
    if smallest >= np.float32(0.5) * largest:
        for m in range(count):
            flags = near_x[m]
            near_x[np.uint64(count_x)] = np.int32(first + m)
            near_y[np.uint64(count_y)] = np.int32(first + m)
            count_x += flags & np.int32(1)
            count_y += flags >> np.int32(1)
    else:
        # Each by the margin of its own tile.
        some = np.int64(0)
        for m in range(count):
            flags = near_x[m]
            near_x[np.uint64(some)] = np.int32(first + m)
            some += flags != np.int32(0)
        for m in range(np.uint64(some)):
            n = np.uint64(near_x[m])
            i, j = out_i[n], out_j[n]
            column = min(max(i, np.int32(0)), last_i) >> 4
            row = min(max(j, np.int32(0)), last_j) >> 4
            margin = margins[np.uint64(row * tiles_x + column)]
            near_x[np.uint64(count_x)] = np.int32(n)
            near_y[np.uint64(count_y)] = np.int32(n)
            count_x += abs(x[n] - i - 0.5) > 0.5 - margin * share_x
            count_y += abs(y[n] - j - 0.5) > 0.5 - margin * share_y
    # A loop, so that there is one copy of the code.
    for side in range(2):
        upright = side == 0
        _decide(
            edges, charges, hot, upright, x if upright else y, y if upright else x, z,
            near_x if upright else near_y, count_x if upright else count_y,
            out_i if upright else out_j,
        )  # fmt: skip
    for n in range(np.uint64(lo), np.uint64(hi)):
        i = out_i[n]
        j = out_j[n]
        inside = (i >= np.int32(0)) & (i <= last_i) & (j >= np.int32(0)) & (j <= last_j)
        inside = inside & (z[n] >= np.float32(0.0))
        out_i[n] = i if inside else np.int32(-1)


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
    doubts, first, near_charges = edges.doubts, charges.first, charges.near
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
        bin_ = np.uint64(min(np.int64(place * bins), bins - 1))
        level = np.uint64(min(charges.ranges[tile], doubts.shape[1] - 1))
        inside = 0 <= line <= lines
        shift = shift_of(
            weights, sums, first, near_charges, g, upright,
            layer + np.int64(part > np.float32(0.5)), nearest[bin_], NORMAL,
            line if inside else 0, other, charges.lows, tile,
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
            weights, sums, points, nearest, first, near_charges, g, upright, layer, part, line,
            along[n], limit, scale_at(scales, per_um, z[n]), charges.lows, tile,
        )  # fmt: skip
        out[n] = line - np.int64(beyond <= shift)
