"""Templates of extended shapes for scans: covariances as predicted, boundaries, rims, combs, boxes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.kinds.map_shapes import Places
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.typing import FloatArray

OCTAVES = 4
"""Number of sizes of boxes: 1/2, 1/4, 1/8 and 1/16 of a side, 340 boxes.  Chosen: each further size
has four times as many; with 8, down to 1/256 of a side, there would be 87,380."""

LENGTHS = 1.5, 4.0
"""Decay lengths of a distortion beside a boundary [pixel].  Chosen: a distortion of length a has
the part 2 (a b)^(1/2) / (a + b) of its significance in the template of length b, at least 0.97
between these two; with 3 and 8, one of 1.5 pixels would have 0.94, and one of 8 pixels 1 instead
of 0.94."""

REACH = 1.5
"""Reported half-width of a boundary, in decay lengths.  Derived: it holds 1 - exp(-2 * 1.5) = 95
% of the square of exp(-|x| / length); twice as large, 99.8 %."""


def own_shapes(g: Group, residuals: FloatArray) -> Iterator[Pattern]:
    """Covariances in the predicted shape of the brighter-fatter effect, by flux and condition.

    One template sums the small deviations of all lags if the effect is stronger or weaker than
    predicted as a whole.
    """
    x = g.axes
    shape = _own_shape(g, residuals)
    level = x["level"].astype(float)
    where = {
        "lags": [(0, 0), (1, 0), (0, 1), (1, 1)],
        "level": (float(level.min()), float(level.max())),
        "set": "own shape",
    }
    for p in (0, 1, 2):
        # The predicted covariances go with the square of the level: hence power + 2.
        unit = (level / level.max()) ** p
        yield "own shape x power", shape * unit, {**where, "power": p + 2}
    for condition in dict.fromkeys(g.condition):
        own = g.condition == condition
        if not own.all():
            told = {**where, "condition": condition}
            yield "own shape x condition", np.where(own, shape, 0.0), told


def _own_shape(g: Group, residuals: FloatArray) -> FloatArray:
    """Predicted covariances; the variance lacks what all lags gain (the areas' sum rule)."""
    x = g.axes
    i, j = x["i"].astype(int), x["j"].astype(int)
    weight = np.where(i > 0, 2.0, 1.0) * np.where(j > 0, 2.0, 1.0)
    zero = (i == 0) & (j == 0)
    shape = np.where(zero, 0.0, g.predicted(residuals))
    folds = np.repeat(np.arange(len(g.members)), [len(c) for c, _ in g.members])
    keys = np.array([
        "/".join(map(str, row)) for row in zip(folds, x["amp"], x["time"], g.condition, strict=True)
    ])  # fmt: skip
    for key in dict.fromkeys(keys):
        own = keys == key
        shape[own & zero] = -(weight[own] * shape[own]).sum()
    return shape


def boundaries(
    rows: NDArray[np.bool_],
    place: FloatArray,
    where: Mapping[str, object],
    axis: str,
) -> Iterator[Pattern]:
    """Patterns of a boundary that displaces pixel edges: columns wider on one side, narrower beyond.

    The response of a column at the distance x from the boundary goes with
    ``sign(x) exp(-|x| / length)``.

    Parameters
    ----------
    rows : ndarray of bool, shape (n,)
        Values that are columns (or rows) of one map.
    place : ndarray, shape (n,)
        Index of each value's column (or row).
    where : mapping
        Description of the map, with 'what'.
    axis : str
        'x' for columns, 'y' for rows.

    Yields
    ------
    pattern : tuple of (str, ndarray, dict)
        Name of the scan, pattern of shape (n,), and place.
    """
    count = int(place[rows].max()) + 1
    for length in LENGTHS:
        for boundary in range(2, count - 1):
            away = place + 0.5 - boundary
            shape = np.sign(away) * np.exp(-np.abs(away) / length)
            reach = REACH * length
            lo, hi = (
                max(int(boundary - reach), 0),
                min(int(np.ceil(boundary + reach)), count),
            )
            yield f"{where['what']} boundaries", np.where(rows, shape, 0.0), {
                **where, axis: (lo, hi),
            }  # fmt: skip


def frames(
    x: Mapping[str, NDArray], here: NDArray[np.bool_]
) -> Iterator[tuple[str, FloatArray, dict[str, object]]]:
    """Patterns of all four rims of a map together, and of columns beside every n-th boundary."""
    sides = []
    for what, axis in (("column", "x"), ("row", "y")):
        rows = here & (x["what"] == what)
        if rows.any():
            place = np.where(rows, x[axis], 0).astype(float)
            sides.append((rows, place, int(place.max()) + 1))
    for length in (1.5, 3.0, 6.0):
        pattern = np.zeros(len(here))
        for rows, place, n in sides:
            both = np.exp(-place / length) + np.exp(-(n - 1 - place) / length)
            pattern += np.where(rows, both, 0.0)
        if sides:
            yield "rims", pattern, {"what": "rim", "length": length}
    columns = here & (x["what"] == "column")
    if columns.any():
        place = x["x"].astype(int)
        for period in range(16, 65):
            inside = (place > 0) & (place < int(place[columns].max()))
            before, behind = (inside & (place % period == k) for k in (period - 1, 0))
            pattern = np.where(columns, before * 1.0 - behind, 0.0)
            yield "combs", pattern, {"what": "comb", "period": float(period)}


def boxes(
    x: Mapping[str, NDArray], here: NDArray[np.bool_], name: str
) -> Iterator[tuple[str, FloatArray, dict[str, object]]]:
    """Boxes of a half, a quarter and so on of a map, as its blocks, columns and rows show them."""
    sides = [
        int(x[axis][here & (x["what"] == what)].max(initial=-1)) + 1
        for what, axis in (("row", "y"), ("column", "x"))
    ]
    if not min(sides) or not (here & (x["what"] == "block")).any():
        return
    places = Places.of(x, (sides[0], sides[1]))
    down, across = (np.arange(n) + 0.5 for n in sides)
    for octave in range(1, OCTAVES + 1):
        tall, wide = (n / 2**octave for n in sides)
        for a in range(2**octave):
            for b in range(2**octave):
                low = a * wide, b * tall
                in_x, in_y = (
                    1.0 * ((place >= start) & (place < start + size))
                    for place, start, size in zip((across, down), low, (wide, tall), strict=True)
                )  # fmt: skip
                box = places.product(in_x, in_y, len(here))
                yield "boxes", np.where(here, box, 0.0), {
                    "map": name, "what": "block", "x": (int(low[0]), int(low[0] + wide)),
                    "y": (int(low[1]), int(low[1] + tall)),
                }  # fmt: skip


def amplifiers(x: Mapping[str, NDArray]) -> list[tuple[object, NDArray[np.bool_]]]:
    """Masks of all amplifiers together, and of each alone."""
    amps = np.unique(x["amp"])
    out: list[tuple[object, NDArray[np.bool_]]] = [("all", np.ones(len(x["amp"]), bool))]
    return out + ([(int(a), x["amp"] == a) for a in amps] if len(amps) > 1 else [])
