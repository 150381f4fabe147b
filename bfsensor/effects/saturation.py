"""Full well that is lower than the card says."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Law, Layout, Parameter, Seen
from bfsensor.typing import FloatArray

UNEVEN = 3e-3
"""Relative scatter of a flat's light from pixel to pixel, response and shape (assumed)."""

FAR = 5.0
"""Distance from the full well [standard deviations] beyond which nothing spills, or all is full."""

LAGS = 4
"""Lags along the column at which spilled charge correlates pixels, as far as it is followed."""

UNSURE = 0.1
"""Part of what the mean of a flat near the full well lacks, of the lesser of what its variance
keeps and loses, and of its covariances, that the assumed unevenness leaves open (assumed)."""

ROUNDS = 200
"""Of spilling: charge that finds no room within so many is lost."""


class Saturation(Effect):
    """Charge beyond ``full_well`` spills to both neighbours in the column, half to either.

    Flats end at the full well and lose their noise; the brightest spots grow along y.  Within
    a per cent of the full well, where part of a flat's pixels spill, variances depend on the
    unevenness of the light, which is assumed: there they are good to some ten per cent.
    """

    word = "saturation"
    stage = "collect"
    parameters = (
        Parameter(
            "full_well",
            "e-",
            7e4,
            1.15e5,
            neutral=2e5,
            law="flat",
            amplitude=True,
            step=30.0,
        ),  # a tenth of a flat's noise, over which its mean bends
    )
    touches = ("flat_mean", "flat_cov", "spot")
    source = (
        "Blooming along the column past the barrier phases: Janesick 2001, Scientific "
        "Charge-Coupled Devices, SPIE Press PM83; even sharing and range assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        del seen
        places = list(np.linspace(7.5e4, 1.35e5, 5))
        flats = [s for s in layout.shots if s.kind == "flat" and s.seconds > 0]
        if flats:
            # A level that light in proportion would have left far behind is the full well itself.
            rates = np.array([s.level / s.seconds for s in flats])
            full = [
                s.level for s, r in zip(flats, rates, strict=True) if r < 0.97 * rates.max()
            ]
            # Levels are known as well as the gain.
            places = (
                [f * float(np.median(full)) for f in (0.93, 1.0, 1.07)] if full else places
            )
        return [{"full_well": float(v)} for v in places]

    def law(self) -> Law:
        return Law(full_well=np.inf if self.is_neutral() else self["full_well"])

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        light = axes.get("light", axes["level"])
        if self.is_neutral():
            return np.zeros(len(light))
        out = np.minimum(light, self["full_well"]) - light
        sigma = np.sqrt(np.maximum(light, 1.0))
        distance = (self["full_well"] - light) / sigma
        for n in np.nonzero(np.abs(distance) <= FAR)[0]:
            short, _ = _between(float(distance[n]), _unevenness(light[n], sigma[n]))
            out[n] -= short * sigma[n]
        return out

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        """What the closed forms near the full well leave open, of each flat and lag on its own."""
        if word not in ("flat_mean", "flat_cov") or self.is_neutral():
            return None
        light = np.asarray(axes.get("light", axes["level"]), float)
        sigma = np.sqrt(np.maximum(light, 1.0))
        distance = (self["full_well"] - light) / sigma
        reach = FAR * np.hypot(1.0, UNEVEN * light / sigma)
        lag = np.zeros(len(light), int)
        near = (distance >= -FAR) & (distance <= (FAR if word == "flat_mean" else reach))
        if word == "flat_cov":
            lag = np.asarray(axes["j"]).astype(int)
            near &= (np.asarray(axes["i"]) == 0) & (lag <= LAGS)
        rows = np.flatnonzero(near)
        out = np.zeros((len(light), len(rows)))
        for mode, n in enumerate(rows):
            short, left = _between(float(distance[n]), _unevenness(light[n], sigma[n]))
            left[0] = min(left[0], 1 - left[0])
            own = short * sigma[n] if word == "flat_mean" else left[lag[n]] * light[n]
            out[n, mode] = UNSURE * own
        return out

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        if self.is_neutral():
            return c
        light = axes.get("light", axes["level"])
        sigma = np.sqrt(np.maximum(c[:, 0, 0], 1.0))
        distance = (self["full_well"] - light) / sigma
        reach = FAR * np.hypot(1.0, UNEVEN * light / sigma)
        out = c.copy()
        out[distance < -FAR] = 0.0
        for n in np.nonzero((distance >= -FAR) & (distance < reach))[0]:
            _, left = _between(float(distance[n]), _unevenness(light[n], sigma[n]))
            # Each pixel keeps what it keeps of its variance; what was spilled, and room that
            # was filled, correlate the column.
            out[n] *= left[0]
            for lag in range(1, LAGS + 1):
                out[n, [lag, -lag], 0] += left[lag] * sigma[n] ** 2
        return out


def _unevenness(light: float, sigma: float) -> float:
    """Of the light from pixel to pixel, in standard deviations of its noise."""
    return UNEVEN * float(light) / float(sigma)


def _between(distance: float, uneven: float) -> tuple[float, FloatArray]:
    """As :func:`_near`, straight between tenths of both: a fit needs slopes and no steps."""
    tenths = int(np.floor(10 * distance)), int(np.floor(10 * uneven))
    parts = 10 * distance - tenths[0], 10 * uneven - tenths[1]
    short, left = 0.0, np.zeros(LAGS + 1)
    for n, m in np.ndindex(2, 2):
        found = _near((tenths[0] + n) / 10, (tenths[1] + m) / 10)
        weight = (parts[0] if n else 1 - parts[0]) * (parts[1] if m else 1 - parts[1])
        short, left = short + weight * found[0], left + weight * found[1]
    return short, left


@lru_cache(maxsize=1024)
def _near(distance: float, uneven: float) -> tuple[float, FloatArray]:
    """Flats near the full well: what their mean lacks, and covariances along the column.

    A small simulation of pairs with fixed random numbers, good to 1 % of the variance.

    Parameters
    ----------
    distance : float
        Full well less mean, in standard deviations of the noise.
    uneven : float
        Scatter that both flats of a pair share, in the same.

    Returns
    -------
    short : float
        Of the mean below that of the light or the full well, in standard deviations.
    left : ndarray, shape (LAGS + 1,)
        Covariances over the variance that the noise had.
    """
    rng = np.random.default_rng(70_251)
    shape = 256, 96
    noise = rng.standard_normal((2, *shape))
    noise /= noise.std()
    pattern = uneven * rng.standard_normal(shape)
    pairs = np.array([spilled(n + pattern, distance) for n in noise])
    before, after = np.diff(noise, axis=0)[0], np.diff(pairs, axis=0)[0]
    whole = before.var()
    left = [np.mean(after[lag:] * after[: len(after) - lag]) for lag in range(LAGS + 1)]
    own = [np.mean(before[lag:] * before[: len(after) - lag]) for lag in range(1, LAGS + 1)]
    found = np.array(left) / whole
    # What the fixed numbers correlate by chance.
    found[1:] -= found[0] * np.array(own) / whole
    short = min(float((noise + pattern).mean()), distance) - float(pairs.mean())
    return short, found


def spilled(charge: FloatArray, full_well: float) -> FloatArray:
    """Charge after what exceeds the full well has spilled along the columns, shape (ny, nx).

    In the limit of endless sharing no order of steps matters: a pile that topples.
    """
    charge = charge.copy()
    for _ in range(ROUNDS):
        excess = np.maximum(charge - full_well, 0.0)
        if not excess.any():
            return charge
        charge -= excess
        charge[1:] += 0.5 * excess[:-1]
        charge[:-1] += 0.5 * excess[1:]
    return np.minimum(charge, full_well)
