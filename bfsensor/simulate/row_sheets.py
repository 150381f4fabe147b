"""Boundaries between rows, found lower down where few points describe them.

Electrons on the boundary between two rows fall into the channel first, from all over the width of a
pixel to near its middle, and then to the saddle of the potential between the two wells.  A micrometre
above that saddle a boundary is a smooth line over a short range of x, its sheet.  A few of its points
are bisected there, by short paths.  Where electrons from higher up must start to fall on it, the secant
method finds in one to three paths that end there, instead of some fifteen that slow down at the saddle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bfsensor._kernels import drift, sheets
from bfsensor.simulate.field import Field, PathSteps
from bfsensor.typing import FloatArray

ABOVE_SADDLE = 1.0
"""Height of sheets above the saddle of the potential between rows [um].

Measured: there the electrons of a pixel of 10 um are 2 (ITL) to 6 um (E2V) apart along a row; at twice
the height 3 and 10 um, which is the whole pixel with its corners."""

POINTS = 8
"""Points of a sheet that are bisected, the Chebyshev points of its range of x.

Measured: the last coefficients are 1e-6 to 1e-5 um (ITL and E2V, up to half of the full well), with six
points up to 7e-5 um; twice as many cost twice as much and leave the tracing error as it is."""

MARGIN = 0.05
"""Range of a sheet beyond the electrons that landed on it, of their range.

Chosen: boundaries shift by less than a hundredth of a pixel, so that paths from them land that much
aside. Derived: at twice the value the coefficient of the seventh order grows by 1.8."""

CLOSER = 0.1
"""Width at which the bisection of a sheet's points ends, in units of that of a boundary's.

