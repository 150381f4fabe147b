r"""Least squares for the parameters of a device, with priors and a scale of the errors.

The objective

.. math:: \sum_k \frac{1}{s_k^2} \sum_n \left(\frac{m_n(\theta) - d_n}{\sigma_n}\right)^2
          + \sum_p \left(\frac{\theta_p - \bar\theta_p}{\pi_p}\right)^2

is minimised over the parameters :math:`\theta` by a trust region within bounds
(:func:`~bfsensor.inference.trust_region.minimise`), with predictions m, data d and errors
:math:`\sigma`, prior means :math:`\bar\theta` and widths :math:`\pi`.  The scale :math:`s_k` of the
errors of data set k makes its scaled chi2 equal to its numbers minus the parameters that it
determines (variance components by restricted likelihood):

.. math:: s_k^2 = \chi^2_k / (n_k - \mathrm{tr}_k), \qquad
          \mathrm{tr}_k = \mathrm{tr}(J_k C J_k^T) / s_k^2 ,

with the derivatives :math:`J_k` in units of the stated errors and the posterior covariance C.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.quantities import Prior
from bfsensor.errors import FitError
from bfsensor.fit.data import DataSet
from bfsensor.fit.predictors import DataPredictor, Prediction
from bfsensor.inference.trust_region import minimise
from bfsensor.typing import FloatArray

FEWEST = 5.0
"""Least number of degrees of freedom at which the scale of a data set is estimated; below it is 1.

Chosen: at 5 the scale has an error of 1 / sqrt(10) = 32 %; twice as large, of 22 %."""

ORDERED = (
    ("gates.gate_oxide", "gates.field_oxide"),
    ("operating_point.gate_low", "operating_point.gate_high"),
)
"""Pairs of parameters of which the first must not exceed the second."""

STEEP = 1e4
"""Residual for a violation of this order by one prior width [standard deviations].

Chosen: at the minimum a violation is about 1e-8 prior widths times the pull of the data, and is then
set to 0; twice as large, a quarter of that."""

ROUNDS = 60
"""Largest number of rounds of least squares with new scales of the errors.

Chosen: beyond it the fit is marked as not converged; twice as large, that takes twice as long."""

STILL, MOST = 1e-10, 200
"""Step [prior widths] below which least squares end, and the largest number of predictions.

Chosen: differences between neighbouring points of a profile are 1e-3 of its rise, far above; with
twice as many predictions fits that do not converge take twice as long."""

TOLERANCE = 1e-4
"""Largest relative change of a scale from one round to the next at which scales have converged.

