"""Variance of images from which the brighter-fatter effect was taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.errors import MeasurementError
from bfsensor.measure.arrays import to_floats
from bfsensor.table.quadrant_shifts import quadrant_shifts
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray


def corrected_variance(
    corrected: ArrayLike,
    table: DistortionTable,
    *,
    read_noise: float = 0.0,
    mask: ArrayLike | None = None,
) -> FloatArray:
    r"""Give the variance of each pixel of a corrected image, for weight maps.

    Light arrives at random, and without the effect pixels share no noise: the variance of light is the
    corrected charge :math:`L` itself.  Read noise of variance :math:`\sigma^2` came after the effect;
    the correction takes it for charge, and amplifies it to

    .. math:: \mathrm{var} = L + \sigma^2 (1 - a_{00} L),
              \qquad \mathrm{cov}_{ij} = -\sigma^2 a_{ij} L ,

    with the area changes :math:`a_{ij}` of the table, :math:`a_{00}` below 0.  Electrons that came early
    acted for longer than those that came late, which the image does not show: by this even an exact
    correction leaves covariances of :math:`L^3 (a * a)_{ij} / 12` with the convolution :math:`a * a`,
    0.1 to 0.3 % of the variance at 80,000 e- for LSST's devices; they are not in the variance.

    Parameters
    ----------
    corrected : array_like, shape (ny, nx)
        Corrected image, with its sky [e-]; charges below 0 count as 0.
    table : DistortionTable
        Table of the correction.
    read_noise : float
        Standard deviation of the read noise [e-], at least 0.
    mask : array_like of bool, shape (ny, nx), optional
        True for pixels that were masked.

    Returns
    -------
    variance : ndarray, shape (ny, nx)
        Variance [e-^2], infinite in pixels that are masked or not finite: their weight is 0.

    Raises
    ------
    MeasurementError
        The image is not two-dimensional, the mask has another shape, or the read noise is not finite
        or below 0.

    Notes
    -----
    The measured charge stands for its expectation, as in all weight maps from images: weighted means
    of faint pixels are biased by that.  The term of read noise is of first order in the effect, and of
    flats; it is below a tenth of the read noise in pixels of less than 70,000 e-.

    Examples
    --------
    >>> table = DistortionTable.load("itl_sta3800c")
    >>> corrected_variance([[1e4, np.nan], [0.0, 5e4]], table, read_noise=5.0).round(1)
    array([[1.00253e+04,         inf],
           [2.50000e+01, 5.00266e+04]])
    """
    found = to_floats(corrected, "corrected")
    if found.ndim != 2:
        raise MeasurementError(f"corrected has the shape {found.shape}, not (ny, nx)")
    if not 0 <= read_noise < np.inf:
        raise MeasurementError(
            f"read_noise = {read_noise} e- must be finite and at least 0"
        )
    bad = ~np.isfinite(found)
    if mask is not None:
        given = np.asarray(mask)
        if given.shape != found.shape:
            raise MeasurementError(f"mask has the shape {given.shape}, not {found.shape}")
        bad |= given.astype(bool)
    deepest = float(quadrant_shifts(table, lags=2, tail_slope=None).areas[0, 0])
    light = np.maximum(np.where(bad, 0.0, found), 0.0)
    variance = light + read_noise**2 * (1 - deepest * light)
    variance[bad] = np.inf
    return np.asarray(variance)
