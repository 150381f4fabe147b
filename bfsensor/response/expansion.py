"""What an emulator gives, and the expansion in the parameters that it is made of."""

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
    """Response of a flat at one condition.

    Attributes
    ----------
    kx, ky : ndarray, shape (2 n + 3, 2 n + 3)
        Mean shifts of right and upper edges [pixel/e-], [row, column], (0, 0) in the middle.
    areas : ndarray, shape (n + 1, n + 1)
        a_ij [1/e-], [j, i] from (0, 0): the change of a pixel's area, relative, per electron.
    jacobian : ndarray, shape (p, n + 1, n + 1)
        Derivatives of the areas by the parameters [1/e- a unit]; 0 by what the condition states.
    dkx, dky : ndarray, shape (p, 2 n + 3, 2 n + 3)
        Derivatives of the shifts.
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
        Points drawn besides at which the device has no solution, such as silicon that is not
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
        """Size of the relative error below which a share of the points lies, by lag."""
        return np.asarray(np.quantile(np.abs(self.relative), share, axis=0))


@dataclass(frozen=True, eq=False)
class Expansion:
    """Shifts about one operating point: value, first and second derivatives in spreads.

    ``free`` are the numbers of the parameters that the operating point leaves free.
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
    """Second derivatives from solutions to either side, or to one, and their derivatives."""

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
    """Of two estimates of one thing the smaller, 0 where they differ in sign.

    Every second derivative is found twice, from the neighbours of either parameter, and on the
    diagonal from their values and from their derivatives.  A point of a boundary that was not
    differentiated well spoils one of them only.
    """
    smaller = np.where(np.abs(one) < np.abs(other), one, other)
    return np.asarray(np.where(one * other > 0, smaller, 0.0))
