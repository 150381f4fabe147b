"""The chi-square near a fit as a function of some parameters, all others refitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import ConvergenceError
from bfsensor.inference.bounded_lsq import solve_within, span
from bfsensor.typing import FloatArray

BENT = 0.5
"""Relative deviation of the rise of the chi-square at the ends of linear intervals from a
parabola's, above which the likelihood profile is computed.  An end is then off by 1 - 1.5^(-1/2) =
18 % of its distance, or 0.5^(-1/2) - 1 = 41 % where it rises less.  Chosen, to be derived: with 1.0
every chi-square that rises to at most twice the parabola's, or not at all, would pass for one."""

TURNS = 4
"""Largest number of Gauss-Newton rounds of the other parameters while one is held.
Chosen: with fewer than needed the profile lies above the true one and intervals are too narrow; 8
cost up to twice the predictions where it does not converge."""

DONE = 0.02
"""Decrease of the chi-square that the linear model still promises when such a fit ends.  Chosen:
it moves an end at a rise of 1 by 0.02 / 2 = 1 % of the error; twice as large, by 2 %."""


class Ranged(NamedTuple):
    """Range, scale and largest steps of a parameter in a fit.

    Parameters
    ----------
    name : str
        Name of the parameter.
    low, high : float
        Range of fits.
    logarithmic : bool
        Whether it varies on the logarithm of its distance above ``neutral``.
    neutral : float
        Value at which it has no effect.
    least : float
        Least plausible distance from ``neutral``.
    width : float
        Width of its plausible range.
    step : callable
        Gives the smallest and the largest step of a fit from a value.
    """

    name: str
    low: float
    high: float
    logarithmic: bool
    neutral: float
    least: float
    width: float
    step: Callable[[float], tuple[float, float]]

    def interval(self, value: float, width: float) -> tuple[float, float]:
        """Ends of the interval ``value`` +- ``width``, or of the log-normal one.

        For a parameter on a logarithmic scale with a relative error above 15 % the logarithm is
        taken for Gaussian: a symmetric interval would come near, or cross, its neutral value.
        """
        away = value - self.neutral if self.logarithmic else value
        if self.logarithmic and away > 0 and width > 0.15 * away:
            factor = float(np.exp(min(width / away, 50.0)))
            return self.neutral + away / factor, self.neutral + away * factor
        return value - width, value + width


class Held(NamedTuple):
    """Smallest chi-square with one parameter held, the parameters and derivatives there."""

    square: float
    values: FloatArray
    slopes: FloatArray


