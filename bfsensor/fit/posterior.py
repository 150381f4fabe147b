"""The errors of a fit: of the tangent, with what it misses, or by draws where predictions bend."""

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
"""Largest second derivative of predictions that count as straight [errors a squared spread]."""

SHARES = {"68": 0.6827, "95": 0.95}
"""Of the draws in central intervals."""

PREDICTED = 100
"""Draws at which predictions are made: what the posterior leaves open of them, to 7 %."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Errors of a fit.

    Attributes
    ----------
    solution : FitSolution
        With the covariance about its values.
    left : tuple of ndarray
        What the posterior leaves open of each set's predictions.
    record : dict
        What is kept with the result: how the errors were found, and what predictions miss.
    words : str
        A sentence of it.
    draws : ndarray, shape (m, p), optional
        Of the parameters [internal units], where predictions bend.
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
    """Find the errors of a solution.

    Parameters
    ----------
    problem, found
        The fit, where it ends.
    exact : callable, optional
        Predictions of all sets from a solution at values; without it nothing is said of what
        predictions miss.
    missed : Missed, optional
        What predictions miss, measured before, in place of ``exact``.
    draws : int
        At which it is asked.
    progress : callable, optional
        Called with (solved, draws).
    """
    bent = bent_about(problem, found)
    curved = bool(np.max(np.abs(bent.second)) > STRAIGHT)
    record: dict[str, Any] = {
        "tangent_error": np.sqrt(np.diag(found.covariance)).tolist(), "curved": curved
    }  # fmt: skip
    words = "errors do not hold what predictions miss over them"
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
            f"errors hold what predictions miss at {len(missed.at)} devices drawn from the posterior: "
            f"at most {', '.join(f'{one:.2g}' for one in most)} scaled errors of the sets"
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
                f"{words}; predictions bend, but {error}: errors are too small",
            )
            record["not_drawn"] = str(error)
    if curved:
        own = with_draws(found, drawn)
        record |= _told(drawn) | {"combinations": _combined(problem, own, drawn)}
        left = _left(problem, found, drawn)
        if missed is not None:
            left = tuple(np.hypot(a, b) for a, b in zip(left, missed.rms, strict=True))
        return Posterior(
            own, left, record, f"{words}; predictions bend: the posterior was drawn from", drawn,
        )  # fmt: skip
    if missed is not None:
        wider, left = widen(problem, found, missed)
        return Posterior(wider, left, record, words)
    left = tuple(
        np.sqrt(np.maximum(np.einsum("np,pq,nq->n", slope, found.covariance, slope), 0.0))
        for _, slope in problem.predict(found.values)
    )
    return Posterior(found, left, record, f"{words}; they are those of the tangent")


def _told(draws: FloatArray) -> dict[str, Any]:
    """Means and central intervals."""
    return {"draws": len(draws), "mean": np.mean(draws, axis=0).tolist()} | _intervals(
        draws
    )


def _combined(
    problem: LeastSquaresProblem, found: FitSolution, draws: FloatArray
) -> dict[str, Any]:
    """Means and intervals of independent combinations, as far from where the fit ends.

    In units of the priors, the best known first.  Where the best known direction turns from place to
    place, its draws lie to one side of the fitted values and are not normal: an error about those
    tells less well than an interval.
    """
    scaled = found.covariance / np.outer(problem.spreads, problem.spreads)
    weights = np.array([one.weights for one in principal(scaled)])
    off = (draws - found.values) / problem.spreads @ weights.T
    return {"mean": np.mean(off, axis=0).tolist()} | _intervals(off)


def _intervals(draws: FloatArray) -> dict[str, Any]:
    out = {}
    for name, share in SHARES.items():
        ends = np.quantile(draws, [(1 - share) / 2, (1 + share) / 2], axis=0)
        out[f"central_{name}"] = ends.T.tolist()
    return out


def _left(
    problem: LeastSquaresProblem, found: FitSolution, draws: FloatArray
) -> tuple[FloatArray, ...]:
    """Scatter of predictions over draws about those of the solution."""
    best = [value for value, _ in problem.predict(found.values)]
    some = draws[:: max(len(draws) // PREDICTED, 1)]
    off = [np.zeros((len(some), len(one))) for one in best]
    for row, values in enumerate(some):
        for one, middle, (value, _) in zip(off, best, problem.predict(values), strict=True):
            one[row] = value - middle
    return tuple(np.sqrt(np.mean(one**2, axis=0)) for one in off)
