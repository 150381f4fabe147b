"""Sizes of the stars of an image, and their slopes against the charge in the peak."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import MeasurementError
from bfsensor.measure.arrays import to_floats
from bfsensor.measure.slopes import UNIT_PEAK
from bfsensor.measure.spot_moments import measure_moments
from bfsensor.measure.spots import SpotList, cut_stamps
from bfsensor.typing import FloatArray

CLIP = 4.0
"""Distance from the line, in robust standard deviations, beyond which a star is left out of a slope.

Chosen: galaxies and blends are farther off; with 8, 5 % of galaxies among stars change slopes by their
error."""

ROUNDS = 5
"""Number of times that stars off the line are left out.  Chosen: the third leaves out none more on
Gaussian noise; with 10 nothing changes."""

FEWEST = 8
"""Smallest number of stars from which slopes are taken.  Chosen: with 16, images of sparse fields have
none; with less than 8 a single blend of two stars moves the line."""


class SizeSlope(NamedTuple):
    """Slope of star sizes against the charge in the peak, and its error.

    Attributes
    ----------
    x, y : float
        Growth of the second moments in x and y for :data:`~bfsensor.measure.slopes.UNIT_PEAK` more
        electrons in the peak [%].
    x_error, y_error : float
        Their standard errors by the scatter of the stars [%].
    ellipticity, ellipticity_error : float
        Change of (xx - yy) / (xx + yy) for as many electrons, and its error.
    stars : int
        Number of stars that the slopes are of.
    """

    x: float
    y: float
    x_error: float
    y_error: float
    ellipticity: float
    ellipticity_error: float
    stars: int


def star_sizes(
    image: ArrayLike,
    stars: SpotList,
    *,
    stamp: int,
    background: float,
    mask: ArrayLike | None = None,
) -> FloatArray:
    """Measure the adaptive moments of stars in an image.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        Charge [e-].
    stars : SpotList
        The stars, from :func:`bfsensor.measure.find_spots` with the same stamp.
    stamp : int
        Side of the square stamps [pixel], odd.
    background : float
        Charge below the stars [e-].
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad; a star with one in its stamp has no moments.

    Returns
    -------
    moments : ndarray, shape (n, 2)
        Second moments in x and y [pixel^2], nan where a star has none.

    Raises
    ------
    MeasurementError
        The stamps do not fit.

    Examples
    --------
    >>> from bfsensor.measure import find_spots
    >>> y, x = np.indices((41, 41)) - 20
    >>> image = 1e4 * np.exp(-0.5 * (x**2 / 1.5**2 + y**2 / 2.0**2))
    >>> stars = find_spots(image, threshold=5e3, stamp=21)
    >>> star_sizes(image, stars, stamp=21, background=0.0).round(3)
    array([[2.25, 4.  ]])
    """
    stamps = cut_stamps(to_floats(image, "image"), stars, size=stamp, mask=mask)
    found = measure_moments(stamps, background=background)
    return np.stack([found.xx, found.yy], axis=1)


def size_slopes(
    peaks: Sequence[ArrayLike], *versions: Sequence[ArrayLike]
) -> tuple[SizeSlope, ...]:
    """Fit the growth of star sizes with the charge in the peak, over several images.

    Each image has a size of its own, as seeing changes; the relative growth is common to all.  Stars
    that are off the line in one version of the images are left out of all.

    Parameters
    ----------
    peaks : sequence of array_like, each of shape (n,)
        Charge in the brightest pixel of each star above its background [e-], an entry an image.
    *versions : sequence of array_like, each of shape (n, 2)
        Second moments in x and y [pixel^2], an entry an image, of each version of the images, such as
        before and after a correction; stars with nan are left out.

    Returns
    -------
    slopes : tuple of SizeSlope
        One for each version.

    Raises
    ------
    MeasurementError
        There are fewer stars than :data:`FEWEST`, or all have the same peak.

    Examples
    --------
    >>> peaks = np.linspace(1e4, 1e5, 10)
    >>> sizes = np.stack([2 + 4e-7 * peaks, 2 + 6e-7 * peaks], axis=1)
    >>> (slope,) = size_slopes([peaks], [sizes])
    >>> print(f"{slope.x:.3f} {slope.y:.3f} {slope.stars}")
    1.000 1.500 10
    """
    charge = np.concatenate([to_floats(p, "peaks") for p in peaks]) / UNIT_PEAK
    image = np.repeat(np.arange(len(peaks)), [len(np.asarray(p)) for p in peaks])
    good = np.isfinite(charge)
    values = []
    for moments in versions:
        sizes = np.concatenate([to_floats(m, "moments").reshape(-1, 2) for m in moments])
        good &= np.all(np.isfinite(sizes), axis=1)
        x, y = sizes.T
        values.append((x, y, (x - y) / (x + y)))
    for _ in range(ROUNDS):
        lines = [[_line(image, charge, v, good) for v in version] for version in values]
        off = np.zeros(len(charge), bool)
        for line in itertools.chain(*lines):
            off |= np.abs(line.residuals) > CLIP * line.scatter
        if not np.any(off & good):
            break
        good &= ~off
    # Growth is relative to the size without charge, the mean of the images' own.
    return tuple(
        SizeSlope(
            100 * x.slope / x.start, 100 * y.slope / y.start, 100 * x.error / x.start,
            100 * y.error / y.start, e.slope, e.error, int(good.sum()),
        )
        for x, y, e in lines
    )  # fmt: skip


class _Line(NamedTuple):
    """Slope of a line with an offset an image, its mean start, and what stars are off it."""

    slope: float
    error: float
    start: float
    residuals: FloatArray
    scatter: float


def _line(
    image: NDArray[np.int64],
    charge: FloatArray,
    values: FloatArray,
    good: NDArray[np.bool_],
) -> _Line:
    """Fit a line with an offset for each image by least squares; errors by the scatter."""
    images = np.unique(image[good])
    free = int(good.sum()) - len(images) - 1
    if good.sum() < FEWEST or free < 1:
        raise MeasurementError(
            f"slopes of star sizes need {FEWEST} stars with moments, not {int(good.sum())}: lower the "
            "threshold, or give more images"
        )
    q, v, which = charge[good], values[good], np.searchsorted(images, image[good])
    count = np.bincount(which)
    mean_q, mean_v = (np.bincount(which, a) / count for a in (q, v))
    dq = q - mean_q[which]
    spread = float(dq @ dq)
    if not spread > 1e-12 * float(q @ q):
        raise MeasurementError("slopes of star sizes need stars of different peaks")
    slope = float(dq @ v) / spread
    offsets = np.full(int(image.max()) + 1, np.nan)
    offsets[images] = mean_v - slope * mean_q
    left = values - offsets[image] - slope * charge
    scatter = 1.4826 * float(np.median(np.abs(left[good])))
    error = float(np.sqrt(np.mean(left[good] ** 2) * len(q) / free / spread))
    start = float(np.average(offsets[images], weights=count))
    # Round-off of exact lines leaves no star out.
    return _Line(slope, error, start, left, max(scatter, 1e-9 * abs(start), 1e-12))