Chosen: far below the statistical error of a scale, 1 / sqrt(2 dof)."""


@dataclass(frozen=True, eq=False)
class LeastSquaresProblem:
    """Free parameters with priors, data sets, and their predictors.

    Attributes
    ----------
    priors : tuple of Prior
        Priors of the p free parameters [internal units].
    sets : tuple of DataSet
        Data sets, fitted or only compared with the fit.
    predictors : tuple of DataPredictor
        Predictor of each set.

    Raises
    ------
    FitError
        There is no free parameter, no fitted set, or not one predictor for each set.
    """

    priors: tuple[Prior, ...]
    sets: tuple[DataSet, ...]
    predictors: tuple[DataPredictor, ...]

    def __post_init__(self) -> None:
        if not self.priors:
            raise FitError("no parameter is free: name at least one with a prior")
        if not any(data.fitted for data in self.sets):
            raise FitError("no data to fit: all data sets are only compared with the fit")
        if len(self.sets) != len(self.predictors):
            raise FitError(
                f"{len(self.sets)} data sets need as many predictors, not {len(self.predictors)}"
            )

    @property
    def means(self) -> FloatArray:
        """Means of the priors [internal units], shape (p,)."""
        return np.array([prior.mean for prior in self.priors])

    @property
    def spreads(self) -> FloatArray:
        """Standard deviations of the priors [internal units], shape (p,)."""
        return np.array([prior.spread for prior in self.priors])

    def predict(self, values: FloatArray) -> list[Prediction]:
        """Predict each set, with derivatives, at values of the parameters [internal units]."""
        return [predictor(values) for predictor in self.predictors]


@dataclass(frozen=True, eq=False)
class FitSolution:
    """Minimum of a least-squares problem, with the posterior of the linear predictions there.

    Attributes
    ----------
    values : ndarray, shape (p,)
        Values of the parameters [internal units].
    covariance : ndarray, shape (p, p)
        Posterior covariance of predictions linear about the solution.
    scales, determined : ndarray, shape (sets,)
        Scale of each set's errors, and number of parameters that it determines; 1 and 0 for sets
        that are not fitted.
    chi2 : ndarray, shape (sets,)
        Chi-square of each set with the errors as stated.
    total : float
        Value of the objective.
    sensitivity : ndarray, shape (n, p)
        Change of each fitted number, in scaled errors, for one prior width of each parameter.
    converged : bool
        Whether the least squares and the scales of the errors have converged; if not, this is the
        best point that was found.
    """

    values: FloatArray
    covariance: FloatArray
    scales: FloatArray
    determined: FloatArray
    chi2: FloatArray
    total: float
    sensitivity: FloatArray
    converged: bool = True


def solve(
    problem: LeastSquaresProblem,
    *,
    fixed: tuple[int, float] | None = None,
    scales: FloatArray | None = None,
    start: FloatArray | None = None,
) -> FitSolution:
    """Minimise the objective over the parameters, and estimate the scales of the errors.

    Parameters
    ----------
    problem : LeastSquaresProblem
        Parameters, data and predictors.
    fixed : (int, float), optional
        Number of a parameter and the value [internal unit] at which it is fixed, for profiles.
    scales : ndarray, shape (sets,), optional
        Fixed scales of the errors; by default they are estimated.
    start : ndarray, shape (p,), optional
        Values to begin from [internal units]; by default the means of the priors.

    Returns
    -------
    solution : FitSolution
        Minimum with posterior covariance.  The fit always ends: ``converged`` says whether at a
        minimum, with scales that no longer change.
    """
    known = scales is not None
    s = np.ones(len(problem.sets)) if scales is None else np.asarray(scales, float)
    values = problem.means if start is None else np.array(start, float)
    for _ in range(ROUNDS):
        found = _minimise(problem, s, values, fixed)
        values = found.values
        new = s if known else _rescaled(problem, found)
        if float(np.max(np.abs(new / s - 1))) < TOLERANCE:
            return found
        s = new
    return replace(found, converged=False)


def _minimise(
    problem: LeastSquaresProblem,
    scales: FloatArray,
    start: FloatArray,
    fixed: tuple[int, float] | None,
) -> FitSolution:
    """Minimise at fixed scales of the errors, with parameters in units of their prior widths."""
    means, spreads = problem.means, problem.spreads
    low, high = (
        (np.array([getattr(prior, end) for prior in problem.priors]) - means) / spreads
        for end in ("low", "high")
    )
    first = (np.array(start, float) - means) / spreads
    if fixed is not None:
        first[fixed[0]] = (fixed[1] - means[fixed[0]]) / spreads[fixed[0]]
        low[fixed[0]] = high[fixed[0]] = first[fixed[0]]
    last: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def both(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals and slopes, cached: both are asked for at the same place, one after the other."""
        key = x.tobytes()
        if key not in last:
            last.clear()
            last[key] = _residuals(problem, scales, means + x * spreads)
        return last[key]

    found = minimise(
        lambda x: both(x)[0], lambda x: both(x)[1], np.clip(first, low, high), low=low, high=high,
        units=1.0, radius=1.0, still=STILL, evaluations=MOST,
    )  # fmt: skip
    whole = means + found.values * spreads
    if fixed is not None:
        whole[fixed[0]] = fixed[1]
    free = np.arange(len(means)) != (-1 if fixed is None else fixed[0])
    residual, slope = both(found.values)
    return _solution(
        problem, scales, _ordered(problem, whole), free, residual, slope, found.converged
    )


