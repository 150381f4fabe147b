"""The chi-square about a fit as a function of one effect's parameters."""

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
"""Part by which the rise of the chi-square at the ends of an interval may differ from that of a
parabola: an end is then off by a fifth of its distance, or two fifths where it rises less."""

TURNS = 4
"""Of fits of the other parameters at a value that is held."""

DONE = 0.02
"""Gain of the chi-square that such a fit still expects when it ends: 1 % of an error."""


class Held(NamedTuple):
    """Chi-square with all that may move at its best, and the effect's parameters there."""

    square: float
    values: FloatArray
    slopes: FloatArray


class Valley:
    """The chi-square about a fit as a function of one effect's parameters.

    Parameters
    ----------
    parameters : sequence of Parameter
        That were fitted.
    best : ndarray, shape (p,)
        Where the fit put them.
    left : callable
        What is left with them as given, everything else at its best; it may raise
        :class:`ConvergenceError`.
    slopes : ndarray, shape (n, p)
        Derivatives of the prediction at the best, what everything else takes of them taken off.
    steps : ndarray, shape (p,)
        Of derivatives.

    Attributes
    ----------
    lowest : Held
        Of all points that were come to; the best, where the fit found it.
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
        """All parameters with one at a value, the others moved linearly with it."""
        variance = self.covariance[k, k]
        rate = self.covariance[:, k] / variance if variance > 0 else 0.0
        values = self.best + rate * (value - self.best[k])
        values[k] = value
        return self.inside(values)

    def inside(self, values: FloatArray) -> FloatArray:
        """Values no farther than their ranges."""
        low, high = np.array([widened(p) for p in self.parameters]).T
        return np.clip(values, low, high)

    def is_parabola(self, k: int, error: float) -> bool:
        """Whether the chi-square at the ends of linear intervals has risen as they say."""
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
        """Rise of the chi-square at a value of one parameter, the others moved linearly."""
        own = np.arange(len(self.best)) != k
        try:
            left = self.left(self.along(k, value))
        except ConvergenceError:
            return np.inf
        if own.any():
            left = left - (q := span(self.slopes[:, own])) @ (q.T @ left)
        return float(left @ left) - self.square

    def hold(self, k: int, value: float, near: Held) -> Held:
        """Fit the effect's other parameters with one held, from a point nearby.

        Derivatives are those of that point, mended by each step (Broyden), found anew where a
        step does harm.

        Raises
        ------
        ConvergenceError
            Nothing can be predicted there.
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
                # What the step did mends the slopes along it.
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
        """Derivatives of the prediction by some parameters."""
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
    """Give the valley about a fit, of one of its effects.

    The effect is predicted anew at each value; everything else that was fitted follows to
    first order, for that is nearly linear over a few errors.  What other effects leave to chance
    stays as strong as in the fit.

    Parameters
    ----------
    model : Model
        With effects.
    n : int
        Which of them.
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
    # Of another effect at the end of its range nothing moves.
    low, high = predictor.reach(point)
    used[: len(point)] &= (low < 0) & (high > 0)
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
    """Ends of an interval by a standard error, or a multiple of it.

    Of positive parameters that are badly known the logarithm is taken for Gaussian.
    """
    away = value - p.neutral if p.law == "log" else value
    if p.law == "log" and not p.signed and away > 0 and width > 0.15 * away:
        factor = float(np.exp(min(width / away, 50.0)))
        return p.neutral + away / factor, p.neutral + away * factor
    return value - width, value + width
