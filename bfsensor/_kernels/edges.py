"""Which pixel collects an electron: the displaced boundaries, evaluated where it lands.

Boundaries are kept nowhere.  The shift of a point of an edge is the sum of weights times
effective charges in a window of pixels around the edge; edges are polylines through their
displaced points.

Most electrons are further from any edge than edges can move (``margins``, a bound from
the range of charges nearby) and stay in the pixel they land in.  Next to an edge the
normal shift of the nearest point decides, unless the electron is closer than the error of
that (``Edges.doubts``, a bound as well); then the polyline itself does.  The result is that of
the polylines in all cases.

A vertical edge runs along y between two pixels of a row, a horizontal edge along x.  The
line of vertical edges ``line`` lies left of the pixels in column ``line``.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.counter_rng import log_single
from bfsensor._kernels.window import sum_8, sum_16, two_sums_8, two_sums_16

NORMAL = 0
TANGENTIAL = 1


class Edges(NamedTuple):
    """Shifts [pixel per electron] of the points of an edge, by source and height.

    ``weights`` holds four blocks, flat, that begin at ``starts``.  Vertical edges [layers,
    2, points, 2 reach + 1, lanes]: sources in rows row - reach .. row + reach and columns
    line - reach - 1 .. line + reach; horizontal edges [layers, 2, points, 2 reach + 2,
    lanes]: rows line - reach - 1 .. line + reach, columns column - reach on; the lanes
    beyond are zero.  Then the second mode of both, of sources within one pixel (8 lanes).
    ``sums`` [2, layers, 2, points, 2]: sums over the window by side and mode.

    ``points``: nominal positions along the edge, 0 to 1; ``nearest``: the nearest point
    for equal steps of the position.  ``normal``: bound of the normal shift by the range of
    effective charges [pixel per electron], ``shares``: of it by side; ``doubts`` [2,
    ranges, steps]: bound of the error of the nearest point's shift, vertical and
    horizontal.  ``alike``: row of the first range for which a layer and the next differ by
    more than 5e-5 pixel (mean over the points).  Layers lie at heights
    with equal steps of the logarithm, ``log_z0 + n log_step``.  ``scale``: factor of all
    shifts at heights ``n / per_um`` [um], where one layer serves all (size 0: none).
    """

    weights: np.ndarray
    starts: np.ndarray
    scale: np.ndarray
    per_um: float
    sums: np.ndarray
    points: np.ndarray
    nearest: np.ndarray
    doubts: np.ndarray
    alike: np.ndarray
    shares: np.ndarray
    normal: float
    reach: int
    lanes: int
    layers: int
    modes: int
    log_z0: float
    log_step: float


class Charges(NamedTuple):
    """Effective charges, each [rows, stride] flat with ``pad`` empty pixels before.

    ``first`` and ``second`` mode (size 0 where there is none); ``low_*`` by tile of
    16 x 16 pixels, subtracted in sums that start from it: a uniform charge moves nothing.
    ``margins`` [pixel] and ``ranges`` (row of ``Edges.doubts``) bound what edges of a tile do.
    """

    first: np.ndarray
    second: np.ndarray
    stride: int
    pad: int
    nx: int
    ny: int
    low_first: np.ndarray
    low_second: np.ndarray
    margins: np.ndarray
    ranges: np.ndarray


class Hot(NamedTuple):
    """Edges through which many electrons are about to pass, evaluated once a block.

    A tile that has some owns a page: ``page_of`` [tiles] (-1: none); ``pages`` [page, side,
    pixel of the tile] is the place in ``lines`` [place, point, (normal, tangential)], -1
    where there is none.  An edge belongs to the pixel right of or above it.  ``used``:
    pages and lines in use, and the tiles of the pages follow.
    """

    page_of: np.ndarray
    pages: np.ndarray
    lines: np.ndarray
    used: np.ndarray


class Grid(NamedTuple):
    """The numbers that say where a window lies: all that is not an array."""

    reach: int
    lanes: int
    layers: int
    modes: int
    stride: int
    pad: int
    vertical: int
    horizontal: int
    vertical_near: int
    horizontal_near: int
    points: int


@numba.njit(cache=True, inline="always")
def _grid(edges, charges):
    return Grid(
        edges.reach, edges.lanes, edges.layers, edges.modes, charges.stride, charges.pad,
        edges.starts[0], edges.starts[1], edges.starts[2], edges.starts[3],
        edges.points.size,
    )  # fmt: skip


@numba.njit(cache=True, inline="always")
def _places(g, upright, layer, point, component, line, other):
    """Where the weights of a point and its window begin, in both modes, and their rows."""
    q = g.reach
    side = 0 if upright else 1
    place = (layer * 2 + component) * g.points + point
    total = 2 * ((side * g.layers * g.points * 2) + place)
    rows = 2 * q + 1 + side
    if upright:
        begin = g.vertical + place * rows * g.lanes
        at = (other - q + g.pad) * g.stride + line - q - 1 + g.pad
        begin_near = g.vertical_near + place * 24
        at_near = (other - 1 + g.pad) * g.stride + line - 2 + g.pad
    else:
        begin = g.horizontal + place * rows * g.lanes
        at = (line - q - 1 + g.pad) * g.stride + other - q + g.pad
        begin_near = g.horizontal_near + place * 32
        at_near = (line - 2 + g.pad) * g.stride + other - 1 + g.pad
    return (
        np.uint64(begin), np.uint64(at), np.uint64(rows), np.uint64(begin_near),
        np.uint64(at_near), np.uint64(3 + side), np.uint64(total),
    )  # fmt: skip


@numba.njit(cache=True, inline="always")
def _shift(weights, sums, first, second, g, upright, layer, point, component, line, other,
           low_first, low_second):  # fmt: skip
    """Shift of a point of an edge in one layer."""
    begin, at, rows, begin_near, at_near, rows_near, total = _places(
        g, upright, layer, point, component, line, other
    )
    none = np.uint64(0)
    stride = np.uint64(g.stride)
    if g.lanes == 8:
        shift = sum_8(weights, begin, none, first, at, stride, rows)
    else:
        shift = sum_16(weights, begin, none, first, at, stride, rows)
    shift -= sums[total] * low_first
    if g.modes == 2:
        shift += sum_8(weights, begin_near, none, second, at_near, stride, rows_near)
        shift -= sums[total + np.uint64(1)] * low_second
    return shift


@numba.njit(cache=True, inline="always")
def _both(weights, sums, first, second, g, upright, layer, point, line, other, low_first,
          low_second):  # fmt: skip
    """Normal and tangential shift of a point in one layer."""
    begin, at, rows, begin_near, at_near, rows_near, total = _places(
        g, upright, layer, point, 0, line, other
    )
    stride = np.uint64(g.stride)
    apart = np.uint64(g.points) * rows * np.uint64(g.lanes)
    if g.lanes == 8:
        normal, tangential = two_sums_8(weights, begin, apart, first, at, stride, rows)
    else:
        normal, tangential = two_sums_16(weights, begin, apart, first, at, stride, rows)
    to = total + np.uint64(2 * g.points)
    normal -= sums[total] * low_first
    tangential -= sums[to] * low_first
    if g.modes == 2:
        apart = np.uint64(g.points * 8) * rows_near
        n, t = two_sums_8(weights, begin_near, apart, second, at_near, stride, rows_near)
        normal += n - sums[total + np.uint64(1)] * low_second
        tangential += t - sums[to + np.uint64(1)] * low_second
    return normal, tangential


@numba.njit(cache=True, _nrt=False)
def _point(weights, sums, first, second, g, upright, layer, part, point, line, other,
           scale, low_first, low_second):  # fmt: skip
    """Shift (normal, tangential) of a point, between two layers."""
    normal, tangential = _both(
        weights, sums, first, second, g, upright, layer, point, line, other, low_first,
        low_second,
    )  # fmt: skip
    if part > np.float32(0.0):
        n, t = _both(
            weights, sums, first, second, g, upright, layer + 1, point, line, other,
            low_first, low_second,
        )  # fmt: skip
        normal += part * (n - normal)
        tangential += part * (t - tangential)
    return scale * normal, scale * tangential


@numba.njit(cache=True, _nrt=False)
def _crossing(weights, sums, points, nearest, first, second, g, upright, layer, part, line,
              along, limit, scale, low_first, low_second):  # fmt: skip
    """Normal shift [pixel] of the polyline ``line`` where it passes ``along`` [pixel].

    The edges of a line follow one another; the walk starts where the tangential shift of
    the nearest point suggests and goes to the segment whose displaced ends enclose
    ``along``.
    """
    last = points.size - 1
    bins = nearest.size
    other = min(max(int(np.floor(along)), -1), limit)
    point = nearest[np.uint64(min(max(int((along - other) * bins), 0), bins - 1))]
    moved = along - scale * _shift(
        weights, sums, first, second, g, upright,
        layer + np.int64(part > np.float32(0.5)), point, TANGENTIAL, line, other, low_first,
        low_second,
    )  # fmt: skip
    other = min(max(int(np.floor(moved)), -1), limit)
    low = nearest[np.uint64(min(max(int((moved - other) * bins), 0), bins - 1))]
    low -= np.int64(low > 0 and points[low] > moved - other)
    low = min(low, last - 1)
    lower, shift = _point(
        weights, sums, first, second, g, upright, layer, part, low, line, other, scale,
        low_first, low_second,
    )  # fmt: skip
    below = other + points[low] + shift
    upper, shift = _point(
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
        lower, shift = _point(
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
        upper, shift = _point(
            weights, sums, first, second, g, upright, layer, part, high, line, up, scale,
            low_first, low_second,
        )  # fmt: skip
        above = up + points[high] + shift
    if not below < above:
        return lower
    share = np.float32(min(max((along - below) / (above - below), 0.0), 1.0))
    return lower + share * (upper - lower)


@numba.njit(cache=True, inline="always")
def _layer(log_z0, per_log, layers, z):
    """Layer below the height ``z`` [um] and the part of the way to the next."""
    if layers == 1:
        return 0, np.float32(0.0)
    at = (log_single(max(z, np.float32(1e-3))) - log_z0) * per_log
    at = min(max(at, np.float32(0.0)), np.float32(layers - 1))
    layer = min(int(at), layers - 2)
    return layer, at - np.float32(layer)


@numba.njit(cache=True, nogil=True, _nrt=False)
def collect(edges, charges, hot, x, y, z, lo, hi, near_x, near_y, out_i, out_j):
    """Pixel (i, j) of the electrons lo to hi; i = -1 for those outside the image or lost.

    ``near_x`` and ``near_y``: room for hi - lo indices.
    """
    nx, ny = charges.nx, charges.ny
    margins = charges.margins
    share_x, share_y = edges.shares[0], edges.shares[1]
    tiles_x = (nx + 15) // 16
    count_x = 0
    count_y = 0
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
    _decide(edges, charges, hot, True, x, y, z, near_x, count_x, out_i)
    _decide(edges, charges, hot, False, y, x, z, near_y, count_y, out_j)
    for n in range(np.uint64(lo), np.uint64(hi)):
        if not (0 <= out_i[n] < nx and 0 <= out_j[n] < ny):
            out_i[n] = -1


@numba.njit(cache=True, inline="always")
def _nearest_line(across, along, upright, columns, rows):
    """Line next to an electron, how far beyond that it is, its row or column, its tile."""
    line = np.int64(across + 1.5) - 1
    beyond = across - line
    other = np.int64(along + 1.0) - 1
    pixel = line - np.int64(beyond < 0.0)
    column = pixel if upright else other
    row = other if upright else pixel
    column = min(max(column >> 4, 0), columns)
    row = min(max(row >> 4, 0), rows)
    return line, beyond, other, np.uint64(row * (columns + 1) + column)


@numba.njit(cache=True, inline="always")
def _scale_at(scale, per_um, z):
    """Factor of the shifts at a height."""
    if scale.size == 0:
        return np.float32(1.0)
    at = min(max(z * per_um, np.float32(0.0)), np.float32(scale.size - 1))
    n = np.uint64(min(np.int32(at), np.int32(scale.size - 2)))
    return scale[n] + (at - np.float32(n)) * (scale[n + np.uint64(1)] - scale[n])


@numba.njit(cache=True, inline="always")
def _hot_place(hot, side, line, other, columns, rows):
    """Place of an edge among the hot ones, -1 if it is not."""
    i = line if side == 0 else other
    j = other if side == 0 else line
    if i < 0 or j < 0 or (i >> 4) > columns or (j >> 4) > rows:
        return np.int32(-1)
    page = hot.page_of[np.uint64((j >> 4) * (columns + 1) + (i >> 4))]
    if page < 0:
        return np.int32(-1)
    return hot.pages[np.uint64(page), np.uint64(side), np.uint64((j & 15) * 16 + (i & 15))]


@numba.njit(cache=True, nogil=True, _nrt=False)
def _decide(edges, charges, hot, upright, across, along, z, near, count, out):
    """Find the side of the nearest line on which the electrons listed in ``near`` are."""
    nx, ny = charges.nx, charges.ny
    g = _grid(edges, charges)
    weights, sums, points, nearest = edges.weights, edges.sums, edges.points, edges.nearest
    doubts, first, second = edges.doubts, charges.first, charges.second
    scales, per_um = edges.scale, np.float32(edges.per_um)
    bins = nearest.size
    side = 0 if upright else 1
    lines, limit = (nx, ny) if upright else (ny, nx)
    log_z0, per_log = np.float32(edges.log_z0), np.float32(1.0 / edges.log_step)
    alike = edges.alike
    last = points.size - 1
    ready = hot.lines
    columns = np.int32((nx - 1) >> 4)
    rows = np.int32((ny - 1) >> 4)
    if hot.used[0] > 0:
        left = 0
        for m in range(np.uint64(count)):
            n = np.uint64(near[m])
            near[np.uint64(left)] = np.int32(n)
            line = np.int64(across[n] + 1.5) - 1
            other = np.int64(along[n] + 1.0) - 1
            at = _hot_place(hot, side, line, other, columns, rows)
            layer, part = _layer(log_z0, per_log, g.layers, z[n])
            if at < 0 or (g.layers > 1 and layer + part < g.layers - 1.001):
                left += 1
                continue
            scale = _scale_at(scales, per_um, z[n])
            place = np.float32(along[n] - other)
            base = np.float32(0.0)
            e = np.uint64(at)
            p = nearest[np.uint64(min(int(place * bins), bins - 1))]
            here = points[np.uint64(p)] + scale * ready[e, np.uint64(p), 1]
            lower = ready[e, np.uint64(p), 0]
            there = here
            upper = lower
            # To the segment that encloses the place, through the next edge of the line.
            up = here <= place
            while at >= 0:
                p += 1 if up else -1
                if p < 0 or p > last:
                    base += np.float32(1.0 if up else -1.0)
                    at = _hot_place(hot, side, line, other + np.int64(base), columns, rows)
                    if at < 0 or abs(base) > np.float32(1.5):
                        at = np.int32(-1)
                        break
                    p = 0 if up else last
                    e = np.uint64(at)
                next_place = base + points[np.uint64(p)] + scale * ready[e, np.uint64(p), 1]
                next_shift = ready[e, np.uint64(p), 0]
                if up:
                    if next_place > place:
                        there = next_place
                        upper = next_shift
                        break
                    here = next_place
                    lower = next_shift
                else:
                    there = here
                    upper = lower
                    here = next_place
                    lower = next_shift
                    if here <= place:
                        break
            if at < 0:
                left += 1
                continue
            share = np.float32(0.0)
            if there > here:
                share = min((place - here) / (there - here), np.float32(1.0))
            shift = scale * (lower + share * (upper - lower))
            out[n] = line - np.int64(across[n] - line <= shift)
        count = left
    unsure = 0
    for m in range(np.uint64(count)):
        n = np.uint64(near[m])
        line, beyond, other, tile = _nearest_line(
            across[n], along[n], upright, columns, rows
        )
        layer, part = _layer(log_z0, per_log, g.layers, z[n])
        place = along[n] - other
        bin_ = np.uint64(min(int(place * bins), bins - 1))
        level = np.uint64(min(charges.ranges[tile], doubts.shape[1] - 1))
        inside = 0 <= line <= lines
        shift = _shift(
            weights, sums, first, second, g, upright,
            layer + np.int64(part > np.float32(0.5)), nearest[bin_], NORMAL,
            line if inside else 0, other, charges.low_first[tile], charges.low_second[tile],
        )  # fmt: skip
        shift *= _scale_at(scales, per_um, z[n])
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
        layer, part = _layer(log_z0, per_log, g.layers, z[n])
        if g.layers > 1 and (
            abs(part - np.float32(0.5)) > np.float32(0.499)
            or alike[np.uint64(layer)] > charges.ranges[tile]
        ):
            # In a layer, or between two so alike that the nearest will do.
            layer += np.int64(part > np.float32(0.5))
            part = np.float32(0.0)
        shift = _crossing(
            weights, sums, points, nearest, first, second, g, upright, layer, part, line,
            along[n], limit, _scale_at(scales, per_um, z[n]), charges.low_first[tile],
            charges.low_second[tile],
        )  # fmt: skip
        out[n] = line - np.int64(beyond <= shift)


@numba.njit(cache=True, _nrt=False)
def cool(hot):
    """Forget all hot edges."""
    for page in range(hot.used[0]):
        hot.page_of[hot.used[2 + page]] = -1
    hot.used[0] = 0
    hot.used[1] = 0


@numba.njit(cache=True, _nrt=False)
def heat(edges, charges, hot, side, line, other):
    """Evaluate an edge for the block to come, in the topmost layer."""
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
    g = _grid(edges, charges)
    for point in range(edges.points.size):
        normal, tangential = _both(
            edges.weights, edges.sums, charges.first, charges.second, g, side == 0,
            edges.layers - 1, point, line, other, charges.low_first[tile],
            charges.low_second[tile],
        )  # fmt: skip
        hot.lines[place, point, 0] = normal
        hot.lines[place, point, 1] = tangential
