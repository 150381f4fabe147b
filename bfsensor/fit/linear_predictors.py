"""Linear predictors of saturation levels, diffusion widths and full-depletion voltages.

Emulators do not predict these.  Each setting is solved at the nominal values, and again half a prior
width to either side of every free parameter: the time grows with the number of free parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import ABSORPTION, DIFFUSION, OFF_DEVICE, Prior
from bfsensor.errors import FitError
from bfsensor.fit.data import DataSet
from bfsensor.fit.device_at import device_at
from bfsensor.fit.predictors import TangentPredictor, Tangents, held
from bfsensor.sensor.drift_field import solve_drift
from bfsensor.simulate.full_depletion import back_field, full_depletion_voltage
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.simulate.well import barrier, full_well
from bfsensor.typing import FloatArray

STEP = 0.5
"""Step to either side for derivatives [prior widths].

Chosen: the derivative is a mean over the central half of the prior; twice as large, over its width."""

SPILL = "well.spill_barrier"
"""Name of the parameter that only saturation levels constrain."""

PERIOD = 4
"""Side of the domain of a well [pixel], defined as that of :mod:`bfsensor.simulate.well`."""

CHARGE_STEP = 0.02
"""Relative step of the charge for the derivative of the barrier at the full well.

Chosen: twice as large, the barrier's curvature over 4 instead of 2 % of the full well enters."""

BIAS_STEP = 1.0
"""Step of the back bias for the derivative of the field at the back [V].

Chosen: the field is nearly linear in the bias; twice as large gives the same to 1e-3."""

START = 2.0
"""Height above the gates below which electrons are taken not to diffuse any more [um].

Chosen: below it the field of the wells confines them; twice as large, the drift path in 100 um of
silicon is 2 % shorter."""


def make_tangents(
    device: Device, *, cells: int = 8, progress: Callable[[int, int], None] | None = None
) -> dict[str, Tangents]:
    """Make the makers of linear predictors of saturation, diffusion and full depletion.

    Parameters
    ----------
    device : Device
        Nominal device, mirror-symmetric for saturation.
    cells : int
        Mesh cells per pixel, even.
    progress : callable, optional
        Called with (settings solved, settings in all) of a data set.

    Returns
    -------
    makers : dict of str to callable
        Functions of a data set and the priors, for 'saturation', 'diffusion' and 'depletion'.

    Examples
    --------
    >>> sorted(make_tangents(Device.load("itl_sta3800c")))
    ['depletion', 'diffusion', 'saturation']
    """
    return {
        "saturation": partial(_tangent, device, cells, progress, _well_at),
        "diffusion": partial(_tangent, device, cells, progress, _width_at),
        "depletion": partial(_tangent, device, cells, progress, _depletion_at),
    }


def _tangent(
    device: Device,
    cells: int,
    progress: Callable[[int, int], None] | None,
    solve: Callable[..., tuple[float, FloatArray]],
    data: DataSet,
    priors: Sequence[Prior],
) -> TangentPredictor:
    """Solve every setting of a data set once, and make its linear predictor."""
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
    """Numbers of the parameters that a condition does not state."""
    stated = held([prior.name for prior in priors], condition)
    return [n for n in range(len(priors)) if not stated[n]]


def _slope(
    value: Callable[[FloatArray], float],
    middle: FloatArray,
    n: int,
    spread: float,
    zero: float,
) -> float:
    """Central difference, one-sided where one of the sides is no device."""
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
        raise FitError(
            f"parameter {n + 1} of the priors: no device half a prior width to either side; give a "
            "narrower prior"
        )
    return (sides[high] - sides[low]) / (high - low)


def _well_at(
    device: Device,
    condition: Condition,
    priors: Sequence[Prior],
    middle: FloatArray,
    cells: int,
) -> tuple[float, FloatArray]:
    r"""Full well [e-] and its derivatives by the parameters.

    At the full well Q the barrier B has the value at which charge spills, so that
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
        elif name not in OFF_DEVICE:
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
            f"{device.name}: saturation levels need a mirror-symmetric device (no edge, no ripples)"
        )
    mesh = make_mesh(device, pixels=(PERIOD, PERIOD), cells=cells)
    solver = Electrostatics(device, mesh)
    charges = np.zeros(solver.pixel_shape)
    charges[0, 0] = charge
    start = tile(solve_unit_cell(device, 0.0, cells=cells), mesh)
    return barrier(solver.solve(charges, start=start, tolerance=1e-4))


def _depletion_at(
    device: Device,
    condition: Condition,
    priors: Sequence[Prior],
    middle: FloatArray,
    cells: int,
) -> tuple[float, FloatArray]:
    r"""Full-depletion voltage [V] and its derivatives by the parameters.

    There the field at the back F vanishes, so that
    :math:`dV/dp = -(\partial F/\partial p) / (\partial F/\partial V)`.
    """
    voltage = full_depletion_voltage(device_at(device, condition), cells=cells)

    def field(values: FloatArray | None, bias: float = voltage) -> float:
        there = replace(condition, back_bias=bias)
        return back_field(device_at(device, there, priors, values), cells=cells)

    here = field(None)
    by_bias = (field(None, voltage - BIAS_STEP) - here) / -BIAS_STEP
    slopes = np.zeros(len(priors))
    for n in _free(priors, replace(condition, back_bias=voltage)):
        if priors[n].name not in (SPILL, *OFF_DEVICE):
            slopes[n] = -_slope(field, middle, n, priors[n].spread, here) / by_bias
    return voltage, slopes


def _width_at(
    device: Device,
    condition: Condition,
    priors: Sequence[Prior],
    middle: FloatArray,
    cells: int,
) -> tuple[float, FloatArray]:
    """Diffusion width of light from the back surface [um], and its derivatives."""
    del cells
    names = [prior.name for prior in priors]
    times = middle[names.index(DIFFUSION)] if DIFFUSION in names else device.diffusion

    def width(values: FloatArray) -> float:
        changed = device_at(device, condition, priors, values)
        drift = solve_drift(changed.to_toml(), changed.operating_point.temperature, START)
        return float(np.sqrt(drift.variance[-1]))

    einstein = width(middle)
    slopes = np.zeros(len(priors))
    for n in _free(priors, condition):
        if names[n] == DIFFUSION:
            slopes[n] = einstein
        elif names[n] not in (SPILL, ABSORPTION):
            slopes[n] = times * _slope(width, middle, n, priors[n].spread, einstein)
    return float(times * einstein), slopes