class LocalLikelihood:
    """The chi-square near a fit as a function of some of its parameters, all others refitted.

    Parameters
    ----------
    parameters : sequence of Ranged
        Names, ranges and scales of these parameters.
    best : ndarray, shape (p,)
        Their values in the fit.
    left : callable
        Gives the whitened residuals, shape (n,), at values of shape (p,), all other parameters
        projected out; it may raise :class:`ConvergenceError`.
    slopes : ndarray, shape (n, p)
        Derivatives of the whitened prediction at ``best``, projected likewise.
    steps : ndarray, shape (p,)
        Steps of finite differences.

    Attributes
    ----------
    square : float
        Chi-square at ``best``.
    covariance : ndarray, shape (p, p)
        Linear covariance of the parameters at ``best``.
    errors : ndarray, shape (p,)
        Linear standard errors.
    lowest : Held
        The point of the smallest chi-square of all that were evaluated by :meth:`hold`, or
        ``best``.  A point lower than ``best`` means that the fit ended early.
    """

    def __init__(
        self,
        parameters: Sequence[Ranged],
        best: FloatArray,
        left: Callable[[FloatArray], FloatArray],
        slopes: FloatArray,
        steps: FloatArray,
    ) -> None:
        self.parameters, self.best, self.left = tuple(parameters), best, left
        self.slopes, self.steps = slopes, steps
        here = left(best)
        self.square = float(here @ here)
        everywhere = np.full(len(best), np.inf)
        self.covariance = solve_within(slopes, here, -everywhere, everywhere).covariance
        self.errors = np.sqrt(np.diag(self.covariance))
        self._unit = np.where(self.errors > 0, self.errors, steps)
        self.lowest = Held(self.square, best, slopes)

    def along(self, k: int, value: float) -> FloatArray:
        """All parameters with the k-th at a value, the others moved along their covariance with it."""
        variance = self.covariance[k, k]
        rate = self.covariance[:, k] / variance if variance > 0 else 0.0
        values = self.best + rate * (value - self.best[k])
        values[k] = value
        return self.inside(values)

    def inside(self, values: FloatArray) -> FloatArray:
        """Values clipped to the ranges of fits."""
        low, high = np.array([(p.low, p.high) for p in self.parameters]).T
        return np.clip(values, low, high)

    def is_parabola(self, k: int, error: float) -> bool:
        """Whether the chi-square rises by 1 and 1.96^2 at the ends of the linear intervals.

        It may differ by half of that; False where an end is outside the range of fits.
        """
        if not (np.isfinite(error) and error > 0):
            return False
        p, best = self.parameters[k], float(self.best[k])
        for width in (1.0, 1.96):
            for end in p.interval(best, width * error):
                if not p.low <= end <= p.high:
                    return False
                if abs(self._rise(k, end) / width**2 - 1) > BENT:
                    return False
        return True

    def _rise(self, k: int, value: float) -> float:
        """Rise of the chi-square at a value of one parameter, the others moved linearly.

        Infinite where nothing can be predicted.
        """
        own = np.arange(len(self.best)) != k
        try:
            left = self.left(self.along(k, value))
        except ConvergenceError:
            return np.inf
        if own.any():
            left = left - (q := span(self.slopes[:, own])) @ (q.T @ left)
        return float(left @ left) - self.square

    def hold(self, k: int, value: float, near: Held) -> Held:
        """Fit the other parameters with the k-th held, from a point nearby.

        Derivatives are those of that point, updated after each step (Broyden's rank-one update),
        and computed by finite differences once a step raises the chi-square.

        Parameters
        ----------
        k : int
            Parameter that is held.
        value : float
            Its value, in its unit.
        near : Held
            Point from which the others begin.

        Returns
        -------
        held : Held
            Point of the smallest chi-square found in :data:`TURNS` rounds.

        Raises
        ------
        ConvergenceError
            Nothing can be predicted at the first point.

        References
        ----------
        Broyden 1965, Math. Comp. 19, 577.
        """
        own = np.flatnonzero(np.arange(len(self.best)) != k)
        values = near.values.copy()
        values[k] = value
        left = self.left(values)
        if not len(own):
            return self._kept(Held(float(left @ left), values, near.slopes))
        slopes, fresh = near.slopes.copy(), False
        for _ in range(TURNS):
            ends = [self.parameters[n].step(float(values[n])) for n in own]
            solved = solve_within(slopes[:, own], left, *np.array(ends).T)
            square, step = float(left @ left), solved.solution
            if square - float(solved.left @ solved.left) < DONE:
                break
            moved = self._tried(values, own, step)
            if moved is not None and float(moved @ moved) < square:
                # Broyden: the residuals that this step left correct the slopes along it, in units
                # of errors, so that the update does not depend on the parameters' units.
                wrong = (left - moved) - slopes[:, own] @ step
                unit = step / self._unit[own] ** 2
                slopes[:, own] += np.outer(wrong, unit) / float(step @ unit)
                values[own] += step
                left, fresh = moved, False
                continue
            if fresh:
                break
            slopes[:, own], fresh = self._slopes_at(values, left, own), True
        return self._kept(Held(float(left @ left), values, slopes))

    def _kept(self, held: Held) -> Held:
        self.lowest = min(self.lowest, held, key=lambda h: h.square)
        return held

    def _tried(
        self, values: FloatArray, own: NDArray[np.int64], step: FloatArray
    ) -> FloatArray | None:
        there = values.copy()
        there[own] += step
        try:
            return self.left(there)
        except ConvergenceError:
            return None

    def _slopes_at(
        self, values: FloatArray, left: FloatArray, own: NDArray[np.int64]
    ) -> FloatArray:
        """Derivatives of the prediction by some parameters, shape (n, len(own))."""
        out = np.zeros((len(left), len(own)))
        for column, n in enumerate(own):
            moved = values.copy()
            moved[n] += self.steps[n]
            try:
                out[:, column] = (left - self.left(moved)) / self.steps[n]
            except ConvergenceError:
                out[:, column] = self.slopes[:, n]
        return out
