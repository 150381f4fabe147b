r"""Shifts of the potential about the electrons of one pixel, which a multigrid cycle hardly sees.

Where a pixel keeps its number of electrons, its potential may rise or fall as a whole at the cost of the
field outside only; with a fixed quasi-Fermi level, as the multigrid cycle has it, the electrons would
hold it with :math:`n / kT`.  One such shift for each pixel that holds electrons is the coarse space of a
two-level preconditioner (Toselli & Widlund 2005, Domain Decomposition Methods, section 2.5):
:math:`M^{-1} + W (W^T J W)^{-1} W^T` with the matrix J of the system.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from bfsensor._kernels import pixel_shifts as kernels
from bfsensor._kernels import relaxation
from bfsensor.simulate.discretise import Coefficients
from bfsensor.simulate.multigrid import Multigrid
from bfsensor.simulate.pixel_nodes import PixelNodes
from bfsensor.typing import FloatArray

FLAT = 0.35
"""Distance from a pixel's centre up to which a shift is whole, in pixels; at 1 - FLAT it is gone.

Chosen: electrons are stored within .3 pixel of the centre (ITL, E2V). Measured on E2V with 44,000 e- in
every pixel: 3 iterations to 3 %, 11 without shifts; where they begin to fall at .35 and end in the next
pixel's centre instead of at its electrons, 6 to 7."""

FALL = 0.2
"""Height in which a shift falls to 1/e above the electrons, in pixels.

Measured on the same system: at 2.5 times the value the same number of iterations."""

PLANES = 4.0
"""Height above the electrons at which a shift is cut off, in units of :data:`FALL` pixels.

Derived: it is 2 % of its value there, at half the height 14 %, a step that costs field energy; at twice
the height the sums over its planes take twice as long."""


