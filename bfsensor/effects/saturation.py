"""Saturation: a full well below that of the nominal device; charge above it spills or is drained."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np

from bfsensor.effects.effect import Axes, Effect, Law, Layout, Parameter, Seen
from bfsensor.typing import FloatArray

UNEVEN = 3e-3
"""Relative scatter of a flat's charge from pixel to pixel, by response and illumination.

Chosen: twice as large, flats of 1e5 e- spill partly over 1.6 times the range of levels, and
their variance falls more slowly there."""

FAR = 5.0
"""Distance from the full well [standard deviations] beyond which no pixel, or every pixel, spills.

Derived: a Gaussian has 3e-7 of its pixels beyond 5 standard deviations."""

LAGS = 4
"""Largest lag along the column at which spilled charge is taken to correlate pixels [pixel].

Measured with ``_near(distance, 0.95)``: the covariance at lag 4 is at most 1 % of the variance."""

UNSURE = 0.1
"""Relative uncertainty of predictions near the full well, as :data:`UNEVEN` is not known: of the
deficit of the mean, of the kept or the lost variance (the smaller one), and of covariances.

Chosen: twice as large, flats within a per cent of the full well constrain it half as well."""

BRIGHTEST, SKEWED = 0.12, 0.01
"""Part of a spot's flux in its brightest pixel, at most, and uncertainty of the skewness [pixel^3] of
spots in which that pixel is full.  Derived: a Gaussian of 1.15 pixels.  Measured: with the full well of
another bench's campaign, skewness, which jumps where the next pixel fills, differs from the prediction
by 0.006 rms (14 exposures); with 0.02, it says nothing of the full well."""

CELLS = 4
"""Number of cells for each standard deviation in which the small simulation is interpolated.

Derived: a function whose second derivative is at most 0.4, the density of a Gaussian, is off by
0.4 / (8 CELLS^2) = 0.3 % of the variance at most, less than the simulation's 1 %."""

CLOSE = 5e-3 * np.arange(-4, 5)
"""Relative distances of first full wells from the level of the brightest flats.  Chosen: only within 2 %
of the full well is a part of a flat's pixels full.  Of starts 2 % apart no fit found a full well that
stood out by 148 standard deviations; of starts 1 % apart the nearest one lowered chi-square by 7 % of
what the fit does."""

ROUNDS = 200
"""Largest number of rounds in which excess charge moves by one pixel; after them it is lost.

Chosen: charge spreads over sqrt(200) = 14 pixels; twice as large, over 20, which only matters where
nearly all pixels of a column are full."""


