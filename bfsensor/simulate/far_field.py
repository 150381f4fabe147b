r"""The far field of a charged pixel, and the periodic images taken out with it.

Many pixels away a stored charge and what it induces on gates and holes act as a dipole
on a grounded plane, facing the back contact at the other end of the silicon.  Its
lateral field is the mode sum (Jackson, Classical Electrodynamics, section 3.11)

.. math::
    E_\rho(\rho, z) = C \sum_n \kappa_n^2 \sin(\kappa_n (T - z)) K_1(\kappa_n \rho)
    (-1)^{n + 1}, \qquad \kappa_n = n \pi / (T - z_0),

and shifts a boundary by the integral of :math:`E_\\rho / E_z` over the path of the
electrons.  A solution with periodic sides is the sum over all images; those at other
lattice points lie at least half a period and more away, where this form holds, so they
can be subtracted.  Only the amplitude C is unknown; the outermost boundaries give it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import k1

from bfsensor.simulate.poisson import Potential
from bfsensor.typing import FloatArray

_MODES = 40
"""Number of modes of the sum.

Derived: mode n falls as exp(-n pi rho / (T - z_0)); at the smallest distance, 20 um in 100 um of
silicon, the 40th is exp(-25)."""

_STEPS = 200
"""Number of heights between the front structure and the back at which a path is integrated.

Chosen: steps are 0.5 um in 100 um of silicon; with twice as many the error of the trapezoids, of
second order, is a quarter, and the depths are interpolated on a grid half as wide."""

_IMAGES = 3
"""Number of periods to either side of which images are summed.

Derived: the next image of a period of 12 pixels of 10 um is at least 420 um away from a pixel,
where the field in 100 um of silicon has fallen to exp(-4.2 pi), 2e-6."""


@dataclass(frozen=True)
class FarField:
    """Shift of boundaries far from a unit dipole, ``shift(rho, depth)``, tabulated.

    Parameters
    ----------
    distances : ndarray, shape (nr,)
        Distances from the dipole [um].
    depths : ndarray, shape (nd,)
        Heights above the gates [um].
    shifts : ndarray, shape (nd, nr)
        Outward shift of a boundary, in arbitrary units.
    """

    distances: FloatArray
    depths: FloatArray
    shifts: FloatArray

    @classmethod
    def of(
        cls, unit: Potential, depths: FloatArray, ground: float, reach: float
    ) -> FarField:
        """Tabulate the far field for the mean drift field of a unit cell.

        Parameters
        ----------
        unit : Potential
            Solution of the uniform array without the charge; its laterally averaged field
            carries the electrons.
        depths : ndarray, shape (nd,)
            Conversion depths as heights above the gates [um].
        ground : float
            Height of the effective grounded plane [um]: the silicon surface.
        reach : float
            Largest distance in the table [um]; at least 40 um are tabulated.

        Returns
        -------
        far : FarField
            Shifts from 20 um to ``reach``; beyond both ends the last value is held.
        """
        mesh = unit.mesh
        weight_x = np.gradient(mesh.x)
        weight_y = np.gradient(mesh.y)
        mean = np.tensordot(unit.phi, np.outer(weight_y, weight_x), 2) / (
            weight_x.sum() * weight_y.sum()
        )
        top = mesh.z[-1]
        low = ground + 4.0  # above the front structure, where the mean field is the field
        z = np.linspace(low, top, _STEPS)
        field = -np.interp(
            z, 0.5 * (mesh.z[1:] + mesh.z[:-1]), np.diff(mean) / np.diff(mesh.z)
        )
        n = np.arange(1, _MODES + 1)
        kappa = n * np.pi / (top - ground)
        distances = np.geomspace(20.0, max(reach, 40.0), 200)
        sign = np.where(n % 2 == 1, 1.0, -1.0)
        modes = (kappa**2 * sign)[:, None] * np.sin(kappa[:, None] * (top - z[None, :]))
        bessel = k1(np.minimum(kappa[:, None] * distances[None, :], 600.0))
        slope = (modes.T @ bessel) / field[:, None]
        steps = 0.5 * (slope[1:] + slope[:-1]) * np.diff(z)[:, None]
        total = np.concatenate([np.zeros((1, len(distances))), np.cumsum(steps, axis=0)])
        shifts = np.array(
            [[np.interp(d, z, total[:, r]) for r in range(len(distances))] for d in depths]
        )
        return cls(distances, np.asarray(depths, float), shifts)

    def vectors(self, points: FloatArray, depth: int) -> FloatArray:
        """Interpolate the outward shifts at points around the dipole.

        Parameters
        ----------
        points : ndarray, shape (..., 2)
            Positions (x, y) relative to the dipole [um], not at 0.
        depth : int
            Index into ``depths``.

        Returns
        -------
        shifts : ndarray, shape (..., 2)
            Shifts (x, y) away from the dipole, in the arbitrary unit of ``shifts``.
        """
        rho = np.hypot(points[..., 0], points[..., 1])
        return points * (self._sizes(np.log(rho), depth) / rho)[..., None]

    def _sizes(self, log_rho: FloatArray, depth: int) -> FloatArray:
        """Interpolate the size of the shifts in logarithms of distance and size."""
        known = np.log(np.maximum(self.shifts[depth], 1e-300))
        return np.exp(np.interp(log_rho, np.log(self.distances), known))

    def of_images(
        self, points: FloatArray, depths: Sequence[int], period: tuple[float, float]
    ) -> FloatArray:
        """Sum the unit shifts from all images but the one at the origin.

        Parameters
        ----------
        points : ndarray, shape (n, 2)
            Positions relative to the dipole at the origin [um].
        depths : sequence of int
            Indices into ``depths``.
        period : tuple of float
            Distance of the images in x and y [um].

        Returns
        -------
        shifts : ndarray, shape (len(depths), n, 2)
            Shifts in the arbitrary unit of ``shifts``.
        """
        number = np.arange(-_IMAGES, _IMAGES + 1)
        places = np.stack(np.meshgrid(*(number * p for p in period)), -1).reshape(-1, 2)
        away = points[None] - places[np.any(places != 0, axis=1), None]
        rho = np.hypot(away[..., 0], away[..., 1])
        away /= rho[..., None]
        log_rho = np.log(rho)
        return np.array(
            [np.einsum("an,ani->ni", self._sizes(log_rho, d), away) for d in depths]
        )
