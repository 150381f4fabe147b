"""The chi-square near a fit as a function of one effect's parameters, all others refitted.

The effect's parameters are not linearised; all other parameters follow to first order: their
columns are projected out of the residuals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.fit.gauss_newton import Steps
from bfsensor.diagnose.model.effect_parameters import fitted, reach_of, widened
from bfsensor.effects.effect import Parameter
from bfsensor.errors import ConvergenceError
from bfsensor.inference.bounded_lsq import solve_within, span
from bfsensor.typing import FloatArray

BENT = 0.5
"""Relative deviation of the rise of the chi-square at the ends of linear intervals from a
parabola's, above which the likelihood profile is computed.  An end is then off by 1 - 1.5^(-1/2) =
18 % of its distance, or 0.5^(-1/2) - 1 = 41 % where it rises less.  Chosen, to be derived: with 1.0
every chi-square that rises to at most twice the parabola's, or not at all, would pass for one."""

TURNS = 4
"""Largest number of Gauss-Newton rounds of the effect's other parameters while one is held.
Chosen: with fewer than needed the profile lies above the true one and intervals are too narrow; 8
cost up to twice the predictions where it does not converge."""

DONE = 0.02
"""Decrease of the chi-square that the linear model still promises when such a fit ends.  Chosen:
it moves an end at a rise of 1 by 0.02 / 2 = 1 % of the error; twice as large, by 2 %."""


class Held(NamedTuple):
    """Smallest chi-square with one parameter held, the effect's parameters and derivatives there."""

    square: float
    values: FloatArray
    slopes: FloatArray


class Valley:
    """The chi-square near a fit as a function of one effect's parameters.

    Parameters
    ----------
    parameters : sequence of Parameter
        Fitted parameters of the effect.
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
        parameters: Sequence[Parameter],
        best: FloatArray,
        left: Callable[[FloatArray], FloatArray],
        slopes: FloatArray,
        steps: FloatArray,
    ) -> None:
        self.parameters, self.best, self.left = tuple(parameters), best, left
        self.slopes, self.steps = slopes, steps
        here = left(best)
        self.square = float(here @ here)
        self.covariance = np.linalg.pinv(slopes.T @ slopes, rcond=1e-12)
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
        low, high = np.array([widened(p) for p in self.parameters]).T
        return np.clip(values, low, high)

    def is_parabola(self, k: int, error: float) -> bool:
        """Whether the chi-square rises by 1 and 1.96^2 at the ends of the linear intervals.

        It may differ by half of that; False where an end is outside the range of fits.
        """
        if not (np.isfinite(error) and error > 0):
            return False
        p, best = self.parameters[k], float(self.best[k])
        low, high = widened(p)
        for width in (1.0, 1.96):
            for end in linear_interval(best, width * error, p):
                if not low <= end <= high:
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
        """Fit the effect's other parameters with the k-th held, from a point nearby.

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
            ends = [reach_of(self.parameters[n], float(values[n])) for n in own]
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


def valley_of(model: Model, n: int) -> Valley:
    """Make the chi-square near a fit a function of the parameters of one of its effects.

    The effect is predicted again at each value; all other fitted parameters follow to first
    order, as they are nearly linear over a few errors.  Random effects of other effects keep the
    variances of the fit.

    Parameters
    ----------
    model : Model
        Fitted, with effects.
    n : int
        Index of the effect in ``model.effects``.

    Returns
    -------
    near : object
        The chi-square as a function of ``model.effects[n]``'s fitted parameters.
    """
    predictor, fit, effect = model.predictor, model.fit, model.effects[n]
    point = fit.values[: len(predictor.names)].copy()
    rows = np.flatnonzero([m.startswith(f"effect {n} ") for m in predictor.names])
    around = Steps(predictor, fit.channels)
    around.point, around.slopes = point, fit.slopes
    around.update_chance()
    design, target = around.problem(around.residuals(point)[1], point)
    used = (design**2).sum(0) > 0
    used[rows] = False
    # A parameter of another effect at the end of its range cannot follow.
    low, high = predictor.limits()
    used[: len(point)] &= (low < point) & (point < high)
    others = span(design[:, used])

    def free(columns: FloatArray) -> FloatArray:
        return np.asarray(columns - others @ (others.T @ columns))

    channels = [
        (c, int(start), predictor.predict(c, point))
        for c, start in zip(fit.channels, around.starts, strict=False)
        if c.word in effect.touches
    ]
    before = free(target)

    def left(values: FloatArray) -> FloatArray:
        there = point.copy()
        there[rows] = values
        change = np.zeros(len(before))
        for channel, start, here in channels:
            with np.errstate(over="ignore", invalid="ignore"):
                moved = predictor.predict(channel, there) - here
            if not np.isfinite(moved).all():
                raise ConvergenceError(f"predictions of {channel.word} overflow")
            change[start : start + len(channel)] = channel.whiten(moved)
        return before - free(change)

    return Valley(
        fitted(effect), point[rows], left, free(design[:, rows]), predictor.steps[rows]
    )


def linear_interval(value: float, width: float, p: Parameter) -> tuple[float, float]:
    """Ends of the interval ``value`` +- ``width``, or of the log-normal one.

    For a positive parameter on a logarithmic scale with a relative error above 15 % the logarithm
    is taken for Gaussian: a symmetric interval would come near, or cross, its neutral value.

    Parameters
    ----------
    value : float
        Best value, in the parameter's unit.
    width : float
        Standard error, or a multiple of it, in the same unit.
    p : Parameter
        Its law, sign and neutral value decide the scale.

    Returns
    -------
    low, high : float

    Examples
    --------
    >>> p = Parameter("sigma", "um", 0.1, 10.0)
    >>> linear_interval(2.0, 0.2, p)
    (1.8, 2.2)
    >>> [round(v, 3) for v in linear_interval(2.0, 2.0, p)]
    [0.736, 5.437]
    """
    away = value - p.neutral if p.law == "log" else value
    if p.law == "log" and not p.signed and away > 0 and width > 0.15 * away:
        factor = float(np.exp(min(width / away, 50.0)))
        return p.neutral + away / factor, p.neutral + away * factor
    return value - width, value + width
