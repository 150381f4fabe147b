"""Intervals of effects' parameters by the chi-square itself, where it is no parabola."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.fit.local_likelihood import Held, Valley, linear_interval, valley_of
from bfsensor.diagnose.model.effect_parameters import widened
from bfsensor.effects.effect import Effect, Parameter
from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

POINTS = 7
"""Values of a parameter that are held, at most, on one side."""

LONGEST = 3.0
"""Stretch of a step over the last one."""

NARROW = 0.8
"""Difference of the roots on both sides of where a width is crossed that needs no value between."""

SEEN = 0.05
"""Rise of the chi-square's root along a step below which nothing tells how far to go next."""


LOWER = 0.2
"""Chi-square by which a profile must be lower than the fit for the fit to go on there."""

RESTARTS = 4
"""Of a fit that profiles found lower places of."""


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

    values: FloatArray
    rises: FloatArray
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


def _crossing(place: FloatArray, roots: FloatArray, width: float) -> tuple[float, bool]:
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


def settle(
    model: Model, n: int, widths: Sequence[float]
) -> tuple[Model, dict[str, Profile]]:
    """Profiles as of :func:`find_profiles`, and the fit gone on from where they are lower.

    Along a bent valley a fit goes by steps that gain ever less and may end before its lowest
    place; profiles, which follow the valley, come by it.
    """
    for _ in range(RESTARTS):
        if type(model.effects[n]).modes is not Effect.modes:
            return model, {}
        valley = valley_of(model, n)
        profiles = profiles_in(valley, widths)
        if valley.square - valley.lowest.square < LOWER:
            return model, profiles
        effects, values = list(model.effects), valley.lowest.values.tolist()
        effects[n] = effects[n].with_values(
            **{p.name: v for p, v in zip(valley.parameters, values, strict=True)}
        )
        try:
            lower = model.with_effects(effects)
        except ConvergenceError:
            return model, profiles
        if lower.fit.total > model.fit.total - 0.5 * LOWER:
            return model, profiles
        model = lower
    return model, find_profiles(model, n, widths)


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
