"""Reading and writing of GalSim's (and Poisson_CCD's) vertex tables, STEM.cfg and STEM.dat.

They hold one charge in the central pixel, no background and one conversion depth.  The ``.dat`` file
lists, pixel by pixel (x slow, y fast), the vertices counter-clockwise from the middle of
the left side: pixel centre x and y, angle, vertex x and y.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.poisson_ccd import import_poisson_ccd, read_configuration
from bfsensor.errors import DeviceError, TableError
from bfsensor.files import refuse_existing, written_whole
from bfsensor.response.vertices import nominal_positions, vertex_fractions
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray


def write_galsim(
    table: DistortionTable,
    stem: str | os.PathLike[str],
    *,
    charge: float,
    depth: float,
    background: float = 0.0,
    device: Device | None = None,
    overwrite: bool = False,
) -> tuple[Path, Path]:
    """Write a table at one charge and depth for ``galsim.SiliconSensor(name=STEM)``.

    Parameters
    ----------
    table : DistortionTable
        Table with square pixels and an even number of vertices a side.
    stem : path-like
        Path without ending.
    charge : float
        Source charge [e-], within the table; GalSim scales the shifts linearly from it.
    depth : float
        Conversion depth [um above the gates], within the table.
    background : float
        Charge of all other pixels [e-], below ``charge``.  GalSim adds the shifts by the charges
        of all pixels, in which those of a uniform background cancel: the file holds ``charge -
        background`` as the collected charge.
    device : Device, optional
        Device with the voltages and gates that GalSim needs for its diffusion; by default the
        one in the table.
    overwrite : bool
        Replace existing files.

    Returns
    -------
    paths : tuple of Path
        The .cfg and the .dat file.

    Raises
    ------
    TableError
        The table does not fit GalSim's format (rectangular pixels, an odd number of vertices, a
        charge that is not above the background, no device), or a file exists.

    Examples
    --------
    >>> import tempfile
    >>> table = DistortionTable.load("itl_sta3800c")
    >>> stem = Path(tempfile.mkdtemp()) / "itl"
    >>> [path.name for path in write_galsim(table, stem, charge=80000.0, depth=95.0)]
    ['itl.cfg', 'itl.dat']
    """
    stem = Path(stem)
    paths = (stem.with_name(stem.name + ".cfg"), stem.with_name(stem.name + ".dat"))
    for path in paths:
        refuse_existing(path, overwrite, TableError)
    _check_fits_galsim(table, charge, background, device)
    if device is None:
        device = Device.from_toml(table.device_text)
    about = [
        f"Distortion table of {device.name} by bfsensor, for galsim.SiliconSensor.",
        f"Source {charge:g} e-, all other pixels {background:g} e-, depth {depth:g} um.",
        table.provenance.get("command", ""),
    ]
    config = [f"# {' '.join(line.split())}" for line in about if line]
    settings = _settings(table, device, charge - background, depth)
    config += [f"{key} = {value}" for key, value in settings.items()]
    outlines = _outlines(table, charge, background, depth)
    _write_together({paths[0]: config, paths[1]: outlines})
    return paths


def _check_fits_galsim(
    table: DistortionTable, charge: float, background: float, device: Device | None
) -> None:
    """Refuse tables and charges that GalSim's format cannot hold."""
    if device is None and not table.device_text:
        raise TableError(
            "GalSim needs the device for its diffusion, and this table holds none: give device="
        )
    if not charge > background:
        raise TableError(
            f"charge = {charge:g} e- must be above the background, {background:g} e-: "
            "GalSim divides by the difference"
        )
    if table.vertices % 2:
        raise TableError(
            f"GalSim's order of vertices needs an even number a side, not {table.vertices}"
        )
    if table.pitch[0] != table.pitch[1]:
        raise TableError(
            f"GalSim assumes square pixels, not {table.pitch[0]:g} x {table.pitch[1]:g} um"
        )


def _origin(table: DistortionTable) -> float:
    """Coordinate of the source pixel's centre in x and in y [um].

    The table's first pixel lies one pixel from 0, as in Poisson_CCD's files.
    """
    return (table.reach + 1.5) * table.pitch[0]


def _outlines(
    table: DistortionTable, charge: float, background: float, depth: float
) -> list[str]:
    """Lines of the vertex file, pixel by pixel."""
    pitch, origin = table.pitch[0], _origin(table)
    lines = ["X0             Y0             Theta          X              Y"]
    for i in range(-table.reach, table.reach + 1):
        for j in range(-table.reach, table.reach + 1):
            points = table.polygon(i, j, charge=charge, background=background, depth=depth)
            x0, y0 = origin + i * pitch, origin + j * pitch
            for x, y in points + origin:
                row = (x0, y0, np.arctan2(y - y0, x - x0), x, y)
                # Seven decimals: half a unit of the customary fourth is 2 % of a shift four
                # pixels away.
                lines.append("".join(f"{value:<15.7f}" for value in row).rstrip())
    return lines


