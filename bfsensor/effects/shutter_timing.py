"""Shutter timing: exposures last longer than commanded, by an amount that varies in x."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

EVEN = 0.1
"""Relative variation over the sensor below which the additional time counts as the same everywhere.
Chosen for the name of the law only: with twice as much, fainter shades are called an offset."""


class ShutterTiming(Effect):
    r"""Exposures last longer than commanded, by an amount that may vary over the sensor.

    .. math:: \Delta t = \mathrm{dt} \left( 1 + \mathrm{shade}\, x + \mathrm{rise}\, y
        - \mathrm{iris}\, \tfrac12 (x^2 + y^2) \right)

    x and y run from -1 to 1 across the columns and the rows: ``shade`` and ``rise`` for a blade that
    opens and closes at unequal speed, ``iris`` for one that opens from the middle.  Of the level of an
    exposure of the commanded time t, the fraction :math:`\Delta t / (t + \Delta t)` is additional.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``dt`` [s]: 0.005 to 0.05 in magnitude, either sign (0 changes nothing);
        ``shade``: -1 to 1; ``rise``: -1 to 1; ``iris``: -1 to 1.

    Examples
    --------
    >>> ShutterTiming({"dt": 0.02, "shade": 0.0}).law_name
    'offset'
    """

    word = "shutter_timing"
    stage = "light"
    parameters = (
        Parameter("dt", "s", 5e-3, 5e-2, signed=True, amplitude=True),
        Parameter("shade", "", -1.0, 1.0, law="flat"),
        Parameter("rise", "", -1.0, 1.0, law="flat", plain=0.0),
        Parameter("iris", "", -1.0, 1.0, law="flat", plain=0.0),
    )
    # A shade makes a gradient in maps of short exposures, which the unknown illumination hides.
    touches: ClassVar[tuple[str, ...]] = ("flat_mean", "spot")
    source = (
        "Opening and closing take time, more here than there: Stetson 1989, Highlights of Astronomy "
        "8, 635; Galadi-Enriquez, Jordi & Trullols 1995, IAU Symp. 167; blades of unequal speed: Reif "
        "et al. 2005; an iris: Zissell 2000, JAAVSO 28, 149; 0.07 s in one camera: Lee 2016, J. Korean "
        "Astron. Soc. 49, 6; range assumed"
    )
    maps_vary = "exposure"

    @property
    def law_name(self) -> str:
        """'blade' or 'iris' by the larger variation over the sensor, 'offset' without one."""
        blade = float(np.hypot(self["shade"], self["rise"]))
        if max(blade, abs(self["iris"])) < EVEN:
            return "offset"
        return "blade" if blade > abs(self["iris"]) else "iris"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        even = {"shade": 0.0, "rise": 0.0, "iris": 0.0}
        return [
            {"dt": sign * 0.02} | even | {name: size}
            for sign in (1, -1)
            for name, size in (
                ("shade", -0.3), ("shade", 0.0), ("shade", 0.3), ("rise", -0.3), ("rise", 0.3),
            )
        ]  # fmt: skip

    def light_map(self, shot: Shot, layout: Layout) -> FloatArray | None:
        if shot.kind not in self._kinds() or not shot.seconds > 0:
            return None
        x, y = (2 * (np.arange(n) + 0.5) / n - 1 for n in layout.shape[::-1])
        longer = self._longer(x, y[:, None], x**2 + y[:, None] ** 2)
        return np.asarray(1 + longer / shot.seconds)

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        ny, nx = layout.shape
        middle = np.array([
            (*_moments(s.x, s.columns, nx), *_moments(s.y, s.rows, ny)) for s in layout.segments
        ])[axes["amp"].astype(int)]  # fmt: skip
        x, square_x, y, square_y = middle.T
        longer = self._longer(x, y, square_x + square_y)
        return np.asarray(axes["level"] * longer / (axes["time"] + longer))

    def spot_flux(self, axes: Axes, layout: Layout) -> FloatArray:
        # Spots lie on all of the sensor: in their mean blades cancel, and x^2 + y^2 is 2 / 3.
        longer = self["dt"] * (1 - self["iris"] / 3)
        return np.asarray(axes["flux"] * longer / (axes["time"] + longer))

    def _longer(self, x: FloatArray, y: FloatArray, squares: FloatArray) -> FloatArray:
        """Additional time [s] at places, with the sum of their squares."""
        shape = self["shade"] * x + self["rise"] * y - 0.5 * self["iris"] * squares
        return np.asarray(self["dt"] * (1 + shape))

    @staticmethod
    def _kinds() -> tuple[str, ...]:
        """Kinds of exposures that this shutter makes."""
        return "flat", "spot"


class FlatShutter(ShutterTiming):
    """A shutter of the flats' light source: spots, made by another one, keep their exposure times.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``dt`` [s]: 0.005 to 0.05 in magnitude, either sign (0 changes nothing);
        ``shade``: -1 to 1; ``rise``: -1 to 1; ``iris``: -1 to 1.

    Examples
    --------
    >>> FlatShutter({"dt": 0.02, "shade": 0.0}).name
    'shutter_timing:flats'
    """

    variant = "flats"
    touches: ClassVar[tuple[str, ...]] = ("flat_mean",)

    def spot_flux(self, axes: Axes, layout: Layout) -> FloatArray:
        return np.zeros(len(axes["flux"]))

    @staticmethod
    def _kinds() -> tuple[str, ...]:
        return ("flat",)


def _moments(first: int, count: int, n: int) -> tuple[float, float]:
    """Mean and mean square of the places, -1 to 1, of some of n pixels."""
    place = 2 * (first + np.arange(count) + 0.5) / n - 1
    return float(place.mean()), float((place**2).mean())
