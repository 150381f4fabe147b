"""GalSim's (and Poisson_CCD's) vertex tables: STEM.cfg and STEM.dat.

One charge in the central pixel, no background, one conversion depth.  The ``.dat`` file
lists, pixel by pixel (x slow, y fast), the vertices counter-clockwise from the middle of
the left side: pixel centre x and y, angle, vertex x and y.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bfsensor.device import Device
from bfsensor.device_import import import_poisson_ccd, read_configuration
from bfsensor.errors import DeviceError, TableError
from bfsensor.simulate.boundaries import PixelBoundaries
from bfsensor.table import DistortionTable, vertex_fractions


def write_galsim(
    table: DistortionTable,
    stem: str | os.PathLike[str],
    *,
    charge: float,
    depth: float,
    overwrite: bool = False,
) -> tuple[Path, Path]:
    """Write a table at one charge and depth for ``galsim.SiliconSensor(name=STEM)``.

    Parameters
    ----------
    table : DistortionTable
        With its device, which GalSim needs for diffusion.
    stem : path-like
        Path without ending.
    charge : float
        Source charge [e-]; GalSim scales from it linearly.
    depth : float
        Conversion depth [um above the gates].
    overwrite : bool
        Replace existing files.

    Returns
    -------
    paths : tuple of Path
        The two files.

    Raises
    ------
    TableError
        What GalSim's format cannot hold, or existing files.
    """
    stem = Path(stem)
    paths = (stem.with_name(stem.name + ".cfg"), stem.with_name(stem.name + ".dat"))
    for path in paths:
        if path.exists() and not overwrite:
            raise TableError(f"{path} exists; say overwrite to replace it")
    if not table.device_text:
        raise TableError(
            "GalSim needs the device for its diffusion, and this table has none"
        )
    if table.vertices % 2:
        raise TableError(
            f"GalSim's order of vertices needs an even number a side, not {table.vertices}"
        )
    if table.pitch[0] != table.pitch[1]:
        raise TableError(
            f"GalSim assumes square pixels, not {table.pitch[0]:g} x {table.pitch[1]:g} um"
        )
    device = Device.from_toml(table.device_text)
    n = 2 * table.reach + 1
    pitch = table.pitch[0]
    origin = (table.reach + 1.5) * pitch
    moved = table.displacements(charge=charge, depth=depth)
    outlines = table._outlines(moved)
    rows = []
    for i in range(n):
        for j in range(n):
            centre = np.array([i - table.reach, j - table.reach]) * pitch
            points = np.roll(outlines[j, i], table.vertices // 2, axis=0)
            angle = np.arctan2(points[:, 1] - centre[1], points[:, 0] - centre[0])
            rows += [
                (centre[0] + origin, centre[1] + origin, a, x + origin, y + origin)
                for a, (x, y) in zip(angle, points, strict=True)
            ]
    # Seven decimals: the customary four are 2 % of a shift four pixels away.
    lines = ["X0             Y0             Theta          X              Y              "]
    lines += ["".join(f"{value:<15.7f}" for value in row).rstrip() for row in rows]
    point, gates, stop = device.operating_point, device.gates, device.channel_stop
    settings = {
        "ScaleFactor": 1,
        "SensorThickness": table.thickness,
        "PixelSizeX": pitch,
        "PixelSizeY": pitch,
        "GateOxide": gates.gate_oxide,
        "FieldOxide": gates.field_oxide,
        "FieldOxideTaper": gates.field_oxide_taper,
        "ChannelStopWidth": stop.width,
        "NumPhases": gates.phases,
        "CollectingPhases": gates.collecting_phases,
        "Vbb": point.back_bias,
        "Vparallel_lo": point.gate_low,
        "Vparallel_hi": point.gate_high,
        "qfh": point.hole_quasi_fermi_level,
        "CCDTemperature": point.temperature,
        "CollectedCharge_0_0": charge,
        "FilledPixelCoords_0_0": f"{origin} {origin}",
        "PixelBoundaryLowerLeft": f"{pitch} {pitch}",
        "PixelBoundaryUpperRight": f"{(n + 1) * pitch} {(n + 1) * pitch}",
        "PixelBoundaryNx": n,
        "PixelBoundaryNy": n,
        "NumVertices": table.vertices,
        "ElectronZ0Area": depth,
    }
    head = [f"# Distortion table of {device.name} by bfsensor, for galsim.SiliconSensor."]
    head += [f"# {line}" for line in (table.provenance.get("command", ""),) if line]
    config = head + [f"{key} = {value}" for key, value in settings.items()]
    for path, text in zip(paths, (config, lines), strict=True):
        beside = path.with_name(path.name + ".part")
        beside.write_text("\n".join(text) + "\n")
        os.replace(beside, path)
    return paths


def read_galsim(stem: str | os.PathLike[str]) -> DistortionTable:
    """Read a GalSim stem as a table of one charge, no background, one depth.

    Of the two copies of a shared side the one of the pixel nearer to the charge counts, as
    in GalSim.  GalSim keeps two copies of each corner; here the sides are joined at one
    common corner, with the area of every pixel kept.

    Parameters
    ----------
    stem : path-like
        Path without ending, ``STEM.cfg`` and ``STEM.dat``.

    Returns
    -------
    DistortionTable

    Raises
    ------
    TableError
        A file is missing, foreign or truncated; names it.
    """
    stem = Path(stem)
    cfg, dat = stem.with_name(stem.name + ".cfg"), stem.with_name(stem.name + ".dat")
    try:
        data = read_configuration(cfg)
    except DeviceError as error:
        raise TableError(str(error)) from None

    def number(key: str) -> float:
        try:
            return float(data[key])
        except KeyError:
            raise TableError(f"{cfg}: {key} is missing") from None
        except ValueError:
            raise TableError(f"{cfg}: {key} = {data[key]!r} is not a number") from None

    def whole(key: str) -> int:
        value = number(key)
        if not value.is_integer() or value < 1:
            raise TableError(f"{cfg}: {key} = {data[key]!r} is not a whole number above 0")
        return int(value)

    nx, ny, nv = (whole(k) for k in ("PixelBoundaryNx", "PixelBoundaryNy", "NumVertices"))
    if nx != ny or nx % 2 == 0:
        raise TableError(f"{cfg}: {nx} x {ny} pixels must be square and odd")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an empty file: refused below
            rows = np.loadtxt(dat, skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        raise TableError(f"{dat}: not a vertex file: {error}") from None
    if rows.shape != (nx * ny * (4 * nv + 4), 5):
        raise TableError(
            f"{dat}: {rows.shape[0]} rows are not the {nx * ny * (4 * nv + 4)} of {nx} x "
            f"{ny} pixels with {nv} vertices a side (truncated, or another table's)"
        )
    pitch = number("PixelSizeX")
    reach = nx // 2
    points = rows[:, 3:5].reshape(nx, ny, 4 * nv + 4, 2).transpose(1, 0, 2, 3)
    centre = rows[:, :2].reshape(nx, ny, 4 * nv + 4, 2)[reach, reach, 0]
    outlines = np.roll(points - centre, -(nv // 2), axis=2)
    columns, rows_ = _lines(outlines, nx, nv)
    lines = PixelBoundaries(
        np.zeros(1),
        (pitch, float(data.get("PixelSizeY", pitch))),
        reach,
        columns[None],
        rows_[None],
        False,
    )
    corners, horizontal, vertical = lines.vertices(nv, vertex_fractions(nv))
    return DistortionTable(
        charges=np.array([number("CollectedCharge_0_0")]),
        backgrounds=np.zeros(1),
        depths=np.array([number("ElectronZ0Area") if "ElectronZ0Area" in data else 95.0]),
        pitch=lines.pitch,
        thickness=number("SensorThickness"),
        vertices=nv,
        reach=reach,
        corners=corners[None, None],
        horizontal=horizontal[None, None],
        vertical=vertical[None, None],
        symmetric=False,
        provenance={"source": stem.name},
        device_text=_device_text(cfg),
    )


def _device_text(cfg: Path) -> str:
    """Give the device of a configuration, or nothing if it holds only what GalSim reads."""
    try:
        return import_poisson_ccd(cfg).to_toml()
    except DeviceError:
        return ""


def _lines(
    outlines: NDArray[np.float64], n: int, nv: int
) -> tuple[NDArray[np.float64], ...]:
    """Find the lines between columns and between rows, from the pixel nearer the charge."""
    reach = n // 2
    closed = np.concatenate([outlines, outlines[:, :, :1]], axis=2)
    side = nv + 1
    lower, right, upper, left = (
        closed[:, :, s * side : (s + 1) * side + 1] for s in range(4)
    )
    rows, columns = [], []
    for line in range(n + 1):
        # Beyond the centre the pixel on the inner side is the nearer one.
        own = line - 1 if line > reach else line
        across = upper[own, :, ::-1] if line > reach else lower[own]
        along = right[:, own] if line > reach else left[:, own, ::-1]
        rows.append(across.reshape(-1, 2))
        columns.append(along.reshape(-1, 2))
    ordered = [
        np.array([line[np.argsort(line[:, axis], kind="stable")] for line in lines])
        for lines, axis in ((columns, 1), (rows, 0))
    ]
    return ordered[0], ordered[1]
