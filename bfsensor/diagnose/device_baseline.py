"""A device as a baseline whose parameters float: our simulation run again at shifted values."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bfsensor.build import build_table
from bfsensor.device import Device
from bfsensor.diagnose.baseline import Baseline, Edges
from bfsensor.diagnose.table_baseline import CHARGE, WAVELENGTHS, edges_at
from bfsensor.errors import DeviceError, DiagnosisError
from bfsensor.files import written_whole
from bfsensor.table import DistortionTable
from bfsensor.table_plan import plan_table

CELLS = 16
"""Cells a pixel of the tables whose differences are taken: a difference needs not the accuracy of
the device's own table, which has those of shipped ones."""

TABLES = "nominal as shipped, differences at 16 cells"
"""How shifts are made: what was kept of others is not read again."""

STEP = 0.5
"""Shift of a parameter to either side [its uncertainty]."""

LEVEL = 40_000.0
"""Background about which the response is taken [e-]: the middle of a flat of 80,000 e-."""

UNUSED = ("well.spill_barrier",)
"""Uncertain quantities that move no boundary."""


def device_parameters(device: Device) -> dict[str, float]:
    """Quantities of a device whose file states an uncertainty, with it [internal units].

    Examples
    --------
    >>> device_parameters(Device.load("itl_sta3800c"))["silicon.thickness"]
    5.0
    """
    return {
        key: float(known.uncertainty)
        for key, known in device.provenance.items()
        if known.uncertainty and key not in UNUSED
    }


def change_parameter(device: Device, key: str, by: float) -> Device:
    """Give a copy with one quantity, also of an implant, changed by so much [internal units].

    Raises
    ------
    DiagnosisError
        No such quantity.
    """
    try:
        return _changed(device, _steps(device, key), by)
    except (AttributeError, IndexError, TypeError):
        raise DiagnosisError(f"no quantity {key!r} in the device {device.name}") from None


def parameter_value(device: Device, key: str) -> float:
    """Give one quantity, also of an implant [internal units].

    Raises
    ------
    DiagnosisError
        No such quantity.

    Examples
    --------
    >>> parameter_value(Device.load("itl_sta3800c"), "silicon.thickness")
    100.0
    """
    part: Any = device
    try:
        for name, n in _steps(device, key):
            part = getattr(part, name if n is None else f"{name}s")
            part = part if n is None else part[n]
        return float(part)
    except (AttributeError, IndexError, TypeError):
        raise DiagnosisError(f"no quantity {key!r} in the device {device.name}") from None


def _steps(device: Device, key: str) -> list[tuple[str, int | None]]:
    """Names, and numbers of implants, from the device down to a quantity."""
    steps = [
        (found[1], None if found[2] is None else int(found[2]))
        for found in (
            re.fullmatch(r"(\w+?)(?:\[(\d+)\])?", part) for part in key.split(".")
        )
        if found is not None
    ]
    if len(steps) != len(key.split(".")) or len(steps) < 2 or steps[-1][1] is not None:
        raise DiagnosisError(f"no quantity {key!r} in the device {device.name}")
    return steps


def _changed(part: Any, steps: list[tuple[str, int | None]], by: float) -> Any:
    """Copy of a part of a device with the quantity at the end of a path changed."""
    (name, n), *rest = steps
    # Files name one implant, Python the tuple of them.
    field = name if n is None else f"{name}s"
    old = getattr(part, field)
    if n is not None:
        members = list(old)
        members[n] = _changed(members[n], rest, by)
        return dataclasses.replace(part, **{field: tuple(members)})
    new = _changed(old, rest, by) if rest else old + by
    return dataclasses.replace(part, **{field: new})


