"""a_ij of a device by Poisson_CCD, the program of Lage et al., which shares no code with this package.

The program is built by its own instructions from https://github.com/craiglagegit/Poisson_CCD (last
compared: commit 036cbef); it needs no HDF5 where the functions of ``hdf5write.cpp`` and
``hdf5read.cpp`` are left empty, as nothing that they write is read here.  This module writes its
configuration, runs the binary, and reads the boundaries of pixels that it finds by tracing electrons.

All pixels of a periodic array hold the level of a flat, the central one an excess above it.  The areas
of pixels in one quadrant, over the area of a pixel and the excess, are a_ij.  Light converts at one
height.
"""

from __future__ import annotations

import math
import re
import resource
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.optimize import brentq

from bfsensor.device.device import Device
from bfsensor.device.parts import Implant
from bfsensor.device.poisson_ccd import PUBLISHED_MATERIAL
from bfsensor.errors import DeviceError

Array = NDArray[np.float64]

PIXELS = 8
"""Pixels of the periodic box in x and in y.  Chosen: at 16 cells a pixel their number times 16 must be
a multiple of 32, and neighbours up to 4 pixels away must not be images; with 20 a run takes four times
as long."""
CENTRE = 3
"""Place of the central pixel from the lower left: four pixels on one side of it, five on the other."""
CELLS_X = 16
"""Cells a pixel at scale 1.  Published: the program's own configurations."""
PLANES, CARRIER_PLANES = 160, 24
"""Planes of the mesh in z, and of those that hold carriers.  Published: its own configurations.  Silicon
above 125 um has 32 more for each 25 um: with 160 its front could not have planes as near."""
CRAMPING, THICKNESS, FRONT = 10.0, 100.0, 1.0
"""Published: how much finer than uniform its mesh is at the gates, for silicon of 100 um.  The height
[um] whose plane stays in place in thicker or thinner silicon, as the oxides are made of whole planes.
Chosen: that of the thickest oxide; at twice the height the planes below 1 um move by less than 2 %
for 10 um of silicon."""

DEGREE, CORNER, ROUGH = 6, 0.06, 5e-4
"""Degree of the polynomial through a side; vertices nearer to another side than this share of the pitch
are left out; largest scatter of vertices about the curve, as share of the pitch.  Measured (ITL, 100,000
e- in one pixel): areas change by at most 0.004 um^2 with degree 4 or with 0.1; the scatter is 4e-6 to
7e-5; with twice the limit a boundary with a kink of 0.01 um passes."""


@dataclass(frozen=True)
class Run:
    """Charge, light and numerics of a run.

    Attributes
    ----------
    level, excess : float
        Charge in every pixel, and above it in the central one [e-].  Chosen: the level of the truths; an
        excess twice as large halves the noise of a_ij and doubles what they lose by its own field.
    depth : float
        Height at which light converts, as share of the thickness, above 0 and below 1.  Published.
    reach : int
        Largest lag in x and in y, 0 to 3.  Chosen: 3 takes 1.8 times as long to find boundaries.
    vertices : int
        Points on each side of a polygon.  Published; with 8, sides have too few for their curves.
    cycles : int
        Relaxation sweeps on the finest mesh; coarser ones have 4 times as many each.  Chosen: electrons
        settle by sweeps too; twice as many double the time of the solution.
    relaxation : float
        Factor of the over-relaxation, below 2.  Chosen: the bulk's smooth errors fall in half the sweeps
        that the published 1.8 takes; above 1.95 what sweeps start with does not die out.
    scale : int
        Power of two that refines the mesh in all directions; 2 takes ten times as long.
    seed : int
        Seed of the random lengths of steps by which electrons are traced.
    strides : int
        Mean length of those steps in units of the program's own.  Measured: 4 make a_00 2 % smaller.
    """

    level: float = 40_000.0
    excess: float = 40_000.0
    depth: float = 0.95
    reach: int = 2
    vertices: int = 32
    cycles: int = 256
    relaxation: float = 1.9
    scale: int = 1
    seed: int = 77
    strides: int = 1


