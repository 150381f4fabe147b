"""Boundary shifts of a device from full solutions, by background and depth, cached in a folder."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import bfsensor
from bfsensor.device.device import Device
from bfsensor.diagnose.model.table_baseline import CHARGE, edges_by_depth
from bfsensor.errors import DiagnosisError
from bfsensor.files import written_whole
from bfsensor.response.edge_response import LEVEL, REACH, VERTICES, mixed, response_depths
from bfsensor.table.build import build_table
from bfsensor.table.table_plan import TablePlan
from bfsensor.typing import Edges, FloatArray

SPAN = 25_000.0
"""Distance of the outer two of three backgrounds from :data:`~bfsensor.response.edge_response.LEVEL`
[e-].  Chosen: the three then span most of a flat's levels, 15,000 to 65,000 e-; twice as large would
put the lowest below 0; half as large, errors of the second derivative are four times as large."""

BEYOND = 50 * CHARGE
"""Charge step above the background that shifts per electron are taken over [e-], 5,000. Chosen: twice
as large doubles the share of the change with charge in it; half as large, errors of boundaries
double."""

FORMAT = "walk"
"""First word of the text that cached files are named after; changing it makes old files unused."""


@dataclass(frozen=True, eq=False)
class Walk:
    """Shifts of a device at one operating point, by background and depth of conversion.

    Attributes
    ----------
    backgrounds : tuple of float
        Charge of all pixels [e-], one or three equidistant values.
    depths : ndarray, shape (nd,)
        Heights of conversion above the gates [um], the last one the back surface.
    kx, ky : ndarray, shape (backgrounds, nd, 2 REACH + 3, 2 REACH + 3)
        Mean shifts of right and upper edges per electron [pixel/e-].
    """

    backgrounds: tuple[float, ...]
    depths: FloatArray
    kx: FloatArray
    ky: FloatArray

    def edges(self, wavelength: float | None, temperature: float) -> Edges:
        """Shifts [pixel/e-] at the middle background, averaged over the depths of conversion.

        Parameters
        ----------
        wavelength : float or None
            Wavelength of the light [nm]; None: all of it converts at the back surface.
        temperature : float
            Temperature of the absorbing silicon [K].
        """
        kx, ky = self._mixed(wavelength, temperature)
        middle = len(self.backgrounds) // 2
        return kx[middle], ky[middle]

    def bent(self, wavelength: float | None, temperature: float) -> tuple[Edges, Edges]:
        """Derivative of the shifts by the background [pixel/e-^2], and half the second [pixel/e-^3].

        Both are of the parabola through three backgrounds.

        Raises
        ------
        DiagnosisError
            The response was calculated at one background only.
        """
        if len(self.backgrounds) != 3:
            raise DiagnosisError(
                "the response was calculated at one background; its change with level takes three"
            )
        low, _, high = self.backgrounds
        half = 0.5 * (high - low)
        slopes, bends = [], []
        for one, mean, two in self._mixed(wavelength, temperature):
            slopes.append((two - one) / (2 * half))
            bends.append((two + one - 2 * mean) / (2 * half**2))
        return (slopes[0], slopes[1]), (bends[0], bends[1])

    def _mixed(self, wavelength: float | None, temperature: float) -> Edges:
        """Shifts by background, weighted by the fraction of light that converts at each depth."""
        return mixed(self.kx, self.ky, self.depths, wavelength, temperature)


def walk(
    device: Device,
    *,
    cells: int,
    backgrounds: Sequence[float] = (LEVEL,),
    keep: Path | None = None,
) -> Walk:
    """Calculate a device's shifts: solve potential and boundaries at one background after another.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device.
    cells : int
        Cells of the mesh per pixel; about 0.4 CPU seconds per background at 8, 1.4 at 16, 3.6 at
        32.
    backgrounds : sequence of float
        One background, or three equidistant ones [e-].
    keep : Path, optional
        Folder in which results are cached, by device, mesh, background and package version.
    """
    depths = response_depths(device)
    both = [_at(device, cells, float(b), depths, keep) for b in backgrounds]
    kx, ky = (np.array([b[n] for b in both]) for n in range(2))
    return Walk(tuple(map(float, backgrounds)), np.array(depths), kx, ky)


def _at(
    device: Device,
    cells: int,
    background: float,
    depths: tuple[float, ...],
    keep: Path | None,
) -> Edges:
    """Shifts by depth at one background, calculated or read from the cache."""
    text = "\n".join([
        f"{FORMAT} 1", bfsensor.__version__, device.physics, f"{cells} {VERTICES} {REACH}",
        " ".join(f"{v:.9g}" for v in (background, *depths)),
    ])  # fmt: skip
    name = f"walk_{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    path = None if keep is None else keep / name
    if path is not None and path.exists():
        return _read(path)
    # The full well is given, not calculated: that would take as long as the table.
    plan = TablePlan(
        device, (background, background + BEYOND), (background,), depths, VERTICES, REACH,
        cells, 0, max(4 * background, 2e5),
    )  # fmt: skip
    kx, ky = edges_by_depth(build_table(plan), background=background)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(path, DiagnosisError) as beside, open(beside, "wb") as stream:
            np.savez(stream, kx=kx, ky=ky)
    return kx, ky


def _read(path: Path) -> Edges:
    try:
        with path.open("rb") as stream, np.load(stream) as data:
            return data["kx"], data["ky"]
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise DiagnosisError(
            f"{path}: not a finished file of boundary shifts; delete it to calculate it again "
            f"({error})"
        ) from None
