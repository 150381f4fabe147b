"""Hot edges: pixel edges near which many electrons land, evaluated once per block.

An edge is a polyline; its points are stored, and the bounds of its shift in each of ``FENCES``
steps along it.  An electron outside these bounds is decided by two comparisons, any other by the
polyline.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.shifts import both_shifts, grid, scale_at

FENCES = 16
"""Number of steps along an edge for which bounds of its shift are stored.

Chosen: with 16 about 99 % of the electrons at hot edges are decided by the bounds alone; twice as many
decide more and cost twice the memory and preparation of an edge."""


class Hot(NamedTuple):
    """Store of the hot edges, with their shifts in the topmost layer.

    A tile with hot edges owns a page: ``page_of`` [tiles] is its number (-1: none); ``pages``
    [page, side, pixel of the tile] is the place of an edge in ``lines`` [place, point, (normal,
    tangential)], -1 where the edge is not hot.  An edge belongs to the pixel right of or above it.
    ``fences`` [place, (middle, half width), step] are bounds of its shift [pixel]; ``edge``
    [place, (side, line, row or column)] names it.  ``used`` holds the numbers of pages and lines in
    use, and then the tiles of the pages.
    """

    page_of: np.ndarray
    pages: np.ndarray
    lines: np.ndarray
    fences: np.ndarray
    edge: np.ndarray
    used: np.ndarray


@numba.njit(cache=True, inline="always")
def _place(hot, side, line, other, columns, rows):
    """Place of an edge among the hot ones, -1 if it is not."""
    i = line if side == 0 else other
    j = other if side == 0 else line
    if i < 0 or j < 0 or (i >> 4) > columns or (j >> 4) > rows:
        return np.int32(-1)
    page = hot.page_of[np.uint64((j >> 4) * (columns + 1) + (i >> 4))]
    if page < 0:
        return np.int32(-1)
    return hot.pages[np.uint64(page), np.uint64(side), np.uint64((j & 15) * 16 + (i & 15))]


@numba.njit(cache=True, inline="always")
def _tile(side, line, other, columns):
    """Tile of the pixel that an edge belongs to."""
    i = line if side == 0 else other
    j = other if side == 0 else line
    return np.uint64((j >> 4) * (columns + 1) + (i >> 4))


@numba.njit(cache=True, _nrt=False)
def cool(hot):
    """Forget all hot edges."""
    for page in range(hot.used[0]):
        hot.page_of[hot.used[2 + page]] = -1
    hot.used[0] = 0
    hot.used[1] = 0


@numba.njit(cache=True, _nrt=False)
def heat(edges, charges, hot, side, line, other):
    """Mark an edge as hot for the next block; :func:`evaluate` and :func:`fence` must follow."""
    i = line if side == 0 else other
    j = other if side == 0 else line
    if not (0 <= i < charges.nx and 0 <= j < charges.ny):
        return
    tiles_x = (charges.nx + 15) >> 4
    tile = (j >> 4) * tiles_x + (i >> 4)
    page = hot.page_of[tile]
    if page < 0:
        page = hot.used[0]
        if page >= hot.pages.shape[0] or hot.used[1] >= hot.lines.shape[0]:
            return
        hot.used[0] += 1
        hot.used[2 + page] = tile
        hot.page_of[tile] = page
        hot.pages[page] = -1
    at = (j & 15) * 16 + (i & 15)
    if hot.pages[page, side, at] >= 0 or hot.used[1] >= hot.lines.shape[0]:
        return
    place = hot.used[1]
    hot.used[1] += 1
    hot.pages[page, side, at] = place
    hot.edge[place, 0] = side
    hot.edge[place, 1] = line
    hot.edge[place, 2] = other


@numba.njit(cache=True, nogil=True, _nrt=False)
def evaluate(edges, charges, hot, first, last):
    """Find the polylines of the hot edges at the places first to last."""
    g = grid(edges, charges)
    tiles_x = (charges.nx + 15) >> 4
    # One side after the other, so that their weights stay in the first-level cache.
    count = last - first
    for n in range(2 * count):
        place = first + n % count
        side = hot.edge[place, 0]
        if side != n // count:
            continue
        line = np.int64(hot.edge[place, 1])
        other = np.int64(hot.edge[place, 2])
        i = line if side == 0 else other
        j = other if side == 0 else line
        tile = (j >> 4) * tiles_x + (i >> 4)
        for point in range(edges.points.size):
            normal, tangential = both_shifts(
                edges.weights, edges.sums, charges.first, charges.second, g, side == 0,
                edges.layers - 1, point, line, other, charges.low_first[tile],
                charges.low_second[tile],
            )  # fmt: skip
            hot.lines[place, point, 0] = normal
            hot.lines[place, point, 1] = tangential


@numba.njit(cache=True, inline="always")
def _top_scale(scale):
    """Factor of the shifts at the back surface."""
    return scale[scale.size - 1] if scale.size > 0 else np.float32(1.0)


@numba.njit(cache=True, _nrt=False)
def _tops(edges):
    """Heights [um] above which the shifts are those of the topmost layer, and with the top's factor."""
    top = np.float32(-1.0)
    if edges.layers > 1:
        # Within a thousandth of the step to the topmost layer.
        top = np.float32(np.exp(edges.log_z0 + (edges.layers - 1.001) * edges.log_step))
    scale = edges.scale
    n = scale.size - 1
    if n < 0:
        return top, top
    while n > 0 and scale[n - 1] == scale[scale.size - 1]:
        n -= 1
    # Rounding of the place in the table: half a step is plenty.
    return top, max(top, np.float32((n + 0.5) / edges.per_um))


