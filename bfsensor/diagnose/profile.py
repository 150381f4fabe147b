"""Intervals of effects' parameters by the chi-square itself, where it is no parabola."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from bfsensor.diagnose.bounded import solve_within, span
from bfsensor.diagnose.fitted_effects import fitted, reach_of, widened
from bfsensor.diagnose.model import Model
from bfsensor.diagnose.steps import Steps
from bfsensor.effects.effect import Effect, Parameter
from bfsensor.errors import ConvergenceError

Values = NDArray[np.float64]

BENT = 0.5
"""Part by which the rise of the chi-square at the ends of an interval may differ from that of a
parabola: an end is then off by a fifth of its distance, or two fifths where it rises less."""

TURNS = 4
"""Of fits of the other parameters at a value that is held."""

DONE = 0.02
"""Gain of the chi-square that such a fit still expects when it ends: 1 % of an error."""

POINTS = 7
"""Values of a parameter that are held, at most, on one side."""

LONGEST = 3.0
"""Stretch of a step over the last one."""

NARROW = 0.8
"""Difference of the roots on both sides of where a width is crossed that needs no value between."""

SEEN = 0.05
"""Rise of the chi-square's root along a step below which nothing tells how far to go next."""


@dataclass(frozen=True)
class Profile:
    """How the chi-square rises with one parameter, all others at their best.

    Attributes
    ----------
    values : ndarray, shape (n,)
        Of the parameter, rising; the best is among them.
    rises : ndarray, shape (n,)
        Of the chi-square above its lowest.
    logarithmic : bool
        Whether the root of the rise is straighter in the logarithm of the parameter's distance
        from ``neutral``.
    neutral : float
        Of the parameter.
    """

    values: Values
    rises: Values
    logarithmic: bool = False
    neutral: float = 0.0

    def interval(self, width: float) -> tuple[float, float, bool, bool]:
        """Ends where the chi-square has risen by the square of ``width``, and whether it does.

        An end at which it has not is the last value that there is.

        Examples
        --------
        >>> x = np.linspace(-1.0, 5.0, 13)
        >>> low, high, closed, open_ = Profile(x, (x - 1) ** 2).interval(3.0)
        >>> low, closed, round(high, 3), open_
        (-1.0, False, 4.0, True)
        """
        best = int(np.argmin(self.rises))
        roots = np.sqrt(np.maximum(self.rises, 0.0))
        place = np.log(self.values - self.neutral) if self.logarithmic else self.values
        low, low_closed = _crossing(place[best::-1], roots[best::-1], width)
        high, high_closed = _crossing(place[best:], roots[best:], width)
        if self.logarithmic:
            low, high = (self.neutral + float(np.exp(v)) for v in (low, high))
        # Back from the logarithm an end of the range is not the same to the last bit.
        low = low if low_closed else float(self.values[0])
        high = high if high_closed else float(self.values[-1])
        return low, high, low_closed, high_closed


def _crossing(place: Values, roots: Values, width: float) -> tuple[float, bool]:
    """Place, going out from the first, at which a root first comes to a width."""
    beyond = np.nonzero(roots >= width)[0]
    if not len(beyond) or len(place) < 2:
        return float(place[-1]), False
    last = int(beyond[0])
    # Two more points give the curve its slope there.
    own = slice(0, min(last + 2, len(place)))
    order = np.argsort(place[own])
    curve = PchipInterpolator(place[own][order], roots[own][order] - width)
    inner, outer = sorted((place[last - 1], place[last]))
    found = [r for r in curve.roots(extrapolate=False) if inner <= r <= outer]
    return float(found[0] if found else place[last]), True


