"""Texture: autocovariance of a map of flats at shifts of a few pixels, and its errors."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, irfft, next_fast_len, rfft, rfft2

from bfsensor.diagnose.data.map_waves import smooth_shapes
from bfsensor.typing import FloatArray

NEAREST, FARTHEST = 4, 40
"""Smallest and largest shift in x [pixel] of the autocovariance.  Chosen: pixels nearer than 4 are
correlated by the brighter-fatter effect; up to 80 would double the number of values."""

STRIPE = 256
"""Number of rows of a map that are transformed at a time.  Chosen: with 512, the transforms take
twice the memory and no less time."""

CLEAR = 18.0
"""Power of a mode over the mean power of noise above which it belongs to a pattern.  Derived: the
power of noise is exponential, so that of 1e6 modes exp(-18) * 1e6 = 0.015 exceed 18; with 36, more
of a pattern's modes count as noise, and errors are larger."""

STRONGEST = 4096
"""Largest number of modes that count as a pattern's; weaker ones count as noise, which makes errors
larger.  Chosen: with 8192, errors of maps with more modes are closer to the truth, at twice the
memory and time."""

SLOW = 0.1
"""Highest frequency [cycles per pixel], along either axis, of noise that is not white.  Chosen: light
that fluctuates with a Gaussian correlation over 10 pixels, the shortest length of
:class:`~bfsensor.effects.illumination_turbulence.IlluminationTurbulence`, has 3e-9 of its largest power
there; with 0.2, four times as many modes of white noise count."""


class Texture(NamedTuple):
    """Autocovariance of a map at shifts of a few pixels.

    Attributes
    ----------
    values : ndarray, shape (n,)
        Mean products [1e-6].
    dx, dy : ndarray, shape (n,)
        Shifts [pixel].
    products : ndarray, shape (n,)
        Number of products in each mean.
    """

    values: FloatArray
    dx: FloatArray
    dy: FloatArray
    products: FloatArray