def configuration(device: Device, run: Run) -> str:
    """Write the configuration of a run.

    Parameters
    ----------
    device : Device
        With square pixels, the program's constants of silicon, no edge, no ripples, and implants of
        one shape in each region.
    run : Run
        The rest.

    Returns
    -------
    text : str
        Lines ``key = value``; :func:`bfsensor.device.poisson_ccd.import_poisson_ccd` reads the device
        from them.

    Raises
    ------
    DeviceError
        The program has no such device.
    """
    _refuse(device)
    pitch = device.pixel.pitch_x
    point, stop = device.operating_point, device.channel_stop
    lower, upper = CENTRE * pitch, (CENTRE + run.reach + 1) * pitch
    lines = {
        "VerboseLevel": 1, "w": run.relaxation, "ncycle": run.cycles, "iterations": 1,
        "Seed": run.seed, "ScaleFactor": run.scale, "SensorThickness": device.silicon.thickness,
        "PixelSizeX": pitch, "PixelSizeY": pitch,
        "GridsPerPixelX": CELLS_X, "GridsPerPixelY": CELLS_X,
        "Nx": PIXELS * CELLS_X, "Ny": PIXELS * CELLS_X,
        "Nz": planes(device.silicon.thickness), "Nzelec": CARRIER_PLANES,
        "NZExp": cramping(device.silicon.thickness), "XBCType": 1, "YBCType": 1,
        "SimulationRegionLowerLeft": "0.0 0.0",
        "GateOxide": device.gates.gate_oxide, "FieldOxide": device.gates.field_oxide,
        "FieldOxideTaper": device.gates.field_oxide_taper,
        "NumPhases": device.gates.phases, "CollectingPhases": device.gates.collecting_phases,
        "BackgroundDoping": device.silicon.background_doping * 1e12,
        "ChannelStopWidth": stop.width, "ChannelStopSideDiff": stop.side_diffusion,
        **_region("Channel", device.channel.implants, device.channel.surface_charge),
        **_region("ChannelStop", stop.implants, stop.surface_charge),
        "Vbb": point.back_bias, "Vparallel_lo": point.gate_low, "Vparallel_hi": point.gate_high,
        "qfh": point.hole_quasi_fermi_level, "CCDTemperature": point.temperature,
        "ElectronMethod": 2, "NumberofFixedRegions": 0, "NumberofPixelRegions": 1,
        "PixelRegionLowerLeft_0": "0.0 0.0",
        "PixelRegionUpperRight_0": f"{PIXELS * pitch!r} {PIXELS * pitch!r}",
        "PixelBoundaryLowerLeft": f"{lower!r} {lower!r}",
        "PixelBoundaryUpperRight": f"{upper!r} {upper!r}",
        "PixelBoundaryNx": run.reach + 1, "PixelBoundaryNy": run.reach + 1,
        "PixelBoundaryTestType": 1, "NumSteps": 1, "NumElec": 0, "CalculateZ0": 0,
        "ElectronZ0Fill": run.depth * device.silicon.thickness,
        "ElectronZ0Area": run.depth * device.silicon.thickness,
        "LogEField": 0, "LogPixelPaths": 0, "PixelAreas": 1, "NumVertices": run.vertices,
        "DiffMultiplier": 1.0, "EquilibrateSteps": 1, "BottomSteps": 1, "NumDiffSteps": run.strides,
        "SaturationModel": 0, "outputfiledir": ".", "outputfilebase": "run",
        "SaveData": 0, "SaveElec": 0, "SaveMultiGrids": 0, "Continuation": 0,
    }  # fmt: skip
    if stop.dots is not None:
        lines |= {
            "ChannelStopDotCenter": stop.dots.centre, "ChannelStopDotHeight": stop.dots.height,
            **_region("ChannelStopDot", stop.dots.implants, stop.dots.surface_charge),
        }  # fmt: skip
    lines |= _wells(pitch, run)
    return "".join(f"{key} = {value}\n" for key, value in lines.items())


def _refuse(device: Device) -> None:
    """Refuse devices that the program does not have, or solves wrongly."""
    silicon = device.silicon
    for wrong, why in (
        (
            device.pixel.pitch_x != device.pixel.pitch_y,
            "its stencil is that of square cells",
        ),
        (
            device.material != PUBLISHED_MATERIAL,
            "constants of silicon are compiled into it",
        ),
        (bool(silicon.ripples), "ripples of the doping are not written"),
        (device.edge is not None, "edges of the array are not written"),
        (device.image_charge is not None, "it has no image-charge model"),
    ):
        if wrong:
            raise DeviceError(f"{device.name}: no device of Poisson_CCD: {why}")


def _region(
    prefix: str, implants: tuple[Implant, ...], surface: float
) -> dict[str, float | int]:
    """Keys of the implants of a region."""
    out: dict[str, float | int] = {f"{prefix}SurfaceCharge": surface * 1e8}
    if implants and all(i.shape == "gaussian" for i in implants):
        out[f"{prefix}Profile"] = len(implants)
        for n, implant in enumerate(implants):
            assert implant.peak is not None and implant.sigma is not None
            out[f"{prefix}Dose_{n}"] = implant.dose * 1e8
            out[f"{prefix}Peak_{n}"] = implant.peak
            out[f"{prefix}Sigma_{n}"] = implant.sigma
        return out
    if len(implants) > 1 or surface:
        raise DeviceError(
            f"{prefix}: Poisson_CCD has Gaussian implants with a surface charge, or one uniform one"
        )
    # A region without implants has a dose that is not 0 by default.
    out[f"{prefix}Profile"] = 0
    out[f"{prefix}Doping"] = implants[0].dose * 1e8 if implants else 0.0
    out[f"{prefix}Depth"] = (implants[0].depth or 1.0) if implants else 1.0
    return out


