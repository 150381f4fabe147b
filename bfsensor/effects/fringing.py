"""Fringing: light that crosses the silicon more than once meets itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

RED = 900.0
"""Wavelength [nm] from which on silicon of 100 um lets enough light through (assumed)."""


class Fringing(Effect):
    r"""Response at 900 nm and beyond varies along the contours of the wafer's thickness.

    .. math::
        1 + A \sin 2 \pi \left[ \frac{1}{P} \left( X + s Y +
        \frac{a X^2 + b X Y + c Y^2}{n} \right) + \varphi \right],

    X, Y from the middle of the sensor of n columns [pixel]: no contour is assumed but that it is
    smooth.  ``period`` P is that along a row at the middle; ``tilt`` s, ``xx`` a, ``xy`` b,
    ``yy`` c bend the contours; ``phase`` in cycles.
    """

    word = "fringing"
    stage = "light"
    parameters = (
        Parameter("amp", "", 1e-3, 2e-2, amplitude=True),
        Parameter("period", "pixel", 15.0, 60.0, step=0.01),
        Parameter("tilt", "", -3.0, 3.0, law="flat", step=1e-3),
        Parameter("xx", "", -2.0, 2.0, law="flat", step=2e-3),
        Parameter("xy", "", -2.0, 2.0, law="flat", step=2e-3),
        Parameter("yy", "", -2.0, 2.0, law="flat", step=2e-3),
        Parameter("phase", "cycle", -0.5, 0.5, law="flat"),
    )
    touches = ("flat_map",)
    of_pixels = True
    from_sightings = True
    bends = True
    source = (
        "Howell 2012, PASP 124, 263 (small variations of thickness make the pattern; from about "
        "700 nm in thinned CCDs); range of thick ones assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Waves that were followed across maps of red light; without such, straight ones."""
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


def _wavelength(name: str) -> float:
    """Of a map, by its name: nan of maps of the commonest light."""
    try:
        return float(name.split("/")[0])
    except ValueError:
        return float("nan")


def _start(wave: Seen, n: int) -> dict[str, float]:
    """Parameters of a wave: its frequency along a row is counted positive."""
    fx, phase = float(wave["fx"]), float(wave["phase"])
    if fx < 0:
        phase = 0.5 - phase
    fx = fx if abs(fx) > 1e-4 else 1e-4
    out = {"amp": float(wave["amp"]), "period": 1 / abs(fx), "tilt": float(wave["fy"]) / fx}
    bent = {"xx": 0.5, "xy": 1.0, "yy": 0.5}
    out |= {name: part * n * float(wave[name]) / fx for name, part in bent.items()}
    return out | {"phase": (phase + 0.5) % 1.0 - 0.5}
