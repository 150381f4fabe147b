"""Shifts of the points of pixel edges: sums of weights times charges in a window.

Boundaries are not stored: their shifts are evaluated where they are needed.

A vertical edge runs along y between two pixels of a row, a horizontal edge along x.  The
line of vertical edges ``line`` lies left of the pixels in column ``line``.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.compile_options import INLINED, INNER
from bfsensor._kernels.counter_rng import log_single
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.window import sum_8, sum_16, two_sums_8, two_sums_16

NEAR_MODES = 3
"""Number of modes of the response of the nearest pixels besides the first mode.

Measured on the tables of both LSST devices at all levels, empty and on backgrounds: with 3 the a_10 of
e2v_ccd250 is right to 0.4 %, with 2 to 9 %, with 1 to 33 %.  With twice as many, effective charges
take twice as long to find, and windows of sources two vectors instead of one."""
MODES = 1 + NEAR_MODES
"""Number of all modes, by definition."""

NORMAL = np.int64(0)  # of a literal 0 numba makes a type and compiles for it as well
"""Index of the shift across an edge, by definition of the layout of ``Edges.weights``."""
TANGENTIAL = np.int64(1)
"""Index of the shift along an edge, by definition of the layout of ``Edges.weights``."""


class Edges(NamedTuple):
    """Shifts [pixel per electron] of the points of an edge, by source and height.

    ``weights`` holds four blocks, flat, that begin at ``starts``.  Vertical edges [layers,
    2, points, 2 reach + 1, lanes]: sources in rows row - reach .. row + reach and columns
    line - reach - 1 .. line + reach; horizontal edges [layers, 2, points, 2 reach + 2,
    lanes]: rows line - reach - 1 .. line + reach, columns column - reach on; the lanes
    beyond are zero.  Then the other modes of both, of sources within one pixel (16 lanes, those of
    a source side by side).  ``sums`` [2, layers, 2, points, MODES]: sums over the window by side and
    mode.

    ``points``: nominal positions along the edge, 0 to 1; ``nearest``: the nearest point
    for equal steps of the position.  ``normal``: bound of the normal shift by the range of
    effective charges [pixel per electron], ``shares``: of it by side; ``doubts`` [2,
    ranges, steps]: bound of the error of the nearest point's shift, vertical and
    horizontal.  ``alike``: row of the first range for which a layer and the next differ by
    more than 5e-5 pixel (mean over the points).  Layers lie at heights
    with equal steps of the logarithm, ``log_z0 + n log_step``.  ``scale``: factor of all
    shifts at heights ``n / per_um`` [um], where one layer serves all (size 0: none).

    ``by_point``: weights of the topmost layer for 16 points at a time, flat: [side, points / 16,
    source, (normal, tangential), 16].  The first MODES sources are the sums over all others, by
    mode; then come those of the first mode, in 2 reach + 2 rows and columns, and those of the
    others in 4 of each, side by side, with zeros where a window is smaller.  ``change`` [bins, (normal,
    tangential)]: bound of the change of a shift from the topmost layer to heights
    ``n / per_change`` to ``(n + 1) / per_change`` [um]; ``along``: bound of the tangential shift
    in the topmost layer; both relative to ``normal``.  ``lowest`` [um]: the height down to which
    the topmost layer is used with that bound.
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
    by_point: np.ndarray
    change: np.ndarray
    per_change: float
    along: float
    lowest: float
    normal: float
    reach: int
    lanes: int
    layers: int
    modes: int
    log_z0: float
    log_step: float


class Charges(NamedTuple):
    """Effective charges, each [rows, stride] flat with ``pad`` empty pixels before.

    ``first`` mode, and ``near`` the others of each pixel side by side (size 0 where there are none);
    ``lows`` [tiles, MODES], flat, by tile of 16 x 16 pixels, subtracted in sums that start from
    it: a uniform charge moves nothing.
    ``margins`` [pixel] and ``ranges`` (row of ``Edges.doubts``) bound what edges of a tile do.
    """

    first: np.ndarray
    near: np.ndarray
    stride: int
    pad: int
    nx: int
    ny: int
    lows: np.ndarray
    margins: np.ndarray
    ranges: np.ndarray


class Grid(NamedTuple):
    """Sizes and offsets from which the place of a window follows, apart from the arrays."""

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


@numba.njit(**INLINED)
def grid(edges, charges):
    """Collect the sizes and offsets of edges and charges."""
    return Grid(
        edges.reach, edges.lanes, edges.layers, edges.modes, charges.stride, charges.pad,
        edges.starts[0], edges.starts[1], edges.starts[2], edges.starts[3],
        edges.points.size,
    )  # fmt: skip


