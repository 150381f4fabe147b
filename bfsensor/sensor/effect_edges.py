"""Changes of edge shifts by effects, carried over to the vertices of a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Shot
from bfsensor.errors import SensorError
from bfsensor.typing import FloatArray

REACH = 7
"""Largest distance [pixel] of a charge that acts on an edge.

Derived: the kernels hold 16 lanes, which are 2 reach + 2."""

_SAME = 1e-9
"""Difference from a factor, relative to the largest shift, below which a change is a factor.

Chosen: above the round-off of products in double precision (1e-16); twice as much changes
nothing unless an effect departs from a factor by just that."""

Sides = tuple[FloatArray, FloatArray]
"""Arrays of the vertical and the horizontal edges."""


class EdgeChange(NamedTuple):
    """Change of the shifts around a charge by effects: first factors, then added shifts.

    Attributes
    ----------
    x, y : float
        Factors on all displacements along x and along y.
    added : pair of ndarray, or None
        Shifts of right and upper edges [pixel/e-], square, the charge in the middle pixel.
    """

    x: float = 1.0
    y: float = 1.0
    added: Sides | None = None

    def is_none(self) -> bool:
        """Whether the change leaves all shifts as they are."""
        return self.x == self.y == 1.0 and self.added is None

    @property
    def reach(self) -> int:
        """Distance [pixel] from the charge within which added shifts move corners."""
        if self.added is None:
            return 0
        half = len(self.added[0]) // 2
        rows, columns = np.nonzero((self.added[0] != 0) | (self.added[1] != 0))
        far = np.abs(np.concatenate([rows, columns]) - half)
        return int(far.max(initial=0)) + 1


def mean_shifts(sides: Sides, points: FloatArray) -> Sides:
    """Average the shifts along right and upper edges, for the topmost layer.

    Parameters
    ----------
    sides : pair of ndarray, shapes (layers, n, n + 1, points, 2), (layers, n + 1, n, points, 2)
        Vertical and horizontal sides around a charge in the middle [pixel/e-].
    points : ndarray
        Nominal positions along a side, from 0 to 1.

    Returns
    -------
    kx, ky : ndarray, shape (n + 2, n + 2)
        Mean normal shifts of right and of upper edges [pixel/e-], ``[row, column]``, with a ring
        of pixels around those of the sides.
    """
    lengths = _lengths(points)
    n = sides[0].shape[1]
    kx, ky = np.zeros((2, n + 2, n + 2))
    # Side l is the left edge of column l, the right one of the column before.
    kx[1:-1, :-1] = sides[0][-1, ..., 0] @ lengths
    ky[:-1, 1:-1] = sides[1][-1, ..., 1] @ lengths
    return kx, ky


def find_change(
    effects: Sequence[Effect], shifts: Sides, shot: Shot, layout: Layout
) -> EdgeChange:
    """Express the change of shifts by effects as factors and added shifts.

    Each effect is applied to the shifts and to zeros; the answer to zeros is the shift that it
    adds.  If the rest of its change is a factor, that is taken; otherwise all of it is added.

    Parameters
    ----------
    effects : sequence of Effect
        Effects in the order in which they act.
    shifts : pair of ndarray
        Shifts of right and upper edges without effects [pixel/e-].
    shot : Shot
        Conditions of the exposure.
    layout : Layout
        Sensor.

    Returns
    -------
    EdgeChange

    Raises
    ------
    SensorError
        An effect returns shifts that are not finite, because a condition of the exposure that it
        needs is not known.
    """
    factors = [1.0, 1.0]
    now = shifts
    added: Sides = (np.zeros_like(shifts[0]), np.zeros_like(shifts[1]))
    for effect in effects:
        then = effect.edges(now[0], now[1], shot, layout)
        if then[0] is now[0] and then[1] is now[1]:
            continue
        if not all(np.isfinite(k).all() for k in then):
            raise SensorError(
                f"effects: {effect.name} gives shifts that are not finite under the conditions "
                f"{shot}"
            )
        none = np.zeros_like(now[0])
        with np.errstate(all="ignore"):
            alone = effect.edges(none, none.copy(), shot, layout)
        new = []
        for axis in (0, 1):
            old = _resized(now[axis], len(then[axis]))
            own = _resized(alone[axis], len(then[axis]))
            if not np.isfinite(own).all():
                own = np.zeros_like(old)
            change = then[axis] - own
            factor = float((change * old).sum() / max((old * old).sum(), 1e-300))
            rest = change - factor * old
            if np.abs(rest).max() > _SAME * max(np.abs(old).max(), 1e-300):
                # Not a factor: all of it is added.
                factor, own = 1.0, then[axis] - old
            factors[axis] *= factor
            new.append(factor * _resized(added[axis], len(own)) + own)
        added = new[0], new[1]
        now = then
    if not (added[0].any() or added[1].any()):
        return EdgeChange(factors[0], factors[1])
    size = max(len(a) for a in added)
    return EdgeChange(
        factors[0], factors[1], (_resized(added[0], size), _resized(added[1], size))
    )


def change_sides(sides: Sides, points: FloatArray, change: EdgeChange, reach: int) -> Sides:
    """Change the sides around a charge, for edges up to ``reach`` pixels away.

    Factors act on every vertex.  An added shift moves all vertices of its edge: corners,
    which belong to four edges, move by the mean of these edges' shifts, so that polygons still
    tile the plane, and the inner vertices by the amount with which the mean along the edge is the
    added shift.  Added shifts are the same at all heights.

    Parameters
    ----------
    sides, points
        As for :func:`mean_shifts`.
    change : EdgeChange
        Factors and added shifts.
    reach : int
        Distance from the charge [pixel] to which the sides extend, at most :data:`REACH`.

    Returns
    -------
    pair of ndarray
        Changed sides, of at least 2 reach + 1 pixels.
    """
    more = max(reach - sides[0].shape[1] // 2, 0)
    width = ((0, 0), (more, more), (more, more), (0, 0), (0, 0))
    scale = np.array([change.x, change.y])
    vertical, horizontal = (np.pad(s, width) * scale for s in sides)
    if change.added is None:
        return vertical, horizontal
    n = vertical.shape[1]
    # A ring beyond the sides, for the corners at their rim.
    kx, ky = (_resized(a, n + 2) for a in change.added)
    right, upper = kx[:, :-1], ky[:-1]
    corners = np.stack(
        [0.5 * (right[:-1] + right[1:]), 0.5 * (upper[:, :-1] + upper[:, 1:])], -1
    )
    vertical += _along(corners[:-1], corners[1:], right[1:-1], 0, points)
    horizontal += _along(corners[:, :-1], corners[:, 1:], upper[:, 1:-1], 1, points)
    return vertical, horizontal


def _along(
    start: FloatArray,
    end: FloatArray,
    mean: FloatArray,
    normal: int,
    points: FloatArray,
) -> FloatArray:
    """Shifts (..., points, 2) along edges between corners, with a given mean normal shift."""
    t = points[:, None]
    out = start[..., None, :] * (1 - t) + end[..., None, :] * t
    if len(points) > 2:
        lengths = _lengths(points)
        ends = lengths[0] * start[..., normal] + lengths[-1] * end[..., normal]
        inner = (mean - ends) / (1 - lengths[0] - lengths[-1])
        out[..., 1:-1, normal] = inner[..., None]
    return np.asarray(out)


def _lengths(points: FloatArray) -> FloatArray:
    """Weights of the points for the mean over the polyline through them."""
    out = np.zeros(len(points))
    out[1:] += np.diff(points) / 2
    out[:-1] += np.diff(points) / 2
    return out


def _resized(kernel: FloatArray, size: int) -> FloatArray:
    """Kernel of another odd size about the same middle, zero beyond."""
    margin = (size - len(kernel)) // 2
    if margin >= 0:
        return np.pad(kernel, margin)
    return kernel[-margin:margin, -margin:margin]