def map_texture(image: NDArray, own: NDArray[np.bool_] | None = None) -> Texture:
    """Measure the autocovariance of a map: mean products of pixels (dx, dy) apart.

    In the same row and from one row to the next: patterns that go with the time of readout are
    in phase along a row and start the next one with another phase.  Means of columns and of rows,
    which are values of their own, are subtracted.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Map of relative response, 0 where ``own`` is not set.
    own : ndarray of bool, shape (ny, nx), optional
        Pixels with a response of their own; others have no part in any product.  All by default.

    Returns
    -------
    Texture

    Examples
    --------
    >>> wave = np.sin(2 * np.pi * np.arange(64 * 100) / 8.1).reshape(64, 100)
    >>> values, dx, dy, _ = map_texture(wave)
    >>> [float(values[(dx == n) & (dy == 0)][0].round(-5)) for n in (4, 8)]
    [-500000.0, 500000.0]
    """
    ny, nx = image.shape
    own = np.ones((ny, nx), bool) if own is None else own
    columns = image.sum(0, dtype=np.float64) / np.maximum(own.sum(0), 1)
    reach = min(FARTHEST, nx // 2)
    side = next_fast_len(nx + reach + 1, real=True)
    same, following, pairs, steps = np.zeros((4, side))
    # Some rows at a time: transforms of large sensors need not be held.
    for start in range(0, ny, STRIPE):
        here = own[start : start + STRIPE + 1]
        rows = image[start : start + STRIPE + 1]
        means = rows.sum(1, dtype=np.float64) / np.maximum(here.sum(1), 1)
        rows = np.where(here, rows - columns - means[:, None] + columns.mean(), 0.0)
        for sums, values in (((same, following), rows), ((pairs, steps), here)):
            modes = rfft(values, side, axis=1)
            first = modes[:STRIPE]
            sums[0][:] += irfft((first.real**2 + first.imag**2).sum(0), side)
            sums[1][:] += irfft((modes[:-1].conj() * modes[1:]).sum(0), side)
    near, all_ = np.arange(NEAREST, reach + 1), np.arange(-reach, reach + 1)
    all_ = all_[np.abs(all_) >= NEAREST]
    products = np.maximum(np.rint(np.concatenate([pairs[near], steps[all_]])), 1.0)
    values = np.concatenate([same[near], following[all_]]) / products
    # Subtracting a row's mean leaves white noise anticorrelated by 1 / nx.
    values[: len(near)] += same[0] / max(float(pairs[0]), 1.0) / nx
    dy = np.repeat([0.0, 1.0], [len(near), len(all_)])
    dx = np.concatenate([near, all_]).astype(float)
    return Texture(1e6 * values, dx, dy, products)


def texture_noise(image: NDArray, texture: Texture, pixels: int) -> FloatArray:
    r"""Errors of a texture, or their covariance where the map has a pattern.

    Products of noise with noise are independent of one another.  Those of noise with a pattern
    are not: the noise n of a pixel is multiplied by the pattern s on both sides of it, so that

    .. math::
        \mathrm{cov}(T_d, T_{d'}) = \frac{1}{N} \Big( \sigma^4 \delta_{d d'} + 4 \sigma^2
        \sum_k P_k \cos(k \cdot d) \cos(k \cdot d') \Big),

    with P the pattern's power in modes k, which are those far above the noise.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        The map, without its smooth shape.
    texture : Texture
        Autocovariance of the map.
    pixels : int
        Number of pixels with a response of their own; the map is 0 in others.

    Returns
    -------
    ndarray, shape (n,) or (n, n)
        Errors [1e-6], or covariance [1e-12].

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> noise = rng.normal(0, 0.003, (128, 128))
    >>> place = np.arange(128)
    >>> wave = 0.002 * np.sin(place / 3) * np.cos(place / 5)[:, None]
    >>> [texture_noise(m, map_texture(m), m.size).ndim for m in (noise, noise + wave)]
    [1, 2]
    """
    ny, nx = image.shape
    products = texture.products
    mean = float(image.mean(dtype=np.float64))
    variance = float(np.square(image, dtype=np.float64).sum()) / max(pixels, 1) - mean**2
    modes = rfft2(image)
    power = (modes.real**2 + modes.imag**2) / (ny * nx)
    # Means of columns and rows are not part of a texture.
    power[0], power[:, 0] = 0.0, 0.0
    noise = float(np.median(power[1:, 1:])) / np.log(2.0)
    row, column = np.nonzero(power > CLEAR * noise)
    if not len(row):
        return np.asarray(1e6 * variance / np.sqrt(products))
    order = np.argsort(power[row, column])[::-1][:STRONGEST]
    row, column = row[order], column[order]
    # A mode of a real transform stands for itself and its conjugate, where there is one.
    twice = np.where((column == 0) | (2 * column == nx), 1.0, 2.0)
    strength = twice * power[row, column] / (ny * nx)
    turns = np.outer(texture.dx, column / nx) + np.outer(
        texture.dy, np.fft.fftfreq(ny)[row]
    )
    # Noise is the variance without the pattern, but no less than that of the median mode: of
    # strong patterns the difference is lost in rounding.
    own = max(variance - float(strength.sum()), noise)
    spread = 2 * np.sqrt(own * strength) * np.cos(2 * np.pi * turns)
    spread *= (1e6 / np.sqrt(products))[:, None]
    return np.asarray(spread @ spread.T + np.diag((1e6 * own) ** 2 / products))


def slow_power(noise: NDArray, modes: NDArray) -> FloatArray:
    """Power of the modes of a map's noise up to :data:`SLOW`, without the map's smooth shape.

    Parameters
    ----------
    noise : ndarray, shape (ny, nx)
        Noise of a map.
    modes : ndarray, shape (ny, nx // 2 + 1)
        ``scipy.fft.rfft2`` of it.

    Returns
    -------
    power : ndarray, shape (rows, columns)
        That of white noise is a pixel's variance; 0 for modes of row or column means.

    Examples
    --------
    >>> noise = np.random.default_rng(1).standard_normal((128, 128))
    >>> slow_power(noise, rfft2(noise)).shape
    (25, 13)
    """
    ny, nx = noise.shape
    rows, columns = _slow(ny), np.s_[: int(SLOW * nx) + 1]
    q_y, q_x = (smooth_shapes(n).astype(noise.dtype, copy=False) for n in (ny, nx))
    smooth = q_y.T @ noise @ q_x
    rough = modes[rows, columns] - _spectra(ny)[rows] @ smooth @ _spectra(nx)[columns].T
    power = np.asarray(rough.real**2 + rough.imag**2, float) / (ny * nx)
    power[rows == 0], power[:, 0] = 0.0, 0.0
    return power


def slow_texture(
    power: FloatArray, white: float, shape: tuple[int, int], texture: Texture, pairs: int
) -> tuple[FloatArray, FloatArray]:
    r"""Texture of noise that is not white, and its covariance.

    Noise whose modes k have the power P gives a map the texture :math:`T_d` with

    .. math::
        \langle T_d \rangle = \frac{1}{N} \sum_k P_k \cos(k \cdot d), \quad
        \mathrm{cov}(T_d, T_{d'}) = \frac{2}{N^2} \sum_k P_k^2 \cos(k \cdot d) \cos(k \cdot d').

    P is known from differences of pairs of flats, so that the mean has an error of its own, the
    covariance over the number of pairs.

    Parameters
    ----------
    power : ndarray, shape (rows, columns)
        Power of the map's noise by :func:`slow_power`, a mean over pairs.
    white : float
        Part of it that is white, whose errors :func:`texture_noise` has.
    shape : (int, int)
        Shape (ny, nx) of the map.
    texture : Texture
        Autocovariance of the map.
    pairs : int
        Number of pairs.

    Returns
    -------
    values : ndarray, shape (n,)
        Mean [1e-6].
    covariance : ndarray, shape (n, n)
        Covariance of a texture less this mean [1e-12].

    Examples
    --------
    >>> noise = np.random.default_rng(1).standard_normal((128, 128))
    >>> texture = map_texture(noise)
    >>> power = slow_power(noise, rfft2(noise))
    >>> values, covariance = slow_texture(power, 1.0, noise.shape, texture, 1)
    >>> bool((np.sqrt(np.diag(covariance)) < texture_noise(noise, texture, 128**2)).all())
    True
    """
    ny, nx = shape
    dx, dy = texture.dx.astype(int), texture.dy.astype(int)
    there = power > 0
    # The mean square of a mean of exponential powers is 1 + 1 / n times the square of their mean.
    square = np.maximum(power**2 * pairs / (pairs + 1) - white**2, 0.0)
    # Products that a transform joins across the border are those of pixels far apart, which are 0.
    values = 1e6 * _cosines(np.where(there, power - white, 0.0), shape, dx, dy)
    values *= nx / (nx - np.abs(dx))
    less, more = (
        _cosines(
            np.where(there, square, 0.0), shape, dx[:, None] + s * dx, dy[:, None] + s * dy
        )
        for s in (-1, 1)
    )
    return values, 1e12 * (1 + 1 / pairs) * (less + more) / (ny * nx)


def _cosines(
    power: FloatArray, shape: tuple[int, int], dx: NDArray[np.int64], dy: NDArray[np.int64]
) -> FloatArray:
    """Sum of power times cos(k d) over slow modes and their conjugates, over the pixels, by shift d."""
    ny, nx = shape
    x, y = np.arange(dx.min(), dx.max() + 1), np.arange(dy.min(), dy.max() + 1)
    along_y = np.exp(2j * np.pi / ny * np.outer(y, _slow(ny)))
    along_x = np.exp(2j * np.pi / nx * np.outer(np.arange(power.shape[1]), x))
    # Modes whose conjugates are in the transform themselves, those of column means, are 0.
    whole = 2 * (along_y @ power @ along_x).real / (ny * nx)
    return np.asarray(whole[dy - y[0], dx - x[0]])


def _slow(n: int) -> NDArray[np.int64]:
    """Indices of the modes of a side of n pixels up to :data:`SLOW`."""
    last = int(SLOW * n)
    return np.arange(-last, last + 1) % n if last else np.zeros(1, int)


@lru_cache(maxsize=8)
def _spectra(n: int) -> NDArray[Any]:
    """Transform of the smooth shapes along a side of n pixels."""
    return np.asarray(fft(smooth_shapes(n), axis=0))