@numba.njit(**INLINED)
def _places(g, upright, layer, point, component, line, other):
    """First indices of a point's weights and of its window, and their rows, far and near."""
    q = g.reach
    side = 0 if upright else 1
    place = (layer * 2 + component) * g.points + point
    total = MODES * ((side * g.layers * g.points * 2) + place)
    rows = 2 * q + 1 + side
    if upright:
        begin = g.vertical + place * rows * g.lanes
        at = (other - q + g.pad) * g.stride + line - q - 1 + g.pad
        begin_near = g.vertical_near + place * 48
        at_near = (other - 1 + g.pad) * g.stride + line - 2 + g.pad
    else:
        begin = g.horizontal + place * rows * g.lanes
        at = (line - q - 1 + g.pad) * g.stride + other - q + g.pad
        begin_near = g.horizontal_near + place * 64
        at_near = (line - 2 + g.pad) * g.stride + other - 1 + g.pad
    return (
        np.uint64(begin), np.uint64(at), np.uint64(rows), np.uint64(begin_near),
        np.uint64(NEAR_MODES * at_near), np.uint64(3 + side), np.uint64(total),
    )  # fmt: skip


@numba.njit(**INLINED)
def shift_of(weights, sums, first, near, g, upright, layer, point, component, line, other, lows,
           tile):  # fmt: skip
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
    low = np.uint64(MODES) * np.uint64(tile)
    shift -= sums[total] * lows[low]
    if g.modes > 1:
        stride *= np.uint64(NEAR_MODES)
        shift += sum_16(weights, begin_near, none, near, at_near, stride, rows_near)
        for m in range(np.uint64(1), np.uint64(MODES)):
            shift -= sums[total + m] * lows[low + m]
    return shift


@numba.njit(**INLINED)
def both_shifts(weights, sums, first, near, g, upright, layer, point, line, other, lows,
          tile):  # fmt: skip
    """Normal and tangential shift of a point in one layer."""
    begin, at, rows, begin_near, at_near, rows_near, total = _places(
        g, upright, layer, point, NORMAL, line, other
    )
    stride = np.uint64(g.stride)
    apart = np.uint64(g.points) * rows * np.uint64(g.lanes)
    if g.lanes == 8:
        normal, tangential = two_sums_8(weights, begin, apart, first, at, stride, rows)
    else:
        normal, tangential = two_sums_16(weights, begin, apart, first, at, stride, rows)
    to = total + np.uint64(MODES * g.points)
    low = np.uint64(MODES) * np.uint64(tile)
    normal -= sums[total] * lows[low]
    tangential -= sums[to] * lows[low]
    if g.modes > 1:
        apart = np.uint64(g.points * 16) * rows_near
        stride *= np.uint64(NEAR_MODES)
        n, t = two_sums_16(weights, begin_near, apart, near, at_near, stride, rows_near)
        normal += n
        tangential += t
        for m in range(np.uint64(1), np.uint64(MODES)):
            normal -= sums[total + m] * lows[low + m]
            tangential -= sums[to + m] * lows[low + m]
    return normal, tangential


@numba.njit(**INNER)
def point_shift(weights, sums, first, near, g, upright, layer, part, point, line, other,
           scale, lows, tile):  # fmt: skip
    """Shift (normal, tangential) of a point, between two layers."""
    normal, tangential = both_shifts(
        weights, sums, first, near, g, upright, layer, point, line, other, lows, tile
    )  # fmt: skip
    if part > np.float32(0.0):
        n, t = both_shifts(
            weights, sums, first, near, g, upright, layer + 1, point, line, other, lows, tile
        )  # fmt: skip
        normal += part * (n - normal)
        tangential += part * (t - tangential)
    return scale * normal, scale * tangential


@numba.njit(**INLINED)
def find_layer(log_z0, per_log, layers, z):
    """Layer below the height ``z`` [um] and the part of the way to the next."""
    if layers == 1:
        return 0, np.float32(0.0)
    at = (log_single(max(z, np.float32(1e-3))) - log_z0) * per_log
    at = min(max(at, np.float32(0.0)), np.float32(layers - 1))
    layer = min(np.int64(at), layers - 2)
    return layer, at - np.float32(layer)


@numba.njit(**INLINED)
def scale_at(scale, per_um, z):
    """Factor of the shifts at a height."""
    if scale.size == 0:
        return np.float32(1.0)
    at = min(max(z * per_um, np.float32(0.0)), np.float32(scale.size - 1))
    n = np.uint64(min(np.int32(at), np.int32(scale.size - 2)))
    return scale[n] + (at - np.float32(n)) * (scale[n + np.uint64(1)] - scale[n])
