r"""Least squares for the parameters of a device, with priors and a scale of the errors.

Minimised is

.. math:: \sum_k \frac{1}{s_k^2} \sum_n \left(\frac{m_n(\theta) - d_n}{\sigma_n}\right)^2
          + \sum_p \left(\frac{\theta_p - \bar\theta_p}{\pi_p}\right)^2

over the parameters, by Gauss and Newton within bounds.  The scale :math:`s_k` of a data set is such
that its chi2 is what it should be for its numbers less the parameters that it determines
(variance components by restricted likelihood):

.. math:: s_k^2 = \chi^2_k / (n_k - \mathrm{tr}_k), \qquad
          \mathrm{tr}_k = \mathrm{tr}(J_k C J_k^T) / s_k^2 .
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bfsensor.device.quantities import Prior
from bfsensor.errors import ConvergenceError, FitError
from bfsensor.fit.data import DataSet
from bfsensor.fit.predictors import DataPredictor, Prediction
from bfsensor.typing import FloatArray

FEWEST = 5.0
"""Degrees of freedom of a data set from which its scale is estimated; 1 below."""

ORDERED = (
    ("gates.gate_oxide", "gates.field_oxide"),
    ("operating_point.gate_low", "operating_point.gate_high"),
)
"""Pairs of which the first is not above the second in any device."""

STEEP = 1e4
"""Of what keeps them so, a spread that they are the wrong way round [standard deviations]."""

ROUNDS = 60
TOLERANCE = 1e-4
"""Of the scales, from one round to the next."""


@dataclass(frozen=True, eq=False)
class LeastSquaresProblem:
    """Free parameters, data and what predicts them.

    Attributes
    ----------
    priors : tuple of Prior
        Of the p parameters.
    sets : tuple of DataSet
        Fitted ones and those only held against the fit.
    predictors : tuple of DataPredictor
        One for each set.
    """

    priors: tuple[Prior, ...]
    sets: tuple[DataSet, ...]
    predictors: tuple[DataPredictor, ...]

    def __post_init__(self) -> None:
        if not self.priors:
            raise FitError("no parameter is free")
        if not any(data.fitted for data in self.sets):
            raise FitError("no data to fit")
        if len(self.sets) != len(self.predictors):
            raise FitError(
                f"{len(self.sets)} data sets and {len(self.predictors)} predictors"
            )

    @property
    def means(self) -> FloatArray:
        """Of the priors [internal units]."""
        return np.array([prior.mean for prior in self.priors])

    @property
    def spreads(self) -> FloatArray:
        """Of the priors [internal units]."""
        return np.array([prior.spread for prior in self.priors])

    def predict(self, values: FloatArray) -> list[Prediction]:
        """Each set's prediction and its derivatives."""
        return [predictor(values) for predictor in self.predictors]


@dataclass(frozen=True, eq=False)
class FitSolution:
    """Where the least squares are.

    Attributes
    ----------
    values : ndarray, shape (p,)
        [internal units].
    covariance : ndarray, shape (p, p)
        Posterior, of the tangent at the solution.
    scales, determined : ndarray, shape (sets,)
        Scale of each set's errors, and parameters that it determines; 1 and 0 where not fitted.
    chi2 : ndarray, shape (sets,)
        With the errors as stated.
    total : float
        What was minimised.
    sensitivity : ndarray, shape (n, p)
        Of all fitted numbers: change in scaled errors for one prior spread.
    """

    values: FloatArray
    covariance: FloatArray
    scales: FloatArray
    determined: FloatArray
    chi2: FloatArray
    total: float
    sensitivity: FloatArray


def solve(
    problem: LeastSquaresProblem,
    *,
    fixed: tuple[int, float] | None = None,
    scales: FloatArray | None = None,
    start: FloatArray | None = None,
) -> FitSolution:
    """Minimise.

    Parameters
    ----------
    problem : LeastSquaresProblem
        What is fitted.
    fixed : (int, float), optional
        A parameter's number and the value [internal unit] at which it is held, for profiles.
    scales : ndarray, shape (sets,), optional
        Of the errors, held; by default found.
    start : ndarray, shape (p,), optional
        Where to begin [the priors' means].

    Raises
    ------
    ConvergenceError
        Least squares or scales do not settle.
    """
    known = scales is not None
    s = np.ones(len(problem.sets)) if scales is None else np.asarray(scales, float)
    values = problem.means if start is None else np.array(start, float)
    history = []
    for _ in range(ROUNDS):
        found = _minimise(problem, s, values, fixed)
        values = found.values
        new = s if known else _rescaled(problem, found)
        history.append(float(np.max(np.abs(new / s - 1))))
        if history[-1] < TOLERANCE:
            return found
        s = new
    raise ConvergenceError(
        f"the scales of the errors still change by {history[-1]:.2g} after {ROUNDS} rounds",
        history,
    )


