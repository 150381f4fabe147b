r"""Toy model of the brighter-fatter effect in flats: charge in two pixels shifts their boundary.

**Two pixels** (Lage, Bradshaw & Tyson 2017, appendix) share a partition.  With the
difference of their charges :math:`D = N_1 - N_2` the areas are :math:`1 \mp \alpha D`, so
the next electron falls on the first pixel with the chance :math:`(1 - \alpha D) / 2` and

.. math::
    E[D_{m+1}^2 \,|\, D_m] = D_m^2 + 2 D_m\, E[D_{m+1} - D_m \,|\, D_m] + 1
                           = (1 - 2 \alpha)\, D_m^2 + 1,

which gives :math:`E[D_m^2] = (1 - (1 - 2 \alpha)^m) / 2 \alpha`.  Of a Poisson number of
electrons with the mean :math:`2 \lambda_0` the expectation of :math:`(1 - 2 \alpha)^m` is
:math:`e^{-4 \alpha \lambda_0}`.  The sum of both charges keeps its Poisson variance
:math:`2 \lambda_0`; by symmetry the mean of D is 0 whatever the sum.  Hence, to all orders,

.. math::
    \mathrm{Var}(D) = \frac{1 - e^{-4 \alpha \lambda_0}}{2 \alpha}, \qquad
    \mathrm{Var}(N_1),\ \mathrm{Cov}(N_1, N_2)
        = \tfrac14 (2 \lambda_0 \pm \mathrm{Var}(D)).

This is Ehrenfest's urn with :math:`2 / \alpha` balls, one moved by each electron.

The equations close because the areas are linear in the charges: this is no expansion.  It
holds as long as neither area reaches 0, see `LARGEST_RMS_AREA`.  Arrays of pixels:
:mod:`bfsensor.measure.toy_array`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import exprel

from bfsensor._kernels import toy as kernels
from bfsensor.errors import MeasurementError
from bfsensor.typing import FloatArray

LARGEST_RMS_AREA = 0.2
"""Largest rms change of the pixels' areas, relative to the area, for which closed forms are given.

Chosen: a boundary is then five standard deviations or more from closing a pixel.  The moments of two
pixels differ from the exact ones by less than 1e-6 of the level there (measured in
tests/measure/test_toy.py); at twice the value, 2.5 standard deviations, the closed forms fail.
"""

MOST_DARTS = 1e9
"""Largest mean number of electrons in a pixel [e-].

