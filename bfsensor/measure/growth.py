"""Growth of spots that were simulated with the brighter-fatter effect and without it.

Both images hold the same electrons, so that the ratio of their widths has a fraction of the
error of either width.  Errors are jackknife errors: one spot is left out at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.errors import MeasurementError
from bfsensor.measure.arrays import to_floats
from bfsensor.measure.spot_fit import fit_spots
from bfsensor.measure.spots import Stamps
from bfsensor.typing import FloatArray

UNIT = 50_000.0
"""Electrons in the peak for which slopes are given [e-], as published by Lage et al. (2017)."""


@dataclass(frozen=True)
class Growth:
    """Relative growth of spot widths by the effect, level by level, and its slope.

    Attributes
    ----------
    peak : ndarray, shape (levels,)
        Signal in the peak without the effect [e-]: the fitted model in a pixel whose middle
        is the spot's centre.
    sigma : ndarray, shape (levels, 2)
        Rms widths in x and y without the effect [pixel].
    growth, growth_error : ndarray, shape (levels, 2)
        Growth of the widths in x and y, and its standard error [%].
    slope, slope_error : ndarray, shape (2,)
        Slope of the growth in x and y against the peak, through the origin, and its standard
        error [% for 50,000 e-].
    spots : int
        Number of spots.

    Examples
    --------
    :func:`measure_growth` makes one; its example shows the growth.
    """

    peak: FloatArray
    sigma: FloatArray = field(repr=False)
    growth: FloatArray
    growth_error: FloatArray = field(repr=False)
    slope: FloatArray
    slope_error: FloatArray
    spots: int


def measure_growth(
    on: ArrayLike, off: ArrayLike, *, stamp: int = 9, weights: str = "equal"
) -> Growth:
    """Measure the growth of spots level by level, and its slope.

    Parameters
    ----------
    on, off : array_like, shape (spots, levels, ny, nx)
        Images of each spot with the effect and without it [e-], with the spot in the middle;
        2 spots at least, ny and nx odd.
    stamp : int
        Side of the postage stamp that is fitted [pixel], odd.
    weights : {'equal', 'noise'}
        Weights of the pixels, see :func:`~bfsensor.measure.spot_fit.fit_spots`.

    Returns
    -------
    growth : Growth
        Growth by level, and its slope: the least-squares line through the origin, in which all
        levels have the same error.

    Raises
    ------
    MeasurementError
        Shapes do not match, images have no pixel in the middle, there are fewer than two spots,
        or a level cannot be fitted; the message has its index from 0.

    Examples
    --------
    >>> from bfsensor.measure.spot_model import Shape, integrate_gaussian
    >>> rng = np.random.default_rng(77)
    >>> x, y = rng.uniform(-0.5, 0.5, (2, 6))
    >>> off = 3e5 * integrate_gaussian(x, y, Shape(1.0, 1.0), 11)[:, None]
    >>> on = 3e5 * integrate_gaussian(x, y, Shape(1.005, 1.01), 11)[:, None]
    >>> found = measure_growth(on, off)
    >>> (found.growth.round(3) + 0.0).tolist()
    [[0.5, 1.0]]
    """
    on, off = to_floats(on, "images with the effect"), to_floats(off, "images without")
    if on.shape != off.shape or on.ndim != 4:
        raise MeasurementError(
            f"images with the effect {on.shape} and without {off.shape} must both be "
            "(spots, levels, rows, columns)"
        )
    spots, _, ny, nx = on.shape
    if ny % 2 == 0 or nx % 2 == 0:
        raise MeasurementError(
            f"images of {ny} x {nx} pixels have none in the middle: both sides must be odd"
        )
    if spots < 2:
        raise MeasurementError(
            f"{spots} spots: errors from leaving one out need 2 at least"
        )
    if stamp % 2 == 0 or not 3 <= stamp <= min(ny, nx):
        raise MeasurementError(
            f"stamp = {stamp} must be odd, from 3 to the side of the images, {min(ny, nx)}"
        )
    rows = slice(ny // 2 - stamp // 2, ny // 2 + stamp // 2 + 1)
    columns = slice(nx // 2 - stamp // 2, nx // 2 + stamp // 2 + 1)
    whole = _measure(on[..., rows, columns], off[..., rows, columns], weights)
    parts = []
    for left_out in range(spots):
        keep = np.arange(spots) != left_out
        parts.append(
            _measure(on[keep][..., rows, columns], off[keep][..., rows, columns], weights)
        )
    growth = np.array([p[2] for p in parts])
    slopes = np.array([p[3] for p in parts])
    factor = (spots - 1) / spots

    def error(values: FloatArray) -> FloatArray:
        return np.sqrt(factor * np.sum((values - values.mean(0)) ** 2, axis=0))

    return Growth(
        peak=whole[0], sigma=whole[1], growth=whole[2], growth_error=error(growth),
        slope=whole[3], slope_error=error(slopes), spots=spots,
    )  # fmt: skip


def _measure(on: FloatArray, off: FloatArray, weights: str) -> tuple[FloatArray, ...]:
    """Peaks, widths, growth by level, and slope of the growth."""
    peak, sigma, growth = [], [], []
    for level in range(on.shape[1]):
        try:
            wide, plain = (
                fit_spots(Stamps(images[:, level]), weights=weights, background=0.0)
                for images in (on, off)
            )
        except MeasurementError as error:
            raise MeasurementError(f"level {level}: {error}") from None
        peak.append(float(np.mean(plain.peak)))
        sigma.append((plain.sigma_x, plain.sigma_y))
        growth.append(
            (
                100 * (wide.sigma_x / plain.sigma_x - 1),
                100 * (wide.sigma_y / plain.sigma_y - 1),
            )
        )
    q, g = np.array(peak), np.array(growth)
    slope = UNIT * (q[:, None] * g).sum(0) / (q**2).sum()
    return q, np.array(sigma), g, slope