def _minimise(
    problem: LeastSquaresProblem,
    scales: FloatArray,
    start: FloatArray,
    fixed: tuple[int, float] | None,
) -> FitSolution:
    """Least squares at given scales of the errors, in units of the priors' spreads."""
    means, spreads = problem.means, problem.spreads
    free = np.ones(len(means), bool)
    whole = np.array(start, float)
    if fixed is not None:
        free[fixed[0]], whole[fixed[0]] = False, fixed[1]
    last: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def both(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals and slopes; kept for the next call, which asks for the other of them."""
        key = x.tobytes()
        if key not in last:
            last.clear()
            whole[free] = means[free] + x * spreads[free]
            last[key] = _residuals(problem, scales, whole)
        return last[key]

    low = np.array([(prior.low - prior.mean) / prior.spread for prior in problem.priors])
    high = np.array([(prior.high - prior.mean) / prior.spread for prior in problem.priors])
    x = ((whole - means) / spreads)[free]
    if free.any():
        # The start must lie inside.
        room = 1e-9 * np.minimum(high - low, 1.0)[free]
        found = least_squares(
            lambda v: both(v)[0], np.clip(x, low[free] + room, high[free] - room),
            jac=lambda v: both(v)[1][:, free], bounds=(low[free], high[free]),
            xtol=1e-10, ftol=1e-12, gtol=1e-10, max_nfev=200,
        )  # fmt: skip
        if not found.success:
            raise ConvergenceError(f"the fit did not settle: {found.message}")
        x = found.x
    residual, slope = both(x)
    return _solution(problem, scales, _ordered(problem, whole), free, residual, slope)


def _residuals(
    problem: LeastSquaresProblem, scales: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals of fitted numbers, priors and the order of pairs; their slopes in spreads."""
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
) -> FitSolution:
    """Posterior of the tangent where least squares end, and what each set has to say there."""
    spreads, p = problem.spreads, len(values)
    n = sum(len(data.values) for data in problem.sets if data.fitted)
    # Priors count, the order of pairs does not: it only cuts intervals off.
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
        float(residual @ residual), slope[:n],
    )  # fmt: skip


def ordered_pairs(problem: LeastSquaresProblem) -> list[tuple[int, int]]:
    """Numbers of parameters of which the first is not above the second in any device."""
    names = [prior.name for prior in problem.priors]
    return [(names.index(a), names.index(b)) for a, b in ORDERED if {a, b} <= set(names)]


def out_of_order(problem: LeastSquaresProblem, values: FloatArray) -> bool:
    """Whether a pair is the wrong way round, such as a gate oxide above the field oxide."""
    return any(values[low] > values[high] for low, high in ordered_pairs(problem))


def _disorder(
    problem: LeastSquaresProblem, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals of pairs that are the wrong way round, and their slopes in spreads."""
    pairs, spreads = ordered_pairs(problem), problem.spreads
    out, slopes = np.zeros(len(pairs)), np.zeros((len(pairs), len(values)))
    for row, (low, high) in enumerate(pairs):
        unit = spreads[low] / STEEP
        if values[low] > values[high]:
            out[row] = (values[low] - values[high]) / unit
            slopes[row, low], slopes[row, high] = STEEP, -spreads[high] / unit
    return out, slopes


def _ordered(problem: LeastSquaresProblem, values: FloatArray) -> FloatArray:
    """Copy in which pairs that are a hair the wrong way round are equal."""
    out = np.array(values)
    for low, high in ordered_pairs(problem):
        out[low] = min(out[low], out[high])
    return out


def _rescaled(problem: LeastSquaresProblem, found: FitSolution) -> FloatArray:
    """Scales that the chi2 of each set asks for."""
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
    """Profile likelihood of one parameter, the scales of the errors held.

    Parameters
    ----------
    problem, solution
        The fit.
    name : str
        Of the parameter.
    points : int
        Odd; the middle one is the solution.  More where the minimum rises less than a parabola.
    reach : float
        To either side [posterior error]: until the minimum lies its square higher, as far as bounds
        allow, which are the last points then, but at most three times as far.

    Returns
    -------
    values, rise : ndarray, shape (n,)
        FloatArray [internal unit], and by how much the minimum lies higher than at the solution.

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
    # Outwards from the solution, each from where the last one ended.
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
