"""Covariance matrix of measured covariances (Bartlett), and helpers for quadrants of lags."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.typing import FloatArray


def image_weights(lags: int) -> FloatArray:
    """Count the lags (+-i, +-j) of the plane for each lag of the quadrant: 1, 2 or 4.

    Parameters
    ----------
    lags : int
        Largest lag.

    Returns
    -------
    weights : ndarray, shape (lags + 1, lags + 1)
        Counts as [j, i]; a sum over the plane is that over the quadrant with these weights.

    Examples
    --------
    >>> image_weights(1)
    array([[1., 2.],
           [2., 4.]])
    """
    once = np.where(np.arange(lags + 1) == 0, 1.0, 2.0)
    return np.asarray(once[:, None] * once[None])


def unfold(quadrant: ArrayLike, reach: int | None = None) -> FloatArray:
    """Mirror a quadrant [j, i] to the plane of lags -reach to reach, 0 beyond its largest lag.

    Parameters
    ----------
    quadrant : array_like, shape (..., lags + 1, lags + 1)
        Values at lags from 0 to ``lags``.
    reach : int, optional
        Largest lag of the plane, at least ``lags``; by default ``lags``.

    Returns
    -------
    plane : ndarray, shape (..., 2 reach + 1, 2 reach + 1)
        Values with lag (0, 0) in the middle.
    """
    q = np.asarray(quadrant, float)
    lags = q.shape[-1] - 1
    at = np.abs(np.arange(-lags, lags + 1))
    plane = q[..., at[:, None], at[None]]
    more = (lags if reach is None else reach) - lags
    return np.pad(plane, [(0, 0)] * (q.ndim - 2) + [(more, more)] * 2)


def bartlett_matrix(covariances: ArrayLike, pairs: ArrayLike) -> FloatArray:
    r"""Covariance matrix of covariances measured on a Gaussian field.

    For the sum over N pairs, summed over all lags m of the plane,

    .. math::
        \mathrm{Cov}(\hat C_L, \hat C_M) = \frac1N \sum_m
            C_m C_{m + M - L} + C_{m + M} C_{m - L} ,

    and each measured value is the mean of the lags (i, j) and (i, -j).  White noise gives
    2 C_00^2 / N for the variance, C_00^2 / N on the axes and half of it off them.

    Parameters
    ----------
    covariances : array_like, shape (..., lags + 1, lags + 1)
        Covariances of the field, modelled or measured, indexed [j, i]; they are taken as 0
        beyond the largest lag.
    pairs : array_like, same shape
        Number of pairs of pixels at each lag (i, j), without those of (i, -j).

    Returns
    -------
    matrix : ndarray, shape (..., (lags + 1)**2, (lags + 1)**2)
        Covariance matrix, with lags flattened as ``[j, i]``.

    References
    ----------
    Bartlett 1946, J. R. Stat. Soc. Suppl. 8, 27, for two dimensions.

    Examples
    --------
    >>> white = np.array([[2.0, 0.0], [0.0, 0.0]])
    >>> np.diag(bartlett_matrix(white, np.full((2, 2), 100)))
    array([0.08, 0.04, 0.04, 0.02])
    """
    c = np.asarray(covariances, float)
    counts = np.asarray(pairs, float)
    lags = c.shape[-1] - 1
    # C is even in both axes, so that the sum over m is the convolution of C with itself, g:
    # Cov(L, M) = [g(L - M) + g(L + M)] / N.  The plane is twice as wide as the lags, for the
    # convolution must not wrap around.
    plane = np.fft.ifftshift(unfold(c, 2 * lags), axes=(-2, -1))
    g = np.fft.ifft2(np.fft.fft2(plane).real ** 2).real
    j, i = (index.ravel() for index in np.indices(c.shape[-2:]))
    dj, di = j[:, None], i[:, None]
    # g is even too: of the means over (i, +-j) and (k, +-l) two different terms of each sign remain.
    matrix = 0.5 * (
        g[..., dj - j, di - i]
        + g[..., dj + j, di + i]
        + g[..., dj - j, di + i]
        + g[..., dj + j, di - i]
    )
    root = np.sqrt(counts.reshape(*counts.shape[:-2], -1))
    return np.asarray(matrix / (root[..., :, None] * root[..., None, :]))
