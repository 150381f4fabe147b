"""Least-squares solver of the covariance model, and the search for the turnoff level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution

from bfsensor.errors import ConvergenceError, MeasurementError
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.measure.covariance_model import Series, expand
from bfsensor.measure.curve import CovarianceCurve
from bfsensor.typing import FloatArray

REJECT = 1e-4
"""Probability of chi-square below which a pair counts as not predicted by those below it.

Chosen: three sound pairs in five then fail with the probability 10 REJECT^3 = 1e-11.  At twice the
value the limit of chi-square falls from 23.5 to 22.0 for the four nearest lags, and gentler
turnoffs end the range.
"""


@dataclass(frozen=True)
class CovarianceSolution:
    """Parameters, their covariance matrix and the chi-square of each pair.

    ``matrix`` is that of a, c, noise (lags flattened) and gain, 0 for parameters that are held.
    """

    a: FloatArray
    c: FloatArray
    noise: FloatArray
    gain: float
    matrix: FloatArray
    chi2: FloatArray

    @property
    def parameters(self) -> FloatArray:
        """All parameters in the order of the matrix."""
        return np.concatenate(
            [self.a.ravel(), self.c.ravel(), self.noise.ravel(), [self.gain]]
        )


def start_values(curve: CovarianceCurve, gain: float | None = None) -> CovarianceSolution:
    """Start values from a robust parabola of the variance, and from C_ij against level squared."""
    mu, c, error = curve.levels, curve.covariances, curve.errors
    top = mu.max()

    def residual(p: FloatArray) -> FloatArray:
        line = p[0] + p[1] * (mu / top) + p[2] * (mu / top) ** 2
        return np.asarray((c[:, 0, 0] - top * line) / error[:, 0, 0])

    lit = mu > 0
    if not lit.any():
        raise MeasurementError(f"no pair has a level above 0, the highest is {top:g}")
    first = float(np.median(c[lit, 0, 0] / mu[lit]))
    parabola = least_squares(residual, [0.0, first, 0.0], loss="soft_l1", x_scale=first)
    slope = parabola.x[1]
    if gain is None and not slope > 0:
        raise MeasurementError(
            f"the variance does not grow with the level (slope {slope:g}): these are no flats, or "
            "all of them are above the turnoff; give lower levels"
        )
    g = 1 / slope if gain is None else gain
    # To first order C_ij is noise + a_ij mu^2: a weighted line in mu^2 for every lag.
    weight, square = error**-2, (mu**2)[:, None, None]
    total = weight.sum(0)
    centre = (weight * square).sum(0) / total
    mean = (weight * c).sum(0) / total
    a = (weight * (square - centre) * c).sum(0) / (weight * (square - centre) ** 2).sum(0)
    noise = (mean - a * centre) * g**2
    a[0, 0] = parabola.x[2] / top
    noise[0, 0] = parabola.x[0] * top * g**2
    n = a.size
    return CovarianceSolution(
        a, np.zeros_like(a), noise, g, np.zeros((3 * n + 1,) * 2), np.empty(0)
    )


def solve(
    curve: CovarianceCurve,
    start: CovarianceSolution,
    *,
    free_gain: bool,
    free_c: bool,
    powers: int,
    bound: float | None = None,
    prior: FloatArray | None = None,
) -> CovarianceSolution:
    """Fit by damped Gauss-Newton, each pair with the inverse of its full error matrix.

    Parameters
    ----------
    curve : CovarianceCurve
        Pairs to fit, all of them.
    start : CovarianceSolution
        Start values, and the values of parameters that are held.
    free_gain, free_c : bool
        Whether gain and c are fitted.
    powers : int
        Highest power of the level.
    bound : float, optional
        Chi-square of a pair above which its part grows with the root of it only (Huber).
    prior : ndarray, shape (3 n + 1,), optional
        Inverse variances of a Gaussian prior about 0, for each parameter.

    Returns
    -------
    found : CovarianceSolution
        Parameters at the minimum of chi-square, their covariance matrix, and chi-squares.

    Raises
    ------
    ConvergenceError
        The fit found no minimum in 60 steps.
    MeasurementError
        The levels do not constrain the parameters.
    """
    n = start.a.size
    free = np.ones(3 * n + 1, bool)
    free[n : 2 * n] = free_c
    free[-1] = free_gain
    about = np.zeros(3 * n + 1) if prior is None else prior
    parameters = start.parameters.copy()
    damping, history = 1e-3, []
    for outer in range(60):
        # The error matrices are those of the fitted covariances, and settle with the parameters.
        inverse = _inverse_errors(curve, parameters, powers)
        normal, gradient, each = _normal_equations(
            curve, parameters, inverse, powers, bound
        )
        normal[np.diag_indices_from(normal)] += about
        gradient -= about * parameters
        diagonal = np.diag(normal)[free]
        if not np.all(diagonal > 0):
            raise MeasurementError(_UNFIXED)
        scale = 1 / np.sqrt(diagonal)
        part = normal[np.ix_(free, free)] * scale[:, None] * scale
        if np.linalg.cond(part) > 1e13:
            raise MeasurementError(_UNFIXED)
        slope = gradient[free] * scale
        # Newton's decrement: the drop of chi-square that a full step would give.
        history.append(float(slope @ np.linalg.solve(part, slope)))
        if history[-1] < 1e-6 and outer >= 3:
            break
        before = _bounded(each, bound) + about @ parameters**2
        while damping < 1e8:
            step = np.zeros_like(parameters)
            step[free] = np.linalg.solve(part + damping * np.eye(len(part)), slope) * scale
            tried = parameters + step
            if tried[-1] > 0:
                *_, model = _evaluate(curve.levels, tried, powers, slopes=False)
                after = _bounded(_chi_squares(curve, model, inverse), bound)
                if after + about @ tried**2 < before * (1 + 1e-12) + 1e-9:
                    parameters, damping = tried, max(0.1 * damping, 1e-12)
                    break
            damping = max(10 * damping, 1e-6)
        else:
            raise ConvergenceError(
                "no step of the covariance fit lowers chi-square: its history is attached; leave "
                "pairs above saturation out with level_range",
                history,
            )
    else:
        raise ConvergenceError(
            f"the covariance fit did not settle in 60 steps: the last would lower chi-square by "
            f"{history[-1]:.3g}, not below 1e-6",
            history,
        )
    matrix = np.zeros((3 * n + 1, 3 * n + 1))
    inverted = np.linalg.inv(part) * scale[:, None] * scale
    matrix[np.ix_(free, free)] = 0.5 * (inverted + inverted.T)
    return _solution(parameters, matrix, each, start.a.shape)


_UNFIXED = (
    "the levels do not constrain the model's parameters, because they are too few or too close: "
    "give more levels, or hold the gain or constant_a"
)
"""Message where the normal equations are singular."""


def _chi_squares(
    curve: CovarianceCurve, model: FloatArray, inverse: FloatArray
) -> FloatArray:
    """Chi-square of each pair."""
    residual = curve.covariances.reshape(len(curve), -1) - model
    return np.asarray(np.einsum("pi,pij,pj->p", residual, inverse, residual))


def _bounded(each: FloatArray, bound: float | None) -> float:
    """Sum of chi-squares, of which those above the bound grow with their root only (Huber)."""
    if bound is None:
        return float(each.sum())
    root = 2 * np.sqrt(bound * np.maximum(each, bound)) - bound
    return float(np.where(each > bound, root, each).sum())


def _solution(
    parameters: FloatArray, matrix: FloatArray,
    each: FloatArray, shape: tuple[int, ...],
) -> CovarianceSolution:  # fmt: skip
    a, c, noise = (x.reshape(shape) for x in np.split(parameters[:-1], 3))
    return CovarianceSolution(a, c, noise, float(parameters[-1]), matrix, each)


def _evaluate(
    levels: FloatArray, parameters: FloatArray, powers: int,
    *, slopes: bool,
) -> tuple[Series, FloatArray, FloatArray]:  # fmt: skip
    """Series, powers of the levels [e-], and covariances [unit^2] with lags flattened."""
    side = round(((len(parameters) - 1) / 3) ** 0.5)
    found = _solution(parameters, np.empty(0), np.empty(0), (side, side))
    series = expand(found.a, found.c, powers, slopes=slopes)
    monomials = series.monomials(found.gain * levels)
    flat = np.tensordot(monomials, series.value, 1) + found.noise
    return series, monomials, flat.reshape(len(levels), -1) / found.gain**2


def _inverse_errors(
    curve: CovarianceCurve, parameters: FloatArray, powers: int
) -> FloatArray:
    """Inverse of Bartlett's matrix of the modelled covariances, for each pair."""
    *_, model = _evaluate(curve.levels, parameters, powers, slopes=False)
    shape = curve.covariances.shape[1:]
    # Start values may give a variance below 0; the measured covariances then set the errors.
    wrong = ~(model[:, 0] > 0.1 * curve.covariances[:, 0, 0])
    model[wrong] = curve.covariances[wrong].reshape(-1, model.shape[1])
    return np.asarray(
        np.linalg.inv(bartlett_matrix(model.reshape(-1, *shape), curve.pairs))
    )


