"""A distortion table as a baseline: mean shifts of edges per electron at each wavelength."""

from __future__ import annotations

import os
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.shipped import tables_dir
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.errors import BFSensorError, DiagnosisError
from bfsensor.response.light import conversion_weights
from bfsensor.response.vertices import vertex_fractions
from bfsensor.table.galsim_format import read_galsim
from bfsensor.table.table import DistortionTable
from bfsensor.typing import Edges, FloatArray

WAVELENGTHS = (400.0, 480.0, 550.0, 620.0, 700.0, 750.0, 870.0, 950.0)
"""Wavelengths at which shifts are calculated [nm].  Chosen: usual wavelengths of flats; light of another
one takes the nearest of these, which the report notes; twice as many only take longer."""

SPAN = 0.15, 0.6
"""Lowest and highest background of the parabola in level, as fractions of a table's largest. Chosen, to
be derived: the levels of most flats; over twice the range a parabola fits the middle less well."""

BACK_BIAS = "operating_point.back_bias"
"""Parameter of :func:`with_operating_point`."""

CHARGE = 100.0
"""Charge above the background [e-] at which shifts per electron are interpolated from a table.  Chosen:
twice as large changes no shift of the tables itl_sta3800c and e2v_ccd250 by more than 1.1e-4 of the
largest."""


