"""Weights of the charges around an edge, packed for the kernels, with bounds on the shifts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels.shifts import NEAR_MODES, Edges
from bfsensor.typing import FloatArray

_BINS = 128
"""Bins along an edge by which the nearest point and its error bound are looked up.

Chosen: the bounds decide only which electrons are held against the whole boundary; with twice as
many bins they are tighter and the tables twice as large."""

_NEAR = 1
"""Largest distance [pixel] of a source to which the modes of the nearest pixels apply.

Chosen: farther away the response is proportional to the first mode; at 2 their windows would hold 25
pixels in place of 9."""

_CHANGE_BINS = 512
"""Bins of height in which the change of shifts from the topmost layer is bounded.

Chosen: 0.2 um in 100 um of silicon, a twentieth of the depth of red light; with twice as many the
bounds are tighter by as little."""

_DEEPEST = 0.03
"""Largest change of shifts, relative to their bound, down to which the topmost layer is used.

Chosen: with it both LSST devices are served down to 35 um below the back surface; electrons within
the change of an edge are held against their own layers, twice as many at twice as much."""

RANGES = np.append(250.0 * 2.0 ** (np.arange(97) / 8), np.inf)
"""Ranges of effective charge [e-] for which errors are bounded; the last, any range.

Chosen: 250 e- to 1 million e- in steps of 9 %, by which a bound may be too wide.  They decide
which electrons are held against the whole boundary and where the nearest layer suffices."""


def join_sides(
    corners: FloatArray,
    horizontal: FloatArray,
    vertical: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Join the vertices of every side with the two corners in which it ends.

    Parameters
    ----------
    corners, horizontal, vertical : ndarray, shapes (..., n + 1, n + 1, 2), \
(..., n + 1, n, v, 2), (..., n, n + 1, v, 2)
        Shifts as in :class:`bfsensor.DistortionTable`.

    Returns
    -------
    vertical, horizontal : ndarray, shapes (..., n, n + 1, v + 2, 2), (..., n + 1, n, v + 2, 2)
        Shifts of the sides along y and along x, in the unit of the arguments.
    """
    c = corners[..., None, :]
    upright = np.concatenate([c[..., :-1, :, :, :], vertical, c[..., 1:, :, :, :]], -2)
    flat = np.concatenate([c[..., :, :-1, :, :], horizontal, c[..., :, 1:, :, :]], -2)
    return upright, flat


