"""Settings of a lamp that no monitor records, from the levels of flats against their exposure times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import median_filter

from bfsensor.typing import FloatArray

LOWER = 0.8
"""Part of the level of a shorter exposure below which a longer one was taken with less light.  Chosen:
beyond full well levels of pixels stay or fall by a few per cent, and lamps flicker by less; with 0.9,
lamps set lower by a tenth are found where they take the brightest flats."""

ALIKE = 1 / LOWER
"""Factor between light per second within which exposures belong to one setting.  Derived: the inverse
of :data:`LOWER`."""

NEAREST = 15
"""Number of exposures of about the same light whose median is a level.  Chosen: their noise is a third
of one's; with 31, levels near full well are off by more."""


def lamp_settings(
    seconds: Sequence[float], levels: Sequence[float]
) -> tuple[NDArray[np.int64], FloatArray]:
    """Sort flats of one condition by the setting of the lamp.

    With one setting a longer exposure never collects less, whatever the sensor's response.  Flats
    that do were taken with less light, and so were those of about the same light per second, and
    longer ones that go on from them beyond full well.

    Parameters
    ----------
    seconds : sequence of float
        Exposure times [s], above 0.
    levels : sequence of float
        Mean levels [ADU].

    Returns
    -------
    settings : ndarray of int, shape (n,)
        0 is the setting of the most light, 1, 2 and so on dimmer ones, in the order found.
    light : ndarray, shape (n,)
        Median light per second of each flat's setting over that of setting 0.

    Examples
    --------
    >>> settings, light = lamp_settings([10, 20, 30, 40, 90], [1.0, 2.0, 3.0, 4.0, 3.0])
    >>> settings.tolist(), [round(float(x), 2) for x in light]
    ([0, 0, 0, 0, 1], [1.0, 1.0, 1.0, 1.0, 0.33])
    """
    times, level = np.asarray(seconds, float), np.asarray(levels, float)
    settings, light = np.zeros(len(times), int), np.ones(len(times))
    rate = level / times
    order = np.argsort(times, kind="stable")
    usual = np.ones(len(times), bool)
    while True:
        own = order[usual[order]]
        most = np.maximum.accumulate(level[own])
        less = own[level[own] < LOWER * most]
        if not len(less):
            break
        # The faintest light first: brighter settings are found in the next round.
        dimmest = rate[less].min()
        here = usual & (rate < ALIKE * dimmest) & (rate > dimmest / ALIKE)
        # Beyond full well the light per second falls from each exposure to the next longer one.
        last = order[here[order]][-1]
        for n in order[times[order] > times[last]]:
            if usual[n] and rate[last] / ALIKE < rate[n] <= rate[last]:
                here[n], last = True, n
        usual &= ~here
        settings[here] = settings.max() + 1
    for n in range(1, settings.max() + 1):
        here = settings == n
        light[here] = np.median(rate[here]) / np.median(rate[usual])
    return settings, light


EQUAL_LIGHT = 1.01
"""Largest factor between the light of exposures whose levels are taken to be equal.  Chosen: lamps
flicker by less; with 1.02, ladders in steps of 2 % are one level."""

CLEAR = 8.0
"""Departure of the exposures of one light from those near to it above which they keep their own level
[standard errors].  Chosen: noise reaches it in none of 1e6 campaigns even where the scatter is known
to a third only; with 16, the response may depart twice as far from a straight line before levels
follow it."""


def smoothed_levels(
    levels: ArrayLike,
    light: ArrayLike,
    groups: Sequence[ArrayLike],
    *,
    within: float = np.inf,
) -> FloatArray:
    """Levels of exposures without the flicker of their lamp: light times a local median.

    A prediction in proportion to a measured level follows its noise, so that an effect that changes
    all levels by a quarter would explain a quarter of the noise.

    Parameters
    ----------
    levels : array_like, shape (n,)
        Measured levels, in any unit.
    light : array_like, shape (n,)
        Exposure times, or times by readings of a lamp; where it is not above 0, levels stay.
    groups : sequence of array_like, shape (n,)
        Exposures that agree in all of these are compared.
    within : float
        Largest factor between the light of exposures that are compared, above 1: levels of one
        light say little of those of another where pixels are full.

    Returns
    -------
    levels : ndarray, shape (n,)

    Examples
    --------
    >>> noise = 0.01 * np.random.default_rng(3).standard_normal(40)
    >>> light = np.arange(1.0, 41.0)
    >>> found = smoothed_levels(5 * light * (1 + noise), light, ())
    >>> bool(np.std(found / light / 5) < 0.4 * np.std(noise))
    True
    """
    out, lit = np.array(levels, float), np.asarray(light, float)
    words = np.array([np.zeros(len(out)), *groups], float)
    _, group = np.unique(np.nan_to_num(words, nan=-1.0), axis=1, return_inverse=True)
    for n in range(int(group.max(initial=-1)) + 1):
        here = np.flatnonzero((group == n) & (lit > 0))
        here = here[np.argsort(lit[here], kind="stable")]
        if len(here):
            ends = np.flatnonzero(lit[here][1:] > within * lit[here][:-1]) + 1
            for own in np.split(here, ends):
                ratio = out[own] / lit[own]
                out[own] = _without_flicker(ratio, lit[own]) * lit[own]
    return out


def _without_flicker(ratio: FloatArray, light: FloatArray) -> FloatArray:
    """Local medians of levels over ascending light; those of equal light where these are clearly off.

    Where the response is not linear, a median over other levels is not that of this one.
    """
    smooth = median_filter(ratio, NEAREST, mode="mirror")
    equal = np.split(
        np.arange(len(light)), np.flatnonzero(light[1:] > EQUAL_LIGHT * light[:-1]) + 1
    )
    own = [float(np.median(ratio[rows])) for rows in equal]
    away = np.concatenate(
        [
            np.abs(ratio[rows] / m - 1)
            for rows, m in zip(equal, own, strict=True)
            if len(rows) > 1
        ]
        or [np.zeros(0)]
    )
    if not len(away):
        return np.asarray(smooth)
    # The flicker of one exposure: half of all pairs differ by less than 0.95 of it, from their mean
    # by half of that.
    scatter = float(np.median(away)) / 0.4769
    for rows, middle in zip(equal, own, strict=True):
        if abs(middle / np.median(smooth[rows]) - 1) > CLEAR * scatter / np.sqrt(len(rows)):
            smooth[rows] = middle
    return np.asarray(smooth)
