"""Saturation levels and diffusion widths, straight in the parameters about the device.

No emulator has them.  Each setting is solved at the device's own values, and again half an
uncertainty to either side of every free parameter: fit few with them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import DIFFUSION, Prior
from bfsensor.errors import FitError
from bfsensor.fit.data import DataSet
from bfsensor.fit.device_at import device_at
from bfsensor.fit.predictors import TangentPredictor, Tangents, held
from bfsensor.sensor.drift_field import solve_drift
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.simulate.well import barrier, full_well
from bfsensor.typing import FloatArray

STEP = 0.5
"""To either side [spread of the prior]."""

SPILL = "well.spill_barrier"

PERIOD = 4
"""Pixels of the domain of a well, as for the full well."""

CHARGE_STEP = 0.02
"""Of the full well, that tells how the barrier falls with charge."""

START = 2.0
"""Height below which electrons diffuse no more [um]: there the field of the wells holds them."""


def make_tangents(
    device: Device, *, cells: int = 8, progress: Callable[[int, int], None] | None = None
) -> dict[str, Tangents]:
    """Make what predicts saturation levels and diffusion widths of a device.

    Parameters
    ----------
    device : Device
        About which they are straight.
    cells : int
        Of the mesh, a pixel.
    progress : callable, optional
        Called with (settings solved, settings in all) of a data set.
    """
    return {
        "saturation": partial(_tangent, device, cells, progress, _well_at),
        "diffusion": partial(_tangent, device, cells, progress, _width_at),
    }


def _tangent(
    device: Device,
    cells: int,
    progress: Callable[[int, int], None] | None,
    solve: Callable[..., tuple[float, FloatArray]],
    data: DataSet,
    priors: Sequence[Prior],
) -> TangentPredictor:
    middle = np.array([prior.mean for prior in priors])
    solved: dict[Condition, tuple[float, FloatArray]] = {}
    for condition in data.conditions:
        if condition in solved:
            continue
        solved[condition] = solve(device, condition, priors, middle, cells)
        if progress is not None:
            progress(len(solved), len(set(data.conditions)))
    both = [solved[condition] for condition in data.conditions]
    return TangentPredictor(
        middle, np.array([b[0] for b in both]), np.array([b[1] for b in both])
    )


def _free(priors: Sequence[Prior], condition: Condition) -> list[int]:
    """Parameters that a condition leaves free."""
    stated = held([prior.name for prior in priors], condition)
    return [n for n in range(len(priors)) if not stated[n]]


def _slope(
    value: Callable[[FloatArray], float],
    middle: FloatArray,
    n: int,
    spread: float,
    zero: float,
) -> float:
    """Central difference, or one-sided at the end of what can be."""
    sides = {0.0: zero}
    for by in (STEP * spread, -STEP * spread):
        changed = middle.copy()
        changed[n] += by
        try:
            sides[by] = value(changed)
        except FitError:
            continue
    low, high = min(sides), max(sides)
    if low == high:
        raise FitError("a parameter cannot be moved to either side")
    return (sides[high] - sides[low]) / (high - low)


def _well_at(
    device: Device,
    condition: Condition,
    priors: Sequence[Prior],
    middle: FloatArray,
    cells: int,
) -> tuple[float, FloatArray]:
    r"""Full well and its derivatives.

    At the full well Q the barrier B stays that of spilling:
    :math:`dQ/dp = -(\partial B/\partial p) / (\partial B/\partial Q)`.
    """
    own = device_at(device, condition)
    well = full_well(own, cells=cells)
    height = _barrier(own, well, cells)
    step = CHARGE_STEP * well
    by_charge = (_barrier(own, well + step, cells) - _barrier(own, well - step, cells)) / (
        2 * step
    )
    slopes = np.zeros(len(priors))
    for n in _free(priors, condition):
        name = priors[n].name
        if name == SPILL:
            slopes[n] = 1 / by_charge
        elif name != DIFFUSION:
            by = _slope(
                lambda v: _barrier(device_at(device, condition, priors, v), well, cells),
                middle, n, priors[n].spread, height,
            )  # fmt: skip
            slopes[n] = -by / by_charge
    return well, slopes


def _barrier(device: Device, charge: float, cells: int) -> float:
    """Barrier between one filled pixel and its empty neighbour along the column [V]."""
    if not device.is_mirror_symmetric:
        raise FitError(
            f"{device.name}: saturation is fitted of mirror-symmetric devices only"
        )
    mesh = make_mesh(device, pixels=(PERIOD, PERIOD), cells=cells)
    solver = Electrostatics(device, mesh)
    charges = np.zeros(solver.pixel_shape)
    charges[0, 0] = charge
    start = tile(solve_unit_cell(device, 0.0, cells=cells), mesh)
    return barrier(solver.solve(charges, start=start, tolerance=1e-4))


def _width_at(
    device: Device,
    condition: Condition,
    priors: Sequence[Prior],
    middle: FloatArray,
    cells: int,
) -> tuple[float, FloatArray]:
    """Width from the back surface [um] and its derivatives."""
    del cells
    names = [prior.name for prior in priors]
    times = middle[names.index(DIFFUSION)] if DIFFUSION in names else 1.0

    def width(values: FloatArray) -> float:
        changed = device_at(device, condition, priors, values)
        drift = solve_drift(changed.to_toml(), changed.operating_point.temperature, START)
        return float(np.sqrt(drift.variance[-1]))

    einstein = width(middle)
    slopes = np.zeros(len(priors))
    for n in _free(priors, condition):
        if names[n] == DIFFUSION:
            slopes[n] = einstein
        elif names[n] != SPILL:
            slopes[n] = times * _slope(width, middle, n, priors[n].spread, einstein)
    return float(times * einstein), slopes
