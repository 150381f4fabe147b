"""One point of a sweep: a device, solved for the response a_ij of flats, and the file of it."""

from __future__ import annotations

import hashlib
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import bfsensor
from bfsensor.device import silicon
from bfsensor.device.depletion import check_depleted
from bfsensor.device.device import Device
from bfsensor.errors import BFSensorError, SweepError
from bfsensor.files import written_whole
from bfsensor.simulate.well import full_well
from bfsensor.sweeps.rows import LAGS
from bfsensor.table.build import build_table
from bfsensor.table.table import DistortionTable
from bfsensor.table.table_plan import TablePlan, default_depths
from bfsensor.typing import FloatArray

LEVEL = 40_000.0
"""Charge of all pixels about which the response is taken [e-].

Chosen: the mean over the exposure of a flat of 80,000 e-.  On 16 cells, at
twice the level a_00 changes by -3.3 % (ITL) and +0.7 % (E2V), other a_ij by up to 10 %."""

STEP = 5_000.0
"""Charge of the source pixel over the background [e-].

Chosen: small, because the response is differential, and large against the solver's iteration
error.  On 16 cells, twice the step weakens a_00 of the two LSST devices by 0.3 and 0.5 %, and no
a_ij changes by more than 1.4 %."""

CELLS = 16
"""Mesh cells a pixel.

Chosen: on 64 cells a_01 is 4 % (ITL) and 9 % (E2V) smaller, and E2V's a_10 is 14 % larger; on
twice as many a level takes 2.6 times as long."""

_REACH = 4
"""Largest pixel offset of a point's table, of which offsets 0 to 2 are used.

Chosen: 5 changes the a_ij of the two LSST devices by 0.2 % at most (on 16 cells).  Twice as many do
not fit into the solver's period of 12 pixels."""

_VERTICES = 32
"""Vertices a side of a pixel in a point's table.

Chosen: twice as many change a_10 of the two LSST devices by 0.1 and 0.3 %, the other a_ij by
0.2 % at most (on 16 cells)."""

_SLABS = 48
"""Slabs of silicon between which the response is linear in depth, for light of a wavelength.

Chosen: twice as many change the a_ij of the two LSST devices in light of 900 nm by 0.1 % at
most."""


