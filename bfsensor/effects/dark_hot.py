"""Dark current beyond the usual, everywhere or in hot columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor.effects.dark_pixels import mean_bias, struck_pixels
from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

DOUBLING = 6.0
"""Rise of the temperature [K] that doubles the rate (assumed)."""

REFERENCE = 173.15
"""Temperature [K] that rates are given for: -100 C."""

MOST = 6
"""Hot columns at most."""

SURE = 5.0
"""Deviation [sigma] from which a column counts as hot."""

SOURCE = (
    "Widenhorn et al. 2002, Proc. SPIE 4669, 193; Widenhorn et al. 2010, J. Appl. Phys. 107 "
    "(222 to 291 K); ranges assumed"
)


class _Dark(Effect):
    """Charge that is born in the dark, ``rate`` [e-/s] in some columns."""

    word = "dark_hot"
    stage = "store"
    source = SOURCE

    def hot(self, layout: Layout) -> NDArray[np.bool_]:
        """Which columns of the sensor."""
        raise NotImplementedError

    def store(
        self,
        charge: Image,
        shot: Shot,
        layout: Layout,
        rng: np.random.Generator,
        memory: dict[str, NDArray],
    ) -> Image:
        mean = self._born(shot.seconds, shot.temperature) * self.hot(layout)
        if not mean.any():
            return charge
        return charge + rng.poisson(mean, charge.shape).astype(charge.dtype)

    def dark_map(self, axes: Axes, layout: Layout) -> FloatArray:
        noise, more = layout.noise, mean_bias(layout)
        hot = self.hot(layout)
        out = np.zeros(len(axes["time"]))
        born = self._born(axes["time"], axes["temperature"])
        for amp, segment in enumerate(layout.segments):
            own = np.asarray(axes["amp"]).astype(int) == amp
            read = hot[segment.sensor_column(np.arange(segment.columns))]
            share = float(read.mean())
            for mean in np.unique(born[own]):
                # Deviations are counted from the median: hot is what fewer than half are.
                level = mean if share > 0.5 else 0.0
                part, others = struck_pixels(float(mean), level, noise[amp], more)
                cold = 0.0 if share < 1 else others
                rows = own & (born == mean)
                what = axes["what"][rows]
                kept = share * (1 - part) + (1 - share)
                mixed = (share * (1 - part) * others + (1 - share) * cold) / kept
                column = np.zeros(len(what))
                at = what == "column"
                # The struck pixels of a column are left out, unless they are most of it.
                value = float(mean) if part > 0.5 else others
                column[at] = value * (
                    read[axes["x"][rows][at].astype(int)] - (1.0 if share > 0.5 else 0.0)
                )
                struck = share * part * segment.rows * segment.columns
                out[rows] = np.where(what == "struck", struck, np.where(at, column, mixed))
        return out

    def _born(
        self, seconds: FloatArray | float, temperature: FloatArray | float
    ) -> FloatArray:
        """Electrons in a pixel of a hot column."""
        warm = np.nan_to_num(np.asarray(temperature, float), nan=REFERENCE) - REFERENCE
        return np.asarray(
            self["rate"] * np.asarray(seconds, float) * 2 ** (warm / DOUBLING)
        )


class DarkCurrent(_Dark):
    """``rate`` [e-/s] in every pixel at -100 C, doubling every 6 K.

    Dark current in proportion to time floats in every fit: what is left to see is its noise.
    """

    variant = "dark"
    parameters = (Parameter("rate", "e-/s", 0.02, 1.0, amplitude=True),)
    touches = ("dark_map",)
    of_pixels = True

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"rate": rate} for rate in (0.05, 0.3, 0.7, 1.2)]

    def hot(self, layout: Layout) -> NDArray[np.bool_]:
        return np.ones(layout.shape[1], bool)


class HotColumns(_Dark):
    """``rate`` [e-/s] in whole columns, the same in all exposures.

    ``columns``: how many; ``x1`` ... their places on the sensor, 0 of those beyond.
    """

    variant = "hot"
    parameters = (
        Parameter("rate", "e-/s", 1.0, 50.0, amplitude=True),
        Parameter("columns", "", 1, MOST, law="whole"),
        *(Parameter(f"x{n}", "pixel", 0, 1e4, law="whole") for n in range(1, MOST + 1)),
    )
    touches = ("dark_map", "flat_map")
    by_time = True

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """The columns that stand out of darks, the hottest first: as many as are sure, and fewer."""
        places: dict[int, float] = {}
        for s in seen:
            if s["word"] == "dark_map" and s.get("what") == "column" and "x" in s:
                amp = s.get("amp", 0)
                segment = layout.segments[
                    int(amp) if isinstance(amp, int | np.integer) else 0
                ]
                column = int(segment.sensor_column(np.array(int(s["x"][0]))))
                places.setdefault(column, float(s.get("z", SURE)))
        # Beside a hot column, which the mean of all takes in, the others seem cold.
        sure = [x for x, z in places.items() if z >= SURE][:MOST] or list(places)[:1]
        return [
            {"rate": rate, "columns": float(count)}
            | {f"x{n + 1}": float(sure[n]) if n < count else 0.0 for n in range(MOST)}
            for count in range(1, len(sure) + 1) for rate in (2.0, 20.0)
        ]  # fmt: skip

    def hot(self, layout: Layout) -> NDArray[np.bool_]:
        out = np.zeros(layout.shape[1], bool)
        places = [int(self[f"x{n}"]) for n in range(1, int(self["columns"]) + 1)]
        out[[x for x in places if 0 <= x < len(out)]] = True
        return out

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        if not shot.level > 0:
            return None
        born = self._born(shot.seconds, shot.temperature) / shot.level
        return np.broadcast_to(born * self.hot(layout), layout.shape)
