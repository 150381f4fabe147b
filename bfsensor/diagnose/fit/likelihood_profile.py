"""Likelihood profiles: intervals of an effect's parameters where the chi-square is no parabola.

The ends of an interval of ``w`` standard deviations are where the smallest chi-square with the
parameter held has risen by ``w^2`` (Wilks' theorem for one parameter).
"""

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
"""Largest number of values on one side, the best among them, at which a parameter is held while
going outwards; up to two more are added at each width.  Chosen, to be derived: with 14, ends that
are reported as open because six steps did not reach them would be searched for by thirteen, at
twice the predictions."""

LONGEST = 3.0
"""Largest factor between successive steps (the smallest is 0.3).  Chosen: six steps that grow by 3
reach 364 times the first; with 6, 9331 times, and the profile's curve between them is less
certain."""

NARROW = 0.8
"""Difference of the roots of the rise [standard deviations] between two neighbouring values that
bracket an end, below which no value is added between them.  Chosen: with 1.6 ends rest on an
interpolation over up to twice the distance."""

SEEN = 0.05
"""Increase of the root of the rise along a step [standard deviations] below which the next step is
not extrapolated from it but is :data:`LONGEST` times as long.  Chosen: profiles are good to a
chi-square of 0.02, a root of 0.14, so that a smaller increase may be numerical; with 0.1, more
steps grow by the full factor."""


LOWER = 0.2
"""Difference by which the lowest chi-square on a profile must be below the fit's for the fit to be
continued from there; it must then gain half of it.  Chosen: a fit that is 0.2 too high ended up to
0.45 errors from its minimum; with 0.4, 0.63 errors."""

RESTARTS = 4
"""Largest number of times that a fit is continued from a lower point of a profile.  Chosen: twice
as many doubles the time of a fit that never settles."""


@dataclass(frozen=True)
class Profile:
    """Likelihood profile: the rise of the chi-square with one parameter, all others refitted.

    Attributes
    ----------
    values : ndarray, shape (n,)
        Values of the parameter, in its unit, increasing; the best is among them.
    rises : ndarray, shape (n,)
        Rise of the chi-square above its smallest value, at least 0.
    logarithmic : bool
        Whether ends are interpolated in the logarithm of the parameter's distance from
        ``neutral``, in which the root of the rise is closer to linear.
    neutral : float
        Value at which the parameter has no effect; used if ``logarithmic``.
    """

    values: FloatArray
    rises: FloatArray
    logarithmic: bool = False
    neutral: float = 0.0

    def interval(self, width: float) -> tuple[float, float, bool, bool]:
        """Ends where the chi-square has risen by the square of ``width``.

        Parameters
        ----------
        width : float
            Half-width in standard deviations, above 0: 1 for 68 %, 1.96 for 95 %.

        Returns
        -------
        low, high : float
            Ends, in the parameter's unit; an open end is the last value of the profile.
        low_closed, high_closed : bool
            Whether the chi-square rises that far on that side; False says that the end is open.

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
    """Place, going out from the first, at which a root first reaches a width, and whether it does."""
    beyond = np.nonzero(roots >= width)[0]
    if not len(beyond) or len(place) < 2:
        return float(place[-1]), False
    last = int(beyond[0])
    # A monotone cubic (PCHIP), since a polynomial through a bracket may overshoot and cross twice;
    # it takes its slope at the bracket from one more point on either side.
    own = slice(0, min(last + 2, len(place)))
    order = np.argsort(place[own])
    curve = PchipInterpolator(place[own][order], roots[own][order] - width)
    inner, outer = sorted((place[last - 1], place[last]))
    found = [r for r in curve.roots(extrapolate=False) if inner <= r <= outer]
    return float(found[0] if found else place[last]), True


class Scale(NamedTuple):
    """Scale along which a parameter is varied: its own, or the log of its distance from neutral."""

    logarithmic: bool
    neutral: float
    least: float

    @classmethod
    def of(cls, p: Parameter, value: float) -> Scale:
        """Choose the scale of a parameter with a best value."""
        away = value - p.neutral
        logarithmic = p.law == "log" and not p.signed and away > 0
        return cls(logarithmic, p.neutral if logarithmic else 0.0, 1e-3 * min(p.low, away))

    def place(self, value: float) -> float:
        """Place of a value on this scale; distances from neutral below ``least`` count as that."""
        if not self.logarithmic:
            return value
        return float(np.log(max(value - self.neutral, self.least)))

    def value(self, place: float) -> float:
        """Value at a place on this scale."""
        return self.neutral + float(np.exp(place)) if self.logarithmic else place

    def first(self, value: float, told: float, p: Parameter) -> float:
        """First step: to the end by the linear error; without one, a part of the range."""
        step = abs(self.place(told) - self.place(value))
        if np.isfinite(step) and step > 0:
            return min(step, 1.0) if self.logarithmic else step
        return 0.2 if self.logarithmic else 0.05 * (p.high - p.low)


class _Side:
    """One side of a profile: values outwards from the best until the chi-square has risen enough."""

    def __init__(self, valley: Valley, k: int, scale: Scale, end: float) -> None:
        self._valley, self._k, self._scale = valley, k, scale
        self._end = scale.place(end)
        best = scale.place(float(valley.best[k]))
        self.places, self.held = [best], [Held(valley.square, valley.best, valley.slopes)]

    def go(self, first: float, widths: Sequence[float]) -> None:
        """Hold the parameter at values outwards, then at some that bracket each width closely."""
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
                    # 5 % beyond the width, so that the end is bracketed and not extrapolated.
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
        """Hold the parameter at a place; False if it is held there, or nothing can be predicted."""
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
        """Starting point at a place: the other parameters inter- or extrapolated from neighbours."""
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
        """Narrow the bracket of a width below NARROW, by at most two further values."""
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
    """Profiles as by :func:`find_profiles`, the fit continued where a profile is lower than it.

    Along a curved minimum Gauss-Newton steps gain ever less, and a fit may stop before the
    lowest point; a profile follows the curve and passes it.

    Parameters
    ----------
    model : Model
        Fitted, with effects.
    n : int
        Index of the effect in ``model.effects``.
    widths : sequence of float
        Half-widths of the intervals [standard deviations], increasing.

    Returns
    -------
    model : Model
        The same, or the one fitted again from a lower point.
    profiles : dict of str to Profile
        Profiles of that model by the name of the parameter.
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
    """Profiles of those parameters of one effect for which linear intervals are wrong.

    For each parameter the chi-square at the ends of its linear intervals is evaluated first, all
    others moved linearly: if it has risen as a parabola does, the linear errors stand.  They also
    stand for effects with random effects: their variances change with the parameters, and the
    chi-square at constant variances is no likelihood (for the rms of turbulence its interval
    missed the truth in two of two trials, the linear one in one of them).

    Parameters
    ----------
    model : Model
        Fitted, with effects.
    n : int
        Index of the effect in ``model.effects``.
    widths : sequence of float
        Half-widths of the intervals [standard deviations], increasing.

    Returns
    -------
    dict of str to Profile
        Profiles by the name of the parameter; empty if linear intervals stand for all.
    """
    if type(model.effects[n]).modes is not Effect.modes:
        return {}
    return profiles_in(valley_of(model, n), widths)


def profiles_in(valley: Valley, widths: Sequence[float]) -> dict[str, Profile]:
    """Profiles as by :func:`find_profiles`, from a chi-square that is given as a function."""
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
