"""The errors of a fit: of the tangent, with what it misses, or by draws where predictions bend."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import ConvergenceError
from bfsensor.fit.missed import (
    DRAWS,
    Exact,
    Missed,
    fitted_numbers,
    measure_missed,
    relative_errors,
    widen,
)
from bfsensor.fit.sampled import bent_about, sample_posterior, with_draws
from bfsensor.fit.solve import Problem, Solution

Values = NDArray[np.float64]

STRAIGHT = 1e-3
"""Largest second derivative of predictions that count as straight [errors a squared spread]."""

PREDICTED = 100
"""Draws at which predictions are made: what the posterior leaves open of them, to 7 %."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Errors of a fit.

    Attributes
    ----------
    solution : Solution
        With the covariance about its values.
    left : tuple of ndarray
        What the posterior leaves open of each set's predictions.
    record : dict
        What is kept with the result: how the errors were found, and what predictions miss.
    words : str
        A sentence of it.
    """

    solution: Solution
    left: tuple[Values, ...]
    record: dict[str, Any] = field(default_factory=dict)
    words: str = ""


def find_posterior(
    problem: Problem,
    found: Solution,
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
        record |= _told(drawn)
        left = _left(problem, found, drawn)
        if missed is not None:
            left = tuple(np.hypot(a, b) for a, b in zip(left, missed.rms, strict=True))
        return Posterior(
            with_draws(found, drawn), left, record,
            f"{words}; predictions bend: the posterior was drawn from",
        )  # fmt: skip
    if missed is not None:
        wider, left = widen(problem, found, missed)
        return Posterior(wider, left, record, words)
    left = tuple(
        np.sqrt(np.maximum(np.einsum("np,pq,nq->n", slope, found.covariance, slope), 0.0))
        for _, slope in problem.predict(found.values)
    )
    return Posterior(found, left, record, f"{words}; they are those of the tangent")


def _told(draws: Values) -> dict[str, Any]:
    """Means and central intervals."""
    low, high = (1 - 0.6827) / 2, (1 - 0.95) / 2
    return {
        "draws": len(draws), "mean": np.mean(draws, axis=0).tolist(),
        "central_68": np.quantile(draws, [low, 1 - low], axis=0).T.tolist(),
        "central_95": np.quantile(draws, [high, 1 - high], axis=0).T.tolist(),
    }  # fmt: skip


def _left(problem: Problem, found: Solution, draws: Values) -> tuple[Values, ...]:
    """Scatter of predictions over draws about those of the solution."""
    best = [value for value, _ in problem.predict(found.values)]
    some = draws[:: max(len(draws) // PREDICTED, 1)]
    off = [np.zeros((len(some), len(one))) for one in best]
    for row, values in enumerate(some):
        for one, middle, (value, _) in zip(off, best, problem.predict(values), strict=True):
            one[row] = value - middle
    return tuple(np.sqrt(np.mean(one**2, axis=0)) for one in off)