Derived: twice as many, the electrons of a pair of pixels, are still below the 2^31 of counts of
32 bits.
"""


@dataclass(frozen=True)
class PairMoments:
    """Moments of the charges of two pixels, or standard errors of them.

    Parameters
    ----------
    mean : ndarray
        Mean charge of one pixel [e-].
    variance : ndarray
        Variance of one pixel [e-^2].
    covariance : ndarray
        Covariance of the two pixels [e-^2].  Lage et al. (2017) call it the correlation, and its
        ratio to the variance the covariance.

    Examples
    --------
    >>> moments = PairMoments(np.array(400.0), np.array(384.8), np.array(15.2))
    >>> float(moments.variance + moments.covariance)
    400.0
    """

    mean: FloatArray
    variance: FloatArray
    covariance: FloatArray


def _check_pair(alpha: ArrayLike, level: ArrayLike, largest: float) -> list[NDArray]:
    """Alpha and level as arrays of one shape, checked to be in range."""
    a, mu = np.broadcast_arrays(np.asarray(alpha, float), np.asarray(level, float))
    if not np.all((a >= 0) & (a <= largest)):
        raise MeasurementError(f"alpha = {a} 1/e- must be from 0 to {largest:g} 1/e-")
    if not np.all((mu >= 0) & (mu <= MOST_DARTS)):
        raise MeasurementError(f"level = {mu} e- must be from 0 to {MOST_DARTS:g} e-")
    return [a, mu]


def predict_pair(alpha: ArrayLike, level: ArrayLike) -> PairMoments:
    r"""Predict the moments of two pixels with a moving partition, to all orders in alpha.

    To first order :math:`\mathrm{Var} = \lambda_0 (1 - \alpha \lambda_0)` and
    :math:`\mathrm{Cov} = \alpha \lambda_0^2`; their sum is :math:`\lambda_0` always.

    Parameters
    ----------
    alpha : array_like
        Fraction of its area that a pixel loses for each electron that it has more than
        the other [1/e-], 0 to 0.08 (there the rms change of area may reach 0.2).
    level : array_like
        Mean number of electrons in a pixel, :math:`\lambda_0` [e-], 0 to 1e9.

    Returns
    -------
    moments : PairMoments
        Moments, of the shape to which both arguments broadcast.

    Raises
    ------
    MeasurementError
        A value is out of range.

    References
    ----------
    The docstring of :mod:`bfsensor.measure.toy` derives it; :func:`predict_pair_as_printed` has
    the published formula.

    Examples
    --------
    >>> moments = predict_pair(1e-4, 400.0)
    >>> f"{moments.variance:.2f} {moments.covariance:.2f}"
    '384.82 15.18'
    """
    a, mu = _check_pair(alpha, level, 2 * LARGEST_RMS_AREA**2)
    difference = 2 * mu * exprel(-4 * a * mu)
    return PairMoments(mu + 0.0, (2 * mu + difference) / 4, (2 * mu - difference) / 4)


def predict_pair_as_printed(alpha: ArrayLike, level: ArrayLike) -> PairMoments:
    r"""Predict the moments of two pixels as the appendix of Lage et al. (2017) prints them.

    The function serves only to compare the printed formulae with :func:`predict_pair`:

    .. math::
        \mathrm{Mean} = \lambda_0 (1 - \tfrac{\alpha}{2}), \quad
        \mathrm{Var} = \lambda_0 (1 - \tfrac{\alpha}{2} (\lambda_0 + \tfrac12)), \quad
        \mathrm{Cov} = \alpha \lambda_0^2 .

    The covariance is right to first order.  The variance has half the slope: the printed
    distribution, :math:`P_1 P_2 (1 - \tfrac{\alpha}{2} (N_1 - N_2)^2)` once normalised,
    itself gives :math:`\lambda_0 (1 - \alpha (\lambda_0 + \tfrac12))`.  That distribution is
    only an approximation: it puts the final charges into the rates of independent Poisson
    counts, which lowers the mean by :math:`\alpha \lambda_0 / 2`, while the exact process keeps
    it.  The exponents of the printed Poisson probabilities lack their minus sign.

    Parameters
    ----------
    alpha, level : array_like
        Alpha [1/e-] and level [e-], as for :func:`predict_pair`.

    Returns
    -------
    moments : PairMoments
        Moments, of the shape to which both arguments broadcast.

    Raises
    ------
    MeasurementError
        A value is out of range.

    Examples
    --------
    >>> moments = predict_pair_as_printed(1e-4, 400.0)
    >>> f"{moments.variance:.2f} {moments.covariance:.2f}"
    '391.99 16.00'
    """
    a, mu = _check_pair(alpha, level, 2 * LARGEST_RMS_AREA**2)
    return PairMoments(mu * (1 - a / 2), mu * (1 - a / 2 * (mu + 0.5)), a * mu**2)


def throw_at_pair(
    alpha: float, level: float, *, realisations: int, seed: int
) -> NDArray[np.int64]:
    """Simulate two pixels electron by electron ("darts"), moving the partition after each.

    Parameters
    ----------
    alpha : float
        Alpha of :func:`predict_pair` [1/e-], 0 to 1.
    level : float
        Mean number of electrons in a pixel [e-]; the number of darts is Poisson distributed
        with twice that mean.
    realisations : int
        Number of simulated pairs.  A smaller number gives the first of those of a larger one.
    seed : int
        Seed, 0 to 2^64 - 1.  Realisations with the same seed share random numbers at any alpha.

    Returns
    -------
    charges : ndarray of int, shape (realisations, 2)
        Electrons in each pixel.

    Raises
    ------
    MeasurementError
        A value is out of range, or the partition left the pair: where alpha is so large that
        one pixel takes all the area, the model is not defined.

    Examples
    --------
    >>> charges = throw_at_pair(1e-3, 100.0, realisations=2000, seed=5501)
    >>> charges.shape, bool(abs(charges.mean() / 100.0 - 1) < 0.01)
    ((2000, 2), True)
    """
    _check_pair(alpha, level, 1.0)
    darts, key0, key1 = draw_darts(2 * level, realisations, seed)
    difference = np.empty(realisations)
    largest = kernels.throw_pair(float(alpha), darts, key0, key1, difference)
    if alpha * largest > 1:
        raise MeasurementError(
            f"alpha = {alpha} 1/e- with a difference of {largest:.0f} e-: the partition left "
            "the pixels; choose a smaller alpha or level"
        )
    first = (darts + difference.astype(np.int64)) // 2
    return np.stack([first, darts - first], axis=1)


def measure_pair(charges: ArrayLike) -> tuple[PairMoments, PairMoments]:
    """Measure the moments of many pairs, with standard errors from their scatter.

    Parameters
    ----------
    charges : array_like, shape (realisations, 2)
        Electrons in each pixel.

    Returns
    -------
    moments, errors : PairMoments
        Moments and their standard errors.  The mean is that of the first pixel, because the
        effect does not change that of both; variance and covariance use both.

    Raises
    ------
    MeasurementError
        The charges have another shape, or fewer than two realisations.

    Examples
    --------
    >>> moments, errors = measure_pair([[3, 5], [5, 3], [4, 4]])
    >>> float(moments.variance), float(moments.covariance)
    (1.0, -1.0)
    """
    pairs = np.asarray(charges, float)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or len(pairs) < 2:
        raise MeasurementError(
            f"charges have the shape {pairs.shape}; (2 or more, 2) is needed"
        )
    n = len(pairs)
    deviations = pairs - pairs.mean(axis=0)
    # n / (n - 1) removes the bias of means that were taken from the same pairs.
    squares = (deviations**2).mean(axis=1) * n / (n - 1)
    products = deviations.prod(axis=1) * n / (n - 1)
    samples = (pairs[:, 0], squares, products)
    errors = (s.std(ddof=1) / np.sqrt(n) for s in samples)
    return PairMoments(*(s.mean() for s in samples)), PairMoments(*errors)


def draw_darts(
    mean: float, realisations: int, seed: int
) -> tuple[NDArray[np.int64], np.uint32, np.uint32]:
    """Numbers of darts, Poisson distributed, and the key of their random numbers."""
    if not 1 <= realisations < 2**32:
        raise MeasurementError(f"realisations = {realisations} must be from 1 to 2^32 - 1")
    if not 0 <= seed < 2**64:
        raise MeasurementError(f"seed = {seed} must be from 0 to 2^64 - 1")
    if not 0 <= mean <= 2 * MOST_DARTS:
        raise MeasurementError(
            f"{mean:g} electrons in all must be from 0 to {2 * MOST_DARTS:g}: choose a smaller "
            "level or size"
        )
    darts = np.random.default_rng(seed).poisson(mean, realisations)
    return darts, np.uint32(seed & 0xFFFFFFFF), np.uint32(seed >> 32)