def _wells(pitch: float, run: Run) -> dict[str, str | int]:
    """Keys of the charges of all pixels."""
    inside, outside = [], []
    for j in range(PIXELS):
        for i in range(PIXELS):
            searched = all(CENTRE <= k <= CENTRE + run.reach for k in (i, j))
            charge = run.level + (run.excess if i == j == CENTRE else 0.0)
            (inside if searched else outside).append((i, j, charge))
    out: dict[str, str | int] = {"NumberofFilledWells_0": len(inside) + len(outside)}
    # Pixels whose boundaries are searched come last: the program drops as many wells from the end of
    # its list as it has moved into that of these pixels.
    for n, (i, j, charge) in enumerate(outside + inside):
        out[f"CollectedCharge_0_{n}"] = round(charge)
        out[f"FilledPixelCoords_0_{n}"] = f"{(i + 0.5) * pitch!r} {(j + 0.5) * pitch!r}"
    return out


def planes(thickness: float) -> int:
    """Number of planes of the mesh in z."""
    return max(PLANES, 32 * math.ceil(thickness / 25.0))


def plane(height: float, thickness: float, cramping: float) -> float:
    """Place of a height [um] on the program's mesh [planes], from 0 at the gates."""
    share = height / thickness
    bent = cramping * share - (cramping - 1) * share ** (1 + 1 / cramping)
    return planes(thickness) * bent


def cramping(thickness: float) -> float:
    """Exponent of the mesh with which the plane at the height :data:`FRONT` stays where it is."""
    wanted = plane(FRONT, THICKNESS, CRAMPING)
    return float(brentq(lambda n: plane(FRONT, thickness, n) - wanted, 1.01, 1e3))


def read_areas(path: Path, pitch: float, excess: float) -> Array:
    """Read a_ij [1/e-], indices [j, i], from a file of vertices that the program wrote.

    The areas that it writes itself are those of polygons whose corners it seeks where the boundary is
    farthest from the centre.  Boundaries between rows end at other heights on the two sides of a channel
    stop.  Here each side is a polynomial through its vertices, and corners are where these meet.  With
    100,000 e- in one pixel of ITL, the two areas differ by up to 0.05 um^2, 5 % of a_10 and of a_11.
    That all pixels together keep their area has not been checked for either.

    Parameters
    ----------
    path : Path
        File whose name ends in ``_Vertices.dat``: a header, then centre in x and y [um], angle [rad],
        and the vertex in x and y [um].
    pitch : float
        Pitch of pixels [um].
    excess : float
        Charge of the pixel with the smallest coordinates above that of all others [e-].

    Raises
    ------
    ValueError
        A pixel is missing, or a side has too few vertices or is no smooth curve.
    """
    rows = np.loadtxt(path, skiprows=1, ndmin=2)
    places = np.rint((rows[:, :2] - rows[:, :2].min(axis=0)) / pitch).astype(int)
    side = int(places.max()) + 1
    out = np.full((side, side), np.nan)
    for j, i in np.ndindex(out.shape):
        own = rows[(places == (i, j)).all(axis=1)]
        if not len(own):
            raise ValueError(f"{path.name}: there is no pixel ({i}, {j})")
        out[j, i] = area_within(own[:, 3:] - own[:, :2], pitch)
    # The search ends at the last point inside: it halves its step from half a pitch down to the first
    # below 1e-4 um, so that the edge lies half of twice that step beyond, all around.
    step = pitch / 2.0
    while step > 1e-4:
        step /= 2.0
    lost = step * 4 * pitch * np.arcsinh(1.0)
    return np.asarray((out + lost - pitch**2) / pitch**2 / excess)