class PixelShifts:
    """The coarse space of one linear system.

    Parameters
    ----------
    coefficients : Coefficients
        Discretised device.
    pixels : PixelNodes
        Pixels of the nodes.
    multigrid : Multigrid
        Cycles with the carriers of the system.
    electrons, stiffness : ndarray, shape (ny + 2, n_front, nx + 2)
        Electrons of each node [e-], and the derivative of all carriers [e-/V].
    kt : float
        Thermal voltage [V].
    conserved : ndarray, shape (pixels,)
        Electrons of pixels that keep their number [e-], 0 in others; some must.

    Raises
    ------
    numpy.linalg.LinAlgError
        Its energies are not positive: by rounding, where pixels hold next to nothing.
    """

    def __init__(
        self,
        coefficients: Coefficients,
        pixels: PixelNodes,
        multigrid: Multigrid,
        electrons: FloatArray,
        stiffness: FloatArray,
        kt: float,
        conserved: FloatArray,
    ) -> None:
        mesh, (nz, ny, nx) = coefficients.mesh, coefficients.mesh.shape
        self._filled = np.flatnonzero(conserved > 0)
        self._x = _windows(
            mesh.x, mesh.pitch[0], pixels.x, len(pixels.share_x), mesh.side_x
        )
        self._y = _windows(
            mesh.y, mesh.pitch[1], pixels.y, len(pixels.share_y), mesh.side_y
        )
        charge = np.zeros((ny + 2, nz, nx + 2))
        front = electrons.shape[1]
        charge[:, :front] = electrons
        response = multigrid.cycle(charge)
        by_plane = electrons.sum(axis=(0, 2))
        height = float(mesh.z[:front] @ by_plane / by_plane.sum())
        fall = FALL * min(mesh.pitch)
        planes = int(np.searchsorted(mesh.z, height + PLANES * fall))
        drop = np.exp(-np.maximum(mesh.z[:planes] - height, 0) / fall)
        self._profile: FloatArray = np.array(
            response[:, :planes] * drop[:, None], np.float64
        )
        relaxation.fill_halo(
            self._profile, mesh.side_x == "periodic", mesh.side_y == "periodic"
        )
        energies = self._energies(coefficients, pixels, electrons, stiffness, kt, conserved)
        # Pixels may hold a thousandth or a hundred thousand electrons: each shift in its own size.
        if not np.all(np.diag(energies) > 0):
            raise np.linalg.LinAlgError("a pixel's shift has no energy")
        self._scale = 1.0 / np.sqrt(np.diag(energies))
        self._factor = cho_factor(energies * self._scale[:, None] * self._scale)
        self._columns = np.zeros(response[:, 0].shape)

    def _energies(
        self,
        c: Coefficients,
        pixels: PixelNodes,
        electrons: FloatArray,
        stiffness: FloatArray,
        kt: float,
        conserved: FloatArray,
    ) -> FloatArray:
        """Matrix of the system between the shifts of two pixels."""
        profile = self._profile
        out = np.zeros((7, *profile[:, 0].shape))
        kernels.link_energies(
            profile, stiffness, c.cx, c.cy, c.cz, c.cd, c.kind, c.north, c.dy, out
        )
        x, y = self._x, self._y
        x_next, y_next = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)

        def pairs(
            ya: FloatArray, yb: FloatArray, xa: FloatArray, xb: FloatArray, n: int
        ) -> FloatArray:
            return np.einsum("aj,bj,ji,ci,di->acbd", ya, yb, out[n], xa, xb, optimize=True)

        total = pairs(y, y, x, x, 0)
        total += pairs(y, y, x, x, 1) + pairs(y, y, x_next, x_next, 3)
        total -= pairs(y, y, x, x_next, 2) + pairs(y, y, x_next, x, 2)
        total += pairs(y, y, x, x, 4) + pairs(y_next, y_next, x, x, 6)
        total -= pairs(y, y_next, x, x, 5) + pairs(y_next, y, x, x, 5)
        count = len(y) * len(x)
        energies = total.reshape(count, count)[np.ix_(self._filled, self._filled)]
        # What moves together costs nothing: the mean over each pixel's electrons comes off.
        held = np.zeros(profile[:, 0].shape)
        kernels.column_products(profile, electrons, held)
        own_x = (pixels.x[None] == np.arange(len(x))[:, None]).astype(float)
        own_y = (pixels.y[None] == np.arange(len(y))[:, None]).astype(float)
        means = np.einsum("aj,bj,ji,ci,di->acbd", own_y, y, held, own_x, x, optimize=True)
        means = means.reshape(count, count)[np.ix_(self._filled, self._filled)]
        scaled = means / (conserved[self._filled, None] * kt)
        return energies - means.T @ scaled

    def add(self, residual: FloatArray, out: NDArray[np.float32]) -> None:
        """Add the correction by shifts for a residual [e-] to a preconditioned one [V], in place."""
        kernels.column_products(self._profile, residual, self._columns)
        held = (self._y @ self._columns @ self._x.T).ravel()
        shifts = np.zeros(held.size)
        shifts[self._filled] = self._scale * cho_solve(
            self._factor, self._scale * held[self._filled]
        )
        factors = self._y.T @ shifts.reshape(len(self._y), len(self._x)) @ self._x
        kernels.add_columns(self._profile, factors, out)


def _windows(
    nodes: FloatArray, pitch: float, pixel: NDArray[np.int64], count: int, side: str
) -> FloatArray:
    """Weight of each pixel's shift at every node, shape (pixels, nodes with halo)."""
    inside = np.flatnonzero(pixel >= 0)
    first = inside[0]
    origin = int(np.floor(nodes[first - 1] / pitch + 0.5)) - pixel[first]
    at = nodes / pitch - origin
    lower = np.floor(at).astype(int)
    upper_part = np.clip((at - lower - FLAT) / (1 - 2 * FLAT), 0, 1)
    out = np.zeros((count, len(nodes) + 2))
    for part, number in ((1 - upper_part, lower), (upper_part, lower + 1)):
        # Beyond a mirror plane lies the image of the last pixel.
        own = number % count if side == "periodic" else np.clip(number, 0, count - 1)
        np.add.at(out, (own, np.arange(len(nodes)) + 1), part)
    if side == "periodic":
        out[:, 0], out[:, -1] = out[:, -2], out[:, 1]
    return out
