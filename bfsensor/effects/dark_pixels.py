"""Pixels of darks with charge: the fraction that counts as struck, and the mean of the others."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri
from scipy.stats import poisson

from bfsensor.effects.effect import Layout
from bfsensor.typing import FloatArray

OUTLIER = 6.0
"""Deviation from which the measurement counts a pixel as struck [sigma of the noise of a usual pixel].

Defined by ``OUTLIER`` of :mod:`bfsensor.diagnose.data.bias_channels`, which must be equal."""

LARGE = 900.0
"""Mean dark charge [e-] from which a Gaussian replaces the Poisson distribution.

Measured, both evaluated at this mean for read noise of 3 to 20 e-: the struck fraction differs by
less than 3e-5, the mean of the others by less than 0.2 e-."""


def usual_noise(mean: FloatArray, noise: float, more: float = 0.0) -> float:
    """Noise of a usual pixel [e-]: from the median difference of neighbours, read and shot noise.

    Parameters
    ----------
    mean : ndarray
        Mean dark charge of the pixels [e-].
    noise, more : float
        As for :func:`struck_pixels`.

    Examples
    --------
    >>> round(usual_noise(np.full(9, 40.0), 3.0), 3)
    7.0
    """
    part = np.linspace(0.005, 0.995, 100)
    sigma = np.sqrt(noise**2 * (1 + more) + np.maximum(np.quantile(mean, part), 0.0))
    if sigma[0] == sigma[-1]:
        return float(sigma[0])
    half = ndtri(0.75)

    def missed(size: float) -> float:
        return float(np.mean(2 * ndtr(half * size / sigma) - 1) - 0.5)

    return float(brentq(missed, sigma[0], sigma[-1]))


def struck_pixels(
    mean: float, level: float, noise: float, more: float = 0.0, usual: float = 0.0
) -> tuple[float, float]:
    """Fraction of pixels that count as struck, and the mean of the others.

    Parameters
    ----------
    mean : float
        Mean of their Poisson-distributed dark charge [e-].
    level : float
        Level from which deviations are counted, the median of all pixels [e-].
    noise : float
        Read noise [e-]; 0, where it is not known: no pixel is struck.
    more : float
        Variance that the subtracted mean bias adds, over that of the read noise.
    usual : float
        Noise of a usual pixel [e-]; 0 for that of a pixel at ``level``.

    Returns
    -------
    part : float
        Fraction of pixels that deviate by more than :data:`OUTLIER` times the noise of a usual pixel,
        read noise and shot noise.
    others : float
        Mean charge of the other pixels [e-]; ``mean`` if all are struck.

    Examples
    --------
    >>> struck_pixels(-1e-20, 0.0, 5.0), struck_pixels(3000.0, 0.0, 5.0)
    ((0.0, -1e-20), (1.0, 3000.0))
    >>> part, others = struck_pixels(200.0, 200.0, 5.0)
    >>> part < 1e-6, round(others, 3)
    (True, 200.0)
    """
    # At the end of its range an amplitude is 0 up to rounding, which may be negative.
    if not noise > 0 or not mean > 0:
        return 0.0, mean
    if mean < LARGE:
        number = np.arange(int(mean + 12 * np.sqrt(mean) + 20))
        weight, away = poisson.pmf(number, mean), number - level
        wide = noise * float(np.sqrt(1 + more))
    else:
        weight, away = np.ones(1), np.array([mean - level])
        wide = float(np.sqrt(noise**2 * (1 + more) + mean))
    limit = OUTLIER * (usual or float(np.sqrt(noise**2 * (1 + more) + max(level, 0.0))))
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
    """Variance that subtracting the mean bias adds to a dark, over that of the read noise."""
    return 1 / len(layout.biases) if layout.biases else 0.0