def _jacobian(
    series: Series, monomials: FloatArray, model: FloatArray, gain: float
) -> FloatArray:
    """Derivatives of the covariances at one level by all parameters."""
    n = len(model)
    out = np.empty((n, 3 * n + 1))
    out[:, :n] = np.tensordot(monomials, series.by_a, 1) / gain**2
    out[:, n : 2 * n] = np.tensordot(monomials, series.by_c, 1) / gain**2
    out[:, 2 * n : 3 * n] = np.eye(n) / gain**2
    growth = (monomials * np.arange(1, len(monomials) + 1)) @ series.value.reshape(-1, n)
    out[:, -1] = growth / gain**3 - 2 * model / gain
    return out


def _normal_equations(
    curve: CovarianceCurve, parameters: FloatArray,
    inverse: FloatArray, powers: int, bound: float | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Normal matrix, right-hand side, and chi-square of each pair."""
    series, monomials, model = _evaluate(curve.levels, parameters, powers, slopes=True)
    residual = curve.covariances.reshape(len(curve), -1) - model
    each = _chi_squares(curve, model, inverse)
    pull = (
        np.ones(len(curve)) if bound is None else np.sqrt(bound / np.maximum(each, bound))
    )
    normal = np.zeros((len(parameters), len(parameters)))
    gradient = np.zeros(len(parameters))
    for k in range(len(curve)):
        slopes = _jacobian(series, monomials[k], model[k], float(parameters[-1]))
        weighted = pull[k] * (inverse[k] @ slopes)
        normal += slopes.T @ weighted
        gradient += weighted.T @ residual[k]
    return normal, gradient, each


def find_turnoff(
    curve: CovarianceCurve, *, gain: float | None, constant_a: bool, powers: int
) -> tuple[float, str]:
    """Find the highest level up to which the model predicts the nearest covariances.

    From the lowest third (at least ten pairs) on, a fit of the lags up to (1, 1) predicts each
    next pair, with the pair's own errors and those of the prediction.  The range ends below the
    first of three failures (probability below REJECT) among five pairs in a row; single failures
    are left to the search for outliers.  A turnoff so gentle that b describes it is not found.

    Low levels alone do not constrain a and c.  A prior therefore limits the change of areas up to
    the highest level to about the areas themselves; the final fit does not use it.

    Returns
    -------
    level : float
        Highest level of the range [unit].
    reason : str
        'found', 'whole curve', or 'too few pairs to find it'.
    """
    near = curve.select(lags=min(curve.lags, 1))
    first = max(10, len(curve) // 3)
    if len(curve) < first + 3 or len(np.unique(curve.levels[:first])) < 5:
        return float(curve.levels[-1]), "too few pairs to find it"
    shape = near.covariances.shape[1:]
    limit = chi2_distribution.isf(REJECT, near.covariances[0].size)
    failed: list[int] = []
    kept = list(range(first))
    group = max(1, len(curve) // 20)
    found = start_values(near.select(kept), gain)
    n, top = found.a.size, found.gain * curve.levels[-1]
    prior = np.repeat([top**2, top**4, 0.0], [n, n, n + 1])
    for begin in range(first, len(curve), group):
        found = solve(
            near.select(kept), found, free_gain=gain is None, free_c=not constant_a,
            powers=powers, bound=limit, prior=prior,
        )  # fmt: skip
        series, monomials, model = _evaluate(
            near.levels, found.parameters, powers, slopes=True
        )
        for k in range(begin, min(begin + group, len(curve))):
            slopes = _jacobian(series, monomials[k], model[k], found.gain)
            error = bartlett_matrix(model[k].reshape(shape), near.pairs[k])
            error = error + slopes @ found.matrix @ slopes.T
            residual = near.covariances[k].ravel() - model[k]
            if residual @ np.linalg.solve(error, residual) <= limit:
                kept.append(k)
                continue
            failed.append(k)
            if len(failed) >= 3 and failed[-1] - failed[-3] < 5:
                return float(curve.levels[failed[-3] - 1]), "found"
    return float(curve.levels[-1]), "whole curve"