Chosen: an error of one of these points moves a third of a pixel's boundary, that of a boundary's point a
twentieth. Measured: far lags of a response to 5,000 e- are within .05 % of those of bisections to
1e-7 um, with 1 instead within .19 %; at twice the value paths are shorter by one of twenty."""

NARROWEST = 0.02
"""Least range of a sheet [um].  Chosen: 2000 times the width at which a bisection ends, so that a range
of one electron has slopes below 1e-3; at twice the value nothing changes."""


@dataclass(frozen=True)
class RowSheets:
    """Boundaries between rows at one height, and the electrons that fall to it from above.

    Attributes
    ----------
    height : float
        Height above the gates [um].
    first : int
        Column of pixels of the first sheet of a line, 0 being that of pixel (0, 0).
    low, high : ndarray, shape (lines, columns)
        Range in x [um], nan where no electron of the column lands.
    coefficients : ndarray, shape (lines, columns, POINTS)
        Chebyshev coefficients of y [um] over that range.
    """

    height: float
    first: int
    low: FloatArray
    high: FloatArray
    coefficients: FloatArray


def sheet_height(field: Field, edge: float, floor: float, ceiling: float) -> float:
    """Height [um] of sheets: some way above the saddle between two rows, in the middle of a channel.

    ``edge`` is the nominal y between the rows; the saddle lies between ``floor`` and ``ceiling``.
    """
    y, x = int(np.argmin(np.abs(field.y - edge))), int(np.argmin(np.abs(field.x)))
    inside = np.flatnonzero((field.z >= floor) & (field.z <= ceiling))
    saddle = inside[np.argmax(field.phi[y, inside, x])]
    return float(field.z[saddle]) + ABOVE_SADDLE


def fall(field: Field, seeds: FloatArray, height: float, steps: PathSteps) -> FloatArray:
    """Find where electrons from seeds, shape (..., 3), land at a height: x, y [um], nan if nowhere."""
    out = np.empty((seeds[..., 0].size, 2))
    sheets.fall_to_height(
        field.phi, field.x, field.y, field.z, np.ascontiguousarray(seeds.reshape(-1, 3)), height,
        steps.coarseness, steps.most, steps.turn, out,
    )  # fmt: skip
    return out.reshape(*seeds.shape[:-1], 2)


def find_sheets(
    field: Field,
    edges: FloatArray,
    landings: FloatArray,
    height: float,
    bracket: float,
    steps: PathSteps,
) -> RowSheets:
    """Bisect the sheets on which electrons land.

    Parameters
    ----------
    field : Field
        The potential.
    edges : ndarray, shape (lines,)
        Nominal y of the lines [um].
    landings : ndarray, shape (lines, n, 2)
        From :func:`fall` of points on those lines.
    height : float
        Height above the gates [um].
    bracket : float
        Distance from an edge at which the search begins [um].
    steps : PathSteps
        How finely paths are followed.

    Returns
    -------
    sheets : RowSheets
        Without those of which a point was not found.
    """
    pitch = field.zone[0]
    x = landings[..., 0]
    columns = np.floor(x / pitch + 0.5)
    first = int(np.nanmin(columns))
    count = int(np.nanmax(columns)) - first + 1
    low, high = np.full((2, len(edges), count), np.nan)
    for c in range(count):
        here = np.where(columns == first + c, x, np.nan)
        some = np.isfinite(here).any(axis=1)
        low[some, c] = np.nanmin(here[some], axis=1)
        high[some, c] = np.nanmax(here[some], axis=1)
    wider = np.maximum(MARGIN * (high - low), NARROWEST / 2)
    low, high = low - wider, high + wider
    node = np.cos(np.pi * (np.arange(POINTS) + 0.5) / POINTS)
    line, column = np.nonzero(np.isfinite(low))
    a, b = low[line, column, None], high[line, column, None]
    seeds = np.empty((len(line), POINTS, 3))
    seeds[..., 0] = a + (b - a) * (node + 1) / 2
    seeds[..., 1] = edges[line, None]
    seeds[..., 2] = height
    y = np.empty(seeds[..., 0].size)
    near = np.full(y.size, bracket)
    drift.bisect_edge(
        field.phi, field.x, field.y, field.z, seeds.reshape(-1, 3), 1,
        seeds[..., 1].ravel(), -near, near, CLOSER * steps.precision, field.zone, steps.coarseness,
        steps.most, y, steps.turn,
    )  # fmt: skip
    fitted = np.linalg.solve(
        np.polynomial.chebyshev.chebvander(node, POINTS - 1), y.reshape(-1, POINTS).T
    )
    coefficients = np.full((*low.shape, POINTS), np.nan)
    coefficients[line, column] = fitted.T
    low[~np.isfinite(coefficients).all(axis=-1)] = np.nan
    return RowSheets(height, first, low, high, coefficients)


def meet(
    field: Field,
    found: RowSheets,
    seeds: FloatArray,
    landings: FloatArray,
    steps: PathSteps,
) -> FloatArray:
    """Find from where electrons fall onto the sheets.

    Parameters
    ----------
    field : Field
        The potential.
    found : RowSheets
        Sheets of the lines.
    seeds : ndarray, shape (lines, n, 3)
        Points on the nominal lines [um].
    landings : ndarray, shape (lines, n, 2)
        From :func:`fall` of them.
    steps : PathSteps
        How finely paths are followed.

    Returns
    -------
    y : ndarray, shape (lines, n)
        Positions [um]; nan where none is found, which happens where columns meet.
    """
    shape = seeds.shape[:2]
    y = np.empty(shape[0] * shape[1])
    sheets.meet_sheets(
        field.phi, field.x, field.y, field.z, np.ascontiguousarray(seeds.reshape(-1, 3)),
        np.ascontiguousarray(landings.reshape(-1, 2)), np.repeat(np.arange(shape[0]), shape[1]),
        field.zone[0], found.first, found.low, found.high, found.coefficients, found.height,
        steps.coarseness, steps.most, steps.turn, steps.precision, y,
    )  # fmt: skip
    return y.reshape(shape)
