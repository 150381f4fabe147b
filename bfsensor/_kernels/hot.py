"""Hot edges: pixel edges near which many electrons land, evaluated once per block.

An edge is a polyline; its points are stored, and the bounds of its shift in each of ``FENCES``
steps along it.  An electron outside these bounds is decided by two comparisons, any other by the
polyline.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.compile_options import INLINED, INNER
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.shifts import MODES, NEAR_MODES
from bfsensor._kernels.window import add_16_points

FENCES = 16
"""Number of steps along an edge for which bounds of its shift are stored.

Chosen: with 16 about 99 % of the electrons at hot edges are decided by the bounds alone; twice as many
decide more and cost twice the memory and preparation of an edge."""


class Hot(NamedTuple):
    """Store of the hot edges, with their shifts in the topmost layer.

    A tile with hot edges owns a page: ``page_of`` [tiles] is its number (-1: none); ``pages``
    [page, side, pixel of the tile] is the place of an edge in ``lines`` [place, (16 points at a
    time, (normal, tangential), point)], -1 where the edge is not hot.  An edge belongs to the pixel
    right of or above it.  ``fences`` [place, step, 4] are bounds of its shift [pixel]: a line by
    its value at the beginning of the step and its rise over it, the half width about that line,
    and what is added to it for electrons below the topmost layer; ``edge``
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


@numba.njit(**INLINED)
def _tile(side, line, other, columns):
    """Tile of the pixel that an edge belongs to."""
    i = line if side == 0 else other
    j = other if side == 0 else line
    return np.uint64((j >> 4) * (columns + 1) + (i >> 4))


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
def evaluate(edges, charges, hot, part, parts):
    """Find the polylines of the hot edges of every ``parts``-th line from ``part`` on."""
    q = edges.reach
    stride = np.uint64(charges.stride)
    # Blocks of 16 points, each with the sums over all sources and then the sources by row, whose
    # columns are even in number.
    blocks = (edges.points.size + 15) // 16
    pairs = q + 1
    far = (2 * q + 2) * 2 * pairs
    size = 32 * (MODES + far + (16 * NEAR_MODES if edges.modes > 1 else 0))
    # One block of points after the other, so that their weights stay in the first-level cache.
    count = hot.used[1]
    for n in range(2 * blocks * count):
        place = n % count
        block = n // count
        side = np.int64(hot.edge[place, 0])
        line = np.int64(hot.edge[place, 1])
        if side != block // blocks or line % parts != part:
            continue
        other = np.int64(hot.edge[place, 2])
        column, row = (line - q - 1, other - q) if side == 0 else (other - q, line - q - 1)
        at = (row + charges.pad) * charges.stride + column + charges.pad
        at_near = NEAR_MODES * (at + (q - 1) * (charges.stride + 1))
        low = np.uint64(MODES) * _tile(side, line, other, (charges.nx - 1) >> 4)
        shifts = hot.lines[place]
        begin = np.uint64(block * size)
        to = np.uint64(32 * (block % blocks))
        for k in range(np.uint64(32)):
            shifts[to + k] = -edges.by_point[begin + k] * charges.lows[low]
        for m in range(np.uint64(1), np.uint64(edges.modes)):
            for k in range(np.uint64(32)):
                shifts[to + k] -= (
                    edges.by_point[begin + np.uint64(32) * m + k] * charges.lows[low + m]
                )
        begin += np.uint64(32 * MODES)
        add_16_points(
            edges.by_point, begin, charges.first, np.uint64(at), stride,
            np.uint64(2 * q + 1 + side), np.uint64(pairs), shifts, to,
        )  # fmt: skip
        if edges.modes > 1:
            add_16_points(
                edges.by_point, begin + np.uint64(32 * far), charges.near, np.uint64(at_near),
                np.uint64(NEAR_MODES) * stride, np.uint64(3 + side), np.uint64(2 * NEAR_MODES),
                shifts, to,
            )  # fmt: skip


@numba.njit(**INLINED)
def _bin(edges, height):
    """Row of ``Edges.change`` for a height [um]."""
    at = np.int32(height * np.float32(edges.per_change))
    return np.uint64(min(at, np.int32(edges.change.shape[0] - 1)))