@dataclass(frozen=True)
class SweepPoint:
    """A device to be solved, and the charges and mesh to solve it with.

    Attributes
    ----------
    device_text : str
        Text of the device file.
    level : float
        Charge of all pixels [e-].
    full_pixel : float
        Charge of one full pixel among empty ones [e-]; 0 leaves it out.
    cells : int
        Mesh cells a pixel.
    with_table : bool
        Whether the distortion table of the differential response is kept.

    Examples
    --------
    >>> len(SweepPoint(Device.load("itl_sta3800c").to_toml(), LEVEL, 0.0, CELLS).key)
    16
    """

    device_text: str
    level: float
    full_pixel: float
    cells: int
    with_table: bool = False

    @property
    def key(self) -> str:
        """Digest of all inputs of the response: device, charges, mesh, constants, version."""
        text = "\n".join([
            "sweep 1", bfsensor.__version__, self.device_text,
            f"{self.level:.9g} {self.full_pixel:.9g} {self.cells} {STEP} {_REACH} {_VERTICES} "
            f"{self.with_table}",
        ])  # fmt: skip
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class PointResponse:
    """Response of a solved point, by depth of conversion.

    Attributes
    ----------
    depths : ndarray, shape (nd,)
        Conversion depths [um above the gates], ascending; at the first, the height of the stored
        charge, nothing moves; the last is the back surface.
    a : ndarray, shape (nd, 3, 3)
        a_ij [1/e-], ``a[:, j, i]``; nan where the point was refused.
    areas : ndarray, shape (nd, 3, 3)
        Area changes around one full pixel [um^2]; nan where none was asked for.
    full_well : float
        Charge at which a pixel spills [e-].
    cpu_seconds : float
        CPU time of the point [s].
    iteration : float
        Bound on the error of an a_ij by the solver's iteration [1/e-].
    reason : str
        Reason of a refusal; empty where there is a response.
    table : DistortionTable, optional
        Table from which ``a`` was taken; it is written beside and never read back.

    Examples
    --------
    >>> a = np.full((2, LAGS, LAGS), -1e-6)
    >>> found = PointResponse(np.array([1.0, 100.0]), a, 0 * a, 1.5e5, 2.0, 1e-10)
    >>> found.in_light(None, 173.0)[0].shape
    (3, 3)
    """

    depths: FloatArray
    a: FloatArray
    areas: FloatArray
    full_well: float
    cpu_seconds: float
    iteration: float
    reason: str = ""
    table: DistortionTable | None = field(default=None, compare=False)

    def write(self, path: Path) -> None:
        """Write an .npz file, whole or not at all; the table comes first, as .fits beside it.

        Parameters
        ----------
        path : Path
            Where to; an existing file is replaced.
        """
        if self.table is not None:
            self.table.write(path.with_suffix(".fits"), overwrite=True)
        values = {k: v for k, v in self.__dict__.items() if k != "table"}
        with written_whole(path, SweepError) as beside, open(beside, "wb") as stream:
            np.savez(stream, **values)

    @classmethod
    def read(cls, path: Path) -> PointResponse:
        """Read the file of a point.

        Parameters
        ----------
        path : Path
            File that :meth:`write` wrote.

        Returns
        -------
        PointResponse
            Without its table.

        Raises
        ------
        SweepError
            The file is damaged or of another kind; the message names it.
        """
        try:
            with path.open("rb") as stream, np.load(stream) as data:
                values = {
                    n: data[n] if data[n].ndim else data[n].item() for n in data.files
                }
            return cls(**values)
        except (ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise SweepError(
                f"{path}: not a finished point; delete it to solve it again ({error})"
            ) from None

    def in_light(self, wavelength: float | None, temperature: float) -> tuple[
        FloatArray, FloatArray
    ]:  # fmt: skip
        """Average the response over the depths at which light converts.

        Parameters
        ----------
        wavelength : float or None
            Vacuum wavelength [nm]; None: all light converts at the back surface.
        temperature : float
            Temperature of the silicon, which sets the absorption length [K].

        Returns
        -------
        a, areas : ndarray, shape (3, 3)
            a_ij [1/e-] and area changes [um^2], ``[j, i]``.
        """
        if wavelength is None:
            return self.a[-1], self.areas[-1]
        weights = light_weights(self.depths, wavelength, temperature)
        return np.tensordot(weights, self.a, 1), np.tensordot(weights, self.areas, 1)


def light_weights(depths: FloatArray, wavelength: float, temperature: float) -> FloatArray:
    r"""Weights of depths for the mean, over converting light, of a response linear between them.

    .. math:: w_k = \int h_k(z)\, \frac{e^{-(T - z) / \ell}}{\ell}\, dz \Big/
        \int \frac{e^{-(T - z) / \ell}}{\ell}\, dz, \qquad \ell = \ell(\lambda, \text{K}),

    with hat functions h_k, in closed form.  Light that passes through the silicon or converts
    below the first depth, where nothing moves, is left out; none is reflected at the gates.

    Parameters
    ----------
    depths : ndarray, shape (nd,)
        Conversion depths [um above the gates], ascending, the last one the back surface.
    wavelength : float
        Vacuum wavelength of the light [nm].
    temperature : float
        Temperature of the silicon [K]; with the wavelength it gives
        :func:`bfsensor.device.silicon.absorption_length`.

    Returns
    -------
    weights : ndarray, shape (nd,)
        Weights of the depths, at least 0; their sum is 1.

    Examples
    --------
    >>> light_weights(np.array([0.0, 50.0, 100.0]), 400.0, 173.0).round(3)
    array([0.   , 0.004, 0.996])
    """
    # 1 m stands for an infinite length: the little light that converts is then uniform in depth.
    length = min(float(silicon.absorption_length(wavelength, temperature)), 1e6)
    reaching = np.exp(-(depths[-1] - depths) / length)
    converted = np.diff(reaching)
    upper = reaching[1:] - converted * length / np.diff(depths)
    weights = np.zeros(len(depths))
    weights[1:] += upper
    weights[:-1] += converted - upper
    return weights / weights.sum()


def solve_point(point: SweepPoint) -> PointResponse:
    """Solve a point of a sweep.

    Parameters
    ----------
    point : SweepPoint
        Device, charges and mesh.

    Returns
    -------
    PointResponse
        The response; for a device that is refused (not depleted, full well below the level, ...)
        or does not converge, a reason and nan instead.

    Examples
    --------
    >>> undepleted = Device.load("e2v_ccd250").with_value("back_bias", "-5 V")
    >>> solve_point(SweepPoint(undepleted.to_toml(), LEVEL, 0.0, 8)).reason.partition(" = ")[0]
    'e2v_ccd250: back_bias'
    """
    began = time.process_time()
    try:
        return _solve(point, began)
    except (BFSensorError, ValueError, ArithmeticError) as error:
        # In barely depleted devices boundary lines between pixels are missing, on which numpy
        # raises ValueError; one such point must not end the sweep.
        none = np.full((1, LAGS, LAGS), np.nan)
        spent = time.process_time() - began
        kind = "" if isinstance(error, BFSensorError) else f"{type(error).__name__}: "
        reason = kind + " ".join(str(error).split())
        return PointResponse(np.zeros(1), none, none, np.nan, spent, np.nan, reason)


def _solve(point: SweepPoint, began: float) -> PointResponse:
    """Solve a point; ``began`` is the process's CPU time at its start [s]."""
    device = Device.from_toml(point.device_text)
    check_depleted(device)
    well = full_well(device, cells=min(point.cells, 16))
    top = max(point.level + STEP, point.full_pixel)
    if top > well:
        raise SweepError(
            f"level or full pixel needs {top:,.0f} e- in a pixel, above its full well, "
            f"{well:,.0f} e-"
        )
    lowest, _, *higher = default_depths(device)
    # Without the depth 2 um into the silicon, whose boundaries take as long as all others.
    levels = (lowest, *higher)
    area = device.pixel.pitch_x * device.pixel.pitch_y
    between = np.linspace(levels[0], levels[-1], _SLABS + 1)[1:-1]
    depths = np.unique([*levels, *between])

    def build(charge: float, background: float) -> DistortionTable:
        return build_table(
            TablePlan(
                device, (background, charge), (background,), levels, _VERTICES, _REACH,
                point.cells, 0, well,
            )
        )  # fmt: skip

    def changes(table: DistortionTable) -> FloatArray:
        """Area changes at lags from 0 [um^2]; the device's symmetry makes the others equal."""
        at = {"charge": float(table.charges[1]), "background": float(table.backgrounds[0])}
        near = slice(_REACH, _REACH + LAGS)
        return np.array([
            table.area_changes(**at, depth=float(z))[near, near] for z in depths
        ])  # fmt: skip

    table = build(point.level + STEP, point.level)
    a = changes(table) / (STEP * area)
    areas = np.full_like(a, np.nan)
    if point.full_pixel:
        areas = changes(build(point.full_pixel, 0.0))
    return PointResponse(
        depths, a, areas, well, time.process_time() - began,
        table.errors["iteration, worst case [um2]"] / (STEP * area),
        table=table if point.with_table else None,
    )  # fmt: skip