def _settings(
    table: DistortionTable, device: Device, excess: float, depth: float
) -> dict[str, object]:
    """Values of the configuration that GalSim reads; ``excess``: charge over the background."""
    point, gates = device.operating_point, device.gates
    n, pitch, origin = 2 * table.reach + 1, table.pitch[0], _origin(table)
    return {
        "ScaleFactor": 1,
        "SensorThickness": table.thickness,
        "PixelSizeX": pitch,
        "PixelSizeY": pitch,
        "GateOxide": gates.gate_oxide,
        "FieldOxide": gates.field_oxide,
        "FieldOxideTaper": gates.field_oxide_taper,
        "ChannelStopWidth": device.channel_stop.width,
        "NumPhases": gates.phases,
        "CollectingPhases": gates.collecting_phases,
        "Vbb": point.back_bias,
        "Vparallel_lo": point.gate_low,
        "Vparallel_hi": point.gate_high,
        "qfh": point.hole_quasi_fermi_level,
        "CCDTemperature": point.temperature,
        "CollectedCharge_0_0": excess,
        "FilledPixelCoords_0_0": f"{origin} {origin}",
        "PixelBoundaryLowerLeft": f"{pitch} {pitch}",
        "PixelBoundaryUpperRight": f"{(n + 1) * pitch} {(n + 1) * pitch}",
        "PixelBoundaryNx": n,
        "PixelBoundaryNy": n,
        "NumVertices": table.vertices,
        "ElectronZ0Area": depth,
    }


def _write_together(files: dict[Path, list[str]]) -> None:
    """Write all files under temporary names before the first is renamed.

    A failure then leaves no pair of which one file is missing.
    """
    with contextlib.ExitStack() as stack:
        for path, lines in files.items():
            beside = stack.enter_context(written_whole(path, TableError))
            beside.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_galsim(stem: str | os.PathLike[str]) -> DistortionTable:
    """Read a GalSim stem as a table of one charge, no background, one depth.

    Of the two copies of a shared side, that of the pixel nearer to the charge is taken, as
    in GalSim.  GalSim keeps several copies of each corner as well, and they differ by up to
    0.4 um in its own files.  A table has one: that of the innermost pixel, moved by the least
    amounts with which every pixel has the area that GalSim gives it.

    Parameters
    ----------
    stem : path-like
        Path without ending of ``STEM.cfg`` and ``STEM.dat``.

    Returns
    -------
    DistortionTable
        Table whose areas at the charge of the file equal GalSim's to single precision
        (1e-6 um^2).  The central area is that of its polygon in the file; other areas differ from
        their polygons' where the copies of a side do.

    Notes
    -----
    One corner cannot keep the areas at every charge, for they are quadratic in the shifts.
    At seven tenths of the file's charge GalSim's own corners differ from ours by 4e-5 of an
    area for lsst_itl_50_8 and 3e-4 for lsst_e2v_50_8; the slope of the areas at small
    charge by up to 0.02 and 0.14 um^2 at 100000 e-.

    Raises
    ------
    TableError
        A file is missing, of another format or truncated; the message names it.

    Examples
    --------
    >>> import galsim
    >>> folder = Path(galsim.meta_data.share_dir) / "sensors"
    >>> read_galsim(folder / "lsst_itl_50_8").reach
    4
    """
    stem = Path(stem)
    cfg, dat = stem.with_name(stem.name + ".cfg"), stem.with_name(stem.name + ".dat")
    numbers = _Numbers(cfg)
    number = numbers.number
    n, nv, pitch = numbers.layout()
    charge = number("CollectedCharge_0_0")
    if not charge > 0:
        raise TableError(f"{cfg}: CollectedCharge_0_0 = {charge:g} must be above 0 e-")
    sides, corners = _share(_read_outlines(dat, n, nv, pitch))
    try:
        empty = DistortionTable(
            charges=np.array([charge]),
            backgrounds=np.zeros(1),
            # GalSim's own files were traced from 95 um; some do not state it.
            depths=np.array([number("ElectronZ0Area", 95.0)]),
            pitch=pitch,
            thickness=number("SensorThickness"),
            vertices=nv,
            reach=n // 2,
            corners=np.zeros((1, 1, 1, n + 1, n + 1, 2)),
            horizontal=np.zeros((1, 1, 1, n + 1, n, nv, 2)),
            vertical=np.zeros((1, 1, 1, n, n + 1, nv, 2)),
            symmetric=False,
            provenance={"source": stem.name},
            device_text=_device_text(cfg),
        )
        nominal = empty.nominal()
        return replace(
            empty,
            corners=(corners - nominal.corners)[None, None, None],
            horizontal=(sides[0][:, :, 1:-1] - nominal.horizontal)[None, None, None],
            vertical=(sides[1][:, :, 1:-1] - nominal.vertical)[None, None, None],
        )
    except TableError as error:
        raise TableError(f"{cfg}: {error}") from None