def baseline_of_table(given: str | os.PathLike[str]) -> Baseline:
    """Make a baseline of a table: a .fits file, a GalSim stem, or the name of a shipped device.

    Shifts are the differential response that flats measure: the change by a small charge on a
    uniform background, per electron, averaged along each edge and over the depths at which light
    converts.  Their change with level is a parabola through three backgrounds.  A table of one
    charge, such as GalSim's, gives the mean shift per electron of that charge and no change with
    level.  A table has no derivatives, so that no device parameter is free.

    Parameters
    ----------
    given : str or path-like
        File, stem (a path, or the name of one of GalSim's own sensors), or device.

    Returns
    -------
    Baseline
        Shifts at eight wavelengths from 400 to 950 nm and the table's back bias.

    Raises
    ------
    DiagnosisError
        ``given`` is none of these, or its file is damaged.

    Examples
    --------
    >>> baseline = baseline_of_table("itl_sta3800c")
    >>> len(baseline.edges), baseline.parameters
    (8, ())
    """
    path = Path(given)
    shipped = tables_dir() / os.fspath(given) / "table.fits"
    try:
        if shipped.exists():
            table = DistortionTable.read(shipped)
        elif path.suffix == ".fits":
            table = DistortionTable.read(path)
        else:
            table = read_galsim(_stem(path))
    except (BFSensorError, OSError) as error:
        raise DiagnosisError(f"{given}: not a baseline: {error}") from None
    device = Device.from_toml(table.device_text) if table.device_text else None
    bias = device.operating_point.back_bias if device is not None else np.nan
    temperature = device.operating_point.temperature if device is not None else 173.0
    edges: dict[tuple[float, float], Edges] = {}
    slopes: dict[tuple[float, float], Edges] = {}
    bends: dict[tuple[float, float], Edges] = {}
    low, high = (part * float(table.backgrounds[-1]) for part in SPAN)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    one_level = (
        len(table.charges) == 1 or high + CHARGE > table.charges[-1] or not high > low
    )
    levels = [float(table.backgrounds[0])] if one_level else [low, middle, high]
    by_depth = [edges_by_depth(table, background=level) for level in levels]
    for wavelength in WAVELENGTHS:
        key = wavelength, float(bias)
        weights = conversion_weights(
            table.depths, wavelength, temperature, thickness=table.thickness
        )
        at = [_seen(by, weights) for by in by_depth]
        edges[key] = at[len(at) // 2]
        if one_level:
            continue
        one, mean, two = at
        slopes[key] = (two[0] - one[0]) / (2 * half), (two[1] - one[1]) / (2 * half)
        bends[key] = (
            (two[0] + one[0] - 2 * mean[0]) / (2 * half**2),
            (two[1] + one[1] - 2 * mean[1]) / (2 * half**2),
        )
    return Baseline(
        os.fspath(given),
        edges,
        {},
        {},
        (620.0, float(bias)),
        slopes=slopes,
        bends=bends,
        level=middle,
    )


def with_operating_point(
    given: str | os.PathLike[str], other: str | os.PathLike[str], *, spread: float = 2.0
) -> Baseline:
    """Make a baseline whose back bias is free, on the line between two tables of one device.

    Other settings that differ between the two tables, such as gate voltages, change in proportion
    with the back bias.  The back bias is also a candidate of an attribution, like any device
    parameter.

    Parameters
    ----------
    given, other : str or path-like
        As for :func:`baseline_of_table`; the nominal shifts are those of ``given``.
    spread : float
        Standard deviation of the back bias about its nominal value [V], above 0.  The default of 2
        V is chosen for a set point in whole volts with drops over cables.

    Returns
    -------
    Baseline
        Baseline of ``given`` with the free parameter 'operating_point.back_bias' [V].

    Raises
    ------
    DiagnosisError
        The tables are of devices that differ by more than the operating point, of the same back
        bias, or of different reach.

    Notes
    -----
    Shifts are linear in the back bias between the tables, and exact at both.  True shifts go about
    with its inverse, which halfway from -50 to -70 V is 3 % below the line.

    Examples
    --------
    >>> with_operating_point("e2v_ccd250", "e2v_ccd250_70").nominal
    {'operating_point.back_bias': -50.0}
    """
    one, two = baseline_of_table(given), baseline_of_table(other)
    cards = [_card(g) for g in (given, other)]
    if cards[0] is None or cards[0] != cards[1]:
        raise DiagnosisError(
            f"{given} and {other} are not of one device at two operating points"
        )
    step = two.reference[1] - one.reference[1]
    here, there = (b.edges[b.reference] for b in (one, two))
    if not step or here[0].shape != there[0].shape:
        raise DiagnosisError(
            f"{given} and {other}: back bias {one.reference[1]:g} and {two.reference[1]:g} V, reach "
            f"{one.reach} and {two.reach}; they must differ in the first alone"
        )
    change = (there[0] - here[0]) / step, (there[1] - here[1]) / step
    return replace(
        one,
        name=f"{one.name}, operating point free towards {two.name}",
        derivatives={BACK_BIAS: change},
        spread={BACK_BIAS: spread},
        nominal={BACK_BIAS: one.reference[1]},
        units={BACK_BIAS: "V"},
    )


def _card(given: str | os.PathLike[str]) -> dict[str, object] | None:
    """Device of a table without name and operating point; None where the table does not hold it."""
    shipped = tables_dir() / os.fspath(given) / "table.fits"
    path = shipped if shipped.exists() else Path(given)
    text = DistortionTable.read(path).device_text if path.suffix == ".fits" else ""
    if not text:
        return None
    known = tomllib.loads(text)
    return {k: v for k, v in known.items() if k not in ("name", "operating_point")}


def _stem(path: Path) -> Path:
    """The path, or GalSim's own file of that name where there is no such path."""
    import galsim

    own = Path(galsim.meta_data.share_dir) / "sensors" / path.name
    there = Path(f"{path}.cfg").exists()
    return (
        own if not there and path.parent == Path() and Path(f"{own}.cfg").exists() else path
    )


def edges_at(
    table: DistortionTable,
    wavelength: float,
    temperature: float,
    *,
    background: float = 0.0,
) -> Edges:
    """Mean shifts of right and upper edges [pixel/e-] for light of one wavelength.

    Parameters
    ----------
    table : DistortionTable
        Table of total displacements.
    wavelength : float
        Wavelength of the light [nm].
    temperature : float
        Temperature of the silicon [K].
    background : float
        Charge in all pixels [e-] to which the small charge is added.

    Returns
    -------
    kx, ky : ndarray, shape (2 reach + 3, 2 reach + 3)
        Shifts, with a ring of pixels around the table's whose outer edges do not move.
    """
    weights = conversion_weights(
        table.depths, wavelength, temperature, thickness=table.thickness
    )
    return _seen(edges_by_depth(table, background=background), weights)


def _seen(by_depth: Edges, weights: FloatArray) -> Edges:
    """Mean shifts of edges over conversion depths."""
    kx, ky = by_depth
    return np.tensordot(weights, kx, 1), np.tensordot(weights, ky, 1)


def edges_by_depth(table: DistortionTable, *, background: float = 0.0) -> Edges:
    """Mean shifts of right and upper edges [pixel/e-] by conversion depth.

    Parameters
    ----------
    table, background
        As for :func:`edges_at`.

    Returns
    -------
    kx, ky : ndarray, shape (depths, 2 reach + 3, 2 reach + 3)
    """
    scale = CHARGE * np.array(table.pitch)
    n = 2 * table.reach + 3
    out_x, out_y = np.zeros((2, len(table.depths), n, n))
    for k, depth in enumerate(table.depths):
        moved = table.displacements(
            charge=background + CHARGE, background=background, depth=float(depth)
        )
        x = _along(moved.corners[..., 0], moved.vertical[..., 0], table, axis=0)
        y = _along(moved.corners[..., 1], moved.horizontal[..., 1], table, axis=1)
        # The line left of the first pixel is the right edge of a pixel outside the table.
        out_x[k, 1:-1, :-1] = x / scale[0]
        out_y[k, :-1, 1:-1] = y / scale[1]
    return out_x, out_y


def _along(
    corners: FloatArray,
    sides: FloatArray,
    table: DistortionTable,
    *,
    axis: int,
) -> FloatArray:
    """Mean of a displacement along each edge: trapezoids between corners and vertices.

    ``axis`` is that of the array along which the edges run.
    """
    ends = np.moveaxis(corners, axis, 0)
    inner = np.moveaxis(sides, axis, 0)
    at = np.concatenate([[0.0], vertex_fractions(table.vertices), [1.0]])
    values = np.concatenate([ends[:-1, :, None], inner, ends[1:, :, None]], axis=-1)
    mean = np.trapezoid(values, at, axis=-1)
    return np.asarray(np.moveaxis(mean, 0, axis))