@numba.njit(cache=True, inline="always")
def _bin(edges, height):
    """Row of ``Edges.change`` for a height [um]."""
    at = np.int32(height * np.float32(edges.per_change))
    return np.uint64(min(at, np.int32(edges.change.shape[0] - 1)))


@numba.njit(cache=True, nogil=True, _nrt=False)
def fence(edges, charges, hot, first, last):
    """Find the bounds of the shifts of the edges at the places first to last, in steps along them.

    All hot edges must have been evaluated, because a step may reach into the next edge.  The
    bounds hold for the points of the topmost layer, each moved along the edge by as much as
    ``Edges.change`` allows at the lowest height that is decided by them.
    """
    columns = np.int32((charges.nx - 1) >> 4)
    rows = np.int32((charges.ny - 1) >> 4)
    scale = _top_scale(edges.scale)
    steps = np.float32(FENCES)
    zero, a_half = np.float32(0.0), np.float32(0.5)
    count = np.int64(edges.points.size)
    change = edges.change[_bin(edges, np.float32(edges.lowest)), 1]
    for at in range(first, last):
        side = hot.edge[at, 0]
        line, other = hot.edge[at, 1], hot.edge[at, 2]
        middle, half = hot.fences[at, 0], hot.fences[at, 1]
        # What the polyline does not pass in full is open.
        middle[:] = zero
        half[:] = np.float32(np.inf)
        margin = charges.margins[_tile(side, line, other, columns)]
        spread = steps * margin * change
        if not spread < np.float32(1.0):
            continue
        back = np.float64(2.0 / FENCES + margin * edges.along)
        # Of the step that the polyline is in: its end, lowest and highest shift, largest slope.
        border = np.int64(-1)
        inside = np.int64(0)
        lowest = highest = steep = zero
        # Of the two steps before: largest slopes, and the bounds of the last.
        steep_1 = steep_2 = middle_1 = half_1 = zero
        # Steps that the polyline makes where two edges meet, or back.
        jumps = zero
        here = lower = zero
        started = False
        for base in range(-1, 2):
            e = _place(hot, side, line, other + base, columns, rows)
            if e < 0:
                continue
            points = hot.lines[np.uint64(e)]
            p = np.int64(0)
            if base < 0 and margin < np.float32(0.5):
                # Further back no point reaches this edge.
                p = count - 1
                while p > 0 and edges.points[p] - 1.0 > -back:
                    p -= 1
            joined = started
            while p < count and border <= FENCES + 1:
                there = steps * (
                    np.float32(base + edges.points[np.uint64(p)])
                    + scale * points[np.uint64(p), 1]
                )
                upper = scale * points[np.uint64(p), 0]
                p += 1
                if not started:
                    started = True
                    border = max(border, np.int64(np.ceil(there)))
                elif there < here:
                    if inside > 0 and there < np.float32(border - 1):
                        # It was in that step before; it is left open with all others.
                        half[:] = np.float32(np.inf)
                        border = np.int64(FENCES + 2)
                        break
                    jumps += abs(upper - lower)
                elif inside > 0 or there >= np.float32(border):
                    slope = (upper - lower) / (there - here) if there > here else zero
                    if joined:
                        jumps += abs(upper - lower)
                    else:
                        steep = max(steep, abs(slope))
                    while there >= np.float32(border) and border <= FENCES + 1:
                        value = lower + slope * (np.float32(border) - here)
                        lowest = min(lowest, value)
                        highest = max(highest, value)
                        n = border - 1
                        if inside > 0 and spread == zero and 0 <= n < FENCES:
                            middle[n] = a_half * (lowest + highest)
                            half[n] = a_half * (highest - lowest) + np.float32(2e-6)
                        if inside > 2 and spread > zero and 0 < n <= FENCES:
                            middle[n - 1] = middle_1
                            half[n - 1] = half_1 + spread * max(steep, steep_1, steep_2)
                        middle_1 = a_half * (lowest + highest)
                        half_1 = a_half * (highest - lowest) + np.float32(2e-6)
                        steep_2 = steep_1
                        steep_1 = steep
                        steep = zero if joined else abs(slope)
                        lowest = highest = value
                        inside += 1
                        border += 1
                if inside > 0:
                    lowest = min(lowest, upper)
                    highest = max(highest, upper)
                joined = False
                here = there
                lower = upper
        if spread > zero:
            half += jumps


