r"""Sweep of a device: the response a_ij of flats as voltages, thickness, doping or light change.

Every point of a sweep is a device of its own, for which Poisson's equation is solved:

.. math:: a_{ij} = \frac{1}{A} \frac{\Delta A_{ij}(B + q, B)}{q},

the relative area change of the pixel at lag i in x, j in y per electron by which one pixel
exceeds all others, which hold the background B.  This is the differential response, which flats
see (C_ij = a_ij mean^2 in the lowest order); a_00 is negative.  On request a sweep also gives the
area changes around one full pixel among empty ones.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

import bfsensor
from bfsensor.device.device import Device
from bfsensor.errors import BFSensorError, SweepError
from bfsensor.response.edge_response import CHARGE, LEVEL
from bfsensor.simulate.mesh import MOST_CELLS
from bfsensor.sweeps.axes import WAVELENGTH, Swept, combine
from bfsensor.sweeps.executors import run_points
from bfsensor.sweeps.points import (
    CELLS,
    PointResponse,
    SweepPoint,
    solve_point,
)
from bfsensor.sweeps.rows import LAGS, DeviceSweep, SweepRow


def partner_cells(cells: int) -> int:
    """Cells a pixel of the mesh whose result measures the error of ``cells``: twice or half."""
    return 2 * cells if cells < 16 else max(8, 2 * (cells // 4))


def sweep_device(
    device: Device,
    swept: Sequence[Swept],
    *,
    paired: bool = False,
    level: float = LEVEL,
    full_pixel: float = 0.0,
    cells: int = CELLS,
    work: Path,
    tables: Path | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
    command: str = "",
) -> DeviceSweep:
    """Compute the response of flats at every point of a sweep.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device, fully depleted.
    swept : sequence of Swept
        Axes from :func:`bfsensor.sweeps.axes.parse_swept`.  Further wavelengths cost no time: one
        solution serves all.  A temperature changes the thermal energy of the carriers and the
        absorption length; the quasi-Fermi level of the holes stays that of the device.
    paired : bool
        Take the first values of all axes together, then the second ones, and so on, instead of
        every combination.
    level : float
        Charge of all pixels about which the response is taken [e-], at least 0.
    full_pixel : float
        Charge of one full pixel among empty ones [e-] for the area changes around it; 0 leaves
        them out.
    cells : int
        Mesh cells a pixel, even, at least 8.  A level takes 1 CPU second at 8, 3 at 16 and
        8 at 32; a point takes two levels, one of them for the full well, and a third with
        ``full_pixel``.
    work : Path
        Folder that keeps finished points; a run that finds points there does not repeat them.
    tables : Path, optional
        Folder for the distortion table of every point, point_0000.fits for the first row; rows
        that differ in wavelength alone share the first row's.
    executor : Executor, optional
        Executor that solves the points; by default this process, one after another.
    progress : callable, optional
        Function that is called with (points done, points in all).
    command : str
        Command line that made the sweep, for the header of its file.

    Returns
    -------
    DeviceSweep
        One row a point.  A point that was refused has a reason and nan for all results.

    Raises
    ------
    SweepError
        No axis, paired axes of unequal lengths, a charge below 0 or not finite, or a mesh that is
        not allowed.

    Notes
    -----
    The error of an a_ij is that of the mesh: the relative difference, lag by lag, between the
    device as given at ``cells`` and on a mesh twice as fine (half as fine from 16 cells on),
    with light that converts at the back surface.  One estimate serves all rows, and most of the
    error is common to them.

    Examples
    --------
    >>> import tempfile
    >>> from bfsensor.sweeps.axes import parse_swept
    >>> device = Device.load("itl_sta3800c")
    >>> over = [parse_swept("wavelength", "400nm,900nm", device)]
    >>> sweep = sweep_device(device, over, cells=8, work=Path(tempfile.mkdtemp()))
    >>> bool(abs(sweep.a[1, 0, 0]) < abs(sweep.a[0, 0, 0]))  # red light converts lower
    True
    """
    _check_request(level, full_pixel, cells)
    places = combine(swept, paired=paired)
    made = [_device_at(device, swept, place) for place in places]

    def plan(made: Device) -> SweepPoint:
        # Without provenance: it does not change the response, so it must not change the key.
        text = dataclasses.replace(made, provenance={}).to_toml()
        return SweepPoint(text, level, full_pixel, cells, tables is not None)

    base = plan(device)
    finer = SweepPoint(base.device_text, level, 0.0, partner_cells(cells))
    wanted = [plan(m) if isinstance(m, Device) else None for m in made]
    points = list(dict.fromkeys([*(p for p in wanted if p is not None), base, finer]))
    work.mkdir(parents=True, exist_ok=True)
    solved = dict(zip(
        points,
        run_points(
            solve_point, points, path=lambda point: work / f"{point.key}.npz",
            read=PointResponse.read, write=PointResponse.write,
            executor=executor, progress=progress,
        ),
        strict=True,
    ))  # fmt: skip
    rows = []
    for place, one, point in zip(places, made, wanted, strict=True):
        if isinstance(one, Device) and point is not None:
            rows.append(_row(one, solved[point], _wavelength(swept, place)))
        else:
            none = np.full((LAGS, LAGS), np.nan)
            rows.append(SweepRow(none, none, np.nan, 0.0, np.nan, str(one)))
    if tables is not None:
        _copy_tables(wanted, solved, work, tables)
    coarse, fine = (solved[p].a[-1] for p in (base, finer))
    refused = [solved[p].reason for p in (base, finer) if solved[p].reason]
    return DeviceSweep.make(
        rows, np.abs(fine / coarse - 1), swept, places,
        {
            "command": command, "version": bfsensor.__version__, "level": level, "step": CHARGE,
            "full_pixel": full_pixel, "cells": cells, "error_cells": partner_cells(cells),
            "no_error": refused[0] if refused else "", "device": device.to_toml().splitlines(),
        },
    )  # fmt: skip


def _check_request(level: float, full_pixel: float, cells: int) -> None:
    """Refuse charges and meshes that are not allowed."""
    if not (
        np.isfinite(level) and level >= 0 and np.isfinite(full_pixel) and full_pixel >= 0
    ):
        raise SweepError(
            f"level = {level:g} e- and full pixel = {full_pixel:g} e- must be finite and at "
            "least 0 e-"
        )
    if not 8 <= cells <= MOST_CELLS or cells % 2:
        raise SweepError(
            f"cells = {cells} must be an even number from 8 to {MOST_CELLS} cells a pixel"
        )


def _copy_tables(
    wanted: Sequence[SweepPoint | None],
    solved: Mapping[SweepPoint, PointResponse],
    work: Path,
    tables: Path,
) -> None:
    """Copy every solved point's table once, under the number of the first row that uses it."""
    tables.mkdir(parents=True, exist_ok=True)
    for n, point in enumerate(wanted):
        if point is not None and wanted.index(point) == n and not solved[point].reason:
            shutil.copyfile(work / f"{point.key}.fits", tables / f"point_{n:04d}.fits")


