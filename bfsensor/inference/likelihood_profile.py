"""Likelihood profiles: intervals of parameters where the chi-square is no parabola.

The ends of an interval of ``w`` standard deviations are where the smallest chi-square with the
parameter held has risen by ``w^2`` (Wilks' theorem for one parameter).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from bfsensor.errors import ConvergenceError
from bfsensor.inference.local_likelihood import Held, LocalLikelihood, Ranged
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
    def of(cls, p: Ranged, value: float) -> Scale:
        """Choose the scale of a parameter with a best value."""
        away = value - p.neutral
        logarithmic = p.logarithmic and away > 0
        return cls(
            logarithmic, p.neutral if logarithmic else 0.0, 1e-3 * min(p.least, away)
        )

    def place(self, value: float) -> float:
        """Place of a value on this scale; distances from neutral below ``least`` count as that."""
        if not self.logarithmic:
            return value
        return float(np.log(max(value - self.neutral, self.least)))

    def value(self, place: float) -> float:
        """Value at a place on this scale."""
        return self.neutral + float(np.exp(place)) if self.logarithmic else place

    def first(self, value: float, told: float, p: Ranged) -> float:
        """First step: to the end by the linear error; without one, a part of the range."""
        step = abs(self.place(told) - self.place(value))
        if np.isfinite(step) and step > 0:
            return min(step, 1.0) if self.logarithmic else step
        return 0.2 if self.logarithmic else 0.05 * p.width


class _Side:
    """One side of a profile: values outwards from the best until the chi-square has risen enough."""

    def __init__(self, near: LocalLikelihood, k: int, scale: Scale, end: float) -> None:
        self._near, self._k, self._scale = near, k, scale
        self._end = scale.place(end)
        best = scale.place(float(near.best[k]))
        self.places, self.held = [best], [Held(near.square, near.best, near.slopes)]

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
        try:
            found = self._near.hold(self._k, value, self._nearest(place))
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
            moved = self._near.along(self._k, self._scale.value(place))
        else:
            one, two = (self.places[int(n)] for n in order[:2])
            part = (place - one) / (two - one)
            moved = first.values + part * (self.held[int(order[1])].values - first.values)
        return first._replace(values=self._near.inside(moved))

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


def profiles_in(near: LocalLikelihood, widths: Sequence[float]) -> dict[str, Profile]:
    """Likelihood profiles of those parameters for which linear intervals are wrong.

    For each parameter the chi-square at the ends of its linear intervals is evaluated first, all
    others moved linearly: if it has risen as a parabola does, the linear errors stand.

    Parameters
    ----------
    near : LocalLikelihood
        The chi-square near the fit.
    widths : sequence of float
        Half-widths of the intervals [standard deviations], increasing.

    Returns
    -------
    dict of str to Profile
        Profiles by the name of the parameter.
    """
    out = {}
    for k, p in enumerate(near.parameters):
        error = float(near.errors[k])
        if near.is_parabola(k, error):
            continue
        scale = Scale.of(p, float(near.best[k]))
        sides = []
        for sign, end in zip((-1, 1), (p.low, p.high), strict=True):
            ends = p.interval(float(near.best[k]), error)
            told = ends[0 if sign < 0 else 1]
            side = _Side(near, k, scale, end)
            side.go(scale.first(float(near.best[k]), told, p), widths)
            sides.append(side)
        places = np.array([*sides[0].places[:0:-1], *sides[1].places])
        squares = np.array([h.square for h in (*sides[0].held[:0:-1], *sides[1].held)])
        if len(places) > 1:
            out[p.name] = Profile(
                np.array([scale.value(x) for x in places]), squares - squares.min(),
                scale.logarithmic, scale.neutral,
            )  # fmt: skip
    return out
