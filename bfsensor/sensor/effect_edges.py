"""Effects on the shifts of edges, carried to the vertices of a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Shot
from bfsensor.errors import SensorError
from bfsensor.typing import FloatArray

REACH = 7
"""Farthest charge [pixel] that the engine lets act on an edge."""

_SAME = 1e-9

Sides = tuple[FloatArray, FloatArray]


class EdgeChange(NamedTuple):
    """What effects make of the shifts around a charge: factors, then shifts that are added.

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
        """Whether nothing changes."""
        return self.x == self.y == 1.0 and self.added is None

    @property
    def reach(self) -> int:
        """Pixels from the charge within which all corners lie that added shifts move."""
        if self.added is None:
            return 0
        half = len(self.added[0]) // 2
        rows, columns = np.nonzero((self.added[0] != 0) | (self.added[1] != 0))
        far = np.abs(np.concatenate([rows, columns]) - half)
        return int(far.max(initial=0)) + 1


def mean_shifts(sides: Sides, points: FloatArray) -> Sides:
    """Means along right and upper edges of the topmost layer of sides.

    Parameters
    ----------
    sides : pair of ndarray, shapes (layers, n, n + 1, points, 2), (layers, n + 1, n, points, 2)
        Vertical and horizontal sides around a charge in the middle [pixel/e-].
    points : ndarray
        Nominal positions along a side, from 0 to 1.

    Returns
    -------
    kx, ky : ndarray, shape (n + 2, n + 2)
        ``[row, column]``, with a ring of pixels around those of the sides.
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
    """Find what effects do to shifts: the factors of each, and what is left is added.

    Parameters
    ----------
    effects : sequence of Effect
        In the order in which they act.
    shifts : pair of ndarray
        Of right and upper edges without effects [pixel/e-].
    shot, layout : Shot, Layout
        Exposure and sensor.

    Returns
    -------
    EdgeChange

    Raises
    ------
    SensorError
        An effect gives shifts that are not finite: it does not know enough of the exposure.
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
    """Change the sides around a charge, for charges up to ``reach`` pixels away.

    Factors act on every vertex.  A shift that is added moves all vertices of its edge; corners,
    which belong to four edges, move by the mean of theirs, so that polygons tile the plane as
    before, and the inner vertices by so much that the mean along the edge is what was asked for.
    Added shifts are the same at all heights.

    Parameters
    ----------
    sides, points
        As for :func:`mean_shifts`.
    change : EdgeChange
        Of the shifts.
    reach : int
        At most :data:`REACH`.

    Returns
    -------
    pair of ndarray
        Sides of at least 2 reach + 1 pixels.
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
    """Shifts (..., points, 2) along edges between corners, of the mean normal shift asked for."""
    t = points[:, None]
    out = start[..., None, :] * (1 - t) + end[..., None, :] * t
    if len(points) > 2:
        lengths = _lengths(points)
        ends = lengths[0] * start[..., normal] + lengths[-1] * end[..., normal]
        inner = (mean - ends) / (1 - lengths[0] - lengths[-1])
        out[..., 1:-1, normal] = inner[..., None]
    return np.asarray(out)


def _lengths(points: FloatArray) -> FloatArray:
    """Part of an edge that each point stands for, of the line through them."""
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