@numba.njit(cache=True, _nrt=False)
def _cross(points, lines, hot, side, at, line, other, place, low, scale, columns, rows):
    """Shift of a hot polyline at ``place`` along an edge, its slope there, and the distance to the
    nearer end of the segment (below 0: not all of the polyline is hot).

    The search starts at the point ``low`` and goes to the segment that encloses the place, if
    need be on the next edge of the line.
    """
    zero = np.float32(0.0)
    last = points.size - 1
    base = 0
    p = low
    e = np.uint64(at)
    here = np.float32(points[np.uint64(p)]) + scale * lines[e, np.uint64(p), 1]
    lower = lines[e, np.uint64(p), 0]
    up = here <= place
    while True:
        p += 1 if up else -1
        if p < 0 or p > last:
            base += 1 if up else -1
            if abs(base) > 1:
                return zero, zero, np.float32(-1.0)
            at = _place(hot, side, line, other + base, columns, rows)
            if at < 0:
                return zero, zero, np.float32(-1.0)
            e = np.uint64(at)
            p = 0 if up else last
        there = np.float32(base + points[np.uint64(p)]) + scale * lines[e, np.uint64(p), 1]
        upper = lines[e, np.uint64(p), 0]
        if (there > place) if up else (there <= place):
            break
        here = there
        lower = upper
    if there == here:
        return scale * lower, zero, zero
    share = min(max((place - here) / (there - here), zero), np.float32(1.0))
    slope = scale * (upper - lower) / (there - here)
    clear = min(abs(place - here), abs(there - place))
    return scale * (lower + share * (upper - lower)), slope, clear


@numba.njit(cache=True, nogil=True, _nrt=False)
def decide_hot(edges, charges, hot, upright, across, along, z, near, count, out):
    """Decide the electrons in ``near`` that are at hot edges; the others stay listed.

    The polylines are those of the topmost layer.  Those of an electron further down differ by
    no more than ``Edges.change`` says; closer to the polyline than that it stays listed.
    Returns how many stay.
    """
    scales, per_um = edges.scale, np.float32(edges.per_um)
    points, nearest, lines, fences = edges.points, edges.nearest, hot.lines, hot.fences
    change = edges.change
    bins = nearest.size
    side = 0 if upright else 1
    columns = np.int32((charges.nx - 1) >> 4)
    rows = np.int32((charges.ny - 1) >> 4)
    top, same = _tops(edges)
    layered = edges.layers > 1
    lowest = np.float32(edges.lowest)
    zero = np.float32(0.0)
    left = 0
    for m in range(np.uint64(count)):
        n = np.uint64(near[m])
        line = np.int64(across[n] + 1.5) - 1
        other = np.int64(along[n] + 1.0) - 1
        at = _place(hot, side, line, other, columns, rows)
        height = z[n]
        if at < 0 or height < lowest:
            near[np.uint64(left)] = np.int32(n)
            left += 1
            continue
        place = np.float32(along[n] - other)
        beyond = np.float32(across[n] - line)
        # What the polyline of this height may differ by, across and along the edge.
        doubt = sway = zero
        if height < top:
            margin = charges.margins[_tile(side, line, other, columns)]
            bin_ = _bin(edges, height)
            # A margin that is cut off is no bound.
            margin = margin if margin < np.float32(0.5) else np.float32(np.inf)
            doubt = margin * change[bin_, 0] + np.float32(2e-6)
            sway = margin * change[bin_, 1] + np.float32(2e-6)
        if layered or height >= same:
            step = np.uint64(
                min(np.int32(place * np.float32(FENCES)), np.int32(FENCES - 1))
            )
            away = beyond - fences[np.uint64(at), np.uint64(0), step]
            # The side is not predictable, so that a branch would cost more than arithmetic.
            out[n] = line - np.int64(away <= zero)
            if abs(away) > fences[np.uint64(at), np.uint64(1), step] + doubt:
                continue
        scale = scale_at(scales, per_um, height)
        low = nearest[np.uint64(min(int(place * bins), bins - 1))]
        shift, slope, clear = _cross(
            points, lines, hot, side, at, line, other, place, low, scale, columns, rows
        )
        if height < top:
            # In one segment all along the way that the polyline may have moved.
            known = clear > sway and abs(beyond - shift) > doubt + abs(slope) * sway
        else:
            known = clear >= zero
        if known:
            out[n] = line - np.int64(across[n] - line <= shift)
        else:
            near[np.uint64(left)] = np.int32(n)
            left += 1
    return left