def _residuals(
    problem: LeastSquaresProblem, scales: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals of fitted numbers, priors and ordered pairs, and slopes per prior width."""
    parts, slopes = [], []
    for data, predictor, scale in zip(
        problem.sets, problem.predictors, scales, strict=True
    ):
        if not data.fitted:
            continue
        value, slope = predictor(values)
        error = scale * data.errors
        parts.append((value - data.values) / error)
        slopes.append(slope * problem.spreads / error[:, None])
    parts.append((values - problem.means) / problem.spreads)
    slopes.append(np.eye(len(values)))
    wrong, turned = _disorder(problem, values)
    return np.concatenate([*parts, wrong]), np.concatenate([*slopes, turned])


def _solution(
    problem: LeastSquaresProblem,
    scales: FloatArray,
    values: FloatArray,
    free: NDArray[np.bool_],
    residual: FloatArray,
    slope: FloatArray,
    converged: bool,
) -> FitSolution:
    """Posterior of the linear predictions at the minimum, and chi2 of each set there."""
    spreads, p = problem.spreads, len(values)
    n = sum(len(data.values) for data in problem.sets if data.fitted)
    # The penalty of ordered pairs is a bound, no information: it is left out of the covariance.
    counted = slice(0, n + p)
    normal = slope[counted, free].T @ slope[counted, free]
    covariance = np.zeros((p, p))
    covariance[np.ix_(free, free)] = np.linalg.inv(normal) if free.any() else 0.0
    chi2, determined = np.zeros(len(problem.sets)), np.zeros(len(problem.sets))
    at = 0
    for k, data in enumerate(problem.sets):
        if not data.fitted:
            value = problem.predictors[k](values)[0]
            chi2[k] = np.sum(((value - data.values) / data.errors) ** 2)
            continue
        rows = slice(at, at + len(data.values))
        at = rows.stop
        chi2[k] = scales[k] ** 2 * np.sum(residual[rows] ** 2)
        determined[k] = np.einsum("np,pq,nq->", slope[rows], covariance, slope[rows])
    return FitSolution(
        values, covariance * np.outer(spreads, spreads), scales, determined, chi2,
        float(residual @ residual), slope[:n], converged,
    )  # fmt: skip


def ordered_pairs(problem: LeastSquaresProblem) -> list[tuple[int, int]]:
    """Give the pairs of parameter numbers of which the first must not exceed the second."""
    names = [prior.name for prior in problem.priors]
    return [(names.index(a), names.index(b)) for a, b in ORDERED if {a, b} <= set(names)]


def out_of_order(problem: LeastSquaresProblem, values: FloatArray) -> bool:
    """Whether a pair violates its order, such as a gate oxide thicker than the field oxide."""
    return any(values[low] > values[high] for low, high in ordered_pairs(problem))


def _disorder(
    problem: LeastSquaresProblem, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals of pairs that violate their order, and their slopes per prior width."""
    pairs, spreads = ordered_pairs(problem), problem.spreads
    out, slopes = np.zeros(len(pairs)), np.zeros((len(pairs), len(values)))
    for row, (low, high) in enumerate(pairs):
        unit = spreads[low] / STEEP
        if values[low] > values[high]:
            out[row] = (values[low] - values[high]) / unit
            slopes[row, low], slopes[row, high] = STEEP, -spreads[high] / unit
    return out, slopes


def _ordered(problem: LeastSquaresProblem, values: FloatArray) -> FloatArray:
    """Copy in which pairs that slightly violate their order are equal."""
    out = np.array(values)
    for low, high in ordered_pairs(problem):
        out[low] = min(out[low], out[high])
    return out


def _rescaled(problem: LeastSquaresProblem, found: FitSolution) -> FloatArray:
    """Scales that make the scaled chi2 of each set equal to its degrees of freedom."""
    out = found.scales.copy()
    for k, data in enumerate(problem.sets):
        dof = len(data.values) - found.determined[k]
        if data.fitted and data.scaled and dof >= FEWEST:
            out[k] = np.sqrt(max(found.chi2[k] / dof, 1e-6))
    return out


def profile(
    problem: LeastSquaresProblem,
    solution: FitSolution,
    name: str,
    *,
    points: int = 13,
    reach: float = 3.0,
) -> tuple[FloatArray, FloatArray]:
    """Compute the profile likelihood of one parameter at fixed scales of the errors.

    Parameters
    ----------
    problem : LeastSquaresProblem
        Parameters, data and predictors.
    solution : FitSolution
        Its minimum.
    name : str
        Dotted name of a free parameter.
    points : int
        Odd number of points, the middle one at the solution; more are added where the objective
        rises less than a parabola.
    reach : float
        Distance to either side [posterior errors].  The profile ends where the objective has risen
        by its square, at a bound of the prior, or at three times this distance.

    Returns
    -------
    values, rise : ndarray, shape (n,)
        Values of the parameter [internal unit], and the rise of the minimum of the objective above
        that of the solution.

    Raises
    ------
    FitError
        The parameter is not free.
    """
    names = [prior.name for prior in problem.priors]
    if name not in names:
        raise FitError(f"{name} is not free; free are {', '.join(names)}")
    k = names.index(name)
    step = reach * float(np.sqrt(solution.covariance[k, k])) / (points // 2)
    prior, best = problem.priors[k], float(solution.values[k])
    found = {best: 0.0}
    # Outwards from the solution: each minimum starts from that of its neighbour.
    for side, end in ((1, prior.high), (-1, prior.low)):
        start = solution.values
        for n in range(1, 3 * (points // 2) + 1):
            value = best + side * n * step
            last = side * (value - end) >= 0
            value = end if last else value
            if value in found:
                break
            there = solve(problem, fixed=(k, value), scales=solution.scales, start=start)
            found[value], start = there.total - solution.total, there.values
            if last or (n >= points // 2 and found[value] >= reach**2 - 1e-3):
                break
    values = np.array(sorted(found))
    return values, np.array([found[value] for value in values])
