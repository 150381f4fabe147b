"""Hot edges: pixel edges near which many electrons land, evaluated once per block.

An edge is a polyline; its points are stored, and the bounds of its shift in each of ``FENCES``
steps along it.  An electron outside these bounds is decided by two comparisons, any other by the
polyline.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.compile_options import INLINED, INNER
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
    ``fences`` [place, step, (middle, half width)] are bounds of its shift [pixel]; ``edge``
    [place, (side, line, row or column)] names it.  ``used`` holds the numbers of pages and lines in
    use, and then the tiles of the pages.
    """

    page_of: np.ndarray
    pages: np.ndarray
    lines: np.ndarray
    fences: np.ndarray
    edge: np.ndarray
    used: np.ndarray


@numba.njit(**INLINED)
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


@numba.njit(**INNER)
def cool(hot):
    """Forget all hot edges."""
    for page in range(hot.used[0]):
        hot.page_of[hot.used[2 + page]] = -1
    hot.used[0] = 0
    hot.used[1] = 0


@numba.njit(**INNER)
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


@numba.njit(**INNER)
def evaluate(edges, charges, hot, first, last):
    """Find the polylines of the hot edges at the places first to last."""
    g = grid(edges, charges)
    tiles_x = (charges.nx + 15) >> 4
    for place in range(first, last):
        side = hot.edge[place, 0]
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


@numba.njit(**INLINED)
def _top_scale(scale):
    """Factor of the shifts at the back surface."""
    return scale[scale.size - 1] if scale.size > 0 else np.float32(1.0)


@numba.njit(**INNER)
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


@numba.njit(**INNER)
def _enclose(fences, here, lower, there, upper):
    """Widen the fences so that they hold a segment; places in steps."""
    if there < here:
        here, there = there, here
        lower, upper = upper, lower
    if there < np.float32(0.0) or here >= np.float32(FENCES):
        return
    first = np.int64(max(here, np.float32(0.0)))
    last = np.int64(min(there, np.float32(FENCES - 1)))
    slope = np.float32(0.0)
    if there > here:
        slope = (upper - lower) / (there - here)
    for n in range(first, last + 1):
        a = lower + slope * (max(np.float32(n), here) - here)
        b = lower + slope * (min(np.float32(n + 1), there) - here)
        fences[np.uint64(n), 0] = min(fences[np.uint64(n), 0], min(a, b))
        fences[np.uint64(n), 1] = max(fences[np.uint64(n), 1], max(a, b))


@numba.njit(**INNER)
def fence(edges, charges, hot, first, last):
    """Find the bounds of the shifts of the edges at the places first to last, in steps along them.

    All hot edges must have been evaluated, because a step may reach into the next edge.
    """
    columns = np.int32((charges.nx - 1) >> 4)
    rows = np.int32((charges.ny - 1) >> 4)
    scale = _top_scale(edges.scale)
    steps = np.float32(FENCES)
    for at in range(first, last):
        side = hot.edge[at, 0]
        fences = hot.fences[at]
        fences[:, 0] = np.float32(np.inf)
        fences[:, 1] = np.float32(-np.inf)
        begin = end = here = lower = np.float32(0.0)
        started = False
        for base in range(-1, 2):
            e = _place(hot, side, hot.edge[at, 1], hot.edge[at, 2] + base, columns, rows)
            if e < 0:
                continue
            for p in range(edges.points.size):
                place = np.float32(base + edges.points[p])
                place = steps * (place + scale * hot.lines[e, p, 1])
                shift = scale * hot.lines[e, p, 0]
                if started:
                    _enclose(fences, here, lower, place, shift)
                else:
                    begin = place
                    started = True
                here = place
                lower = shift
            end = here
        for n in range(FENCES):
            lowest, highest = fences[n, 0], fences[n, 1]
            fences[n, 0] = np.float32(0.0)
            # What the polyline does not pass in full is open.
            fences[n, 1] = np.float32(np.inf)
            if begin <= np.float32(n) and end >= np.float32(n + 1):
                fences[n, 0] = np.float32(0.5) * (lowest + highest)
                fences[n, 1] = np.float32(0.5) * (highest - lowest) + np.float32(2e-6)


@numba.njit(**INNER)
def _cross(points, lines, hot, side, at, line, other, place, low, scale, columns, rows):
    """Shift of a hot polyline at ``place`` along an edge, and whether all of it is hot.

    The search starts at the point ``low`` and goes to the segment that encloses the place, if
    need be on the next edge of the line.
    """
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
                return np.float32(0.0), False
            at = _place(hot, side, line, other + base, columns, rows)
            if at < 0:
                return np.float32(0.0), False
            e = np.uint64(at)
            p = 0 if up else last
        there = np.float32(base + points[np.uint64(p)]) + scale * lines[e, np.uint64(p), 1]
        upper = lines[e, np.uint64(p), 0]
        if (there > place) if up else (there <= place):
            break
        here = there
        lower = upper
    share = np.float32(0.0)
    if there != here:
        share = min(max((place - here) / (there - here), np.float32(0.0)), np.float32(1.0))
    return scale * (lower + share * (upper - lower)), True


@numba.njit(**INNER)
def decide_hot(edges, charges, hot, upright, across, along, z, near, count, out):
    """Decide the electrons in ``near`` that are at hot edges; the others stay listed.

    Returns how many these are.
    """
    scales, per_um = edges.scale, np.float32(edges.per_um)
    points, nearest, lines, fences = edges.points, edges.nearest, hot.lines, hot.fences
    bins = nearest.size
    side = 0 if upright else 1
    columns = np.int32((charges.nx - 1) >> 4)
    rows = np.int32((charges.ny - 1) >> 4)
    top, same = _tops(edges)
    left = 0
    for m in range(np.uint64(count)):
        n = np.uint64(near[m])
        line = np.int64(across[n] + 1.5) - 1
        other = np.int64(along[n] + 1.0) - 1
        at = _place(hot, side, line, other, columns, rows)
        if at < 0 or z[n] < top:
            near[np.uint64(left)] = np.int32(n)
            left += 1
            continue
        place = np.float32(along[n] - other)
        beyond = np.float32(across[n] - line)
        if z[n] >= same:
            step = np.uint64(
                min(np.int32(place * np.float32(FENCES)), np.int32(FENCES - 1))
            )
            away = beyond - fences[np.uint64(at), step, 0]
            # The side is not predictable, so that a branch would cost more than arithmetic.
            out[n] = line - np.int64(away <= np.float32(0.0))
            if abs(away) > fences[np.uint64(at), step, 1]:
                continue
        scale = scale_at(scales, per_um, z[n])
        low = nearest[np.uint64(min(int(place * bins), bins - 1))]
        shift, known = _cross(
            points, lines, hot, side, at, line, other, place, low, scale, columns, rows
        )
        if known:
            out[n] = line - np.int64(across[n] - line <= shift)
        else:
            near[np.uint64(left)] = np.int32(n)
            left += 1
    return left
