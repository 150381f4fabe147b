"""Additional dark current, in all pixels, in hot columns, or as the glow of a corner."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from bfsensor.device.parts import Material
from bfsensor.effects.dark_pixels import OUTLIER, mean_bias, struck_pixels, usual_noise
from bfsensor.effects.effect import Axes, Effect, Image, Layout, Parameter, Seen, Shot
from bfsensor.typing import FloatArray

REFERENCE = 173.15
"""Temperature [K] for which rates are defined: -100 C, exactly."""

MOST = 6
"""Largest number of hot columns.

Chosen: each takes a parameter ``x1``, ``x2`` ...; twice as large, the search has twice as many
starts, and up to twelve columns are explained."""

OTHERS = range(2, MOST + 1)
"""Numbers of the hot columns after the first.  Derived from :data:`MOST`."""

SURE = 5.0
"""Significance from which a column of darks counts as hot in the starts [sigma].

Chosen: twice as large, columns between 5 and 10 sigma begin as cold, unless none is hotter."""

SOURCE = (
    "Generation in depleted silicon: Sah, Noyce & Shockley 1957, Proc. IRE 45, 1228; Widenhorn et al. "
    "2002, Proc. SPIE 4669, 193; Widenhorn et al. 2010, J. Appl. Phys. 107 (222 to 291 K); ranges "
    "assumed"
)


def warmth(temperature: FloatArray | float) -> FloatArray:
    """Dark current at a temperature over that at :data:`REFERENCE`, 1 where the temperature is NaN.

    Depleted silicon generates charge at traps in the middle of the band gap in proportion to the
    intrinsic density, T^(3/2) exp(-E_g / 2kT), which doubles in 3.1 K at 173 K and in 5.7 K at 235 K.
    Of neutral silicon, above some 260 K, and of traps elsewhere in the gap it rises faster (Widenhorn
    et al. 2002: E_g / 2 to E_g).

    Parameters
    ----------
    temperature : float or ndarray
        Temperature [K].

    Returns
    -------
    ndarray, shape of ``temperature``
        Ratio of the two dark currents.

    Examples
    --------
    >>> warmth([173.15, 193.15]).round(1)
    array([ 1. , 57.4])
    """
    kelvin = np.nan_to_num(np.asarray(temperature, float), nan=REFERENCE)
    each, which = np.unique(kelvin, return_inverse=True)
    usual = Material().intrinsic_density(REFERENCE)
    ratio = np.array([Material().intrinsic_density(t) / usual for t in each.tolist()])
    return ratio[which].reshape(kelvin.shape)


class _Dark(Effect):
    """Dark current of ``rate`` [e-/s] in columns, or a part of it; subclasses choose them."""

    word = "dark_hot"
    stage = "store"
    source = SOURCE

    def hot(self, layout: Layout) -> FloatArray:
        """Part of this dark current in each column of the sensor, shape (nx,)."""
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

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        hot = self.hot(layout)
        part = np.array([
            hot[s.sensor_column(np.arange(s.columns))].mean() for s in layout.segments
        ])  # fmt: skip
        amp = np.asarray(axes["amp"]).astype(int)
        return part[amp] * self._born(axes["time"], axes["temperature"])

    def dark_map(self, axes: Axes, layout: Layout) -> FloatArray:
        noise, more = layout.noise, mean_bias(layout)
        hot = self.hot(layout)
        out = np.zeros(len(axes["time"]))
        born = self._born(axes["time"], axes["temperature"])
        for amp, segment in enumerate(layout.segments):
            own = np.asarray(axes["amp"]).astype(int) == amp
            read = hot[segment.sensor_column(np.arange(segment.columns))]
            parts, which, count = np.unique(read, return_inverse=True, return_counts=True)
            usual = float(np.median(read))
            for mean in np.unique(born[own]):
                # Levels leave out what deviates from the median of all pixels, columns and numbers of
                # struck pixels what deviates from that of its column, unless the column is hot.
                one = float(noise[amp]), more
                level = float(mean * usual)
                struck, others = np.transpose([
                    struck_pixels(float(mean * p), level, *one) if p else (0.0, 0.0)
                    for p in parts
                ])  # fmt: skip
                width = float(np.sqrt(one[0] ** 2 * (1 + more) + max(level, 0.0)))
                beyond = np.array([
                    struck_pixels(float(mean * p), float(mean * p), *one, width)[0] if p else 0.0
                    for p in parts
                ])  # fmt: skip
                rows = own & (born == mean)
                what = axes["what"][rows]
                kept = count * (1 - struck)
                column = np.zeros(len(what))
                at = what == "column"
                value = mean * parts
                column[at] = value[which[axes["x"][rows][at].astype(int)]]
                column[at] -= value[parts == usual].sum()
                hit = float((beyond * (struck <= 0.5)) @ count) * segment.rows
                mixed = float(kept @ others) / float(kept.sum())
                out[rows] = np.where(what == "struck", hit, np.where(at, column, mixed))
        return out

    def _born(
        self, seconds: FloatArray | float, temperature: FloatArray | float
    ) -> FloatArray:
        """Mean dark charge of a pixel of these columns [e-]."""
        return np.asarray(self["rate"] * np.asarray(seconds, float) * warmth(temperature))


class DarkCurrent(_Dark):
    """Dark current of ``rate`` [e-/s at -100 C] in every pixel; :func:`warmth` says it elsewhere.

    Of recordings whose temperature is not known, every fit has a free dark current proportional to
    time: only the Poisson noise of this one, in struck pixels of darks, then constrains ``rate``.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rate`` [e-/s]: 0.02 to 1 (0 changes nothing).

    Examples
    --------
    >>> DarkCurrent({"rate": 0.1}).name
    'dark_hot:dark'
    """

    variant = "dark"
    parameters = (Parameter("rate", "e-/s", 0.02, 1.0, amplitude=True),)
    touches = ("dark_map", "flat_mean")
    needs: ClassVar[tuple[str, ...]] = ("pixels",)

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"rate": rate} for rate in (0.05, 0.3, 0.7, 1.2)]

    def hot(self, layout: Layout) -> FloatArray:
        return np.ones(layout.shape[1])


class HotColumns(_Dark):
    """Dark current of ``rate`` [e-/s at -100 C] in one column, and a part of it in others.

    ``columns`` is their number, ``x1``, ``x2`` ... are their places on the sensor from 0, and ``part2``,
    ``part3`` ... the dark current of all but the first, over that of the first.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rate`` [e-/s]: 1 to 50 (0 changes nothing); ``columns``: 1 to 6, whole;
        ``x1`` to ``x6`` [pixel]: columns of the sensor from 0, whole; ``part2`` to ``part6``: 0.02 to
        1, searched but not fitted.

    Examples
    --------
    >>> HotColumns({"rate": 5.0, "columns": 2, "x1": 17, "x2": 30, "part2": 0.5}).name
    'dark_hot:hot'
    """

    variant = "hot"
    parameters = (
        Parameter("rate", "e-/s", 1.0, 50.0, amplitude=True),
        Parameter("columns", "", 1, MOST, law="whole"),
        Parameter("x1", "pixel", 0, 1e4, law="whole"),
        *(Parameter(f"x{n}", "pixel", 0, 1e4, law="whole", plain=0.0) for n in OTHERS),
        *(Parameter(f"part{n}", "", 0.02, 1.0, law="whole", plain=1.0) for n in OTHERS),
    )
    touches = ("dark_map", "flat_map", "flat_mean")
    maps_vary = "exposure"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Begin with the columns that are significantly hot in darks: all of them, and fewer."""
        places: dict[int, float] = {}
        for s in seen:
            if s["word"] == "dark_map" and s.get("what") == "column" and "x" in s:
                amp = s.get("amp", 0)
                segment = layout.segments[
                    int(amp) if isinstance(amp, int | np.integer) else 0
                ]
                column = int(segment.sensor_column(np.array(int(s["x"][0]))))
                places[column] = max(places.get(column, 0.0), float(s.get("z", SURE)))
        order = sorted(places, key=lambda x: -places[x])
        # Only significant ones: a hot column raises the mean, below which others then seem cold.
        sure = [x for x in order if places[x] >= SURE][:MOST] or order[:1]
        parts = [places[x] / max(places[sure[0]], SURE) for x in sure]
        return [
            {"rate": rate, "columns": float(count)}
            | {f"x{n + 1}": float(sure[n]) for n in range(count)}
            | {f"part{n + 1}": parts[n] for n in range(1, count)}
            for count in range(1, len(sure) + 1) for rate in (2.0, 20.0)
        ]  # fmt: skip

    def hot(self, layout: Layout) -> FloatArray:
        out = np.zeros(layout.shape[1])
        for n in range(1, int(self["columns"]) + 1):
            x = int(self[f"x{n}"])
            if 0 <= x < len(out):
                out[x] = self[f"part{n}"] if n > 1 else 1.0
        return out

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        if not shot.level > 0:
            return None
        born = self._born(shot.seconds, shot.temperature) / shot.level
        return np.broadcast_to(born * self.hot(layout), layout.shape)


