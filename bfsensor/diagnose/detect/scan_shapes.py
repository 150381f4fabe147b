"""Shapes that scans seek as a whole: the effect itself, and boundaries between columns or rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.detect.scan_templates import Group, Pattern
from bfsensor.diagnose.model.map_shapes import Places
from bfsensor.typing import FloatArray

OCTAVES = 4
"""Sizes of boxes, from half a side on."""

LENGTHS = 1.5, 4.0
"""Reaches of a distortion by a boundary [pixel]."""

REACH = 1.5
"""Of these lengths, to either side: 95 % of the distortion's square."""


def own_shapes(g: Group) -> Iterator[Pattern]:
    """Covariances as the effect gives them, stronger or weaker: by flux, condition and level.

    One template for what single lags hold in small parts each.
    """
    x = g.axes
    shape = _own_shape(g)
    level = x["level"].astype(float)
    where = {
        "lags": [(0, 0), (1, 0), (0, 1), (1, 1)],
        "level": (float(level.min()), float(level.max())),
        "set": "own shape",
    }
    for p in (0, 1, 2):
        # The covariances themselves go with the square of the level.
        unit = (level / level.max()) ** p
        yield "own shape x power", shape * unit, {**where, "power": p + 2}
    for condition in dict.fromkeys(g.condition):
        own = g.condition == condition
        if not own.all():
            told = {**where, "condition": condition}
            yield "own shape x condition", np.where(own, shape, 0.0), told


def _own_shape(g: Group) -> FloatArray:
    """Covariances due to the effect, as predicted; what neighbours gain the variance lacks."""
    x = g.axes
    i, j = x["i"].astype(int), x["j"].astype(int)
    weight = np.where(i > 0, 2.0, 1.0) * np.where(j > 0, 2.0, 1.0)
    zero = (i == 0) & (j == 0)
    shape = np.where(zero, 0.0, g.predicted())
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
    """Edges displaced by a boundary, exponentially less with distance: wide here, narrow there.

    Parameters
    ----------
    rows : ndarray of bool
        Values that are columns (or rows) of one map.
    place : ndarray
        Which column (or row) each is.
    where : mapping
        What the map is.
    axis : str
        'x' of columns, 'y' of rows.
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
    """All four rims of a map together, and columns beside every n-th boundary from the rim."""
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
    """Halves, quarters and so on of a map, with what columns and rows have of them."""
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
