"""The road from a device to its shifts, walked anew for every change of it, and kept."""

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
"""To either side of it, of the backgrounds that tell how the response changes [e-]."""

BEYOND = 50 * CHARGE
"""Largest charge above the background [e-]: the response is differential, so a small one."""


@dataclass(frozen=True, eq=False)
class Walk:
    """Shifts of a device at one operating point, by background and depth of conversion.

    Attributes
    ----------
    backgrounds : tuple of float
        Charge of all pixels [e-].
    depths : ndarray, shape (nd,)
        [um above the gates], the last one the back surface.
    kx, ky : ndarray, shape (backgrounds, nd, 2 REACH + 3, 2 REACH + 3)
        Mean shifts of right and upper edges per electron [pixel/e-].
    """

    backgrounds: tuple[float, ...]
    depths: FloatArray
    kx: FloatArray
    ky: FloatArray

    def edges(self, wavelength: float | None, temperature: float) -> Edges:
        """Shifts about the middle background.

        Parameters
        ----------
        wavelength : float or None
            Of the light [nm]; None: all of it converts at the back surface.
        temperature : float
            Of the silicon that absorbs it [K].
        """
        kx, ky = self._mixed(wavelength, temperature)
        middle = len(self.backgrounds) // 2
        return kx[middle], ky[middle]

    def bent(self, wavelength: float | None, temperature: float) -> tuple[Edges, Edges]:
        """Slope of the shifts by the background [pixel/e-^2], and half the second derivative.

        Of the parabola through three backgrounds.
        """
        if len(self.backgrounds) != 3:
            raise DiagnosisError("the response was walked at one background, not at three")
        low, _, high = self.backgrounds
        half = 0.5 * (high - low)
        slopes, bends = [], []
        for one, mean, two in self._mixed(wavelength, temperature):
            slopes.append((two - one) / (2 * half))
            bends.append((two + one - 2 * mean) / (2 * half**2))
        return (slopes[0], slopes[1]), (bends[0], bends[1])

    def _mixed(self, wavelength: float | None, temperature: float) -> Edges:
        """By background, weighted by where light converts."""
        return mixed(self.kx, self.ky, self.depths, wavelength, temperature)


def walk(
    device: Device,
    *,
    cells: int,
    backgrounds: Sequence[float] = (LEVEL,),
    keep: Path | None = None,
) -> Walk:
    """Walk from a device to its shifts: potential, boundaries, one background after another.

    Parameters
    ----------
    device : Device
        Mirror-symmetric.
    cells : int
        Of the mesh, a pixel: 0.4 CPU seconds a background at 8, 1.4 at 16, 3.6 at 32.
    backgrounds : sequence of float
        One, or three equally far from each other [e-].
    keep : Path, optional
        Folder in which the result is kept, and found by a later walk.
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
    """Shifts by depth about one background, walked or read."""
    text = "\n".join([
        "walk 1", bfsensor.__version__, device.physics, f"{cells} {VERTICES} {REACH}",
        " ".join(f"{v:.9g}" for v in (background, *depths)),
    ])  # fmt: skip
    name = f"walk_{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"
    path = None if keep is None else keep / name
    if path is not None and path.exists():
        return _read(path)
    # The full well is not asked for: it takes as long as the table.
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
            f"{path}: not a finished walk; delete it to walk again ({error})"
        ) from None
