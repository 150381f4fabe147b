r"""Toy model of the brighter-fatter effect in flats on an array of pixels.

Electrons already in the array change the areas to
:math:`A_i = 1 + \sum_j a_{i-j} N_j` with :math:`\sum a = 0` and :math:`a_0 < 0` [1/e-].  With
the mean :math:`\mu` as time, electrons reach pixel i at the rate :math:`A_i`, so that

.. math::
    \frac{d E[N_i N_j]}{d \mu} = E[A_i N_j + N_i A_j] + \delta_{ij} E[A_i]
    \quad\Rightarrow\quad
    \frac{d C}{d \mu} = 1 + a * C + (a * C)^T .

A Fourier mode obeys :math:`dC_k / d\mu = 1 + 2\, \mathrm{Re}(a_k)\, C_k`, that is
:math:`C_k = (e^{2 a_k \mu} - 1) / 2 a_k`, whose series is that of Astier et al. (2019,
A&A 629, A36, eq. 20) with b = 0.  Two pixels are the array with :math:`a = (-\alpha,
\alpha)`, see :mod:`bfsensor.measure.toy`.  The equations close because the areas are
linear in the charges: this is no expansion.  It holds as long as no area reaches 0, see
`LARGEST_RMS_AREA`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import exprel

from bfsensor._kernels import toy as kernels
from bfsensor.errors import MeasurementError
from bfsensor.measure.toy import LARGEST_RMS_AREA, MOST_DARTS, draw_darts
from bfsensor.typing import FloatArray


def close_sum(a: ArrayLike) -> FloatArray:
    """Add a ring of equal values around an a-matrix, so that its sum is 0.

    Measured and tabulated a-matrices end at some lag, the electric field does not: the area
    that their pixels lose in sum is gained by pixels farther out.

    Parameters
    ----------
    a : array_like, shape (2 reach_y + 1, 2 reach_x + 1)
        a-matrix with lag (0, 0) in the middle [1/e-].

    Returns
    -------
    closed : ndarray, shape (2 reach_y + 3, 2 reach_x + 3)
        a-matrix with the ring [1/e-]; its sum is 0 to round-off.

    Raises
    ------
    MeasurementError
        A side is even, or a value is not finite.

    Examples
    --------
    >>> close_sum([[-8e-7]])[0].tolist()
    [1e-07, 1e-07, 1e-07]
    """
    a = _check_lags(a)
    ring = np.pad(np.zeros(a.shape), 1, constant_values=1.0)
    return np.pad(a, 1) - a.sum() * ring / ring.sum()


def _check_lags(a: ArrayLike) -> FloatArray:
    """a-matrix as an array, checked to have odd sides and finite values."""
    a = np.asarray(a, float)
    if a.ndim != 2 or a.shape[0] % 2 == 0 or a.shape[1] % 2 == 0:
        raise MeasurementError(
            f"a-matrix of shape {a.shape}: two axes of odd length are needed, with lag "
            "(0, 0) in the middle (bfsensor.measure.bartlett.unfold makes them of a quadrant)"
        )
    if not np.all(np.isfinite(a)):
        raise MeasurementError("a-matrix must be finite")
    return a


def _wrap(a: ArrayLike, size: int, level: float) -> FloatArray:
    """Checked a-matrix on a periodic array, with lag (0, 0) first."""
    a = _check_lags(a)
    if not max(a.shape) <= size <= 4096:
        raise MeasurementError(
            f"size = {size} pixels must be from {max(a.shape)}, the reach of the a-matrix, "
            "to 4096"
        )
    if abs(a.sum()) > 1e-9 * np.abs(a).max():
        raise MeasurementError(
            f"a-matrix sums to {a.sum():.3g} 1/e-; it must sum to 0, because the whole area stays "
            "the same (bfsensor.measure.toy_array.close_sum adds the rest in a ring)"
        )
    if not 0 <= level <= MOST_DARTS:
        raise MeasurementError(f"level = {level} e- must be from 0 to {MOST_DARTS:g} e-")
    ny, nx = a.shape
    whole = np.zeros((size, size))
    whole[:ny, :nx] = a
    return np.roll(whole, (-(ny // 2), -(nx // 2)), axis=(0, 1))


def predict_array(a: ArrayLike, level: float, *, size: int = 64) -> FloatArray:
    r"""Predict covariances of a flat whose pixel areas are linear in the charges, to all orders.

    .. math::
        C(\mu) = \mathrm{FFT}^{-1}\, \frac{e^{2 a_k \mu} - 1}{2 a_k}
               = \mu + a \mu^2 + \tfrac23\, a {*} a\, \mu^3 + \ldots

    Parameters
    ----------
    a : array_like, shape (2 reach_y + 1, 2 reach_x + 1)
        ``a[reach_y + j, reach_x + i]`` is the fraction of its area that the pixel at the
        lag i in x and j in y gains for each electron [1/e-]: negative in the middle, where
        the pixel that holds the electron loses area; its sum is 0.  It need not be symmetric:
        the covariances depend on the mean of opposite lags.
    level : float
        Mean number of electrons in a pixel, :math:`\mu` [e-], 0 to 1e9.
    size : int
        Side of the periodic array [pixel], up to 4096.

    Returns
    -------
    covariances : ndarray, shape (size, size)
        ``covariances[j, i]`` is C_ij [e-^2]; negative lags count from the end.

    Raises
    ------
    MeasurementError
        The a-matrix has even sides, does not fit into the array or does not sum to 0, ``level``
        is out of range, or areas change by more than `LARGEST_RMS_AREA`, beyond which the model
        does not hold.

    Examples
    --------
    >>> from bfsensor.measure.bartlett import unfold
    >>> a = unfold([[-3e-6, 0.7e-6], [0.8e-6, 0.0]])
    >>> c = predict_array(a, 5e4)
    >>> f"{c[0, 0]:.0f} {c[0, 1]:.0f} {c[1, 0]:.0f} {c[1, 1]:.0f} {c.sum():.0f}"
    '43348 1443 1648 75 50000'
    """
    modes = np.fft.fft2(_wrap(a, size, level))
    # The limit avoids overflow; such areas are refused below.
    spectrum = level * exprel(np.minimum(2 * modes.real * level, 600.0))
    area = np.sqrt((np.abs(modes) ** 2 * spectrum).mean())
    if area > LARGEST_RMS_AREA:
        raise MeasurementError(
            f"level = {level} e-: areas change by {area:.2g} rms, above {LARGEST_RMS_AREA}, "
            "where pixels may close and the model does not hold; choose a smaller level or a"
        )
    return np.fft.ifft2(spectrum).real


def throw_at_array(
    a: ArrayLike, level: float, *, size: int, realisations: int, seed: int
) -> NDArray[np.int32]:
    """Simulate a periodic array of pixels electron by electron, changing the areas after each.

    Parameters
    ----------
    a, level, size
        a-matrix, level and side of the array as for :func:`predict_array`; the number of
        electrons is Poisson distributed with the mean ``level * size**2``.
    realisations : int
        Number of simulated arrays.  A smaller number gives the first of those of a larger one.
    seed : int
        Seed, 0 to 2^64 - 1.

    Returns
    -------
    charges : ndarray of int, shape (realisations, size, size)
        Electrons in each pixel, [realisation, y, x].

    Raises
    ------
    MeasurementError
        A value is out of range, or the area of a pixel left the range 0 to 2.

    Examples
    --------
    >>> from bfsensor.measure.bartlett import unfold
    >>> a = unfold([[-4e-3, 1e-3], [1e-3, 0.0]])
    >>> charges = throw_at_array(a, 50.0, size=8, realisations=500, seed=7720)
    >>> bool(charges.var() < predict_array(a, 50.0)[0, 0] * 1.05 < 45.0)
    True
    """
    wrapped = _wrap(a, size, level)
    lags = np.argwhere(wrapped)
    weights = wrapped[tuple(lags.T)]
    place = np.argwhere(np.ones((size, size)))
    reached = (place[:, None] + lags[None]) % size
    partners = reached[..., 0] * size + reached[..., 1]
    darts, key0, key1 = draw_darts(level * size**2, realisations, seed)
    charges = np.empty((realisations, size**2), np.int32)
    least, largest = kernels.throw_array(partners, weights, darts, key0, key1, charges)
    if least < 0 or largest > 2:
        raise MeasurementError(
            f"level = {level} e-: areas went from {least:.2f} to {largest:.2f} of the pixel; "
            "they must stay between 0 and 2: choose a smaller level or a"
        )
    return charges.reshape(realisations, size, size)


def measure_array(charges: ArrayLike, level: float) -> tuple[FloatArray, FloatArray]:
    """Measure the covariances of many periodic arrays, with errors from their scatter.

    Parameters
    ----------
    charges : array_like, shape (realisations, ny, nx)
        Electrons in each pixel.
    level : float
        True mean of the simulation [e-].  It is not estimated, so that the Poisson noise of the
        sum is part of the covariances, as it is in the prediction.

    Returns
    -------
    covariances, errors : ndarray, shape (ny, nx)
        ``covariances[j, i]`` is C_ij, with its standard error [e-^2]; negative lags count from
        the end.

    Raises
    ------
    MeasurementError
        The charges have another shape, or fewer than two realisations.

    Examples
    --------
    >>> charges = np.random.default_rng(903).poisson(100.0, (400, 8, 8))
    >>> covariances, errors = measure_array(charges, 100.0)
    >>> bool(abs(covariances[0, 0] - 100.0) < 5 * errors[0, 0] < 5.0)
    True
    """
    images = np.asarray(charges, float)
    if images.ndim != 3 or len(images) < 2 or images.size == 0:
        raise MeasurementError(
            f"charges have the shape {images.shape}; (2 or more, ny, nx) is needed"
        )
    power = np.abs(np.fft.fft2(images - level)) ** 2
    each = np.fft.ifft2(power).real / images[0].size
    return each.mean(axis=0), each.std(axis=0, ddof=1) / np.sqrt(len(each))
