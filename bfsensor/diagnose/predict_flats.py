"""Covariances of flats in closed form, from boundary shifts."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

GRID = 48
"""Side of the periodic array of the closed form: shifts of 21 x 21 pixels fold thrice over."""


def flat_covariances_of(
    a: NDArray[np.float64], levels: ArrayLike, *, lags: int
) -> NDArray[np.float64]:
    r"""Covariances of flats of given levels.

    .. math::
        C = \mathrm{FFT}^{-1}\, \frac{e^{2 \hat a m} - 1}{2 \hat a},

    the solution of :math:`d\tilde C / dm = 1 + 2 \hat a \tilde C`: areas follow charge, charge
    follows areas, to all orders of a response that is linear in charge.

    Parameters
    ----------
    a : ndarray, odd sides
        Area change per electron [1/e-], lag (0, 0) in the middle; shape (ny, nx), or (n, ny, nx)
        where each level has its own.
    levels : array_like, shape (n,)
        Mean electrons m [e-].
    lags : int
        Largest lag.

    Returns
    -------
    covariances : ndarray, shape (n, lags + 1, lags + 1)
        Of the lags (i, j), the mean of (i, j) and (i, -j) [e-^2].

    Examples
    --------
    >>> a = np.zeros((3, 3))
    >>> a[1] = [1e-7, -2e-7, 1e-7]
    >>> flat_covariances_of(a, [1e5], lags=1)[0].round(0)
    array([[98039.,   974.],
           [    0.,     0.]])
    """
    ny, nx = a.shape[-2:]
    wide = np.zeros((*a.shape[:-2], GRID, GRID))
    wide[..., :ny, :nx] = a
    wide = np.roll(wide, (-(ny // 2), -(nx // 2)), (-2, -1))
    a_k = np.fft.fft2(wide).real
    m = np.asarray(levels, float)[:, None, None]
    x = 2 * a_k * m
    small = np.abs(x) < 1e-9
    power = m * np.where(small, 1 + x / 2, np.expm1(x) / np.where(small, 1.0, x))
    c = np.fft.ifft2(power).real
    side = np.arange(lags + 1)
    return np.asarray(0.5 * (c[:, side[:, None], side] + c[:, -side[:, None], side]))
