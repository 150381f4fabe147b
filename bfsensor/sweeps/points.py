"""One point of a sweep: a device solved for its response about a level, kept in a file."""

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
"""Background about which the response is taken [e-]: the middle of a flat of 80,000 e-."""

STEP = 5_000.0
"""Charge over the background [e-]: the response is differential, so a small one.

It still falls by 0.4 % within the step, from 12 % over 80,000 e-."""

CELLS = 16
"""Cells a pixel.

On 64 cells a_01 is 4 % (ITL) and 9 % (E2V) smaller, and E2V's a_10 is 14 % larger."""

_REACH = 4
_VERTICES = 32
_SLABS = 48


@dataclass(frozen=True)
class SweepPoint:
    """One device to be solved, and how.

    Attributes
    ----------
    device_text : str
        The device file.
    level : float
        Charge of all pixels [e-].
    full_pixel : float
        Charge of the one full pixel among empty ones [e-]; 0: not wanted.
    cells : int
        Of the mesh, a pixel.
    with_table : bool
        Keep the table of the differential response too.
    """

    device_text: str
    level: float
    full_pixel: float
    cells: int
    with_table: bool = False

    @property
    def key(self) -> str:
        """Digest that changes with anything that would change the response."""
        text = "\n".join([
            "sweep 1", bfsensor.__version__, self.device_text,
            f"{self.level:.9g} {self.full_pixel:.9g} {self.cells} {STEP} {_REACH} {_VERTICES} "
            f"{self.with_table}",
        ])  # fmt: skip
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True, eq=False)
class PointResponse:
    """What a point gives, by depth of conversion.

    Attributes
    ----------
    depths : ndarray, shape (nd,)
        [um above the gates], ascending; at the first nothing moves, the last is the back.
    a : ndarray, shape (nd, 3, 3)
        a_ij [1/e-], ``a[:, j, i]``.
    areas : ndarray, shape (nd, 3, 3)
        Area changes around one full pixel [um^2]; nan where not wanted.
    full_well, cpu_seconds, iteration : float
        [e-]; cost [s]; bound on what the solver's iteration error does to an a_ij [1/e-].
    reason : str
        Why there is no answer; empty where there is one.
    table : DistortionTable, optional
        From which ``a`` was taken; written beside, never read back.
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
        """Write it whole or not at all, after its table."""
        if self.table is not None:
            self.table.write(path.with_suffix(".fits"), overwrite=True)
        values = {k: v for k, v in self.__dict__.items() if k != "table"}
        with written_whole(path, SweepError) as beside, open(beside, "wb") as stream:
            np.savez(stream, **values)

    @classmethod
    def read(cls, path: Path) -> PointResponse:
        """Read what :meth:`write` wrote."""
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
        """Response and areas for light of one wavelength [nm]; None: all at the back."""
        if wavelength is None:
            return self.a[-1], self.areas[-1]
        weights = light_weights(self.depths, wavelength, temperature)
        return np.tensordot(weights, self.a, 1), np.tensordot(weights, self.areas, 1)


def light_weights(depths: FloatArray, wavelength: float, temperature: float) -> FloatArray:
    r"""Share of the light that each depth stands for, the response linear between them.

    .. math:: w_k = \int h_k(z)\, \frac{e^{-(T - z) / \ell}}{\ell}\, dz \Big/
        \int \frac{e^{-(T - z) / \ell}}{\ell}\, dz, \qquad \ell = \ell(\lambda, \text{K}),

    with hat functions h_k, in closed form.  What passes through the silicon or converts below
    the first depth, where nothing moves, is left out; nothing is reflected at the gates.

    Parameters
    ----------
    depths : ndarray, shape (nd,)
        Conversion depths [um above the gates], ascending, the last one the back surface.
    wavelength : float
        Of the light [nm].
    temperature : float
        Of the silicon [K].

    Returns
    -------
    weights : ndarray, shape (nd,)
        Their sum is 1.

    References
    ----------
    :func:`bfsensor.device.silicon.absorption_length`.

    Examples
    --------
    >>> light_weights(np.array([0.0, 50.0, 100.0]), 400.0, 173.0).round(3)
    array([0.   , 0.004, 0.996])
    """
    # Light that silicon does not absorb converts, where at all, as much at every depth.
    length = min(float(silicon.absorption_length(wavelength, temperature)), 1e6)
    reaching = np.exp(-(depths[-1] - depths) / length)
    converted = np.diff(reaching)
    upper = reaching[1:] - converted * length / np.diff(depths)
    weights = np.zeros(len(depths))
    weights[1:] += upper
    weights[:-1] += converted - upper
    return weights / weights.sum()


def solve_point(point: SweepPoint) -> PointResponse:
    """Solve a device for its response about one level.

    Parameters
    ----------
    point : SweepPoint
        What to solve.

    Returns
    -------
    PointResponse
        With a reason in place of numbers where the device refuses (not depleted, its full well
        below the level, ...) or does not converge.
    """
    began = time.process_time()
    try:
        return _solve(point, began)
    except (BFSensorError, ValueError, ArithmeticError) as error:
        # Near the end of depletion tracing leaves gaps that numpy trips over; a sweep goes on.
        none = np.full((1, LAGS, LAGS), np.nan)
        spent = time.process_time() - began
        kind = "" if isinstance(error, BFSensorError) else f"{type(error).__name__}: "
        reason = kind + " ".join(str(error).split())
        return PointResponse(np.zeros(1), none, none, np.nan, spent, np.nan, reason)


def _solve(point: SweepPoint, began: float) -> PointResponse:
    device = Device.from_toml(point.device_text)
    check_depleted(device)
    well = full_well(device, cells=min(point.cells, 16))
    top = max(point.level + STEP, point.full_pixel)
    if top > well:
        raise SweepError(
            f"{top:,.0f} e- are wanted in a pixel, above its full well, {well:,.0f} e-"
        )
    lowest, _, *higher = default_depths(device)
    levels = (lowest, *higher)  # the one left out, 2 um in, takes as long as all others
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
        """Of the quadrant of positive lags [um^2]; the others are equal."""
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
