"""Pixels of darks that hold charge without light: how many count as struck, and the others' mean."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr
from scipy.stats import poisson

from bfsensor.effects.effect import Layout

OUTLIER = 6.0
"""Deviation [sigma of the read noise] from which the measurement counts a pixel as struck."""

LARGE = 900.0
"""Mean number of electrons from which on a Gaussian is as good."""


def struck_pixels(
    mean: float, level: float, noise: float, more: float = 0.0
) -> tuple[float, float]:
    """Part of pixels that deviate by more than the limit, and the mean of the others.

    Parameters
    ----------
    mean : float
        Electrons in each, Poisson [e-].
    level : float
        What deviations are counted from [e-].
    noise : float
        Read noise [e-].
    more : float
        Variance that the subtracted mean bias adds, over that of the read noise.

    Returns
    -------
    part : float
        Struck.
    others : float
        Mean of the others [e-]; that of all if all are struck.

    Examples
    --------
    >>> struck_pixels(-1e-20, 0.0, 5.0), struck_pixels(3000.0, 0.0, 5.0)
    ((0.0, -1e-20), (1.0, 3000.0))
    """
    # At the end of a range an amplitude is 0 but for rounding, which may be below.
    if not noise > 0 or not mean > 0:
        return 0.0, mean
    if mean < LARGE:
        number = np.arange(int(mean + 12 * np.sqrt(mean) + 20))
        weight, away = poisson.pmf(number, mean), number - level
        wide = noise * float(np.sqrt(1 + more))
    else:
        weight, away = np.ones(1), np.array([mean - level])
        wide = float(np.sqrt(noise**2 * (1 + more) + mean))
    limit = OUTLIER * noise
    low, high = (-limit - away) / wide, (limit - away) / wide
    inside = ndtr(high) - ndtr(low)
    kept = float(weight @ inside)
    if kept < 1e-9:
        return 1.0, mean
    bell = (np.exp(-0.5 * high**2) - np.exp(-0.5 * low**2)) / np.sqrt(2 * np.pi)
    return 1.0 - kept / float(weight.sum()), level + float(
        weight @ (away * inside - wide * bell)
    ) / kept


def mean_bias(layout: Layout) -> float:
    """Variance that the mean bias adds to a dark's pixels, over that of the read noise."""
    return 1 / len(layout.biases) if layout.biases else 0.0