class Saturation(Effect):
    """Charge above ``full_well`` spills to both neighbours in the column, half to each.

    The level of flats ends at the full well, where they lose their noise; the brightest spots grow
    in y.  Within a per cent of the full well a part of the pixels spills, and variances depend on
    the unevenness of the light (:data:`UNEVEN`): there they are uncertain by about ten per cent.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``full_well`` [e-]: 70000 to 115000 (200000 changes nothing).

    Examples
    --------
    >>> Saturation({"full_well": 90000.0}).name
    'saturation'
    """

    word = "saturation"
    stage = "collect"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "full_well",
            "e-",
            7e4,
            1.15e5,
            neutral=2e5,
            law="flat",
            amplitude=True,
            step=30.0,
        ),  # a tenth of the noise of a flat, on which scale its mean saturates
    )
    touches = ("flat_mean", "flat_cov", "spot")
    response = "rough"
    source = (
        "Blooming along the column past the barrier phases: Janesick 2001, Scientific "
        "Charge-Coupled Devices, SPIE Press PM83; even sharing and range assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        del seen
        places = list(np.linspace(7.5e4, 1.35e5, 5))
        flats = [s for s in layout.shots if s.kind == "flat" and s.seconds > 0]
        if np.isfinite(layout.turn_off):
            # Variance has collapsed there; the full well lies below, by up to a step of the levels.
            fainter = [s.level for s in flats if s.level < 0.97 * layout.turn_off]
            last = max(fainter, default=0.9 * layout.turn_off)
            places = [last + f * (layout.turn_off - last) for f in (0.05, 0.5, 0.95)]
        elif flats:
            # A level far below that of proportional light is the full well itself.
            rates = np.array([s.level / s.seconds for s in flats])
            full = [
                s.level for s, r in zip(flats, rates, strict=True) if r < 0.97 * rates.max()
            ]
            # Levels in electrons are as uncertain as the gain: some per cent to either side.
            # Without one, a part of the brightest flats' pixels may be full: seen within 2 % of it.
            brightest = max(s.level for s in flats)
            places = (
                [f * float(np.median(full)) for f in (0.93, 1.0, 1.07)]
                if full
                else places + [f * brightest for f in 1 + CLOSE]
            )
        return [{"full_well": float(v)} for v in places]

    def law(self) -> Law:
        return Law(full_well=np.inf if self.is_neutral() else self["full_well"])

    def _near(self, distance: float, uneven: float) -> tuple[float, FloatArray]:
        """Deficit of the mean and covariances near the full well: :func:`_near`."""
        return _between(distance, uneven, 0.0)

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        light = axes.get("light", axes["level"])
        if self.is_neutral():
            return np.zeros(len(light))
        out = np.minimum(light, self["full_well"]) - light
        sigma = np.sqrt(np.maximum(light, 1.0))
        distance = (self["full_well"] - light) / sigma
        for n in np.nonzero(np.abs(distance) <= FAR)[0]:
            short, _ = self._near(float(distance[n]), _unevenness(light[n], sigma[n]))
            out[n] -= short * sigma[n]
        return out

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        """Uncertainty of predictions near and above the full well, independent by flat, lag and spot."""
        if word not in ("flat_mean", "flat_cov", "spot") or self.is_neutral():
            return None
        if word == "spot":
            skew = np.isin(axes["what"], ("skew_x", "skew_y"))
            rows = np.flatnonzero(skew & (axes["flux"] * BRIGHTEST > self["full_well"]))
            out = np.zeros((len(skew), len(rows)))
            out[rows, np.arange(len(rows))] = SKEWED
            return out
        light = np.asarray(axes.get("light", axes["level"]), float)
        sigma = np.sqrt(np.maximum(light, 1.0))
        distance = (self["full_well"] - light) / sigma
        reach = FAR * np.hypot(1.0, UNEVEN * light / sigma)
        lag = np.zeros(len(light), int)
        near = (distance >= -FAR) & (distance <= (FAR if word == "flat_mean" else reach))
        if word == "flat_cov":
            lag = np.asarray(axes["j"]).astype(int)
            near &= (np.asarray(axes["i"]) == 0) & (lag <= LAGS)
        full = distance < -FAR
        rows = np.flatnonzero(near | full)
        out = np.zeros((len(light), len(rows)))
        for mode, n in enumerate(rows):
            if full[n]:
                # Where all pixels are full, the excess may stay, leave, or move on: the mean lies
                # between full well and light, a covariance between 0 and the variance of the light.
                out[n, mode] = (
                    (light[n] - self["full_well"]) if word == "flat_mean" else light[n]
                )
                out[n, mode] *= 12**-0.5 if word == "flat_cov" else 1.0
                continue
            short, left = self._near(float(distance[n]), _unevenness(light[n], sigma[n]))
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
            _, left = self._near(float(distance[n]), _unevenness(light[n], sigma[n]))
            # All covariances shrink like the variance; spilled charge correlates the column.
            out[n] *= left[0]
            for lag in range(1, LAGS + 1):
                out[n, [lag, -lag], 0] += left[lag] * sigma[n] ** 2
        return out


class DrainedSaturation(Saturation):
    """The part ``drain`` of the charge above ``full_well`` is lost, the rest spills along the column.

    With ``drain`` = 1 pixels are clipped: the charge goes to the substrate or to a surface layer.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``full_well`` [e-]: 70000 to 115000 (200000 changes nothing); ``drain``: 0
        to 1.

    Examples
    --------
    >>> DrainedSaturation({"full_well": 90000.0, "drain": 1.0}).name
    'saturation:drained'
    """

    variant = "drained"
    parameters = (
        *Saturation.parameters,
        Parameter("drain", "", 0.0, 1.0, law="flat", ends=(0.0, 1.0)),
    )
    source = (
        "Surface full well and anti-blooming drains: Janesick 2001, Scientific Charge-Coupled "
        "Devices, SPIE Press PM83, section 2.3; shares and range assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [s | {"drain": 0.9} for s in super().starts(layout, seen)]

    def law(self) -> Law:
        drain = float(np.clip(self["drain"], 0.0, 1.0))
        return super().law()._replace(drain=0.0 if self.is_neutral() else drain)

    def _near(self, distance: float, uneven: float) -> tuple[float, FloatArray]:
        # Linear between both ends: the simulation of each is kept, and derivatives need no more.
        part = float(np.clip(self["drain"], 0.0, 1.0))
        (short, left), (lost, less) = (_between(distance, uneven, d) for d in (0.0, 1.0))
        return (1 - part) * short + part * lost, (1 - part) * left + part * less


def _unevenness(light: float, sigma: float) -> float:
    """Scatter of the charge from pixel to pixel in standard deviations of its noise."""
    return UNEVEN * float(light) / float(sigma)


def _between(distance: float, uneven: float, drain: float) -> tuple[float, FloatArray]:
    """Interpolate :func:`_near` linearly on a grid of both: derivatives need no steps."""
    place = distance * CELLS, uneven * CELLS
    cell = int(np.floor(place[0])), int(np.floor(place[1]))
    parts = place[0] - cell[0], place[1] - cell[1]
    short, left = 0.0, np.zeros(LAGS + 1)
    for n, m in np.ndindex(2, 2):
        found = _near((cell[0] + n) / CELLS, (cell[1] + m) / CELLS, drain)
        weight = (parts[0] if n else 1 - parts[0]) * (parts[1] if m else 1 - parts[1])
        short, left = short + weight * found[0], left + weight * found[1]
    return short, left


@lru_cache(maxsize=1024)
def _near(distance: float, uneven: float, drain: float = 0.0) -> tuple[float, FloatArray]:
    """Deficit of the mean of a flat near the full well, and covariances along the column.

    Both come from a small simulation of pairs with fixed random numbers, with errors of 1 % of the
    variance.

    Parameters
    ----------
    distance : float
        Full well minus mean [standard deviations of the noise].
    uneven : float
        Fixed scatter from pixel to pixel, equal in both flats of a pair [same unit].
    drain : float
        Part of the spilled charge that is lost.

    Returns
    -------
    short : float
        Deficit of the mean below the light or the full well, the lower of both [same unit].
    left : ndarray, shape (LAGS + 1,)
        Covariances by lag over the variance without saturation.
    """
    rng = np.random.default_rng(70_251)
    shape = 256, 96
    noise = rng.standard_normal((2, *shape))
    noise /= noise.std()
    pattern = uneven * rng.standard_normal(shape)
    pairs = np.array([spilled(n + pattern, distance, drain=drain) for n in noise])
    before, after = np.diff(noise, axis=0)[0], np.diff(pairs, axis=0)[0]
    whole = before.var()
    left = [np.mean(after[lag:] * after[: len(after) - lag]) for lag in range(LAGS + 1)]
    own = [np.mean(before[lag:] * before[: len(after) - lag]) for lag in range(1, LAGS + 1)]
    found = np.array(left) / whole
    # Subtract the correlations that the fixed random numbers have by chance.
    found[1:] -= found[0] * np.array(own) / whole
    short = min(float((noise + pattern).mean()), distance) - float(pairs.mean())
    return short, found


def spilled(charge: FloatArray, full_well: float, *, drain: float = 0.0) -> FloatArray:
    """Spill the charge above the full well along the columns, half to each neighbour, repeatedly.

    Charge that reaches the end of a column leaves.  The final state does not depend on the order of
    the steps (an abelian sandpile).

    Parameters
    ----------
    charge : ndarray, shape (ny, nx)
        Charge of the pixels, in any unit; not changed.
    full_well : float
        Largest charge of a pixel, in the same unit.
    drain : float
        Part of the excess that is lost in each step, from 0 to 1.

    Returns
    -------
    charge : ndarray, shape (ny, nx)
        At most the full well.

    Examples
    --------
    >>> spilled(np.array([[0.0], [4.0], [0.0]]), 2.0).ravel()
    array([1., 2., 1.])
    """
    charge = charge.copy()
    for _ in range(ROUNDS):
        excess = np.maximum(charge - full_well, 0.0)
        if not excess.any():
            return charge
        charge -= excess
        half = 0.5 * (1 - drain) * excess
        charge[1:] += half[:-1]
        charge[:-1] += half[1:]
    return np.minimum(charge, full_well)
