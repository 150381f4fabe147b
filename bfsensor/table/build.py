"""Construction of a distortion table from its plan, by Poisson's equation or image charges."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Collection
from concurrent.futures import Executor, as_completed
from pathlib import Path
from typing import Any, Literal

import numpy as np

import bfsensor
from bfsensor.errors import TableError
from bfsensor.response.periodic_images import PERIOD
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.mean_field import mean_drift_field
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import AREA_PER_VOLT
from bfsensor.table.build_image_charge import build_image_charge_table
from bfsensor.table.levels import Level, solve_level
from bfsensor.table.table import DistortionTable
from bfsensor.table.table_plan import TablePlan
from bfsensor.typing import FloatArray

ENGINES = ("poisson", "image_charge")
"""Poisson's equation solved on a mesh, or the closed form of Astier & Regnault (2023)."""


def build_table(
    plan: TablePlan,
    *,
    engine: Literal["poisson", "image_charge"] = "poisson",
    image_charge: ImageCharge | None = None,
    executor: Executor | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    errors: Callable[[DistortionTable], dict[str, float]] | None = None,
    provenance: dict[str, str] | None = None,
) -> DistortionTable:
    """Compute the distortion table of a plan.

    Parameters
    ----------
    plan : TablePlan
        Plan from :func:`bfsensor.table.table_plan.plan_table`.
    engine : {'poisson', 'image_charge'}
        'poisson' solves Poisson's equation with the device's implants, gates and carriers, in
        minutes of CPU time; 'image_charge' takes charge rectangles between conducting planes, in
        0.3 s, linear in charge, with parameters that are given beside the device.
    image_charge : ImageCharge, optional
        Parameters of the engine 'image_charge', required there and refused elsewhere; pitch,
        thickness and permittivity must be the device's.  Below its sealed heights nothing moves;
        conversion depths that begin there
        (:func:`bfsensor.table.build_image_charge.default_depths`) interpolate better than the
        plan's default ones.
    executor : Executor, optional
        Executor that solves the levels; by default this process, one after another.  This and
        the next three are for the engine 'poisson' and refused by the other.
    checkpoint : Path, optional
        Folder that keeps finished levels; a run that finds levels of the same plan there does
        not repeat them.  The caller removes it.
    progress : callable, optional
        Function that is called with (levels done, levels in all).
    errors : callable, optional
        Function that is called with the table when all levels are solved and returns error
        estimates for its header, such as :func:`bfsensor.table.assess.mesh_errors` of a plan.
    provenance : dict of str to str, optional
        Further entries for the header.

    Returns
    -------
    DistortionTable
        Table with the device and its full well, which is the Poisson solver's for either engine;
        the header names the engine that made the shifts.

    Raises
    ------
    TableError
        An unknown engine, an option of the other one, or parameters that do not fit the
        device.

    Examples
    --------
    >>> from bfsensor import Device, plan_table
    >>> device = Device.load("itl_sta3800c")
    >>> plan = plan_table(device, charges=[0, 5e4], backgrounds=[0], depths=[95.0], pixels=3)
    >>> model = ImageCharge(0.32, 1.21, 2.57, 0.2, 3.8, drift_field=((0, 0.74), (100, 0.36)))
    >>> table = build_table(plan, engine="image_charge", image_charge=model)
    >>> bool(table.area_changes(charge=5e4, depth=95.0)[1, 1] < 0)
    True
    """
    if engine not in ENGINES:
        raise TableError(f"engine = {engine!r} must be one of {', '.join(ENGINES)}")
    if engine == "poisson":
        _refuse(engine, image_charge=image_charge)
        return _solve_table(plan, executor, checkpoint, progress, errors, provenance or {})
    _refuse(
        engine, executor=executor, checkpoint=checkpoint, progress=progress, errors=errors
    )
    if image_charge is None:
        raise TableError(
            "engine = 'image_charge' needs its parameters: give image_charge=ImageCharge(...)"
        )
    _check_model(plan, image_charge)
    table = build_image_charge_table(
        image_charge, charges=plan.charges, backgrounds=plan.backgrounds, depths=plan.depths,
        vertices=plan.vertices, pixels=2 * plan.reach + 1,
    )  # fmt: skip
    return dataclasses.replace(
        table, device_text=plan.device.to_toml(), full_well=plan.full_well,
        provenance={**table.provenance, **(provenance or {})},
    )  # fmt: skip


def _refuse(engine: str, **given: Any) -> None:
    """Refuse options that the engine does not have."""
    wrong = [name for name, value in given.items() if value is not None]
    if wrong:
        raise TableError(f"{', '.join(wrong)}: not an option of engine = {engine!r}")