class Glow(Effect):
    """Glow of ``rate`` [e-/s] at a corner of the sensor, which falls as exp(-r / length).

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``rate`` [e-/s]: 0.02 to 20 (0 changes nothing); ``length`` [pixel]: 10 to
        1000; ``corner``: 0 to 3, whole, of (first column, first row), (last, first), (first, last),
        (last, last).

    Examples
    --------
    >>> Glow({"rate": 0.5, "length": 60.0, "corner": 0}).name
    'dark_hot:glow'
    """

    word = "dark_hot"
    variant = "glow"
    stage = "store"
    parameters = (
        Parameter("rate", "e-/s", 0.02, 20.0, amplitude=True),
        Parameter("length", "pixel", 10.0, 1000.0),
        Parameter("corner", "", 0, 3, law="whole"),
    )
    touches = ("dark_map", "flat_map", "flat_mean")
    maps_vary = "exposure"
    needs: ClassVar[tuple[str, ...]] = ("pixels",)
    source = (
        "Glow of an output amplifier, which falls with the distance from it: Janesick 2001, Scientific "
        "Charge-Coupled Devices, SPIE Press, section 7.2; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"rate": 0.5, "length": length, "corner": float(corner)}
            for corner in range(4) for length in (30.0, 120.0)
        ]  # fmt: skip

    def store(
        self,
        charge: Image,
        shot: Shot,
        layout: Layout,
        rng: np.random.Generator,
        memory: dict[str, NDArray],
    ) -> Image:
        if self["rate"] == 0:
            return charge
        mean = self._light(layout) * shot.seconds
        return charge + rng.poisson(mean).astype(charge.dtype)

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        return self._light(layout) * shot.seconds / shot.level if shot.level > 0 else None

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        light = self._light(layout)
        part = np.array([
            light[s.y : s.y + s.rows, s.sensor_column(np.arange(s.columns))].mean()
            for s in layout.segments
        ])  # fmt: skip
        return part[np.asarray(axes["amp"]).astype(int)] * np.asarray(axes["time"], float)

    def dark_map(self, axes: Axes, layout: Layout) -> FloatArray:
        noise, more = layout.noise, mean_bias(layout)
        out = np.zeros(len(axes["time"]))
        light = self._light(layout)
        for amp, s in enumerate(layout.segments):
            own = np.asarray(axes["amp"]).astype(int) == amp
            glow = light[s.y : s.y + s.rows, s.sensor_column(np.arange(s.columns))]
            for seconds in np.unique(axes["time"][own]):
                rows = own & (axes["time"] == seconds)
                part, kept = self._seen(glow * seconds, float(noise[amp]), more)
                # Particles in columns stand out of these, by the noise of a usual pixel.
                charge = glow * seconds
                limit = OUTLIER * usual_noise(charge, float(noise[amp]), more)
                away = np.abs(charge - np.median(charge, axis=0))
                wide = np.sqrt(float(noise[amp]) ** 2 * (1 + more) + charge)
                cold = part.mean(0) <= 0.5
                beyond = ndtr((away - limit) / wide) + ndtr((-away - limit) / wide)
                hit = float((beyond * (charge > 0) * cold).sum())
                near = (away <= limit) | ~cold
                columns = (charge * near).sum(0) / np.maximum(near.sum(0), 1)
                what, x = axes["what"][rows], axes["x"][rows].astype(int)
                column = (columns - np.median(columns))[np.clip(x, 0, len(columns) - 1)]
                level = float((kept * (1 - part)).sum() / max((1 - part).sum(), 1e-9))
                out[rows] = np.select(
                    [what == "struck", what == "column"], [hit, column], level
                )
        return out

    def _seen(
        self, mean: FloatArray, noise: float, more: float
    ) -> tuple[FloatArray, FloatArray]:
        """Fraction of pixels that count as struck, and the mean of the others, by mean charge."""
        # A function of one smooth variable: interpolate it between forty means.
        top = float(np.max(mean))
        if not top > 0:
            return np.zeros(mean.shape), mean
        knots = np.append(0.0, np.geomspace(1e-3 * top, top, 40))
        level = float(np.median(mean))
        usual = usual_noise(mean, noise, more)
        found = np.array(
            [struck_pixels(float(m), level, noise, more, usual) for m in knots]
        )
        return np.interp(mean, knots, found[:, 0]), np.interp(mean, knots, found[:, 1])

    def _light(self, layout: Layout) -> FloatArray:
        """Glow by pixel of the sensor [e-/s]."""
        return self["rate"] * _fall(self["length"], int(self["corner"]), layout.shape)


@lru_cache(maxsize=2)
def _fall(length: float, corner: int, shape: tuple[int, int]) -> FloatArray:
    """Fall of a glow with the distance from a corner; the same in all exposures."""
    (ny, nx), right, top = shape, corner % 2, corner // 2
    x, y = np.arange(nx) + 0.5, np.arange(ny) + 0.5
    away = np.hypot((nx - x if right else x)[None], (ny - y if top else y)[:, None])
    return np.asarray(np.exp(-away / length))
