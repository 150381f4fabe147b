"""Gain non-linearity: the amplifier's response is a curve, has a kink at a level, or starts late."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

SCALE = 1e5
"""Signal [e-] at which c2 and c3 are defined as relative changes."""


KNOTS = (0.05, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2)
"""Signals [1e5 e-] at which the free response curve has its values.

Chosen: intervals of 2e4 e- follow curves whose period is 4e4 e- and longer up to the full well of
the sensors in the catalogue; one more near zero, where video chains start late.  With twice as many,
errors of each value grow by a half."""


class _Response(Effect):
    """A signal that becomes another one, the same in all pixels; subclasses state the curve."""

    word = "gain_nonlinearity"
    stage = "amplifier"
    touches = ("flat_mean", "flat_cov", "spot")

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        del shot
        return [self._bent(f).astype(f.dtype) for f in frames]

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        return self._bent(level)

    def _bent(self, signal: Image) -> Image:
        """Signal after the amplifier [e-]."""
        raise NotImplementedError


class GainNonlinearity(_Response):
    """Signal S becomes S (1 + c2 S/1e5 + c3 (S/1e5)^2), S in electrons.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``c2``: 0.001 to 0.02 in magnitude, either sign (0 changes nothing);
        ``c3``: 0.0003 to 0.005 in magnitude, either sign (0 changes nothing).

    Examples
    --------
    >>> GainNonlinearity({"c2": 0.004, "c3": 0.001}).name
    'gain_nonlinearity'
    """

    parameters = (
        Parameter("c2", "", 1e-3, 2e-2, signed=True, amplitude=True),
        Parameter("c3", "", 3e-4, 5e-3, signed=True, amplitude=True),
    )
    source = (
        "Polynomial response of video chains: Astier et al. 2019, A&A 629, A36, section 5 (0.6 % "
        "of an LSST test chain); range assumed"
    )

    def _bent(self, signal: Image) -> Image:
        """Signal after the polynomial [e-]."""
        x = signal / SCALE
        return signal * (1 + self["c2"] * x + self["c3"] * x * x)


class GainKink(_Response):
    """Above ``level`` the slope of the response is ``slope`` higher than below.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``slope``: 0.001 to 0.1 in magnitude, either sign (0 changes nothing);
        ``level`` [e-]: 5000 to 120000.

    Examples
    --------
    >>> GainKink({"slope": -0.01, "level": 7e4}).signal(np.array([5e4, 9e4]), {}, None)
    array([50000., 89800.])
    """

    variant = "kink"
    parameters = (
        Parameter("slope", "", 1e-3, 0.1, signed=True, amplitude=True),
        Parameter("level", "e-", 5e3, 1.2e5, law="flat"),
    )
    source = (
        "Response of SDSS imaging CCDs, linear up to a level and of another slope above: Gunn et al. "
        "1998, AJ 116, 3040; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"slope": 0.01, "level": v} for v in (1.5e4, 3.5e4, 5.5e4, 7.5e4, 9.5e4)]

    def _bent(self, signal: Image) -> Image:
        return signal + self["slope"] * np.maximum(signal - self["level"], 0)


class LateStart(_Response):
    """A signal S lacks ``deficit`` (1 - exp(-S / length)) electrons: the first ones are lost.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``deficit`` [e-]: 1 to 300 in magnitude, either sign (0 changes nothing);
        ``length`` [e-]: 100 to 5000.

    Examples
    --------
    >>> LateStart({"deficit": 10.0, "length": 500.0}).signal(np.array([1e5]), {}, None)
    array([99990.])
    """

    variant = "low_signal"
    parameters = (
        Parameter("deficit", "e-", 1.0, 300.0, signed=True, amplitude=True),
        Parameter("length", "e-", 100.0, 5e3),
    )
    source = (
        "Loss of the first electrons in some CCDs of the Dark Energy Camera: Bernstein et al. 2017, "
        "PASP 129, 114502; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"deficit": 30.0, "length": v} for v in (300.0, 1000.0, 3000.0)]

    def _bent(self, signal: Image) -> Image:
        # Below zero, where only noise leads, the curve goes on with its slope there.
        start = -np.expm1(-np.maximum(signal, 0) / self["length"])
        return signal - self["deficit"] * (start + np.minimum(signal, 0) / self["length"])


class ResponseCurve(_Response):
    """Signal S becomes S (1 + f(S)), f a natural cubic spline that is 0 at S = 0.

    Its values at the signals :data:`KNOTS` are ``f1`` to ``f7``; beyond the last one f is constant.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges (0 changes nothing): ``f1``: -0.03 to 0.03; ``f2``: -0.03 to
        0.03; ``f3``: -0.03 to 0.03; ``f4``: -0.03 to 0.03; ``f5``: -0.03 to 0.03;
        ``f6``: -0.03 to 0.03; ``f7``: -0.03 to 0.03.

    Examples
    --------
    >>> curve = ResponseCurve({f"f{n}": 1e-3 * n for n in range(1, 8)})
    >>> curve.signal(np.array([2e4]), {}, None).round(6)
    array([20040.])
    """

    variant = "curve"
    parameters = tuple(
        Parameter(
            f"f{n}", "", -0.03, 0.03, law="flat", signed=True, amplitude=True, step=1e-4
        )
        for n in range(1, len(KNOTS) + 1)
    )
    source = (
        "Spline through measured deviations, as linearizers of video chains use it: Plazas Malagon "
        "et al. 2024, arXiv 2404.14516; range assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        # One curvature in the middle and one at low signal; the fit frees all values together.
        return [
            {f"f{n}": 0.01 * f(x) for n, x in enumerate(KNOTS, 1)}
            for f in (lambda x: x * x, lambda x: x * (1 - x))
        ]

    def _bent(self, signal: Image) -> Image:
        values = tuple(self[f"f{n}"] for n in range(1, len(KNOTS) + 1))
        where = np.clip(signal / SCALE, 0.0, KNOTS[-1])
        return np.asarray(signal * (1 + _spline(values)(where)))


@lru_cache(maxsize=256)
def _spline(values: tuple[float, ...]) -> CubicSpline:
    """Natural cubic spline through 0 at 0 and ``values`` at :data:`KNOTS`."""
    return CubicSpline((0.0, *KNOTS), (0.0, *values), bc_type="natural")
