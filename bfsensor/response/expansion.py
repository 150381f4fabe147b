"""Second-order expansion of edge shifts in a device's parameters, and results of an emulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import FitError
from bfsensor.response.emulator_nodes import Solved
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class ExpandedResponse:
    """Response of a device at one condition, with derivatives; n is the largest lag.

    Attributes
    ----------
    kx, ky : ndarray, shape (2 n + 3, 2 n + 3)
        Mean shifts of right and upper edges [pixel/e-], [row, column], (0, 0) in the middle.
    areas : ndarray, shape (n + 1, n + 1)
        a_ij [1/e-], [j, i] from (0, 0): relative change of a pixel's area per electron.
    jacobian : ndarray, shape (p, n + 1, n + 1)
        Derivatives of ``areas`` with respect to the parameters [1/e- per internal unit]; 0 for
        parameters that the condition states.
    dkx, dky : ndarray, shape (p, 2 n + 3, 2 n + 3)
        Derivatives of ``kx`` and ``ky`` with respect to the parameters.
    """

    kx: FloatArray
    ky: FloatArray
    areas: FloatArray
    jacobian: FloatArray
    dkx: FloatArray
    dky: FloatArray


@dataclass(frozen=True, eq=False)
class EmulatorCheck:
    """An emulator against full solutions at random points of the prior volume.

    Attributes
    ----------
    values : ndarray, shape (points, p)
        Parameters [internal units].
    solved, emulated : ndarray, shape (points, n + 1, n + 1)
        a_ij [1/e-], [j, i].
    unsolved : int
        Number of further points that were drawn but have no solution, as where the silicon is not
        depleted.
    """

    values: FloatArray
    solved: FloatArray
    emulated: FloatArray
    unsolved: int

    @property
    def relative(self) -> FloatArray:
        """Errors relative to the solved a_ij, shape (points, n + 1, n + 1)."""
        return self.emulated / self.solved - 1.0

    def quantile(self, share: float) -> FloatArray:
        """Size of the relative error that a share (0 to 1) of the points does not exceed, by lag."""
        return np.asarray(np.quantile(np.abs(self.relative), share, axis=0))


@dataclass(frozen=True, eq=False)
class Expansion:
    """Expansion of the shifts at one operating point, in units of the parameters' spreads.

    Attributes
    ----------
    free : ndarray of int, shape (p,)
        Numbers of the parameters that the operating point does not state.
    value : ndarray, shape (2, nd, ny, nx)
        Shifts of right and upper edges at the nominal values [pixel/e-].
    first : ndarray, shape (p, 2, nd, ny, nx)
        First derivatives [pixel/e- per spread].
    second : ndarray, shape (p, p, 2, nd, ny, nx)
        Second derivatives [pixel/e- per spread^2].
    """

    free: NDArray[np.int64]
    value: FloatArray
    first: FloatArray
    second: FloatArray

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Shifts (2, nd, ny, nx) and derivatives (p, ...) at offsets of the free parameters."""
        bent = np.tensordot(t, self.second, (0, 0))
        slopes = self.first + bent
        return (
            self.value + np.tensordot(t, self.first, 1) + 0.5 * np.tensordot(t, bent, 1), slopes,
        )  # fmt: skip


def expand(
    solved: Mapping[tuple[int, int], Solved],
    free: NDArray[np.int64],
    names: Sequence[str],
    spreads: FloatArray,
) -> Expansion:
    """Make the expansion at one operating point from the device and its moved neighbours.

    Second derivatives come from the values and derivatives of the neighbours one spread to either
    side of each parameter, or to one side where the other has no solution.

    Raises
    ------
    FitError
        A parameter has no solution to either side.
    """

    def scaled(slopes: FloatArray) -> FloatArray:
        return slopes * spreads[:, None, None, None, None]

    value, slopes = solved[-1, 0]
    first = scaled(slopes)
    second = np.zeros((len(names), *first.shape))
    for n, name in enumerate(names):
        sides = [side for side in (1, -1) if (n, side) in solved]
        if not sides:
            raise FitError(
                f"{name}: no solution one spread to either side; give a smaller one"
            )
        bends, turns = [], []
        for side in sides:
            there, steeper = solved[n, side]
            bends.append(2 * (there - value - side * first[n]))
            turns.append(side * (scaled(steeper) - first))
        second[n] = np.mean(turns, axis=0)
        second[n, n] = _agreed(second[n, n], np.mean(bends, axis=0))
    return Expansion(free, value, first, _agreed(second, np.swapaxes(second, 0, 1)))


def _agreed(one: FloatArray, other: FloatArray) -> FloatArray:
    """Smaller one of two estimates of the same derivative, 0 where they differ in sign.

    Every second derivative is found twice, from the neighbours of either parameter, and on the
    diagonal from their values and from their derivatives.  A boundary point that was not
    differentiated well spoils only one of them, and usually makes it too large.
    """
    smaller = np.where(np.abs(one) < np.abs(other), one, other)
    return np.asarray(np.where(one * other > 0, smaller, 0.0))
