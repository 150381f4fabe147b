r"""Amplitudes that the scatter of values constrains: REML scoring, and the likelihood gain before a fit.

Random effects add :math:`M u` to whitened values, with unknown :math:`u \sim N(0, 1)` and modes
:math:`M` that depend on variance parameters.  The covariance is :math:`C = 1 + M M^T`, whose
inverse and determinant are worked out in the space of the modes (Woodbury's identity).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bfsensor.typing import FloatArray

FACTORS = np.geomspace(0.05, 20.0, 61)
"""Factors on a starting amplitude among which the one of greatest likelihood is taken.  Chosen: 61
of them from 1/20 to 20 are 10 % apart; a range twice as wide would begin fits of amplitudes that
are more than twenty times off their starting values, too, and the steps be 13 %."""

SURE = 1e-8
"""Eigenvalue of the information matrix, relative to the largest, below which a combination of
variance parameters counts as unconstrained.  Chosen, to be derived for parameters in units of their
errors: eigenvalues are those in the parameters' own units, so that an error of 1e4 times another's
number (pixels beside a relative rms) counts as unconstrained, and of 7e3 times with 2e-8.  Measured
in the case ``diagnosis/turbulence`` of tests.golden: eigenvalues of 4e8 and 9e-5, so that scatter
constrains one combination of rms and correlation length."""


class Score(NamedTuple):
    r"""Fisher scoring of variance parameters, as rows of a least-squares problem.

    Minimising :math:`|t - R (\theta - \theta_0)|^2` gives the scoring step
    :math:`\theta - \theta_0 = I^{-1} S`, as :math:`R^T R = I` and :math:`R^T t = S`.

    Attributes
    ----------
    origin : ndarray, shape (p,)
        Parameters :math:`\theta_0` at which score and information were found.
    rows : ndarray, shape (k, p)
        Root :math:`R` of Fisher's information; columns of other parameters are 0.
    target : ndarray, shape (k,)
        :math:`t`, the score in units of that root.
    """

    origin: FloatArray
    rows: FloatArray
    target: FloatArray

    def left(self, point: FloatArray) -> FloatArray:
        """Residuals of the score's rows at a point, shape (k,)."""
        return np.asarray(self.target - self.rows @ (point - self.origin))


def no_score(point: FloatArray) -> Score:
    """Empty score, for a fit without variance parameters."""
    return Score(point, np.zeros((0, len(point))), np.zeros(0))


def score_of(
    point: FloatArray,
    modes: FloatArray,
    moved: Mapping[int, FloatArray],
    span: FloatArray,
    residuals: FloatArray,
) -> Score:
    r"""Score and Fisher information of the restricted likelihood (REML) by variance parameters.

    Residuals :math:`r` have the covariance :math:`C = 1 + M M^T`; linear parameters with columns
    :math:`L` are unknown.  With the subscript for a derivative by a parameter :math:`a`,

    .. math::
        S_a &= (P r)^T M_a M^T (P r) - \mathrm{tr}\,P M_a M^T, \qquad
        I_{ab} = \tfrac12 \mathrm{tr}\,P C_a P C_b, \\
        C_a &= M_a M^T + M M_a^T, \qquad
        P = C^{-1} - C^{-1} L (L^T C^{-1} L)^{-1} L^T C^{-1}.

    Parameters
    ----------
    point : ndarray, shape (p,)
        Non-linear parameters.
    modes : ndarray, shape (n, m)
        :math:`M` there, whitened.
    moved : mapping of int to ndarray, shape (n, m)
        Derivative :math:`M_a` by each variance parameter, by its index in ``point``.
    span : ndarray, shape (n, q)
        With which :math:`P = 1 - {}` ``span @ span.T``.
    residuals : ndarray, shape (n,)
        Whitened residuals :math:`r`.

    Returns
    -------
    score : Score
        Empty where no variance parameter changes any mode.

    References
    ----------
    Patterson & Thompson 1971, Biometrika 58, 545 (restricted likelihood); Fisher scoring.
    """
    moved = {n: m for n, m in moved.items() if m.any()}
    if not moved:
        return no_score(point)

    def free(columns: FloatArray) -> FloatArray:
        return np.asarray(columns - span @ (span.T @ columns))

    # Only modes that some variance parameter changes enter score and information.
    some_modes = np.any([m.any(0) for m in moved.values()], axis=0)
    moved, modes = {n: m[:, some_modes] for n, m in moved.items()}, modes[:, some_modes]
    apart, left = free(modes), free(residuals)
    slopes = [free(m) for m in moved.values()]
    strengths = modes.T @ left
    told = np.array([
        float(left @ (m @ strengths)) - float((s * modes).sum())
        for m, s in zip(moved.values(), slopes, strict=True)
    ])  # fmt: skip
    own = modes.T @ apart
    mixed = [m.T @ apart for m in moved.values()]
    information = np.zeros((len(moved), len(moved)))
    for a, m in enumerate(moved.values()):
        for b in range(a + 1):
            both = float((mixed[a].T * mixed[b]).sum()) + float(
                ((m.T @ slopes[b]) * own).sum()
            )
            information[a, b] = information[b, a] = both
    sizes, shapes = np.linalg.eigh(information)
    some = sizes > SURE * max(float(sizes.max()), 1e-300)
    root = np.sqrt(sizes[some])
    rows = np.zeros((int(some.sum()), len(point)))
    rows[:, list(moved)] = root[:, None] * shapes[:, some].T
    return Score(point.copy(), rows, shapes[:, some].T @ told / root)


def likeliest(
    sizes: FloatArray, along: FloatArray, products: FloatArray
) -> tuple[float, float]:
    r"""Likelihood gain of an effect that changes means and scatter, maximised over its amplitude.

    With a factor :math:`f` on the amplitude the residuals :math:`r` have the mean
    :math:`f t_1 + f^2 t_2` and the covariance :math:`C = 1 + f^2 M M^T`, and

    .. math::
        2 \ln \frac{p(r \mid f)}{p(r \mid 0)}
        = r^T r - (r - f t_1 - f^2 t_2)^T C^{-1} (r - f t_1 - f^2 t_2) - \ln |C|.

    Parameters
    ----------
    sizes : ndarray, shape (m,)
        Squares of the singular values of :math:`M`, whitened, a fit's parameters projected out.
    along : ndarray, shape (3, m)
        :math:`r^T M v`, :math:`t_1^T M v` and :math:`t_2^T M v` with its right singular vectors.
    products : ndarray, shape (3, 3)
        Scalar products of :math:`r`, :math:`t_1` and :math:`t_2`.

    Returns
    -------
    gain, factor : float
        Twice the logarithm of the likelihood ratio, and :math:`f`, at the best of
        :data:`FACTORS`.

    Examples
    --------
    >>> noise = np.random.default_rng(2).normal(0, 5.0, 400)
    >>> along, products = np.zeros((3, 400)), np.zeros((3, 3))
    >>> along[0], products[0, 0] = noise, noise @ noise
    >>> gain, factor = likeliest(np.ones(400), along, products)
    >>> gain > 1000, round(factor)
    (True, 5)
    """
    gains = []
    for f in FACTORS:
        weights = np.array([1.0, -f, -(f**2)])
        inner = f * (weights @ along)
        wide = 1 + f**2 * sizes
        square = weights @ products @ weights - float((inner**2 / wide).sum())
        gains.append(products[0, 0] - square - float(np.log(wide).sum()))
    best = int(np.argmax(gains))
    return float(gains[best]), float(FACTORS[best])
