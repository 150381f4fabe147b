"""Points along boundary lines: where they are traced, and between which they are smooth.

Lines between columns are smooth along a pixel, so that few points describe them.  Those between rows
jump where they cross a boundary between columns, and all of their points are traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bfsensor.typing import FloatArray

SMOOTH_POINTS = 12
"""Points of a line between columns that are traced in a pixel, its Chebyshev points.

Measured beside 100,000 e-: polynomials of higher order would add 2e-6 (ITL) and 5e-5 um (E2V, 2 um above
the gates), at most 3e-3 of the shift there; with twice as many nothing, at twice the cost."""

_BEYOND = (0.15, 0.4)
"""Points of a line in the pixel beyond the last, in half pitches.

Chosen: two, so that the last corner, which moves by less, has a point on either side; at twice the
values the corner lies between points 1.5 um apart."""


@dataclass(frozen=True)
class LinePoints:
    """Points along a line on which it is traced, and those on which it is given.

    Attributes
    ----------
    traced : ndarray, shape (n,)
        Nominal coordinates along the line [um], from 0 on a mirror-symmetric domain.
    even, odd : ndarray, shape (m, n), or None
        Matrices that interpolate from ``traced`` to the given points: ``even`` for coordinates that are
        the same on both sides of the mirror plane, ``odd`` for those that change sign there.  Without
        mirror planes both are equal.  None where all given points are traced.
    """

    traced: FloatArray
    even: FloatArray | None
    odd: FloatArray | None

    def spread(self, points: FloatArray, along: int) -> FloatArray:
        """Interpolate points (x, y), shape (..., n, 2), of lines along an axis: (..., m, 2)."""
        if self.even is None or self.odd is None:
            return points
        kinds = (self.odd, self.even) if along == 0 else (self.even, self.odd)
        return np.stack(
            [points[..., k] @ matrix.T for k, matrix in enumerate(kinds)], axis=-1
        )


@lru_cache(maxsize=16)
def line_points(
    reach: int, pitch: float, samples: int, *, symmetric: bool, smooth: bool
) -> LinePoints:
    """Choose the points of lines, ``samples`` in a pixel up to pixel ``reach`` and a little more."""
    points = min(samples, SMOOTH_POINTS) if smooth else samples
    traced = _positions(reach, pitch, points)
    count = len(traced)
    kept = traced >= 0 if symmetric else np.ones(count, bool)
    if points == samples:
        return LinePoints(traced[kept], None, None)
    inside = np.kron(np.eye(2 * reach + 1), _interpolation(points, samples))
    edge = len(_BEYOND)
    whole = np.zeros((len(inside) + 2 * edge, count))
    whole[edge:-edge, edge:-edge] = inside
    whole[:edge, :edge] = whole[-edge:, -edge:] = np.eye(edge)
    if not symmetric:
        return LinePoints(traced, whole, whole)
    given = _positions(reach, pitch, samples) >= 0
    half = whole[given]
    # The mirror image of a point adds what it sees; a point on the plane has none.
    mirrored = half[:, ::-1] * (traced > 0)
    return LinePoints(traced[kept], (half + mirrored)[:, kept], (half - mirrored)[:, kept])


def _positions(reach: int, pitch: float, samples: int) -> FloatArray:
    """Positions along a line: Chebyshev points in each pixel, so denser at the corners."""
    pixels = np.arange(-reach, reach + 1)
    # A little of the next pixel, for the corner and its displacement.
    margin = np.array(_BEYOND) * pitch / 2 + (reach + 0.5) * pitch
    inside = pixels[:, None] * pitch + _nodes(samples) * pitch / 2
    return np.concatenate([-margin[::-1], inside.ravel(), margin])


def _nodes(samples: int) -> FloatArray:
    """Chebyshev points between -1 and 1, ascending; that in the middle is 0 to the last bit."""
    ascending = -np.cos(np.pi * (np.arange(samples) + 0.5) / samples)
    return 0.5 * (ascending - ascending[::-1])


def _interpolation(points: int, samples: int) -> FloatArray:
    """Matrix from values at ``points`` Chebyshev points to those at ``samples`` of them."""
    degree = points - 1
    at_points = np.polynomial.chebyshev.chebvander(_nodes(points), degree)
    at_samples = np.polynomial.chebyshev.chebvander(_nodes(samples), degree)
    return at_samples @ np.linalg.inv(at_points)
