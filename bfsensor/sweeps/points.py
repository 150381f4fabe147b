"""One point of a sweep: a device, solved for the response a_ij of flats, and the file of it."""

from __future__ import annotations

import hashlib
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import bfsensor
from bfsensor.device.depletion import check_depleted
from bfsensor.device.device import Device
from bfsensor.errors import BFSensorError, SweepError
from bfsensor.files import written_whole
from bfsensor.response.edge_response import (
    CHARGE,
    REACH,
    REFINE_Z,
    VERTICES,
    EdgeResponse,
    area_matrix,
    solve_response,
)
from bfsensor.response.light import conversion_weights
from bfsensor.simulate.boundaries import BISECTION
from bfsensor.simulate.poisson import AREA_PER_VOLT
from bfsensor.simulate.well import full_well
from bfsensor.sweeps.rows import LAGS
from bfsensor.table.build import build_table
from bfsensor.table.table import DistortionTable
from bfsensor.table.table_plan import TablePlan
from bfsensor.typing import FloatArray

CELLS = 32
"""Mesh cells a pixel.

Measured (``python -m validation.boundaries.sweep_mesh``): the nearest a_ij are within 0.9 % (ITL) and
3.2 % (E2V's a_10) of 64 cells; 16 cells are off by 4 and 14 %, and take a third of the time."""


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
    >>> len(SweepPoint(Device.load("itl_sta3800c").to_toml(), 40e3, 0.0, CELLS).key)
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
            "sweep 2", bfsensor.__version__, self.device_text,
            f"{self.level:.9g} {self.full_pixel:.9g} {self.cells} {CHARGE} {REACH} {VERTICES} "
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
        weights = conversion_weights(self.depths, wavelength, temperature)
        return np.tensordot(weights, self.a, 1), np.tensordot(weights, self.areas, 1)


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
    >>> solve_point(SweepPoint(undepleted.to_toml(), 40e3, 0.0, 8)).reason.partition(" = ")[0]
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
    top = max(point.level + CHARGE, point.full_pixel)
    if top > well:
        raise SweepError(
            f"level or full pixel needs {top:,.0f} e- in a pixel, above its full well, "
            f"{well:,.0f} e-"
        )
    area = device.pixel.pitch_x * device.pixel.pitch_y

    def response(level: float, charge: float) -> tuple[EdgeResponse, FloatArray]:
        """Response by depth, and its a_ij at lags from 0 [1/e-]; symmetry makes others equal."""
        found = solve_response(
            device, level=level, charge=charge, cells=point.cells, precision=BISECTION
        )
        near = slice(REACH + 1, REACH + 1 + LAGS)
        return found, area_matrix(found.kx, found.ky)[:, near, near]

    found, a = response(point.level, CHARGE)
    areas = np.full_like(a, np.nan)
    if point.full_pixel:
        areas = response(0.0, point.full_pixel)[1] * point.full_pixel * area
    table = None
    if point.with_table:
        charges = point.level, point.level + CHARGE
        table = build_table(
            TablePlan(
                device, charges, charges[:1], tuple(found.depths), VERTICES, REACH, point.cells,
                REFINE_Z, well,
            )
        )  # fmt: skip
    return PointResponse(
        found.depths, a, areas, well, time.process_time() - began,
        AREA_PER_VOLT * found.error_volts / (CHARGE * area), table=table,
    )  # fmt: skip