def transpose_sides(
    vertical: FloatArray, horizontal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Exchange x and y of sides as :func:`join_sides` returns them."""
    axes = (*range(horizontal.ndim - 4), -3, -4, -2, -1)
    order = tuple(a % horizontal.ndim for a in axes)
    return (
        horizontal.transpose(order)[..., ::-1],
        vertical.transpose(order)[..., ::-1],
    )


def window_weights(
    vertical: FloatArray, horizontal: FloatArray, reach: int
) -> tuple[FloatArray, FloatArray]:
    """Order the shifts around one source as weights of the sources around one edge.

    Parameters
    ----------
    vertical, horizontal : ndarray, shapes (layers, n, n + 1, points, 2), \
(layers, n + 1, n, points, 2)
        Shifts (dx, dy) [pixel per electron] around a source in the middle.
    reach : int
        Largest distance of a source [pixel], at most (n - 1) / 2.

    Returns
    -------
    vertical, horizontal : ndarray, shapes (layers, points, 2, 2 reach + 1, 2 reach + 2), \
(layers, points, 2, 2 reach + 2, 2 reach + 1)
        Normal and tangential shift of a point [pixel per electron], by row and column of the
        source.
    """
    middle = vertical.shape[1] // 2
    q = reach
    across = slice(middle - q, middle + q + 1)
    lines = slice(middle - q, middle + q + 2)
    v = vertical[:, across, lines][:, ::-1, ::-1]
    h = horizontal[:, lines, across][:, ::-1, ::-1]
    return v.transpose(0, 3, 4, 1, 2), h[..., ::-1].transpose(0, 3, 4, 1, 2)


def make_edges(
    modes: Sequence[tuple[FloatArray, FloatArray]],
    points: FloatArray,
    heights: FloatArray,
    reach: int,
    *,
    scale: FloatArray | None = None,
) -> Edges:
    """Pack the shifts of all modes for the kernels, with bounds on them.

    Parameters
    ----------
    modes : sequence of pairs of ndarray
        Vertical and horizontal sides of each mode as for :func:`window_weights`: one mode, or with it
        all of those that apply to sources within one pixel only.
    points : ndarray
        Nominal positions along a side, from 0 to 1.
    heights : ndarray, shape (layers,)
        Heights of the layers above the gates [um], in equal steps of the logarithm.
    reach : int
        Largest distance of a source [pixel].
    scale : ndarray, optional
        Factor on all shifts, on equal steps from the gates to the height of the only layer.

    Returns
    -------
    Edges
    """
    lanes = 8 if 2 * reach + 2 <= 8 else 16
    windows = [window_weights(*modes[0], reach)]
    windows += [window_weights(*mode, _NEAR) for mode in modes[1:]]
    sums = np.zeros((2, *windows[0][0].shape[:3], 1 + NEAR_MODES))
    blocks = []
    for side in (0, 1):
        for m, mode in enumerate(windows):
            sums[side, ..., m] = mode[side].sum((-2, -1))
        blocks.append(_pack(windows[0][side], lanes))
    for side in (0, 1):
        near = [mode[side] for mode in windows[1:]]
        blocks.append(_pack(_side_by_side(near), 16) if near else np.zeros(0, np.float32))
    centres = (np.arange(_BINS) + 0.5) / _BINS
    nearest = np.abs(centres[:, None] - points).argmin(1)
    normal, doubts = _bounds(windows, points, nearest)
    log_step = float(np.log(heights[1] / heights[0])) if len(heights) > 1 else 1.0
    factor = np.ones(2) if scale is None else np.asarray(scale, float)
    change, along = _changes(
        windows, float(heights[-1]), log_step, float(normal.max()), factor
    )
    used = np.flatnonzero(change[:, 0] <= _DEEPEST)
    per_change = _CHANGE_BINS / float(heights[-1])
    return Edges(
        weights=np.concatenate(blocks),
        scale=np.zeros(0, np.float32) if scale is None else scale.astype(np.float32),
        per_um=0.0 if scale is None else (len(scale) - 1) / float(heights[-1]),
        starts=np.cumsum([0, *(block.size for block in blocks[:3])]),
        sums=sums.astype(np.float32).swapaxes(2, 3).ravel(),
        points=np.ascontiguousarray(points, float),
        nearest=nearest.astype(np.int64),
        doubts=doubts,
        alike=_alike(windows),
        shares=(normal / normal.max() if normal.max() > 0 else np.ones(2)).astype(
            np.float32
        ),
        by_point=_by_point(windows, float(factor[-1])),
        change=change,
        per_change=per_change,
        along=along,
        lowest=float(used[0] / per_change),
        normal=float(normal.max()),
        reach=int(reach),
        lanes=lanes,
        layers=len(heights),
        modes=len(windows),
        log_z0=float(np.log(heights[0])),
        log_step=log_step,
    )


def _side_by_side(modes: list[FloatArray]) -> FloatArray:
    """Join the modes of a window in its columns, those of a pixel side by side."""
    joined = np.stack(modes, -1)
    return joined.reshape(*joined.shape[:-2], -1)


def _pack(weights: FloatArray, lanes: int) -> NDArray[np.float32]:
    """Weights in single precision, rows padded to ``lanes``, points before components."""
    packed = np.zeros((*weights.shape[:-1], lanes), np.float32)
    packed[..., : weights.shape[-1]] = weights
    return packed.swapaxes(1, 2).ravel()


def _by_point(
    modes: list[tuple[FloatArray, FloatArray]], factor: float
) -> NDArray[np.float32]:
    """Weights of the topmost layer with the points side by side, as ``Edges.by_point``."""
    points = modes[0][0].shape[1]
    blocks = (points + 15) // 16
    sides = []
    for side in (0, 1):
        weights = [factor * mode[side][-1] for mode in modes]
        sums = np.zeros((points, 2, 1 + NEAR_MODES))
        squares = []
        for m, w in enumerate(weights):
            sums[..., m] = w.sum((-2, -1))
            size = max(w.shape[-2:])
            square = np.zeros((points, 2, size, size))
            square[..., : w.shape[-2], : w.shape[-1]] = w
            squares.append(square)
        flat = [squares[0], _side_by_side(squares[1:])] if squares[1:] else squares
        parts = [sums, *(f.reshape(points, 2, -1) for f in flat)]
        packed = np.zeros((16 * blocks, 2, sum(part.shape[-1] for part in parts)))
        packed[:points] = np.concatenate(parts, -1)
        sides.append(packed.reshape(blocks, 16, 2, -1).transpose(0, 3, 2, 1))
    return np.stack(sides).astype(np.float32).ravel()


def _bounds(
    modes: list[tuple[FloatArray, FloatArray]],
    points: FloatArray,
    nearest: NDArray[np.int64],
) -> tuple[FloatArray, NDArray[np.float32]]:
    """Bound the normal shift, and its change from the nearest point to the true place.

    Effective charges in a range r, less any value in it, move a point by at most r times
    the larger of the sums of its positive and its negative weights, plus their sum.

    Returns
    -------
    normal : ndarray, shape (2,)
        Bound of any normal shift by range [pixel per electron], vertical and horizontal.
    doubts : ndarray, shape (2, ranges, bins)
        Bound of (shift of the polyline at a place along the edge) - (shift of the nearest
        point in the nearest layer) for the ranges of ``RANGES``, vertical and horizontal.
    """
    top = np.zeros(2)
    doubts = np.zeros((2, len(RANGES), _BINS), np.float32)
    for side in (0, 1):
        normal = tangential = layer = np.zeros(len(points))
        slope = np.zeros(len(points) - 1)
        ends = 0.0
        for sides in modes:
            weights = sides[side]
            normal = normal + _largest(weights[:, :, 0])
            tangential = tangential + _largest(weights[:, :, 1])
            if len(weights) > 1:
                layer = layer + _largest(0.5 * np.diff(weights[:, :, 0], axis=0))
            gaps = np.diff(points)[:, None, None]
            slope = slope + _largest(np.diff(weights[:, :, 0], axis=1) / gaps)
            # Where two edges of a line meet their shifts may differ, for the windows of sources
            # around them do: the next window lies one row (column) further on.
            before, after = [(0, 0), (0, 0), (0, 0)], [(0, 0), (0, 0), (0, 0)]
            before[1 + side], after[1 + side] = (0, 1), (1, 0)
            for c in (0, 1):
                jump = np.pad(weights[:, -1, c], before) - np.pad(weights[:, 0, c], after)
                ends += float(_largest(jump[:, None]).max())
        top[side] = normal.max()
        doubts[side, -1] = np.inf
        # Three edges in a row: tangential shifts may bring a point from beyond a corner here.
        at = np.concatenate([points - 1, points, points + 1])
        move = np.tile(tangential, 3)
        climb = np.concatenate([[*slope, 0.0]] * 3)[:-1]
        way = np.concatenate([[0.0], np.cumsum(climb * np.diff(at))])
        between = np.array([
            np.maximum.accumulate(np.where(np.arange(len(at)) < k, 0.0, move))
            for k in range(len(at))
        ])  # fmt: skip
        for n, r in enumerate(RANGES[:-1]):
            doubts[side, n] = _doubt(
                r * between, r * way, r * layer, r * ends, at, points, nearest
            )
    # Room for the rounding to single precision.
    return 1.00001 * top, 1.00001 * doubts


def _changes(
    modes: list[tuple[FloatArray, FloatArray]],
    top: float,
    log_step: float,
    normal: float,
    factor: FloatArray,
) -> tuple[NDArray[np.float32], float]:
    """Bounds by which shifts change from the topmost layer to a height, and of those along edges.

    Returns
    -------
    change : ndarray, shape (bins, 2)
        Bound of the change of the normal and of the tangential shift, relative to ``normal``, in
        equal bins of height from 0 to ``top`` [um]; ``factor`` multiplies all shifts, on equal
        steps of the same height.
    along : float
        Bound of the tangential shift in the topmost layer, relative to ``normal``.
    """
    layers = len(modes[0][0])
    by_layer = np.zeros((layers, 2))
    along = 0.0
    for side in (0, 1):
        moved = np.zeros((layers, 2))
        tangential = np.zeros(modes[0][0].shape[1])
        for mode in modes:
            weights = mode[side]
            for layer in range(layers - 1):
                moved[layer] += _largest(weights[layer] - weights[-1])
            tangential = tangential + _largest(weights[-1:, :, 1])
        by_layer = np.maximum(by_layer, moved)
        along = max(along, float(tangential.max()))
    by_layer = np.maximum.accumulate(by_layer[::-1])[::-1]
    low = top * np.arange(_CHANGE_BINS) / _CHANGE_BINS
    at = layers - 1 + np.log(np.maximum(low, 1e-3) / top) / log_step
    at = np.clip(at, 0, layers - 1)
    # In the lower half between two layers the lower one may be taken in place of both.
    at = np.where(at % 1.0 <= 0.501, np.floor(at), at)
    change = np.stack([np.interp(at, np.arange(layers), c) for c in by_layer.T], 1)
    per_normal = 1.0 / normal if normal > 0 else 0.0
    # A factor of the height moves points by what it takes from the whole shift.
    less = np.abs(factor - factor[-1])
    less = np.maximum.accumulate(less[::-1])[::-1]
    part = less[np.arange(_CHANGE_BINS) * (len(less) - 1) // _CHANGE_BINS]
    change = per_normal * change * np.abs(factor).max() + np.stack(
        [part, part * per_normal * along], 1
    )
    # Room for the rounding to single precision.
    return (1.0001 * change).astype(np.float32), 1.0001 * per_normal * along


def _alike(
    modes: list[tuple[FloatArray, FloatArray]],
) -> NDArray[np.int64]:
    """Row of the first range for which half a step to the next layer is above 5e-5 pixel.

    Below it the nearest layer stands for all heights around it.  The mean over the points of an
    edge is compared: next to corners points move along their edge by more, which changes no
    area.
    """
    steps = np.zeros(max(len(modes[0][0]) - 1, 1))
    if len(modes[0][0]) > 1:
        for side in (0, 1):
            change = sum(
                np.abs(0.5 * np.diff(mode[side], axis=0)).sum((-2, -1)).mean((1, 2))
                for mode in modes
            )
            steps = np.maximum(steps, change)
    return np.searchsorted(RANGES, 5e-5 / np.maximum(steps, 1e-30), side="right")


def _largest(weights: FloatArray) -> FloatArray:
    """Bound by point, over the layers, for charges in a range of 1."""
    up = np.maximum(weights, 0).sum((-2, -1))
    down = np.maximum(-weights, 0).sum((-2, -1))
    return np.asarray((np.maximum(up, down) + np.abs(weights.sum((-2, -1)))).max(0))


def _doubt(
    between: FloatArray,
    way: FloatArray,
    layer: FloatArray,
    ends: float,
    at: FloatArray,
    points: FloatArray,
    nearest: NDArray[np.int64],
) -> FloatArray:
    """Bound of the error of the nearest point's shift, by place along the edge.

    ``between[a, b]``: largest tangential shift of the points ``at`` from a to b; ``way``:
    the normal shift's largest change up to each.
    """
    most = between[0, -1]
    if most >= 0.9:
        return np.full(_BINS, np.inf)
    low = np.arange(_BINS) / _BINS
    high = low + 1 / _BINS
    reach = np.full(_BINS, most)
    for _ in range(8):
        first = np.clip(np.searchsorted(at, low - reach) - 1, 0, len(at) - 1)
        last = np.clip(np.searchsorted(at, high + reach), 0, len(at) - 1)
        reach = np.minimum(reach, between[first, last])
    here = points[nearest]
    up = np.interp(high + reach, at, way) - np.interp(here, at, way)
    down = np.interp(here, at, way) - np.interp(low - reach, at, way)
    crosses = (low - reach < 0) | (high + reach > 1)
    return np.maximum(np.maximum(up, down), 0) + layer[nearest] + ends * crosses
