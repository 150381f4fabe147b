r"""What the predictions of a fit miss over its posterior, as an error of theirs.

A fit predicts by the tangent where it ends, or by an emulator.  The device is solved at values drawn
from the posterior, and what predictions miss there,

.. math:: m(\theta) = f(\theta) - f_\mathrm{predicted}(\theta), \qquad R = \langle m\, m^T \rangle ,

is taken as an error of the prediction besides those of the data (Kaipio and Somersalo 2007, J. Comput.
Appl. Math. 198, 493), with :math:`P` of the priors and :math:`s^2 \Sigma` of the data:

.. math:: C = \left(P^{-1} + J^T V^{-1} J\right)^{-1}, \quad V = s^2 \Sigma + R, \qquad
          \mathrm{var}(f) = M - M (M + s^2 \Sigma)^{-1} M, \quad M = J P J^T + R .

The mean of :math:`m` counts in :math:`R`: values stay where the posterior is largest.  Of a tangent
over which a_ij bend by more than the data's errors this is half the cure: with the bend of the
emulated ITL device the best two combinations of each fit have pulls of 2.3 rms without and 1.6, 1.3
with it (50 mocks); draws of the bent posterior (:mod:`bfsensor.fit.posterior_draws`) are the whole one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import BFSensorError, FitError
from bfsensor.fit.least_squares import FitSolution, LeastSquaresProblem, out_of_order
from bfsensor.typing import FloatArray

Exact = Callable[[FloatArray], Sequence[FloatArray]]
"""Predictions of all sets at values of all parameters, from a solution there."""

DRAWS = 12
"""At which the device is solved: each variance of what is missed is then known to 40 %."""

SEED = 6203
TRIES = 20
"""Draws for each that is used: some lie out of bounds, or where there is no device."""


@dataclass(frozen=True, eq=False)
class Missed:
    """What predictions miss at values drawn from a posterior.

    Attributes
    ----------
    at : ndarray, shape (k, p)
        FloatArray [internal units].
    values : tuple of ndarray, each of shape (k, n)
        Solved less predicted, by data set.
    """

    at: FloatArray
    values: tuple[FloatArray, ...]

    @property
    def rms(self) -> tuple[FloatArray, ...]:
        """Of each number, by data set."""
        return tuple(np.sqrt(np.mean(v**2, axis=0)) for v in self.values)


def measure_missed(
    problem: LeastSquaresProblem,
    found: FitSolution,
    exact: Exact,
    *,
    draws: int = DRAWS,
    seed: int = SEED,
    progress: Callable[[int, int], None] | None = None,
) -> Missed:
    """Hold predictions against solutions over the posterior.

    Parameters
    ----------
    problem, found
        The fit, where it ends.
    exact : callable
        Predictions of all sets at values of all parameters; raises ``BFSensorError`` or
        ``ValueError`` where there is no such device.
    draws : int
        How many values are drawn.
    seed : int
        Of the draws.
    progress : callable, optional
        Called with (solved, draws).

    Raises
    ------
    FitError
        There are hardly any devices over the posterior.
    """
    rng = np.random.default_rng(seed)
    spreads = problem.spreads
    root = np.linalg.cholesky(found.covariance / np.outer(spreads, spreads))
    low, high = (
        np.array([getattr(q, end) for q in problem.priors]) for end in ("low", "high")
    )
    at: list[FloatArray] = []
    missed: list[list[FloatArray]] = []
    for _ in range(TRIES * draws):
        if len(at) == draws:
            break
        step = spreads * (root @ rng.standard_normal(len(spreads)))
        there = found.values + step
        if np.any(there < low) or np.any(there > high) or out_of_order(problem, there):
            continue
        try:
            solved = exact(there)
        except (BFSensorError, ValueError):
            continue
        predicted = problem.predict(there)
        missed.append(
            [one - value for one, (value, _) in zip(solved, predicted, strict=True)]
        )
        at.append(there)
        if progress is not None:
            progress(len(at), draws)
    if len(at) < draws:
        raise FitError(
            f"only {len(at)} of {draws} devices drawn from the posterior have a solution"
        )
    return Missed(
        np.array(at),
        tuple(np.array([m[k] for m in missed]) for k in range(len(problem.sets))),
    )


def relative_errors(
    problem: LeastSquaresProblem, found: FitSolution, missed: Missed
) -> FloatArray:
    """Covariance of what the predictions of all numbers miss, in scaled errors of the data."""
    errors = np.concatenate([
        s * one.errors for s, one in zip(found.scales, problem.sets, strict=True)
    ])  # fmt: skip
    m = np.concatenate(missed.values, axis=1) / errors
    return np.asarray(m.T @ m / len(m))


def fitted_numbers(problem: LeastSquaresProblem) -> NDArray[np.int64]:
    """Which of all numbers are fitted."""
    return np.flatnonzero(np.repeat(
        [one.fitted for one in problem.sets], [len(one.values) for one in problem.sets]
    ))  # fmt: skip


def widen(
    problem: LeastSquaresProblem, found: FitSolution, missed: Missed
) -> tuple[FitSolution, tuple[FloatArray, ...]]:
    """Count what predictions miss as an error of theirs.

    Parameters
    ----------
    problem, found
        The fit, where it ends.
    missed : Missed
        Over its posterior.

    Returns
    -------
    solution : FitSolution
        With the wider covariance, and sensitivities in the larger errors.
    errors : tuple of ndarray
        What the posterior leaves open of each set's predictions.
    """
    errors = np.concatenate([
        s * one.errors for s, one in zip(found.scales, problem.sets, strict=True)
    ])  # fmt: skip
    # All in errors of the data, and in spreads of the priors.
    slopes = np.concatenate([slope for _, slope in problem.predict(found.values)])
    slopes = slopes * problem.spreads / errors[:, None]
    r, f = relative_errors(problem, found, missed), fitted_numbers(problem)
    noise = np.eye(len(f))
    sensitivity = np.linalg.solve(np.linalg.cholesky(r[np.ix_(f, f)] + noise), slopes[f])
    covariance = np.linalg.inv(sensitivity.T @ sensitivity + np.eye(len(problem.spreads)))
    before = slopes @ slopes.T + r
    told = np.linalg.solve(before[np.ix_(f, f)] + noise, before[f])
    left = np.diag(before) - np.einsum("fn,fn->n", before[f], told)
    ends = np.cumsum([len(one.values) for one in problem.sets])[:-1]
    return (
        replace(
            found, covariance=covariance * np.outer(problem.spreads, problem.spreads),
            sensitivity=sensitivity,
        ),
        tuple(np.split(errors * np.sqrt(np.maximum(left, 0.0)), ends)),
    )  # fmt: skip