def _check_model(plan: TablePlan, model: ImageCharge) -> None:
    """Refuse parameters whose pitch, thickness or permittivity are not the device's."""
    device = plan.device
    for name, own in (
        ("pitch_x", device.pixel.pitch_x),
        ("pitch_y", device.pixel.pitch_y),
        ("thickness", device.silicon.thickness),
        ("permittivity", device.material.permittivity_silicon),
    ):
        given = getattr(model, name)
        if not np.isclose(given, own, rtol=1e-9, atol=0):
            raise TableError(
                f"image_charge: {name} = {given:g} is not that of {device.name}, {own:g}"
            )


def _solve_table(
    plan: TablePlan,
    executor: Executor | None,
    checkpoint: Path | None,
    progress: Callable[[int, int], None] | None,
    errors: Callable[[DistortionTable], dict[str, float]] | None,
    provenance: dict[str, str],
) -> DistortionTable:
    """Solve every level of a plan and assemble the table."""
    levels = _solve_levels(plan, executor, checkpoint, progress)

    def gather(name: str) -> FloatArray:
        return np.array(
            [[getattr(levels[q, b], name) for b in plan.backgrounds] for q in plan.charges]
        )

    table = DistortionTable(
        charges=np.array(plan.charges),
        backgrounds=np.array(plan.backgrounds),
        depths=np.array(plan.depths),
        pitch=(plan.device.pixel.pitch_x, plan.device.pixel.pitch_y),
        thickness=plan.device.silicon.thickness,
        vertices=plan.vertices,
        reach=plan.reach,
        corners=gather("corners"),
        horizontal=gather("horizontal"),
        vertical=gather("vertical"),
        errors={
            "iteration [V]": max(level.error_volts for level in levels.values()),
            "iteration, worst case [um2]": AREA_PER_VOLT
            * max(level.error_volts for level in levels.values()),
            "images removed at the corner [%]": 100
            * max(lv.image_share for lv in levels.values()),
        },
        device_text=plan.device.to_toml(),
        provenance={
            "version": bfsensor.__version__,
            "cells": str(plan.cells),
            "refine_z": str(plan.refine_z),
            "period": str(PERIOD),
            **_effort(plan, levels.values()),
            **provenance,
        },
        full_well=plan.full_well,
        symmetric=True,
        drift_field=mean_drift_field(plan.device),
    )
    if errors is None:
        return table
    return dataclasses.replace(table, errors={**table.errors, **errors(table)})


def _level_name(charge: float, background: float) -> str:
    """Name of a level's file, by all digits: charges that differ in the last one are two levels."""
    return f"level_{charge:.17g}_{background:.17g}.npz"


def _solve_levels(
    plan: TablePlan,
    executor: Executor | None,
    checkpoint: Path | None,
    progress: Callable[[int, int], None] | None,
) -> dict[tuple[float, float], Level]:
    """Solve the levels of a plan that its checkpoint does not hold, by charge and background."""
    wanted = [(q, b) for b in plan.backgrounds for q in plan.charges]
    levels: dict[tuple[float, float], Level] = {}
    folder = None
    if checkpoint is not None:
        folder = checkpoint / plan.key
        folder.mkdir(parents=True, exist_ok=True)
        for q, b in wanted:
            path = folder / _level_name(q, b)
            if path.exists():
                levels[q, b] = Level.read(path)

    def keep(q: float, b: float, level: Level) -> None:
        levels[q, b] = level
        if folder is not None:
            level.write(folder / _level_name(q, b))
        if progress is not None:
            progress(len(levels), len(wanted))

    if progress is not None:
        progress(len(levels), len(wanted))
    missing = [level for level in wanted if level not in levels]
    if executor is None:
        for q, b in missing:
            keep(q, b, solve_level(plan, q, b))
    else:
        futures = {executor.submit(solve_level, plan, q, b): (q, b) for q, b in missing}
        try:
            for future in as_completed(futures):
                keep(*futures[future], future.result())
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return levels


def _effort(plan: TablePlan, levels: Collection[Level]) -> dict[str, str]:
    """Effort of the solver (nodes, CPU time, steps), for the header."""
    nz, ny, nx = make_mesh(
        plan.device, pixels=(PERIOD, PERIOD), cells=plan.cells, refine_z=plan.refine_z
    ).shape
    return {
        "nodes": str(nx * ny * nz),
        "levels cpu [s]": f"{sum(level.cpu_seconds for level in levels):.1f}",
        "newton steps": str(sum(level.newton for level in levels)),
        "linear iterations": str(sum(level.linear_iterations for level in levels)),
    }


def peak_memory() -> float:
    """Return the largest resident memory of this process and its children [GB].

    Only finished children count; nan on Windows.
    """
    if sys.platform == "win32":
        return float("nan")
    # Not at the top: Windows has no such module.
    import resource

    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    # Linux counts in kB, macOS in bytes.
    return max(own, children) / (1e9 if sys.platform == "darwin" else 1e6)