def baseline_of_device(
    device: Device,
    *,
    parameters: Sequence[str] = (),
    back_biases: Sequence[float] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Baseline:
    """Simulate the shifts of a device, and their change with its uncertain parameters.

    Parameters
    ----------
    device : Device
        Mirror-symmetric.
    parameters : sequence of str
        Which float, by their dotted names; ``('all',)`` for every quantity whose file states an
        uncertainty.
    back_biases : sequence of float
        Back biases to hold besides the device's own [V].
    progress : callable, optional
        Called with (tables made, tables in all).

    Returns
    -------
    Baseline
        Derivatives from tables half an uncertainty to either side, or to the one side on which
        there is such a device.

    Raises
    ------
    DiagnosisError
        A parameter that the device does not have, or without uncertainty; names those that are.
    """
    known = device_parameters(device)
    chosen = list(known) if tuple(parameters) == ("all",) else list(parameters)
    for name in chosen:
        if name not in known:
            raise DiagnosisError(
                f"{device.name} states no uncertainty for {name!r}; it does for {', '.join(known)}"
            )
    own = float(device.operating_point.back_bias)
    biases = [
        own,
        *(b for b in dict.fromkeys(map(float, back_biases)) if abs(b - own) > 0.5),
    ]
    total, done = len(biases) + 2 * len(chosen), 0

    def table_of(changed: Device, cells: int | None = None) -> DistortionTable:
        nonlocal done
        thickness = changed.silicon.thickness
        depths = [5.0, 20.0, 0.5 * thickness, thickness]
        plan = plan_table(
            changed,
            charges=[LEVEL, LEVEL + 50 * CHARGE],
            backgrounds=[LEVEL],
            depths=depths,
        )
        table = build_table(
            plan if cells is None else dataclasses.replace(plan, cells=cells)
        )
        done += 1
        if progress is not None:
            progress(done, total)
        return table

    temperature = device.operating_point.temperature
    edges: dict[tuple[float, float], Edges] = {}
    for bias in biases:
        table = table_of(change_parameter(device, "operating_point.back_bias", bias - own))
        for wavelength in WAVELENGTHS:
            edges[wavelength, bias] = edges_at(
                table, wavelength, temperature, background=LEVEL
            )
    derivatives: dict[str, Edges] = {}
    for name in chosen:
        sides: dict[float, Edges] = {}
        refused = ""
        for by in (STEP * known[name], -STEP * known[name]):
            try:
                table = table_of(change_parameter(device, name, by), CELLS)
            except DeviceError as error:
                # At the end of what can be, such as oxides of equal thickness: from one side.
                refused = str(error)
                continue
            sides[by] = edges_at(table, 620.0, temperature, background=LEVEL)
        if not sides:
            raise DiagnosisError(f"{device.name}: {name!r} cannot float: {refused}")
        if len(sides) == 1:
            table = table_of(device, CELLS)
            sides[0.0] = edges_at(table, 620.0, temperature, background=LEVEL)
        (high, up), (low, down) = sorted(sides.items(), key=lambda s: -s[0])
        derivatives[name] = (
            (up[0] - down[0]) / (high - low),
            (up[1] - down[1]) / (high - low),
        )
    return Baseline(
        device.name, edges, derivatives, {n: known[n] for n in chosen}, (620.0, own),
        nominal={n: parameter_value(device, n) for n in chosen},
    )  # fmt: skip


def write_edges(baseline: Baseline, path: str | os.PathLike[str]) -> None:
    """Write a baseline's shifts, derivatives and spreads as :func:`read_edges` reads them.

    The spread goes into the same file: it is its own device card.
    """

    def lists(pair: Edges, names: tuple[str, str]) -> dict[str, list]:
        return {n: np.asarray(a).tolist() for n, a in zip(names, pair, strict=True)}

    reference = f"{baseline.reference[0]:g}_m{abs(baseline.reference[1]):g}"
    text = {
        "note": "edge displacements per electron of a device, right / upper edge; spreads included",
        "conditions": {
            f"{w:g}_{b:g}": lists(pair, ("kx", "ky"))
            for (w, b), pair in baseline.edges.items()
        },
        f"derivatives_{reference}": {
            name: lists(pair, ("dkx", "dky")) for name, pair in baseline.derivatives.items()
        },
        "spread_1sigma": dict(baseline.spread),
    }
    with written_whole(Path(path), DiagnosisError) as beside:
        Path(beside).write_text(json.dumps(text))