def _device_at(
    device: Device, swept: Sequence[Swept], place: Sequence[int]
) -> Device | str:
    """Device at a point, or the reason why it cannot be built."""
    changes = [
        (one.name, one.texts[n])
        for one, n in zip(swept, place, strict=True)
        if one.name != WAVELENGTH
    ]
    reason = ""
    # Values are changed one by one, and each step must be a device: with both gates moved, the
    # low one may pass the high one in one order and not in the other.
    for order in (changes, changes[::-1]):
        try:
            changed = device
            for name, text in order:
                changed = changed.with_value(name, text)
        except BFSensorError as error:
            reason = reason or " ".join(str(error).split())
        else:
            return changed
    return reason


def _wavelength(swept: Sequence[Swept], place: Sequence[int]) -> float | None:
    """Wavelength of a point [nm]; None: light converts at the back surface."""
    for one, n in zip(swept, place, strict=True):
        if one.name == WAVELENGTH:
            return one.values[n]
    return None


def _row(device: Device, found: PointResponse, wavelength: float | None) -> SweepRow:
    """Row of a point in light of its wavelength [nm]; None: converted at the back surface."""
    a, areas = found.a[0], found.areas[0]
    if not found.reason:
        a, areas = found.in_light(wavelength, device.operating_point.temperature)
    return SweepRow(
        a, areas, found.full_well, found.cpu_seconds, found.iteration, found.reason
    )
