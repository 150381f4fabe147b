"""Boundary shifts of a device from full solutions, by background and depth, cached in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bfsensor.device.device import Device
from bfsensor.errors import DiagnosisError
from bfsensor.response.edge_response import LEVEL, REFINE_Z
from bfsensor.response.emulator_nodes import Node, solve_nodes
from bfsensor.response.light import conversion_depths, mixed
from bfsensor.typing import Edges, FloatArray

PRECISION = 1e-6
"""Width of the interval at which the bisection of boundary points ends [um].  Measured on itl_sta3800c,
3 um thicker: differences of the devices' a_ij are right to 0.5 % of themselves; with 1e-5, to 15 % at
(2, 0), for a quarter less time."""

SPAN = 25_000.0
"""Distance of the outer two of three backgrounds from :data:`~bfsensor.response.edge_response.LEVEL`
[e-].  Chosen: the three then span most of a flat's levels, 15,000 to 65,000 e-; twice as large would
put the lowest below 0; half as large, errors of the second derivative are four times as large."""


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
    laid_for: Device | None = None,
) -> Walk:
    """Calculate a device's shifts: solve potential and boundaries at one background after another.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device.
    cells : int
        Cells of the mesh per pixel; about 1 CPU second per background at 8, 3 at 16, 8 at
        32.
    backgrounds : sequence of float
        One background, or three equidistant ones [e-].
    keep : Path, optional
        Folder in which results are cached, by device, mesh, background and package version.
    laid_for : Device, optional
        Device near to this one whose mesh is moved to it; by default the device itself.
    """
    text = device.physics
    laid = text if laid_for is None else laid_for.physics
    nodes = [
        Node(text, laid, float(b), cells, REFINE_Z, (), (), (n, -1, 0), precision=PRECISION)
        for n, b in enumerate(backgrounds)
    ]
    found = solve_nodes(nodes, keep=keep, progress=None, executor=None)
    kx, ky = (np.array([found[node.at][0][n] for node in nodes]) for n in range(2))
    return Walk(tuple(map(float, backgrounds)), np.array(conversion_depths(device)), kx, ky)
