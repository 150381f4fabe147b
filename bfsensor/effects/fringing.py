"""Fringing: interference of light that crosses the silicon several times."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np
from scipy.fft import irfft2, rfft2, rfftfreq

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

RED = 900.0
"""Shortest wavelength [nm] at which fringes are looked for.

Derived from :func:`bfsensor.device.silicon.absorption_length` at 173 K: 100 um of silicon lets 5 % of
the light of 900 nm cross twice, but 0.3 % at 850 nm.  Other thicknesses move this."""

LONGEST = 16.0
"""Longest period of rough fringes [pixel] whose power is predicted.

Derived: two blocks of 8 pixels, whose means show the places of longer waves; sensors with larger
blocks could have twice as much."""


class Fringing(Effect):
    r"""Response at 900 nm and beyond varies with the thickness of the silicon, as a sine of its phase.

    .. math::
        1 + A \sin 2 \pi \left[ \frac{1}{P} \left( X + s Y +
        \frac{a X^2 + b X Y + c Y^2}{n} \right) + \varphi \right],

    X, Y from the middle of the sensor of n columns [pixel]: the phase is any smooth quadratic
    function of the place.  ``amp`` A is relative; ``period`` P is that along a row in the middle;
    ``tilt`` s, ``xx`` a, ``xy`` b and ``yy`` c give direction and curvature of the fringes;
    ``phase`` :math:`\varphi` in cycles.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp``: 0.001 to 0.02 (0 changes nothing); ``period`` [pixel]: 15 to 150;
        ``tilt``: -6 to 6; ``xx``: -6 to 6; ``xy``: -6 to 6; ``yy``: -6 to 6; ``phase`` [cycle]:
        -0.5 to 0.5.

    Examples
    --------
    >>> shape = {"xy": 0.0, "yy": 0.0, "phase": 0.0}
    >>> Fringing({"amp": 0.004, "period": 30.0, "tilt": 0.0, "xx": 0.0} | shape).name
    'fringing'
    """

    word = "fringing"
    stage = "light"
    parameters = (
        Parameter("amp", "", 1e-3, 2e-2, amplitude=True),
        Parameter("period", "pixel", 15.0, 150.0, step=0.01),
        Parameter("tilt", "", -6.0, 6.0, law="flat", step=1e-3),
        Parameter("xx", "", -6.0, 6.0, law="flat", step=2e-3),
        Parameter("xy", "", -6.0, 6.0, law="flat", step=2e-3),
        Parameter("yy", "", -6.0, 6.0, law="flat", step=2e-3),
        Parameter("phase", "cycle", -0.5, 0.5, law="flat"),
    )
    touches = ("flat_map",)
    needs: ClassVar[tuple[str, ...]] = ("pixels", "patterns")
    response = "quadratic"
    source = (
        "Howell 2012, PASP 124, 263 (small variations of thickness make the pattern; from about "
        "700 nm in thinned CCDs); range of thick ones assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Begin with waves detected in maps of red light; without any, with straight fringes."""
        n = layout.shape[1]
        waves = [
            s
            for s in layout.sightings
            if s["shape"] == "wave" and _wavelength(s["map"]) >= RED
        ]
        if waves:
            return [_start(s, n) for s in waves]
        usual = {p.name: 0.0 for p in cls.parameters} | {"amp": 3e-3}
        return [
            usual | {"period": period, "tilt": tilt, "phase": phase}
            for period in (18.0, 27.0, 40.0)
            for tilt in (-1.0, 0.0, 1.0) for phase in (0.0, 0.25)
        ]  # fmt: skip

    def light_map(self, shot: Shot, layout: Layout) -> FloatArray | None:
        if not shot.wavelength >= RED or not self["amp"]:
            return None
        ny, nx = layout.shape
        x, y = np.arange(nx) - nx / 2, np.arange(ny)[:, None] - ny / 2
        height = x * (1 + self["xx"] / nx * x) + y * (
            self["tilt"] + self["xy"] / nx * x + self["yy"] / nx * y
        )
        turns = height / self["period"] + self["phase"]
        return np.asarray(1 + self["amp"] * np.sin(2 * np.pi * turns))


