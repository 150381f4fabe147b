r"""How flats respond as a device is operated or made otherwise: a_ij over swept quantities.

Every point of a sweep is a device of its own, solved anew:

.. math:: a_{ij} = \frac{1}{A} \frac{\Delta A_{ij}(B + q, B)}{q},

the relative area change of the pixel at lag i in x, j in y per electron by which one pixel
exceeds all others, which hold the background B.  This is the differential response, which flats
see (C_ij = a_ij mean^2 in the lowest order); a_00 is negative.  Apart from it, and only where
asked for, stands the area change of one full pixel among empty ones, the seed paper's.
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
from bfsensor.sweeps.axes import WAVELENGTH, Swept, combine
from bfsensor.sweeps.executors import run_points
from bfsensor.sweeps.points import (
    CELLS,
    LEVEL,
    STEP,
    PointResponse,
    SweepPoint,
    solve_point,
)
from bfsensor.sweeps.rows import LAGS, DeviceSweep, SweepRow


def partner_cells(cells: int) -> int:
    """Mesh that is held against one of ``cells`` for its error: twice or half as fine."""
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
    """Sweep over quantities of a device and the light.

    Parameters
    ----------
    device : Device
        Mirror-symmetric.
    swept : sequence of Swept
        From :func:`bfsensor.sweeps.axes.parse_swept`.  Wavelengths cost nothing: one solution serves
        all.  A temperature changes the heat of carriers and the absorption; the quasi-Fermi
        level of the holes stays where the device has it.
    paired : bool
        Take the values pairwise instead of all with all.
    level : float
        Background about which the response is taken [e-].
    full_pixel : float
        Charge of the one full pixel among empty ones [e-]; 0: not wanted.
    cells : int
        Of the mesh, a pixel, even, from 8: 0.4 CPU seconds a level at 8, 1.4 at 16, 3.6 at 32,
        and two levels a point, of which one is the full well; three with a full pixel.
    work : Path
        Folder that keeps finished points; a run that finds them goes on from there.
    tables : Path, optional
        Folder for the table of the differential response of every point, point_0000.fits for
        the first row; rows that differ by the wavelength alone share the first one's.
    executor : Executor, optional
        Where the points are solved; by default here.
    progress : callable, optional
        Called with (points done, points in all).
    command : str
        What made it, for the header.

    Returns
    -------
    DeviceSweep
        One row a point.  A point that was refused has a reason and no numbers.

    Raises
    ------
    SweepError
        Nothing to sweep, quantities that do not pair, a level or mesh that is not allowed.

    Notes
    -----
    The error of an a_ij is that of the mesh: the relative difference, lag by lag, between the
    device as given at ``cells`` and at a mesh twice as fine (half as fine from 16 cells on),
    light converting at the back surface.  One estimate serves all rows, and most of it is
    common to them.

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
        # What is known about a value does not change the answer, and a swept value is new.
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
            "command": command, "version": bfsensor.__version__, "level": level, "step": STEP,
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
            f"level = {level:g} e- and full pixel = {full_pixel:g} e- must be finite, from 0 e-"
        )
    if cells < 8 or cells % 2:
        raise SweepError(
            f"cells = {cells} must be an even number of at least 8 cells a pixel"
        )


def _copy_tables(
    wanted: Sequence[SweepPoint | None],
    solved: Mapping[SweepPoint, PointResponse],
    work: Path,
    tables: Path,
) -> None:
    """Put the table of every point where it is asked for, of rows alike the first one's."""
    tables.mkdir(parents=True, exist_ok=True)
    for n, point in enumerate(wanted):
        if point is not None and wanted.index(point) == n and not solved[point].reason:
            shutil.copyfile(work / f"{point.key}.fits", tables / f"point_{n:04d}.fits")


def _device_at(
    device: Device, swept: Sequence[Swept], place: Sequence[int]
) -> Device | str:
    """Device at a point, or why there is none."""
    changes = [
        (one.name, one.texts[n])
        for one, n in zip(swept, place, strict=True)
        if one.name != WAVELENGTH
    ]
    reason = ""
    # Two gates may pass one another on the way; backwards they then do not.
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
    a, areas = found.a[0], found.areas[0]
    if not found.reason:
        a, areas = found.in_light(wavelength, device.operating_point.temperature)
    return SweepRow(
        a, areas, found.full_well, found.cpu_seconds, found.iteration, found.reason
    )
