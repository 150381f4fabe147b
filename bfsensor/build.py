"""From a device to its distortion table: one independent solution per level.

A level is one source charge on one background.  Levels do not depend on each other,
not even as starting points: any number of processes gives the same bits, and a run that
was interrupted goes on with the levels that are missing.
"""

from __future__ import annotations

import hashlib
import json
import resource
import time
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import bfsensor
from bfsensor.errors import TableError
from bfsensor.files import written_whole
from bfsensor.simulate.boundaries import SPLIT_HEIGHT, find_boundaries
from bfsensor.simulate.far_field import FarField, image_shifts
from bfsensor.simulate.mesh import Surfaces, make_mesh
from bfsensor.simulate.poisson import (
    AREA_PER_VOLT,
    Electrostatics,
    solve_unit_cell,
    tile,
)
from bfsensor.simulate.well import full_well
from bfsensor.table import DistortionTable, nominal_positions, vertex_fractions

if TYPE_CHECKING:
    from bfsensor.device import Device

PERIOD = 12
"""Period of the domain [pixel]; what its images do is subtracted (``far_field``)."""

ACCURACIES = {0.05: 16, 0.02: 24, 0.01: 32, 0.005: 48}
"""Cells a pixel for an accuracy aimed at in the nearest area changes.

Measured against 64 cells for the two LSST devices (``python -m validation.convergence``): at 32
cells 0.2 % or less at the centre, 0.5 % at (0, 1), 0.1 % at (1, 1), and at (1, 0) 0.1 % (ITL) and
1.1 % (E2V)."""

CHARGE_FRACTIONS = (0.03, 0.15, 0.35, 0.55, 0.75, 0.9)
"""Source charges of a table in full wells; the response bends most at small charges."""

BACKGROUND_FRACTIONS = (0.0, 0.25, 0.5, 0.8)
"""Background charges of a table in full wells."""

STORAGE_DEPTH = 0.3
"""Depth of the stored charge below the channel's silicon surface [um].

The mean depth of the electrons is 0.25 to 0.36 um in the four built-in devices from 20,000 to
150,000 e- (tests); a device with deeper implants stores deeper, and its table's lowest level
is then too low by that much."""

SAMPLES = 24
"""Points of a boundary line per pixel."""