def area_within(points: Array, pitch: float) -> float:
    """Area [um^2] within four smooth sides through points (n, 2) [um] about a pixel's centre."""
    sides = []
    for along, sign in ((1, 1), (0, 1), (1, -1), (0, -1)):  # right, top, left, bottom
        u, v = points[:, along], points[:, 1 - along]
        own = (sign * v > 0) & (abs(u) < abs(v) - CORNER * pitch)
        if own.sum() < 2 * DEGREE:
            raise ValueError(f"a side of a pixel has only {own.sum()} vertices")
        curve = Polynomial.fit(u[own], v[own], DEGREE)
        if np.std(v[own] - curve(u[own])) > ROUGH * pitch:
            raise ValueError("the boundary of a pixel is no smooth curve")
        sides.append(curve)
    right, top, left, bottom = sides

    def corner(column: Polynomial, row: Polynomial, x: float) -> tuple[float, float]:
        for _ in range(
            50
        ):  # slopes of sides are a few percent: each step gains a factor of 100
            x = column(row(x))
        return x, row(x)

    half = pitch / 2
    corners = [
        corner(right, top, half), corner(left, top, -half),
        corner(left, bottom, -half), corner(right, bottom, half),
    ]  # fmt: skip
    # Green's theorem: the integral of x dy counter-clockwise.
    (_, y0), (_, y1), (_, y2), (_, y3) = corners
    (x0, _), (x1, _), (x2, _), (x3, _) = corners

    def under(row: Polynomial, start: float, end: float) -> float:
        """Integral of x dy along a row's curve."""
        whole = (Polynomial([0.0, 1.0]) * row.convert().deriv()).integ()
        return float(whole(end) - whole(start))

    def beside(column: Polynomial, start: float, end: float) -> float:
        """Integral of x dy along a column's curve."""
        whole = column.integ()
        return float(whole(end) - whole(start))

    return (
        beside(right, y3, y0) + under(top, x0, x1) + beside(left, y1, y2) + under(bottom, x2, x3)
    )  # fmt: skip


def area_changes(binary: str | Path, device: Device, run: Run) -> tuple[Array, float]:
    """a_ij [1/e-] of a device by the program, and the CPU time [s].

    Parameters
    ----------
    binary : path
        The program.
    device : Device
        As in :func:`configuration`.
    run : Run
        Charge, light and numerics.

    Returns
    -------
    a : ndarray, shape (reach + 1, reach + 1)
        Indices [j, i].
    cpu_s : float
        CPU time of the run.

    Raises
    ------
    DeviceError
        As :func:`configuration`.
    ValueError
        The program did not end well, or the areas of the nearest pixels do not grow together by less
        than the central one shrinks.
    """
    text = configuration(device, run)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "run.cfg").write_text(text)
        done = subprocess.run(
            [str(Path(binary).resolve()), "run.cfg"], cwd=folder, capture_output=True, text=True
        )  # fmt: skip
        path = Path(folder) / "run_0_Vertices.dat"
        if done.returncode or not path.exists() or re.search("Nan|Too many", done.stdout):
            raise ValueError(f"{device.name}: Poisson_CCD failed: {done.stdout[-300:]}")
        a = read_areas(path, device.pixel.pitch_x, run.excess)
    if (
        run.reach
        and not -1.0 < (a[0, 0] + 2 * (a[0, 1] + a[1, 0]) + 4 * a[1, 1]) / -a[0, 0] < 0.0
    ):
        raise ValueError(
            f"{device.name}: areas by Poisson_CCD are not those of a pixel that repels"
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return a, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def change_ratio(
    binary: str | Path,
    before: Device,
    after: Device,
    *,
    lags: int,
    run: Run | None = None,
    known: dict[str, Array] | None = None,
) -> Array:
    """Ratio of the a_ij of two devices by the program, as :func:`ratio_of_areas` takes it.

    Parameters
    ----------
    binary : path
        The program.
    before, after : Device
        As in :func:`configuration`.
    lags : int
        Number of lags in x and in y, from 0.
    run : Run, optional
        Charge, light and numerics, the defaults if not given.
    known : dict, optional
        a_ij by the text of the configuration; those in it are not run again, and others are added.

    Returns
    -------
    ratio : ndarray, shape (lags, lags)
        After over before, indices [j, i].

    Raises
    ------
    DeviceError, ValueError
        As :func:`area_changes`.
    """
    run = run or Run()
    known = {} if known is None else known
    both = []
    for device in (before, after):
        key = configuration(device, run)
        if key not in known:
            known[key] = area_changes(binary, device, run)[0]
        both.append(known[key])
    return ratio_of_areas(*both, lags=lags)


def ratio_of_areas(before: Array, after: Array, *, lags: int) -> Array:
    """Ratio of a_ij by lag: each its own up to lag 1 in x and y, one of all beyond.

    The areas of pixels beyond are as uncertain as their small changes by the charge; those of lag 2
    together are not.  Our solver has changes of lags 2 and 3 that differ by a tenth of them.

    Parameters
    ----------
    before, after : ndarray, shape (3, 3) or larger
        a_ij, indices [j, i].
    lags : int
        Number of lags in x and in y of the result, from 0.

    Returns
    -------
    ratio : ndarray, shape (lags, lags)
        After over before.
    """
    j, i = np.indices(before.shape)
    far = np.maximum(i, j) > 1
    out = np.full((lags, lags), after[far].sum() / before[far].sum())
    out[:2, :2] = after[:2, :2] / before[:2, :2]
    return out
