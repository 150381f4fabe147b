"""Gain drift: the gain changes with time, linearly, as a warming chain, or as any smooth curve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

KNOTS = 6
"""Number of equal intervals of the campaign's time in which the free curve of the gain may turn.

Chosen: 6 follow one and a half periods of a cycle; with twice as many, errors of the values grow by
a factor of 1.4 and three periods are followed."""


class _Drift(Effect):
    """A signal that is multiplied by a function of time; subclasses state it."""

    word = "gain_drift"
    touches = ("flat_mean", "flat_cov", "spot")

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        change = float(self._change(np.array(shot.hours), layout))
        return [f * np.asarray(1 + change, f.dtype) for f in frames] if change else frames

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        if "hours" not in axes:
            return level
        return level * (1 + self._change(np.nan_to_num(axes["hours"]), layout))

    def _change(self, hours: NDArray, layout: Layout) -> FloatArray:
        """Relative change of the signal in ADU by the time since the first exposure [h]."""
        raise NotImplementedError


def _duration(layout: Layout) -> float:
    """Time from the first exposure to the last one [h]."""
    hours = np.array([s.hours for s in layout.shots])
    last = float(np.nanmax(hours)) if np.isfinite(hours).any() else 0.0
    return last if last > 0 else 1.0


class GainDrift(_Drift):
    """The signal in ADU grows by the fraction ``slope`` per hour since the first exposure.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``slope`` [1/h]: 0.0005 to 0.02 in magnitude, either sign (0 changes
        nothing).

    Examples
    --------
    >>> GainDrift({"slope": 0.003}).name
    'gain_drift'
    """

    parameters = (Parameter("slope", "1/h", 5e-4, 2e-2, signed=True, amplitude=True),)
    source = (
        "Gain follows the electronics' temperature by some 5e-4/K (assumed): drifts of up to tens "
        "of K an hour while a chain warms up"
    )

    def _change(self, hours: NDArray, layout: Layout) -> FloatArray:
        return np.asarray(self["slope"] * hours)


class GainWarming(_Drift):
    """The signal in ADU changes by the fraction ``amp`` (1 - exp(-t / tau)) of time t.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp``: 0.0003 to 0.03 in magnitude, either sign (0 changes nothing);
        ``tau`` [h]: 0.05 to 10.

    Examples
    --------
    >>> GainWarming({"amp": 0.003, "tau": 0.5}).name
    'gain_drift:warming'
    """

    variant = "warming"
    parameters = (
        Parameter("amp", "", 3e-4, 3e-2, signed=True, amplitude=True),
        Parameter("tau", "h", 0.05, 10.0),
    )
    source = (
        "A chain of electronics that is switched on approaches its temperature exponentially "
        "(Newton's law of cooling), at some 5e-4/K of gain (assumed)"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"amp": 3e-3, "tau": f * _duration(layout)} for f in (0.08, 0.3, 1.0)]

    def _change(self, hours: NDArray, layout: Layout) -> FloatArray:
        return np.asarray(-self["amp"] * np.expm1(-hours / self["tau"]))


class GainCycle(_Drift):
    """The signal in ADU follows a sine of time: ``amp`` sin(2 pi (t / period + phase)).

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp``: 0.0003 to 0.03 (0 changes nothing); ``period`` [h]: 0.1 to 24;
        ``phase`` [turns]: 0 to 1.

    Examples
    --------
    >>> GainCycle({"amp": 0.003, "period": 0.5, "phase": 0.2}).name
    'gain_drift:cycle'
    """

    variant = "cycle"
    parameters = (
        Parameter("amp", "", 3e-4, 3e-2, amplitude=True),
        Parameter("period", "h", 0.1, 24.0),
        Parameter("phase", "turns", 0.0, 1.0, law="flat"),
    )
    source = "Cycles of a cooler or of a room's conditioning (range assumed)"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        # From one half to ten periods, so near one another that one begins within a third of a turn.
        last = _duration(layout)
        return [
            {"amp": 2e-3, "period": last / turns, "phase": phase}
            for turns in np.arange(0.5, 10.1, 0.5) for phase in (0.0, 0.25, 0.5, 0.75)
        ]  # fmt: skip

    def _change(self, hours: NDArray, layout: Layout) -> FloatArray:
        turns = hours / self["period"] + self["phase"]
        return np.asarray(self["amp"] * np.sin(2 * np.pi * turns))


class GainCurve(_Drift):
    """The gain follows a natural cubic spline in time, 0 at the first exposure.

    ``g1`` to ``g6`` are the relative changes of the signal in ADU at equal steps of the time from the
    first exposure to the last one.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges (0 changes nothing): ``g1``: -0.03 to 0.03; ``g2``: -0.03 to
        0.03; ``g3``: -0.03 to 0.03; ``g4``: -0.03 to 0.03; ``g5``: -0.03 to 0.03;
        ``g6``: -0.03 to 0.03.

    Examples
    --------
    >>> GainCurve({f"g{n}": 0.001 for n in range(1, 7)}).name
    'gain_drift:curve'
    """

    variant = "curve"
    parameters = tuple(
        Parameter(
            f"g{n}", "", -0.03, 0.03, law="flat", signed=True, amplitude=True, step=1e-4
        )
        for n in range(1, KNOTS + 1)
    )
    source = (
        "Gains of LSST's chains that follow the temperature of their board: O'Connor et al. 2016, "
        "Proc. SPIE 9915; a free curve, range assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        place = np.arange(1, KNOTS + 1) / KNOTS
        return [
            {f"g{n}": 2e-3 * float(v) for n, v in enumerate(shape, 1)}
            for shape in (place, np.sin(np.pi * place), np.sin(2 * np.pi * place))
        ]

    def _change(self, hours: NDArray, layout: Layout) -> FloatArray:
        values = [0.0, *(self[f"g{n}"] for n in range(1, KNOTS + 1))]
        spline = CubicSpline(np.linspace(0, 1, KNOTS + 1), values, bc_type="natural")
        return np.asarray(spline(np.clip(hours / _duration(layout), 0.0, 1.0)))
