"""Covariances of flats in closed form, from boundary shifts."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft2, next_fast_len, rfft2

from bfsensor.effects.effect import Law
from bfsensor.typing import FloatArray

GRID = 48
"""Side of the periodic array of the closed form [pixel]. Chosen: more than twice the window of 21
pixels, so that lags do not overlap to second order in the shifts; twice as large takes four times as
long."""

NODES = 12
"""Number of Gauss-Legendre nodes of the integral over charge. Measured: at 1.5e5 e- and a_00 of -2e-6
/ e-, 6 nodes differ from 48 by less than 1e-12 of the largest value, and so do 12."""

LINEAR = Law()
"""Collection with shifts proportional to the stored charge, without loss or full well."""


def flat_covariances_of(
    a: FloatArray, levels: ArrayLike, *, lags: int, law: Law = LINEAR
) -> FloatArray:
    r"""Calculate the covariances of flats of given levels in closed form.

    .. math::
        C = \mathrm{FFT}^{-1}\, \frac{e^{2 \hat a m} - 1}{2 \hat a},

    the solution of :math:`d\tilde C / dm = 1 + 2 \hat a \tilde C`: area changes are proportional to
    the charge, and new charge to the areas, to all orders of such a linear response.

    Parameters
    ----------
    a : ndarray, odd sides
        Area change per electron [1/e-], lag (0, 0) in the middle; shape (ny, nx), or (n, ny, nx)
        where each level has its own.
    levels : array_like, shape (n,)
        Mean levels m [e-].
    lags : int
        Largest lag in x and y [pixel].
    law : Law
        Departure of the collection from shifts proportional to charge.

    Returns
    -------
    covariances : ndarray, shape (n, lags + 1, lags + 1)
        ``covariances[:, j, i]``: mean of lags (i, j) and (i, -j) [e-^2].

    Examples
    --------
    >>> a = np.zeros((3, 3))
    >>> a[1] = [1e-7, -2e-7, 1e-7]
    >>> flat_covariances_of(a, [1e5], lags=1)[0].round(0)
    array([[98039.,   974.],
           [    0.,     0.]])
    """
    c = periodic_covariances(a, levels, law=law)
    return quadrant(c, lags)


def periodic_covariances(
    a: FloatArray, levels: ArrayLike, *, law: Law = LINEAR
) -> FloatArray:
    r"""Calculate covariances of flats at all lags of a periodic array, lag (0, 0) first [e-^2].

    With the law's quadratic term b and loss q the power spectrum follows
    :math:`d\tilde C / dm = 1 + 2 (\hat a (1 + b m) - q) \tilde C`: the response to a small
    change of Q (1 + b Q / 2) about the level m, and light that is lost where there is more
    charge; m is what is collected.

    Parameters
    ----------
    a, levels, law
        As for :func:`flat_covariances_of`.

    Returns
    -------
    covariances : ndarray, shape (n, side, side)
        The side is :data:`GRID`, or larger for wider area changes.
    """
    side = side_of(a)
    # Covariances depend on the even part of the area changes alone, whose transform is real.
    a_k = transform_areas(a, side) - law.loss
    m = np.asarray(levels, float)[:, None, None]
    if law.bend or law.losses:
        # Integrate over the charge s at which a fluctuation arose; the integrand is smooth.
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        power = np.zeros(np.broadcast_shapes(a_k.shape, m.shape))
        a_bent = law.bend * (a_k + law.loss)
        rest = law._replace(loss=0.0)
        for node, weight in zip(0.5 * (nodes + 1), 0.5 * weights, strict=True):
            s = node * m
            grown = 2 * a_k * (m - s) + a_bent * (m**2 - s**2)
            if law.losses:
                grown = grown - 2 * (rest.lost(m) - rest.lost(s))
            power += weight * m * np.exp(grown)
    else:
        x = 2 * a_k * m
        small = np.abs(x) < 1e-9
        # A search may try area changes that overflow: these become infinite and are rejected.
        with np.errstate(over="ignore"):
            grown = np.expm1(x)
        power = m * np.where(small, 1 + x / 2, grown / np.where(small, 1.0, x))
    return np.asarray(irfft2(power, s=(side, side)))


def quadrant(c: FloatArray, lags: int) -> FloatArray:
    """Covariances at lags from 0, the mean of (i, j) and (i, -j), of periodic covariances."""
    side = np.arange(lags + 1)
    return np.asarray(0.5 * (c[:, side[:, None], side] + c[:, -side[:, None], side]))


def flat_response(a: FloatArray, levels: ArrayLike, *, power: int = 0) -> FloatArray:
    r"""Calculate the derivative of flats' power spectra by a response that grows with the level.

    .. math:: \delta\tilde C = \delta\hat a \int_0^m 2 s^p\, \tilde C(s)\,
        e^{2 \hat a (m - s)} ds

    Parameters
    ----------
    a, levels
        As for :func:`periodic_covariances`.
    power : int
        Power p of the level: the change of the areas is s^p times a constant where all pixels
        hold a charge s.

    Returns
    -------
    response : ndarray, shape (n, side, side // 2 + 1)
        By spatial frequency [e-^(2 + p)]; multiply by the transform of the change [1/e-^(1 + p)].
    """
    a_k = transform_areas(a, side_of(a))
    m = np.asarray(levels, float)[:, None, None]
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    out = np.zeros(np.broadcast_shapes(a_k.shape, m.shape))
    for node, weight in zip(0.5 * (nodes + 1), 0.5 * weights, strict=True):
        s = node * m
        x = 2 * a_k * s
        small = np.abs(x) < 1e-9
        grown = s * np.where(small, 1 + x / 2, np.expm1(x) / np.where(small, 1.0, x))
        out += weight * m * 2 * s**power * grown * np.exp(2 * a_k * (m - s))
    return out


def side_of(a: FloatArray) -> int:
    """Side of the periodic array of the closed form: :data:`GRID`, or that of wider areas."""
    return max(GRID, int(next_fast_len(max(a.shape[-2:]), real=True)))


def transform_areas(a: FloatArray, side: int) -> FloatArray:
    """Fourier transform of area changes on a periodic array, shape (..., side, side // 2 + 1)."""
    ny, nx = a.shape[-2:]
    wide = np.zeros((*a.shape[:-2], side, side))
    wide[..., :ny, :nx] = a
    wide = np.roll(wide, (-(ny // 2), -(nx // 2)), (-2, -1))
    return np.asarray(rfft2(wide).real)
