"""A baseline from a device: simulated shifts, and their derivatives by its uncertain parameters."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter, device_parameters
from bfsensor.device.quantities import quantities
from bfsensor.diagnose.model.baseline import Baseline, Curve, Key
from bfsensor.diagnose.model.cached_response import Walk, walk
from bfsensor.diagnose.model.device_solver import (
    BACKGROUNDS,
    COARSE,
    FINE,
    DeviceSolver,
    less,
)
from bfsensor.diagnose.model.mesh_error import FINEST, in_proportion, mesh_errors, part_of
from bfsensor.diagnose.model.table_baseline import WAVELENGTHS
from bfsensor.effects.changed_device import add_edges
from bfsensor.errors import DeviceError, DiagnosisError
from bfsensor.files import written_whole
from bfsensor.response.edge_response import LEVEL, EdgeResponse, solve_response
from bfsensor.response.light import mixed
from bfsensor.simulate.edge_field import front_plane
from bfsensor.typing import Edges
from bfsensor.units import to_celsius

TABLES = (
    "derivatives on 16 cells at every back bias, by voltages too; levels, mesh at the first"
)
"""Method of the shifts, part of the name of cached files: files of other methods are not read."""

STEP = 1e-4
"""Step over which the device, not its solution, is differentiated by a parameter [its uncertainty].
Chosen: twice as large doubles the relative error of the one-sided difference, itself of the order of
the step."""

WARMER = 10.0
"""Temperature step for the derivative of shifts by temperature [K]. Chosen: twice as large doubles
the error of curvature, for the difference is to one side; half as large doubles errors of the
solutions."""

VOLTAGES = {
    "operating_point.back_bias": 5.0,
    "operating_point.gate_high": 0.5,
    "operating_point.gate_low": 0.5,
}
"""Voltages [V] that are candidates though no device file gives them an uncertainty, and their typical
errors, from which fits begin.  Chosen, as in the fits of the a_ij of 2019: with twice the errors fits
begin twice as far off."""

STRAIGHT = 0.3
"""Change of a fitted quantity [spread of its prior] below which its response is taken as straight.
Chosen: with 0.6, the error of a curved response is four times as large."""

PARTS = ("levels", "depths")
"""Parts of the physics that a baseline can be calculated without: change with level, and depths."""


def baseline_of_device(
    device: Device,
    *,
    parameters: Sequence[str] = (),
    back_biases: Sequence[float] = (),
    lacks: Sequence[str] = (),
    warming: bool = False,
    cells: int = FINE,
    keep: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Baseline:
    """Simulate the shifts of a device, and their derivatives by its uncertain parameters.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device.
    parameters : sequence of str
        Dotted names of the parameters that are free in fits; ``('all',)`` for every quantity
        with an uncertainty in the device's file.
    back_biases : sequence of float
        Back biases of the recordings [V]; without any, the device's own.
    lacks : sequence of str
        Parts of the physics that are left out, as simpler simulations do: 'levels', so that the
        response is the same at all levels; 'depths', so that all light converts at the back
        surface.
    warming : bool
        Whether shifts change with temperature, through absorption and the carriers' heat.
    cells : int
        Mesh cells per pixel of the nominal device.  Where parameters are free, half as many more are
        solved at the first back bias, others take their change in proportion to the shifts, and
        errors of shifts by the mesh are free too.  The change with the level is solved at the first
        back bias alone.
    keep : Path, optional
        Folder where solutions are cached.
    progress : callable, optional
        Called with (solutions made, solutions in all).

    Returns
    -------
    Baseline
        Shifts at eight wavelengths from 400 to 950 nm and each back bias, with derivatives by
        each parameter from the linearised equations of one solution.

    Raises
    ------
    DiagnosisError
        A parameter that the device does not have, or that has no uncertainty (names those that
        have), one that exists on neither side, or an unknown part in ``lacks``.

    Examples
    --------
    A baseline takes seconds to minutes of CPU time, so that this example does not run in tests::

        device = Device.load("itl_sta3800c")
        baseline = baseline_of_device(device, parameters=("silicon.thickness",))
    """
    known = device_parameters(device)
    chosen = list(known) if tuple(parameters) == ("all",) else list(parameters)
    for name in chosen:
        if name not in known:
            raise DiagnosisError(
                f"{device.name} states no uncertainty for {name!r}; it does for {', '.join(known)}"
            )
    for part in lacks:
        if part not in PARTS:
            raise DiagnosisError(
                f"lacks = {part!r} must be one of {', '.join(PARTS)}; leave out other physics in the "
                "device's file"
            )
    own = float(device.operating_point.back_bias)
    # Readings of the device's own bias are its own: solutions are those of its shipped table.
    given = [own if abs(b - own) <= 0.5 else float(b) for b in back_biases]
    biases = sorted(dict.fromkeys(given or [own]), key=lambda b: abs(b - own))
    total, done = len(biases) * (1 + warming + bool(chosen)) + bool(chosen), 0

    def walked(changed: Device, cells: int, levels: Sequence[float] = (LEVEL,)) -> Walk:
        nonlocal done
        found = walk(changed, cells=cells, backgrounds=levels, keep=keep)
        done += 1
        if progress is not None:
            progress(done, total)
        return found

    kelvin = device.operating_point.temperature
    backgrounds = (LEVEL,) if "levels" in lacks else BACKGROUNDS
    solver = DeviceSolver(
        device.to_toml(), tuple(biases), WAVELENGTHS, "levels" not in lacks,
        "depths" not in lacks, keep,
    )  # fmt: skip
    asked = [*chosen, *(n for n in VOLTAGES if n not in chosen)]
    typical = {**VOLTAGES, **known}
    per = {n: quantities(device)[n].number(1.0) for n in asked}
    colours = {w: None if "depths" in lacks else w for w in WAVELENGTHS}
    held: dict[Key, dict[str, Edges]] = {}
    edges: dict[Key, Edges] = {}
    slopes: dict[Key, Edges] = {}
    bends: dict[Key, Edges] = {}
    warmer: dict[Key, Edges] = {}
    errors: dict[str, float] = {}
    most = cells * FINEST // FINE if chosen else cells
    finest: Walk | None = None
    for bias in biases:
        here = change_parameter(device, "operating_point.back_bias", bias - own)
        if finest is None:
            finest = walked(here, most, backgrounds)
            first = found = walked(here, cells) if chosen else finest
        else:
            found = walked(here, cells)
        slopes_of = _derivatives(here, {n: typical[n] for n in asked}) if chosen else None
        if slopes_of is not None:
            done += 1
            if progress is not None:
                progress(done, total)
            light = None if "depths" in lacks else WAVELENGTHS[0]
            errors = errors or mesh_errors(
                *(solved.edges(light, kelvin) for solved in (slopes_of, found, finest))
            )
        if warming:
            hot = change_parameter(here, "operating_point.temperature", WARMER)
            warm, cold = walked(hot, COARSE), walk(here, cells=COARSE, keep=keep)
        for wavelength, colour in colours.items():
            key = wavelength, bias
            fine, start, best = (w.edges(colour, kelvin) for w in (found, first, finest))
            edges[key] = add_edges(fine, in_proportion(less(best, start), start, fine), 1.0)
            if "levels" not in lacks:
                slopes[key], bends[key] = (
                    in_proportion(change, best, edges[key])
                    for change in finest.bent(colour, kelvin)
                )
            held[key] = {}
            if slopes_of is not None:
                dkx, dky = mixed(
                    slopes_of.dkx, slopes_of.dky, slopes_of.depths, colour, kelvin
                )
                held[key] = {
                    n: (x / per[n], y / per[n])
                    for n, x, y in zip(asked, dkx, dky, strict=True)
                } | {n: part_of(edges[key], n) for n in errors}
            if warming:
                warmer[key] = _slope(
                    warm.edges(colour, kelvin + WARMER), cold.edges(colour, kelvin), WARMER
                )
    reference = 620.0, biases[0]
    nominal = {n: solver.nominal(n) for n in chosen}
    ends = {n: solver.range(n) for n in chosen}
    return Baseline(
        device.name, edges, {n: held[reference][n] for n in (*chosen, *errors)},
        {n: known[n] * per[n] for n in chosen} | errors, reference, accuracy=tuple(errors),
        nominal=nominal, held=held, slopes=slopes, bends=bends, level=LEVEL if slopes else 0.0,
        spots_bend=bool(slopes), warming=warmer, temperature=kelvin, card=_card(device),
        units={n: solver.unit(n) for n in chosen}, solver=solver,
        bounds={n: (low - nominal[n], high - nominal[n]) for n, (low, high) in ends.items()},
    )  # fmt: skip


def far_from_solution(baseline: Baseline, pulls: Mapping[str, float]) -> bool:
    """Whether fitted quantities of a device are far from those that it was solved at.

    Parameters
    ----------
    baseline : Baseline
        Any; only a device that can be solved is ever far.
    pulls : mapping of str to float
        Parameters less their nominal values, over their spreads.
    """
    solved = {} if baseline.curve is None else baseline.curve.pulls
    far = [abs(pulls[n] - solved.get(n, 0.0)) for n in baseline.units if n in pulls]
    return baseline.solver is not None and max(far, default=0.0) >= STRAIGHT


def expand_at(baseline: Baseline, pulls: Mapping[str, float]) -> Baseline:
    """Solve a baseline's device at fitted values of its parameters as well.

    Parameters
    ----------
    baseline : Baseline
        From :func:`baseline_of_device`, with its solver.
    pulls : mapping of str to float
        Parameters less their nominal values, over their spreads.

    Returns
    -------
    Baseline
        Its shifts are those of the solutions at the nominal and, by the change on 32 cells, at the
        fitted values, with the same derivatives at the nominal ones.

    Raises
    ------
    DeviceError, ConvergenceError
        There is no such device, or it could not be solved.
    """
    solver = baseline.solver
    assert solver is not None
    change = {n: p * baseline.spread[n] for n, p in pulls.items()}
    more = solver.changed({n: baseline.nominal[n] + by for n, by in change.items()})
    for key, (kx, ky) in more.items():
        for name, by in change.items():
            dkx, dky = baseline.derivative(name, key)
            kx, ky = kx - by * dkx, ky - by * dky
        more[key] = kx, ky
    return replace(baseline, curve=Curve(dict(pulls), more))


def _derivatives(device: Device, spreads: Mapping[str, float]) -> EdgeResponse:
    """Response of a device with derivatives by each of some quantities."""
    changed, refused = [], ""
    for name, spread in spreads.items():
        for step in (STEP * spread, -STEP * spread):
            try:
                changed.append((change_parameter(device, name, step), step))
                break
            except DeviceError as error:
                # No device on this side, such as one of negative thickness: step to the other.
                refused = str(error)
        else:
            raise DiagnosisError(f"{device.name}: {name!r} cannot be changed: {refused}")
    return solve_response(device, cells=COARSE, changed=changed)


def _slope(up: Edges, down: Edges, apart: float) -> Edges:
    return (up[0] - down[0]) / apart, (up[1] - down[1]) / apart


def _card(device: Device) -> dict[str, float]:
    """Dimensions of a device for effects: pitch and thickness [um], voltage of the front [V]."""
    return {
        "pixel": 0.5 * (device.pixel.pitch_x + device.pixel.pitch_y),
        "thickness": device.silicon.thickness,
        "front": front_plane(device).potential,
    }


def write_edges(baseline: Baseline, path: str | os.PathLike[str]) -> None:
    """Write a baseline's shifts, derivatives and spreads as :func:`read_edges` reads them.

    Spreads go into the same file, which then also is its device card.
    """

    def lists(pair: Edges, names: tuple[str, str]) -> dict[str, list]:
        return {n: np.asarray(a).tolist() for n, a in zip(names, pair, strict=True)}

    changes = "dkx", "dky"
    # :func:`read_edges` takes the first derivatives as those of the reference.
    ordered = {baseline.reference: baseline.derivatives, **baseline.held}
    text = {
        "note": "edge displacements per electron of a device, right / upper edge; spreads included",
        "conditions": {
            f"{w:g}_{b:g}": lists(pair, ("kx", "ky"))
            for (w, b), pair in baseline.edges.items()
        },
        **{
            f"derivatives_{w:g}_{b:g}".replace("-", "m"): {
                name: lists(pair, changes) for name, pair in of_key.items()
            }
            for (w, b), of_key in ordered.items()
        },
        **{
            word: {f"{w:g}_{b:g}": lists(pair, changes) for (w, b), pair in given.items()}
            for word, given in (
                ("slopes", baseline.slopes), ("bends", baseline.bends),
                ("warming", baseline.warming),
            )
        },
        "level": baseline.level,
        "spots_bend": baseline.spots_bend,
        "temperature": to_celsius(baseline.temperature) if baseline.warming else None,
        "spread_1sigma": dict(baseline.spread),
        "nominal": dict(baseline.nominal),
        "units": dict(baseline.units),
        "accuracy": list(baseline.accuracy),
        "bounds": {n: list(ends) for n, ends in baseline.bounds.items()},
        "card": dict(baseline.card),
    }  # fmt: skip
    with written_whole(Path(path), DiagnosisError) as beside:
        Path(beside).write_text(json.dumps(text))
