"""Errors of a fit: Gaussian with the error of the predictions, or from draws if they are curved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bfsensor.errors import ConvergenceError
from bfsensor.fit.degeneracies import principal
from bfsensor.fit.least_squares import FitSolution, LeastSquaresProblem
from bfsensor.fit.posterior_draws import bent_about, sample_posterior, with_draws
from bfsensor.fit.prediction_error import (
    DRAWS,
    Exact,
    Missed,
    fitted_numbers,
    measure_missed,
    relative_errors,
    widen,
)
from bfsensor.typing import FloatArray

STRAIGHT = 1e-3
"""Largest second derivative of predictions that are treated as linear [scaled errors per squared
prior width].

Chosen: predictions then differ by at most 0.0005 errors at one prior width; twice as large, 0.001."""

SHARES = {"68": 0.6827, "95": 0.95}
"""Probability in the central intervals of the draws, defined by their names."""

PREDICTED = 100
"""Number of draws at which predictions are made.  Derived: their scatter is then known to
1 / sqrt(200) = 7 %."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Solution of a fit with its posterior errors.

    Attributes
    ----------
    solution : FitSolution
        Solution with the final covariance about its values.
    left : tuple of ndarray
        Posterior error of each set's predictions, in the unit of the set.
    record : dict
        Entry 'posterior' of ``fit.json``: how the errors were found, and the error of predictions.
    words : str
        Note that describes it.
    draws : ndarray, shape (m, p), optional
        Draws of the parameters [internal units], if predictions are curved.
    """

    solution: FitSolution
    left: tuple[FloatArray, ...]
    record: dict[str, Any] = field(default_factory=dict)
    words: str = ""
    draws: FloatArray | None = None


def find_posterior(
    problem: LeastSquaresProblem,
    found: FitSolution,
    exact: Exact | None,
    *,
    missed: Missed | None = None,
    draws: int = DRAWS,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Find the posterior errors of a solution.

    Parameters
    ----------
    problem : LeastSquaresProblem
        Parameters, data and predictors.
    found : FitSolution
        Its solution.
    exact : callable, optional
        Function that predicts all sets from a full solution at values of the parameters; without
        it the errors do not include that of the predictions.
    missed : Missed, optional
        Errors of the predictions, measured before, in place of ``exact``.
    draws : int
        Number of draws at which ``exact`` is called.
    progress : callable, optional
        Called with (draws solved, draws in all).

    Returns
    -------
    posterior : Posterior
        Solution with final errors.
    """
    bent = bent_about(problem, found)
    curved = bool(np.max(np.abs(bent.second)) > STRAIGHT)
    record: dict[str, Any] = {
        "tangent_error": np.sqrt(np.diag(found.covariance)).tolist(), "curved": curved
    }  # fmt: skip
    words = "errors do not include the error of the predictions, which was not measured"
    if missed is None and exact is not None and draws:
        missed = measure_missed(problem, found, exact, draws=draws, progress=progress)
    if missed is not None:
        record |= {"solved": len(missed.at), "rms": {
            data.name: rms.tolist()
            for data, rms in zip(problem.sets, missed.rms, strict=True)
        }}  # fmt: skip
        most = [
            float(np.max(rms / (scale * data.errors)))
            for data, rms, scale in zip(problem.sets, missed.rms, found.scales, strict=True)
        ]
        words = (
            f"errors include the error of the predictions, measured at {len(missed.at)} devices drawn "
            f"from the posterior: at most {', '.join(f'{one:.2g}' for one in most)} scaled errors of "
            "the sets"
        )
    if curved:
        unknown = None
        if missed is not None:
            f = fitted_numbers(problem)
            unknown = relative_errors(problem, found, missed)[np.ix_(f, f)]
        try:
            drawn = sample_posterior(problem, found, bent=bent, unknown=unknown)
        except ConvergenceError as error:
            curved, words = (
                False,
                f"{words}; predictions are not linear, but {error}: errors are too small",
            )
            record["not_drawn"] = str(error)
    if curved:
        own = with_draws(found, drawn)
        record |= _told(drawn) | {"combinations": _combined(problem, own, drawn)}
        left = _left(problem, found, drawn)
        if missed is not None:
            left = tuple(np.hypot(a, b) for a, b in zip(left, missed.rms, strict=True))
        return Posterior(
            own, left, record, f"{words}; predictions are not linear: errors are those of draws", drawn,
        )  # fmt: skip
    if missed is not None:
        wider, left = widen(problem, found, missed)
        return Posterior(wider, left, record, words)
    left = tuple(
        np.sqrt(np.maximum(np.einsum("np,pq,nq->n", slope, found.covariance, slope), 0.0))
        for _, slope in problem.predict(found.values)
    )
    return Posterior(found, left, record, f"{words}; they are those of linear predictions")


def _told(draws: FloatArray) -> dict[str, Any]:
    """Number, means and central intervals of draws, for the record."""
    return {"draws": len(draws), "mean": np.mean(draws, axis=0).tolist()} | _intervals(
        draws
    )


def _combined(
    problem: LeastSquaresProblem, found: FitSolution, draws: FloatArray
) -> dict[str, Any]:
    """Means and intervals of the independent combinations, relative to the solution.

    In units of the prior widths, the best constrained combination first.  Where its direction
    changes over the posterior, its draws lie to one side of the solution and are not Gaussian: an
    interval describes them better than an error about the solution.
    """
    scaled = found.covariance / np.outer(problem.spreads, problem.spreads)
    weights = np.array([one.weights for one in principal(scaled)])
    off = (draws - found.values) / problem.spreads @ weights.T
    return {"mean": np.mean(off, axis=0).tolist()} | _intervals(off)


def _intervals(draws: FloatArray) -> dict[str, Any]:
    """Central intervals of the draws of each column, by their probability."""
    out = {}
    for name, share in SHARES.items():
        ends = np.quantile(draws, [(1 - share) / 2, (1 + share) / 2], axis=0)
        out[f"central_{name}"] = ends.T.tolist()
    return out


def _left(
    problem: LeastSquaresProblem, found: FitSolution, draws: FloatArray
) -> tuple[FloatArray, ...]:
    """Root mean square difference of predictions at draws from those at the solution."""
    best = [value for value, _ in problem.predict(found.values)]
    some = draws[:: max(len(draws) // PREDICTED, 1)]
    off = [np.zeros((len(some), len(one))) for one in best]
    for row, values in enumerate(some):
        for one, middle, (value, _) in zip(off, best, problem.predict(values), strict=True):
            one[row] = value - middle
    return tuple(np.sqrt(np.mean(one**2, axis=0)) for one in off)