def read_sides(
    cfg: str | os.PathLike[str], dat: str | os.PathLike[str]
) -> tuple[tuple[FloatArray, FloatArray], FloatArray]:
    """Read the shifts of all sides of a GalSim table, each with its own copies of the corners.

    Of the two copies of a side, that of the pixel nearer to the charge is taken.

    Parameters
    ----------
    cfg, dat : path-like
        The configuration and the vertex file.

    Returns
    -------
    vertical, horizontal : ndarray, shapes (n, n + 1, vertices + 2, 2), \
(n + 1, n, vertices + 2, 2)
        Shifts (dx, dy) [um] for the charge of the file, by row and column.
    points : ndarray, shape (vertices + 2,)
        Nominal positions along a side, 0 to 1.

    Raises
    ------
    TableError
        A file is missing, of another format or truncated; the message names it.
    """
    numbers = _Numbers(Path(cfg))
    n, nv, pitch = numbers.layout()
    along_x, along_y = _share(_read_outlines(Path(dat), n, nv, pitch))[0]
    fractions = np.concatenate([[0.0], vertex_fractions(nv), [1.0]])
    at = nominal_positions(pitch, n // 2, fractions)
    return (along_y - at.vertical, along_x - at.horizontal), fractions


class _Numbers:
    """A configuration file with methods that convert its texts; errors name the file."""

    def __init__(self, cfg: Path) -> None:
        self.cfg = cfg
        try:
            self.data = read_configuration(cfg)
        except DeviceError as error:
            raise TableError(str(error)) from None

    def number(self, key: str, default: float | None = None) -> float:
        """Return the number of a key, ``default`` where it is missing; None: it must be there."""
        if key not in self.data:
            if default is None:
                raise TableError(f"{self.cfg}: {key} is missing")
            return default
        try:
            value = float(self.data[key])
        except ValueError:
            raise TableError(
                f"{self.cfg}: {key} = {self.data[key]!r} is not a number"
            ) from None
        if not np.isfinite(value):
            raise TableError(
                f"{self.cfg}: {key} = {self.data[key]!r} must be a finite number"
            )
        return value

    def whole(self, key: str) -> int:
        """Return the whole number, above 0, of a key."""
        value = self.number(key)
        if not value.is_integer() or value < 1:
            raise TableError(
                f"{self.cfg}: {key} = {self.data[key]!r} is not a whole number above 0"
            )
        return int(value)

    def layout(self) -> tuple[int, int, tuple[float, float]]:
        """Return the width of the table [pixel], vertices a side, and the pitch in x and y [um]."""
        n, ny, nv = (
            self.whole(k) for k in ("PixelBoundaryNx", "PixelBoundaryNy", "NumVertices")
        )
        if n != ny or n % 2 == 0:
            raise TableError(f"{self.cfg}: {n} x {ny} pixels must be square and odd")
        pitch = self.number("PixelSizeX")
        if not pitch > 0:
            raise TableError(f"{self.cfg}: PixelSizeX = {pitch:g} um must be above 0 um")
        return n, nv, (pitch, self.number("PixelSizeY", pitch))


def _read_outlines(dat: Path, n: int, nv: int, pitch: tuple[float, float]) -> FloatArray:
    """Read the polygons, (n, n, 4 nv + 4, 2), from lower left, about the central pixel."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file; refused below
            rows = np.loadtxt(dat, skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        raise TableError(f"{dat}: not a vertex file: {error}") from None
    count = n * n * (4 * nv + 4)
    if rows.shape != (count, 5):
        raise TableError(
            f"{dat}: {rows.shape[0]} rows are not the {count} of {n} x {n} pixels with "
            f"{nv} vertices a side (truncated, or another table's)"
        )
    if not np.all(np.isfinite(rows)):
        raise TableError(f"{dat}: holds values that are not finite")
    grid = rows.reshape(n, n, 4 * nv + 4, 5).transpose(1, 0, 2, 3)
    offset = (np.arange(n) - n // 2)[:, None]
    centre = grid[n // 2, n // 2, 0, :2]
    at_x, at_y = (centre[k] + offset * pitch[k] for k in (0, 1))
    # Positions in the files are rounded to four decimals.
    if np.abs(grid[..., 0] - at_x).max() > 1e-3 or (
        np.abs(grid[..., 1] - at_y[:, None]).max() > 1e-3
    ):
        raise TableError(
            f"{dat}: pixels are not listed column by column, {pitch[0]:g} x "
            f"{pitch[1]:g} um apart"
        )
    far = (np.abs(rows[:, 3:] - rows[:, :2]) >= pitch).any(1)
    if far.any():
        line = int(np.argmax(far))
        raise TableError(
            f"{dat}: line {line + 2}: the vertex ({rows[line, 3]:g}, {rows[line, 4]:g}) um lies a "
            f"pixel or more from the middle of its pixel ({int(far.sum())} of {count} vertices)"
        )
    return np.roll(grid[..., 3:] - centre, -(nv // 2), axis=2)


def _device_text(cfg: Path) -> str:
    """Return the device of a configuration; empty where it holds only the keys GalSim reads."""
    try:
        return import_poisson_ccd(cfg).to_toml()
    except DeviceError:
        return ""


def _share(
    outlines: FloatArray,
) -> tuple[tuple[FloatArray, FloatArray], FloatArray]:
    """Join polygons: sides along x and y, each with its own ends, and common corners."""
    n = len(outlines)
    side = outlines.shape[2] // 4
    closed = np.concatenate([outlines, outlines[:, :, :1]], axis=2)
    lower, right, upper, left = (
        closed[:, :, k * side : (k + 1) * side + 1] for k in range(4)
    )
    line = np.arange(n + 1)
    # Lines beyond the centre take the copy of the pixel before them, the others of that after:
    # the pixel nearer to the charge.
    beyond = line > n // 2
    own = line - beyond
    along_x = np.where(beyond[:, None, None, None], upper[own, :, ::-1], lower[own])
    along_y = np.where(beyond[None, :, None, None], right[:, own], left[:, own, ::-1])
    # Lower left, lower right, upper right, upper left corner of the innermost pixel.
    which = np.where(
        beyond[:, None], np.where(beyond[None], 2, 3), np.where(beyond[None], 1, 0)
    )
    corners = outlines[own[:, None], own[None], which * side]
    return (along_x, along_y), corners + _corner_shifts(along_x, along_y, corners)


def _corner_shifts(
    along_x: FloatArray, along_y: FloatArray, corners: FloatArray
) -> FloatArray:
    """Least shifts of the corners with which pixels keep the areas within their separate sides.

    No two corners are adjacent vertices of a polygon, so its area is linear in their positions
    and a linear least-squares solution is exact.
    """
    n = len(corners) - 1
    wanted = _ring_areas(_ring(along_x, along_y))
    inner_x, inner_y = along_x[:, :, 1:-1], along_y[:, :, 1:-1]
    common_x = np.concatenate(
        [corners[:, :-1, None], inner_x, corners[:, 1:, None]], axis=2
    )
    common_y = np.concatenate(
        [corners[:-1, :, None], inner_y, corners[1:, :, None]], axis=2
    )
    missing = wanted - _ring_areas(_ring(common_x, common_y))
    slope = np.zeros((n, n, n + 1, n + 1, 2))
    j, i = np.indices((n, n))
    # Around the pixel: what comes before and after each corner.
    before_after = {
        (0, 0): (inner_y[:, :-1, 0], inner_x[:-1, :, 0]),
        (0, 1): (inner_x[:-1, :, -1], inner_y[:, 1:, 0]),
        (1, 1): (inner_y[:, 1:, -1], inner_x[1:, :, -1]),
        (1, 0): (inner_x[1:, :, 0], inner_y[:, :-1, -1]),
    }
    for (up, over), (before, after) in before_after.items():
        chord = after - before
        slope[j, i, j + up, i + over, 0] = 0.5 * chord[..., 1]
        slope[j, i, j + up, i + over, 1] = -0.5 * chord[..., 0]
    shifts = np.linalg.lstsq(slope.reshape(n * n, -1), missing.ravel(), rcond=None)[0]
    return np.asarray(shifts.reshape(corners.shape))


def _ring(along_x: FloatArray, along_y: FloatArray) -> FloatArray:
    """Vertices around every pixel, counter-clockwise along its four sides."""
    return np.concatenate(
        [along_x[:-1], along_y[:, 1:], along_x[1:, :, ::-1], along_y[:, :-1, ::-1]], axis=2
    )


def _ring_areas(ring: FloatArray) -> FloatArray:
    """Areas by the shoelace formula."""
    after = np.roll(ring, -1, axis=2)
    return np.asarray(
        0.5 * np.sum(ring[..., 0] * after[..., 1] - ring[..., 1] * after[..., 0], axis=2)
    )