@numba.njit(**INNER)
def fence(edges, charges, hot, part, parts):
    """Find the bounds of the shifts of the hot edges, in steps along them.

    The edges are those of every ``parts``-th line from ``part`` on; all of a line must have been
    evaluated, because a step may reach into the next edge.  The bounds hold for the points of the
    topmost layer, each moved along the edge by as much as ``Edges.change`` allows at the lowest height
    that is decided by them.
    """
    columns = (charges.nx - 1) >> 4
    rows = (charges.ny - 1) >> 4
    steps = np.float32(FENCES)
    zero, a_half = np.float32(0.0), np.float32(0.5)
    count = np.int64(edges.points.size)
    change = edges.change[_bin(edges, np.float32(edges.lowest)), 1]
    for at in range(hot.used[1]):
        side = np.int64(hot.edge[at, 0])
        line, other = np.int64(hot.edge[at, 1]), np.int64(hot.edge[at, 2])
        if line % parts != part:
            continue
        fences = hot.fences[at]
        # What the polyline does not pass in full is open.
        fences[:] = np.float32(np.inf)
        tile = _tile(side, line, other, columns)
        margin = charges.margins[tile]
        spread = steps * margin * change
        if not spread < np.float32(1.0):
            continue
        back = np.float64(2.0 / FENCES + margin * edges.along)
        # Rounding of the shifts, here and where they are summed for one electron.
        low = np.float32(0.0)
        for m in range(np.uint64(MODES)):
            low += abs(charges.lows[np.uint64(MODES) * np.uint64(tile) + m])
        slack = np.float32(2e-6) + np.float32(1e-5) * (
            margin + np.float32(edges.normal) * low
        )
        # Of the step that the polyline is in: its end, shift and slope where it begins, lowest and
        # highest shift beside that line, largest slope; then those of the two steps before.
        border = np.int64(-1)
        inside = np.int64(0)
        begin = rise = lowest = highest = steep = steep_1 = steep_2 = zero
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
                at_point = np.uint64((p >> 4) * 32 + (p & 15))
                there = steps * (
                    np.float32(base + edges.points[np.uint64(p)])
                    + points[at_point + np.uint64(16)]
                )
                upper = points[at_point]
                p += 1
                nearer, further = min(here, there), max(here, there)
                if inside > 0 and nearer < np.float32(border - 1):
                    # Back in steps that it has passed: their bounds are widened to hold it as well,
                    # and those of the step that it is in where it goes back from there or returns.
                    slope = (upper - lower) / (there - here) if further > nearer else zero
                    if there >= here:
                        jumps += abs(upper - lower)
                    last = min(np.int64(np.floor(further)) + 1, np.int64(FENCES))
                    last = min(border - 1, last)
                    for n in range(max(np.int64(nearer), np.int64(0)), last):
                        row = np.uint64(n)
                        for place in (
                            max(nearer, np.float32(n)), min(further, np.float32(n + 1)),
                        ):  # fmt: skip
                            away = lower + slope * (place - here) - fences[row, 0]
                            away = abs(away - fences[row, 1] * (place - np.float32(n)))
                            # Steps that are open, whose bounds are infinite, stay so.
                            if away + slack > fences[row, 2]:
                                fences[row, 2] = away + slack
                    if further >= np.float32(border - 1):
                        beside = lower + slope * (np.float32(border - 1) - here) - begin
                        lowest = min(lowest, beside)
                        highest = max(highest, beside)
                if not started:
                    started = True
                    border = max(border, np.int64(np.ceil(there)))
                elif there < here:
                    jumps += abs(upper - lower)
                elif inside > 0 or there >= np.float32(border):
                    slope = (upper - lower) / (there - here) if there > here else zero
                    if joined:
                        jumps += abs(upper - lower)
                    else:
                        steep = max(steep, abs(slope))
                    while there >= np.float32(border) and border <= FENCES + 1:
                        value = lower + slope * (np.float32(border) - here)
                        lowest = min(lowest, value - begin - rise)
                        highest = max(highest, value - begin - rise)
                        n = border - 1
                        if inside > 0 and 0 <= n < FENCES:
                            row = np.uint64(n)
                            fences[row, 0] = begin + a_half * (lowest + highest)
                            fences[row, 1] = rise
                            fences[row, 2] = a_half * (highest - lowest) + slack
                        if inside > 2 and 0 < n <= FENCES:
                            most = max(max(steep, steep_1), steep_2)
                            fences[np.uint64(n - 1), 3] = spread * most
                        steep_2 = steep_1
                        steep_1 = steep
                        rise = zero if joined else slope
                        steep = abs(rise)
                        begin = value
                        lowest = highest = zero
                        inside += 1
                        border += 1
                if inside > 0 and there >= np.float32(border - 1):
                    beside = upper - begin - rise * (there - np.float32(border - 1))
                    lowest = min(lowest, beside)
                    highest = max(highest, beside)
                joined = False
                here = there
                lower = upper
        for n in range(np.uint64(FENCES)):
            fences[n, 3] += jumps


@numba.njit(**INNER)
def decide_hot(edges, charges, hot, upright, across, along, z, near, count, out):
    """Decide the electrons in ``near`` that are outside the bounds of hot edges.

    The bounds are those of the topmost layer.  The polyline of an electron further down differs
    by no more than ``Edges.change`` says.  Returns how many electrons stay listed.
    """
    fences, change = hot.fences, edges.change
    side = np.int64(0) if upright else np.int64(1)
    columns = (charges.nx - 1) >> 4
    rows = (charges.ny - 1) >> 4
    lowest = np.float32(edges.lowest)
    left = 0
    for m in range(np.uint64(count)):
        n = np.uint64(near[m])
        line = np.int64(across[n] + 1.5) - 1
        other = np.int64(along[n] + 1.0) - 1
        at = _place(hot, side, line, other, columns, rows)
        height = z[n]
        near[np.uint64(left)] = np.int32(n)
        if at < 0 or height < lowest:
            left += 1
            continue
        place = np.float32(along[n] - other) * np.float32(FENCES)
        step = np.uint64(min(np.int32(place), np.int32(FENCES - 1)))
        row = fences[np.uint64(at), step]
        line_there = row[0] + row[1] * (place - np.float32(step))
        away = np.float32(across[n] - line) - line_there
        doubt = row[2]
        more = change[_bin(edges, height), 0]
        if more > np.float32(0.0):
            # A margin that is cut off is no bound.
            margin = charges.margins[_tile(side, line, other, columns)]
            more *= margin if margin < np.float32(0.5) else np.float32(np.inf)
            doubt += more + row[3]
        # The side is not predictable, so that a branch would cost more than arithmetic.
        out[n] = line - np.int64(away <= np.float32(0.0))
        left += not abs(away) > doubt
    return left
