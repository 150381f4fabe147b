"""Second-order expansion of edge shifts in a device's parameters, and results of an emulator."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import FitError
from bfsensor.response.edge_response import area_matrix
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


def steepest(
    value: FloatArray, slopes: FloatArray, spreads: FloatArray, count: int
) -> NDArray[np.int64]:
    """Find the parameters that change a_ij most within their spreads.

    Parameters
    ----------
    value, slopes : ndarray, shapes (2, nd, ny, nx) and (p, 2, nd, ny, nx)
        Shifts and their derivatives [pixel/e-, and per internal unit].
    spreads : ndarray, shape (p,)
        Standard deviations of the parameters [internal units].
    count : int
        Number of parameters that are wanted.

    Returns
    -------
    numbers : ndarray of int, shape (count,) or (p,)
        By falling root mean square of the relative changes of the a_ij up to two pixels away, of
        light that converts at the back surface.
    """
    middle = value.shape[-1] // 2
    near = slice(middle, middle + 3)

    def areas(k: FloatArray) -> FloatArray:
        return area_matrix(k[..., 0, -1, :, :], k[..., 1, -1, :, :])[..., near, near]

    changes = areas(slopes) * spreads[:, None, None] / areas(value)
    return np.argsort(-np.sum(changes**2, axis=(1, 2)), kind="stable")[:count]


def expand(
    solved: Mapping[tuple[int, int], Solved],
    free: NDArray[np.int64],
    names: Sequence[str],
    spreads: FloatArray,
) -> Expansion:
    """Make the expansion at one operating point from the device and its moved neighbours.

    Second derivatives by one parameter come from the values of its neighbours one spread to either
    side, or to one side where the other has no solution; those by two from derivatives at a
    neighbour of either.  Between parameters whose neighbours were not differentiated they are 0.

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
    turned = np.zeros(len(names), bool)
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
            if len(steeper):
                turns.append(side * (scaled(steeper) - first))
        bend = np.mean(bends, axis=0)
        if turns:
            turned[n] = True
            second[n] = np.mean(turns, axis=0)
            bend = _agreed(second[n, n], bend)
        second[n, n] = bend
    for n, m in itertools.combinations(range(len(names)), 2):
        both = second[n, m], second[m, n]
        second[n, m] = _agreed(*both) if turned[n] and turned[m] else both[0] + both[1]
        second[m, n] = second[n, m]
    return Expansion(free, value, first, second)


def _agreed(one: FloatArray, other: FloatArray) -> FloatArray:
    """Smaller one of two estimates of the same derivative, 0 where they differ in sign.

    Second derivatives are found twice, from differentiated neighbours of either parameter, and on
    the diagonal from their values and from their derivatives.  A boundary point that was not
    differentiated well spoils only one of them, and usually makes it too large.
    """
    smaller = np.where(np.abs(one) < np.abs(other), one, other)
    return np.asarray(np.where(one * other > 0, smaller, 0.0))