class RoughFringes(Effect):
    r"""Response at 900 nm and beyond varies as fringes of silicon of irregular thickness.

    Where the thickness varies by more than a half-wave, the power of :math:`\cos \phi(x, y)` at a
    frequency is the part of the sensor that has this gradient of the phase (Woodward 1952).  For a
    random surface gradients are Gaussian, and so is the power by frequency k,

    .. math:: S(k) \propto A^2 e^{-k^2 P^2},

    with P the period at the root mean square frequency.  Only the power of the pattern is predicted,
    with the places of one random pattern: waves along an axis and those longer than :data:`LONGEST`,
    which means of rows, columns and blocks of pixels would show, are left out.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``amp``: 0.0001 to 0.02, root mean square (0 changes nothing); ``period``
        [pixel]: 3 to 30.

    Examples
    --------
    >>> RoughFringes({"amp": 0.001, "period": 8.0}).name
    'fringing:rough'
    """

    word = "fringing"
    variant = "rough"
    law_name = "rough"
    stage = "light"
    parameters = (
        Parameter("amp", "", 1e-4, 2e-2, amplitude=True),
        Parameter("period", "pixel", 3.0, 30.0),
    )
    touches = ("flat_map",)
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    response = "quadratic"
    source = (
        "Woodward 1952, Telecommunications Research Establishment, Memorandum 666 (spectrum of waves of "
        "wide phase modulation; a test holds it to such waves); Guo et al. 2023, PASP 135, 034503 (LSST "
        "sensors: random thickness); the Gaussian and the range are assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"amp": 1e-3, "period": period} for period in (4.0, 7.0, 12.0, 20.0)]

    def light_map(self, shot: Shot, layout: Layout) -> FloatArray | None:
        if not shot.wavelength >= RED or not self["amp"]:
            return None
        modes, k2 = _white_modes(layout.shape)
        power = np.exp(-k2 * self["period"] ** 2)
        whole = float(power.sum())
        power[k2 < LONGEST**-2.0] = 0.0
        power[0], power[:, 0] = 0.0, 0.0
        ny, nx = layout.shape
        # White noise of variance 1 has the same power in each of about ny nx / 2 modes.
        size = self["amp"] * np.sqrt(power / whole * power.size)
        return 1 + np.asarray(irfft2(modes * size, s=(ny, nx)))


@lru_cache(maxsize=2)
def _white_modes(shape: tuple[int, int]) -> tuple[np.ndarray, FloatArray]:
    """Transform of one pattern of white noise, and squares of the frequency [pixel^-2]."""
    white = np.random.default_rng(1952).standard_normal(shape)
    k2 = np.fft.fftfreq(shape[0])[:, None] ** 2 + rfftfreq(shape[1]) ** 2
    return np.asarray(rfft2(white)), np.asarray(k2)


def _wavelength(name: str) -> float:
    """Wavelength [nm] in the name of a map; nan for maps of the commonest light, which have none."""
    try:
        return float(name.split("/")[0])
    except ValueError:
        return float("nan")


def _start(wave: Seen, n: int) -> dict[str, float]:
    """Parameters of a detected wave, with the sign chosen so that its frequency along x is positive."""
    fx, phase = float(wave["fx"]), float(wave["phase"])
    if fx < 0:
        phase = 0.5 - phase
    fx = fx if abs(fx) > 1e-4 else 1e-4
    out = {"amp": float(wave["amp"]), "period": 1 / abs(fx), "tilt": float(wave["fy"]) / fx}
    bent = {"xx": 0.5, "xy": 1.0, "yy": 0.5}
    out |= {name: part * n * float(wave[name]) / fx for name, part in bent.items()}
    return out | {"phase": (phase + 0.5) % 1.0 - 0.5}