class Held(NamedTuple):
    """Chi-square with all that may move at its best, and the effect's parameters there."""

    square: float
    values: Values
    slopes: Values


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
    """

    def __init__(
        self,
        parameters: Sequence[Parameter],
        best: Values,
        left: Callable[[Values], Values],
        slopes: Values,
        steps: Values,
    ) -> None:
        self.parameters, self.best, self.left = tuple(parameters), best, left
        self.slopes, self.steps = slopes, steps
        here = left(best)
        self.square = float(here @ here)
        self.covariance = np.linalg.pinv(slopes.T @ slopes, rcond=1e-12)
        self.errors = np.sqrt(np.diag(self.covariance))
        self._unit = np.where(self.errors > 0, self.errors, steps)

    def along(self, k: int, value: float) -> Values:
        """All parameters with one at a value, the others moved linearly with it."""
        variance = self.covariance[k, k]
        rate = self.covariance[:, k] / variance if variance > 0 else 0.0
        values = self.best + rate * (value - self.best[k])
        values[k] = value
        return self.inside(values)

    def inside(self, values: Values) -> Values:
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
            return Held(float(left @ left), values, near.slopes)
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
        return Held(float(left @ left), values, slopes)

    def _tried(self, values: Values, own: NDArray[np.int64], step: Values) -> Values | None:
        there = values.copy()
        there[own] += step
        try:
            return self.left(there)
        except ConvergenceError:
            return None

    def _slopes_at(self, values: Values, left: Values, own: NDArray[np.int64]) -> Values:
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

    def free(columns: Values) -> Values:
        return np.asarray(columns - others @ (others.T @ columns))

    channels = [
        (c, int(start), predictor.predict(c, point))
        for c, start in zip(fit.channels, around.starts, strict=False)
        if c.word in effect.touches
    ]
    before = free(target)

    def left(values: Values) -> Values:
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


class Scale(NamedTuple):
    """On what scale a parameter goes: its own, or the logarithm of its distance from neutral."""

    logarithmic: bool
    neutral: float
    least: float

    @classmethod
    def of(cls, p: Parameter, value: float) -> Scale:
        """Of a parameter whose best value is given."""
        away = value - p.neutral
        logarithmic = p.law == "log" and not p.signed and away > 0
        return cls(logarithmic, p.neutral if logarithmic else 0.0, 1e-3 * min(p.low, away))

    def place(self, value: float) -> float:
        """Of a value; what is nearest to neutral is one."""
        if not self.logarithmic:
            return value
        return float(np.log(max(value - self.neutral, self.least)))

    def value(self, place: float) -> float:
        """Of a place."""
        return self.neutral + float(np.exp(place)) if self.logarithmic else place

    def first(self, value: float, told: float, p: Parameter) -> float:
        """First step, to the end that a linear error tells; of none, a part of the range."""
        step = abs(self.place(told) - self.place(value))
        if np.isfinite(step) and step > 0:
            return min(step, 1.0) if self.logarithmic else step
        return 0.2 if self.logarithmic else 0.05 * (p.high - p.low)


class _Side:
    """Goes out from the best value on one side until the chi-square has risen enough."""

    def __init__(self, valley: Valley, k: int, scale: Scale, end: float) -> None:
        self._valley, self._k, self._scale = valley, k, scale
        self._end = scale.place(end)
        best = scale.place(float(valley.best[k]))
        self.places, self.held = [best], [Held(valley.square, valley.best, valley.slopes)]

    def go(self, first: float, widths: Sequence[float]) -> None:
        """Hold the parameter at values ever farther out, then near where widths are crossed."""
        step = first
        while len(self.places) < POINTS:
            roots = self._roots()
            wanted = next((w for w in widths if w > roots[-1]), None)
            if wanted is None:
                break
            if len(roots) > 1:
                last = self.places[-1] - self.places[-2]
                rate = (roots[-1] - roots[-2]) / abs(last)
                if roots[-1] - roots[-2] > SEEN:
                    # A little beyond: what is crossed is told best from both sides.
                    step = (1.05 * wanted - roots[-1]) / rate
                    step = float(np.clip(step, 0.3 * abs(last), LONGEST * abs(last)))
                else:
                    step = LONGEST * abs(last)
            if not self._add(self._towards(self.places[-1], step), len(self.places)):
                break
        for width in widths:
            self._close_in(width)

    def _towards(self, place: float, step: float) -> float:
        out = float(np.sign(self._end - place))
        return place + out * min(step, abs(self._end - place))

    def _add(self, place: float, at: int) -> bool:
        """Hold the parameter at a place; False where there is none, or nothing is predicted."""
        if any(abs(place - p) < 1e-12 * (1 + abs(p)) for p in self.places):
            return False
        value = self._scale.value(place)
        near = self._nearest(place)
        try:
            found = self._valley.hold(self._k, value, near)
        except ConvergenceError:
            return False
        self.places.insert(at, place)
        self.held.insert(at, found)
        return True

    def _nearest(self, place: float) -> Held:
        """Where the others may begin: as they were nearby, gone on as far as told."""
        order = np.argsort(np.abs(np.array(self.places) - place))
        first = self.held[int(order[0])]
        if len(order) < 2:
            moved = self._valley.along(self._k, self._scale.value(place))
        else:
            one, two = (self.places[int(n)] for n in order[:2])
            part = (place - one) / (two - one)
            moved = first.values + part * (self.held[int(order[1])].values - first.values)
        return first._replace(values=self._valley.inside(moved))

    def _roots(self) -> list[float]:
        least = min(h.square for h in self.held)
        return [float(np.sqrt(max(h.square - least, 0.0))) for h in self.held]

    def _close_in(self, width: float) -> None:
        """Halve what brackets a width until it is narrow."""
        for _ in range(2):
            roots = self._roots()
            at = next((n for n, r in enumerate(roots) if r >= width), 0)
            if not at or roots[at] - roots[at - 1] < NARROW:
                return
            part = (width - roots[at - 1]) / (roots[at] - roots[at - 1])
            one, two = self.places[at - 1 : at + 1]
            if not self._add(one + float(np.clip(part, 0.2, 0.8)) * (two - one), at):
                return


def find_profiles(model: Model, n: int, widths: Sequence[float]) -> dict[str, Profile]:
    """Profiles of one effect's parameters of which linear errors tell a wrong interval.

    Of each parameter the chi-square at the ends of its intervals is found first, all others
    following linearly: where it is as the errors say, they are believed.  Of effects that leave
    something to chance they are believed too: how much that is goes with the parameters, and
    a chi-square that holds it is no profile (of turbulence's rms it missed the truth in two of two
    trials, of which errors held one).

    Parameters
    ----------
    model : Model
        With effects.
    n : int
        Which of them.
    widths : sequence of float
        Roots of the rises of the chi-square that intervals end at, rising.

    Returns
    -------
    dict of str to Profile
        By parameter.
    """
    if type(model.effects[n]).modes is not Effect.modes:
        return {}
    return profiles_in(valley_of(model, n), widths)


def profiles_in(valley: Valley, widths: Sequence[float]) -> dict[str, Profile]:
    """As :func:`find_profiles`, of a valley."""
    out = {}
    for k, p in enumerate(valley.parameters):
        error = float(valley.errors[k])
        if valley.is_parabola(k, error):
            continue
        scale = Scale.of(p, float(valley.best[k]))
        sides = []
        for sign, end in zip((-1, 1), widened(p), strict=True):
            ends = linear_interval(float(valley.best[k]), error, p)
            told = ends[0 if sign < 0 else 1]
            side = _Side(valley, k, scale, end)
            side.go(scale.first(float(valley.best[k]), told, p), widths)
            sides.append(side)
        places = np.array([*sides[0].places[:0:-1], *sides[1].places])
        squares = np.array([h.square for h in (*sides[0].held[:0:-1], *sides[1].held)])
        if len(places) > 1:
            out[p.name] = Profile(
                np.array([scale.value(x) for x in places]), squares - squares.min(),
                scale.logarithmic, scale.neutral,
            )  # fmt: skip
    return out


def linear_interval(value: float, width: float, p: Parameter) -> tuple[float, float]:
    """Ends of an interval by a standard error, or a multiple of it.

    Of positive parameters that are badly known the logarithm is taken for Gaussian.
    """
    away = value - p.neutral if p.law == "log" else value
    if p.law == "log" and not p.signed and away > 0 and width > 0.15 * away:
        factor = float(np.exp(min(width / away, 50.0)))
        return p.neutral + away / factor, p.neutral + away * factor
    return value - width, value + width