@dataclass(frozen=True)
class Plan:
    """Everything that determines a table's numbers."""

    device: Device
    charges: tuple[float, ...]
    backgrounds: tuple[float, ...]
    depths: tuple[float, ...]
    vertices: int
    reach: int
    cells: int
    refine_z: int
    full_well: float

    @property
    def key(self) -> str:
        """Digest that changes with anything that would change a level."""
        text = json.dumps(
            [
                bfsensor.__version__,
                self.device.to_toml(),
                self.charges,
                self.backgrounds,
                self.depths,
                self.vertices,
                self.reach,
                self.cells,
                self.refine_z,
            ]
        )
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Level:
    """Displacements of one source charge on one background, all depths, and its cost."""

    corners: NDArray[np.float64]
    horizontal: NDArray[np.float64]
    vertical: NDArray[np.float64]
    newton: int
    linear_iterations: int
    error_volts: float
    cpu_seconds: float
    image_share: float

    def write(self, path: Path) -> None:
        """Write it whole or not at all: half a level never exists."""
        with written_whole(path, TableError) as beside, open(beside, "wb") as stream:
            np.savez(stream, **self.__dict__)

    @classmethod
    def read(cls, path: Path) -> Level:
        """Read what :meth:`write` wrote."""
        try:
            with path.open("rb") as stream, np.load(stream) as data:
                values = {name: data[name] for name in data.files}
            scalars = {k: v.item() for k, v in values.items() if v.ndim == 0}
            return cls(**{**values, **scalars})
        except (ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise TableError(
                f"{path}: not a finished level; delete it to solve it again ({error})"
            ) from None


def default_depths(device: Device) -> tuple[float, ...]:
    """Seven conversion depths [um above the gates], from the stored charge to the light side.

    At the first, the height of the charge (0.3 um into the silicon of the channel), nothing
    moves; the second is the lowest at which every electron's well is well defined.  The
    response rises over one pixel pitch and is nearly flat beyond four.
    """
    surfaces = Surfaces.of(device)
    thickness = device.silicon.thickness
    pitch = 0.5 * (device.pixel.pitch_x + device.pixel.pitch_y)
    deepest = max(surfaces.silicon_channel, surfaces.silicon_stop)
    low = (deepest + 2.0, deepest + SPLIT_HEIGHT)
    inner = [
        d for d in (pitch, 2.0 * pitch, 4.0 * pitch) if low[1] + 1 < d < 0.8 * thickness
    ]
    return (storage_height(device), *low, *inner, thickness)


def storage_height(device: Device) -> float:
    """Height above the gates [um] at and below which boundaries are taken as fixed.

    Where the charge is stored, :data:`STORAGE_DEPTH` into the silicon of the channel.
    """
    return Surfaces.of(device).silicon_channel + STORAGE_DEPTH


def plan_table(
    device: Device,
    *,
    charges: Sequence[float] | None = None,
    backgrounds: Sequence[float] | None = None,
    depths: Sequence[float] | None = None,
    vertices: int = 32,
    pixels: int = 9,
    accuracy: float = 0.01,
    refine_z: int = 0,
) -> Plan:
    """Check a request against the device and fill in what was left open.

    Parameters
    ----------
    device : Device
        Mirror-symmetric in x and y.
    charges : sequence of float, optional
        Source charges [e-]; by default zero and :data:`CHARGE_FRACTIONS` of the full well.
    backgrounds : sequence of float, optional
        Charge of all other pixels [e-]; by default :data:`BACKGROUND_FRACTIONS`.
    depths : sequence of float, optional
        Conversion depths [um above the gates]; by default :func:`default_depths`.
    vertices : int
        Vertices a side between the corners.
    pixels : int
        Width of the table [pixel], odd.
    accuracy : float
        Wanted accuracy of area changes, relative; sets the mesh (:data:`ACCURACIES`).
    refine_z : int
        Further halvings of the mesh in z.

    Returns
    -------
    Plan

    Raises
    ------
    TableError
        Something does not fit; says the limit.
    """
    if not device.is_mirror_symmetric:
        raise TableError(
            f"{device.name}: a table needs a device that is mirror-symmetric about a pixel "
            "(no ripples, no edge, centred dots)"
        )
    if pixels % 2 == 0 or not 3 <= pixels <= PERIOD - 1:
        raise TableError(f"pixels = {pixels} must be odd and from 3 to {PERIOD - 1}")
    if vertices < 2:
        raise TableError(f"vertices = {vertices} must be at least 2 a side")
    fitting = [
        cells for limit, cells in ACCURACIES.items() if limit <= accuracy * (1 + 1e-9)
    ]
    if not fitting:
        raise TableError(f"accuracy = {accuracy:g} must be at least {min(ACCURACIES):g}")
    cells = min(fitting)
    well = full_well(device)
    if charges is None:
        charges = (0.0, *(_round(f * well) for f in CHARGE_FRACTIONS))
    if backgrounds is None:
        backgrounds = tuple(_round(f * well) for f in BACKGROUND_FRACTIONS)
    for name, values in (("charge", charges), ("background", backgrounds)):
        for value in values:
            if not 0 <= value <= well:
                raise TableError(
                    f"{name} = {value:g} e- must be from 0 to the full well of "
                    f"{device.name}, {well:.6g} e-, where the barrier along the column "
                    f"falls to {device.well.spill_barrier:g} V"
                )
        if len(values) < 1 or any(b <= a for a, b in pairwise(values)):
            raise TableError(f"{name}s {list(values)} must ascend")
    if depths is None:
        depths = default_depths(device)
    low, high = storage_height(device), device.silicon.thickness
    for depth in depths:
        if not low - 1e-9 <= depth <= high:
            raise TableError(
                f"depth = {depth:g} um must lie in the silicon of {device.name}, from "
                f"{low:g} um, where charge is stored, to {high:g} um, the back surface"
            )
    if any(b <= a for a, b in pairwise(depths)):
        raise TableError(f"depths {list(depths)} must ascend")
    return Plan(
        device, tuple(map(float, charges)), tuple(map(float, backgrounds)),
        tuple(map(float, depths)), vertices, pixels // 2, cells, refine_z, well,
    )  # fmt: skip


def _round(charge: float) -> float:
    """Round to two digits: a table's levels are meant to be read."""
    if charge <= 0:
        return 0.0
    digits = 1 - int(np.floor(np.log10(charge)))
    return float(round(charge, digits))


@lru_cache(maxsize=1)
def _workshop(device_text: str, cells: int, refine_z: int) -> tuple[Any, Any, Any]:
    """Build the device, solver and mesh of a process, once for all its levels."""
    from bfsensor.device import Device

    device = Device.from_toml(device_text)
    mesh = make_mesh(device, pixels=(PERIOD, PERIOD), cells=cells, refine_z=refine_z)
    return device, Electrostatics(device, mesh), mesh


def solve_level(plan: Plan, charge: float, background: float) -> Level:
    """Solve one level of a plan.

    Parameters
    ----------
    plan : Plan
        From :func:`plan_table`.
    charge, background : float
        Source charge and charge of all other pixels [e-].

    Returns
    -------
    Level
    """
    began = time.process_time()
    device, solver, mesh = _workshop(plan.device.to_toml(), plan.cells, plan.refine_z)
    unit = solve_unit_cell(device, background, cells=plan.cells, refine_z=plan.refine_z)
    n = 2 * plan.reach + 1
    nd = len(plan.depths)
    fractions = vertex_fractions(plan.vertices)
    shapes = (
        (nd, n + 1, n + 1, 2),
        (nd, n + 1, n, plan.vertices, 2),
        (nd, n, n + 1, plan.vertices, 2),
    )
    if charge == background:
        corners, horizontal, vertical = (np.zeros(s) for s in shapes)
        return Level(
            corners, horizontal, vertical, 0, 0, 0.0, time.process_time() - began, 0.0
        )
    charges = np.full(solver.pixel_shape, background)
    charges[0, 0] = charge
    potential = solver.solve(charges, start=tile(unit, mesh))
    depths = np.array(plan.depths)
    fixed = depths <= storage_height(device) + 1e-9
    moved = tuple(np.zeros(shape) for shape in shapes)
    if not fixed.all():
        lines = find_boundaries(
            potential, depths[~fixed], reach=plan.reach, samples=SAMPLES
        )
        for whole, found in zip(
            moved, lines.vertices(plan.vertices, fractions), strict=True
        ):
            whole[~fixed] = found
    far = FarField.of(unit, depths, Surfaces.of(device).silicon_stop, 5 * max(mesh.period))
    moved, share = without_images(far, moved, mesh.pitch, mesh.period, fractions)
    corners, horizontal, vertical = moved
    return Level(
        corners, horizontal, vertical, len(potential.history), potential.linear_iterations,
        potential.error_volts, time.process_time() - began, share,
    )  # fmt: skip


def without_images(
    far: FarField,
    moved: tuple[NDArray[np.float64], ...],
    pitch: tuple[float, float],
    period: tuple[float, float],
    fractions: NDArray[np.float64],
) -> tuple[tuple[NDArray[np.float64], ...], float]:
    """Take the periodic images off displacements; returns also their share at the corner.

    The amplitude is the one with which dipole and images together give the outermost
    boundaries that face the source.
    """
    corners, horizontal, vertical = (a.copy() for a in moved)
    at = nominal_positions(pitch, horizontal.shape[2] // 2, fractions)
    share = 0.0
    for d in range(len(far.depths)):
        if far.shifts[d].max() <= 0:
            continue
        images = [
            image_shifts(far, points, d, period)
            for points in (at.corners, at.horizontal, at.vertical)
        ]
        facing_x = (slice(None), [0, -1])
        facing_y = ([0, -1], slice(None))
        near_y = np.abs(at.vertical[..., 1]) < 1.5 * pitch[1]
        near_x = np.abs(at.horizontal[..., 0]) < 1.5 * pitch[0]
        model_x = (far.vectors(at.vertical, d) + images[2])[..., 0]
        model_y = (far.vectors(at.horizontal, d) + images[1])[..., 1]
        amplitudes = []
        for model, data, facing, near in (
            (model_x, vertical[d, ..., 0], facing_x, near_y),
            (model_y, horizontal[d, ..., 1], facing_y, near_x),
        ):
            use = near[facing]
            amplitudes.append(
                (model[facing][use] @ data[facing][use])
                / (model[facing][use] @ model[facing][use])
            )
        amplitude = float(np.mean(amplitudes))
        for a, shift in zip((corners[d], horizontal[d], vertical[d]), images, strict=True):
            a -= amplitude * shift
        share = max(
            share,
            float(
                np.abs(amplitude * images[0][-1, -1]).max()
                / np.abs(moved[0][d, -1, -1]).max()
            ),
        )
    return (corners, horizontal, vertical), share


def build_table(
    plan: Plan,
    *,
    executor: Executor | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    errors: Callable[[], dict[str, float]] | None = None,
    provenance: dict[str, str] | None = None,
) -> DistortionTable:
    """Solve every level of a plan and assemble the table.

    Parameters
    ----------
    plan : Plan
        From :func:`plan_table`.
    executor : Executor, optional
        Where the levels are solved; by default here, one after another.
    checkpoint : Path, optional
        Folder that keeps finished levels; a run that finds them goes on from there.  It
        is left behind only by an interrupted run.
    progress : callable, optional
        Called with (levels done, levels in all).
    errors : callable, optional
        Called once all levels are there; gives error estimates for the header, such as
        :func:`bfsensor.assess.assess`.
    provenance : dict, optional
        Further entries for the header.

    Returns
    -------
    DistortionTable
    """
    wanted = [(q, b) for b in plan.backgrounds for q in plan.charges]
    levels: dict[tuple[float, float], Level] = {}
    folder = None
    if checkpoint is not None:
        folder = checkpoint / plan.key
        folder.mkdir(parents=True, exist_ok=True)
        for q, b in wanted:
            path = folder / f"level_{q:.6g}_{b:.6g}.npz"
            if path.exists():
                levels[q, b] = Level.read(path)

    def keep(q: float, b: float, level: Level) -> None:
        levels[q, b] = level
        if folder is not None:
            level.write(folder / f"level_{q:.6g}_{b:.6g}.npz")
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

    def gather(name: str) -> NDArray[np.float64]:
        return np.array(
            [[getattr(levels[q, b], name) for b in plan.backgrounds] for q in plan.charges]
        )

    nz, ny, nx = make_mesh(
        plan.device, pixels=(PERIOD, PERIOD), cells=plan.cells, refine_z=plan.refine_z
    ).shape
    cost = {
        "nodes": str(nx * ny * nz),
        "levels cpu [s]": f"{sum(level.cpu_seconds for level in levels.values()):.1f}",
        "newton steps": str(sum(level.newton for level in levels.values())),
        "linear iterations": str(sum(level.linear_iterations for level in levels.values())),
    }
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
            **(errors() if errors is not None else {}),
        },
        device_text=plan.device.to_toml(),
        provenance={
            "version": bfsensor.__version__,
            "cells": str(plan.cells),
            "refine_z": str(plan.refine_z),
            "period": str(PERIOD),
            **cost,
            **(provenance or {}),
        },
        full_well=plan.full_well,
        symmetric=True,
    )
    return table


def peak_memory() -> float:
    """Largest resident memory of this process and its finished children [GB]."""
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return max(own, children) / 1e6
