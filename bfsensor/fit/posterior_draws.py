r"""Draws from the posterior of a fit whose predictions are second order in the parameters.

Where the data hardly constrain parameters, a_ij depart from linear predictions by more than their
errors within the priors, and the best constrained combination changes over the posterior: the
Gaussian of linear predictions at the solution is too narrow along its own best combinations.

Predictions are second order about the solution, as an emulator gives them.  Draws are made by
Hamiltonian Monte Carlo in units of the prior widths (Neal 2011, Handbook of Markov Chain Monte Carlo,
section 5.3), with many chains at once; elliptical slice sampling moves too slowly in the curved
tails.  Covariances are about the solution, not the mean: an error stated with a value describes how
far the truth is from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bfsensor.errors import ConvergenceError
from bfsensor.fit.least_squares import FitSolution, LeastSquaresProblem, ordered_pairs
from bfsensor.typing import FloatArray

CHAINS, STEPS = 16, 300
"""Number of chains, and draws of each after half as many that adapt the step and are discarded.

Chosen: 4800 draws; twice as many draws of each take twice as long, and chains that do not agree are
refused more seldom (:data:`AGREED`)."""

LENGTH = np.pi / 2
"""Length of a trajectory [prior widths at unit speed].

Derived: a quarter period of the prior, of unit width; without data its end is independent of its
start."""

WANTED = 0.85
"""Fraction of accepted trajectories to which the step is adapted.

Chosen, above the optimum of 0.65 of Neal 2011, section 5.4: curved tails need shorter steps.  It
cannot be twice as large; at 0.95 steps are shorter and draws take longer."""

AGREED = 1.1
"""Largest ratio of the spread of all chains to that within them for any parameter, above which
draws are refused (published: Gelman and Rubin 1992)."""

SEED = 4409
"""Seed of the draws.  Chosen, arbitrary: another one changes errors by the scatter of 4800 draws."""


@dataclass(frozen=True, eq=False)
class CurvedPosterior:
    """Fitted numbers to second order in the parameters about a solution of a fit.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Predicted minus measured numbers at the solution [scaled errors].
    first, second : ndarray, shape (n, p) and (n, p, p)
        Derivatives there [scaled errors per prior width, and per product of two].

    Examples
    --------
    >>> straight = CurvedPosterior(np.zeros(1), np.ones((1, 1)), np.zeros((1, 1, 1)))
    >>> straight.at(np.array([[2.0]]))
    (array([2.]), array([[2.]]))
    """

    residual: FloatArray
    first: FloatArray
    second: FloatArray

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate half of chi2 and its gradient at steps from the solution.

        Parameters
        ----------
        t : ndarray, shape (chains, p)
            Steps [prior widths].

        Returns
        -------
        half, gradient : ndarray, shapes (chains,) and (chains, p)
            Half of chi2 of the data, without priors, and its derivatives.
        """
        turned = np.einsum("nij,cj->cni", self.second, t, optimize=True)
        slopes = self.first + turned
        r = self.residual + np.einsum("cni,ci->cn", self.first + 0.5 * turned, t)
        return 0.5 * np.sum(r**2, axis=1), np.einsum("cni,cn->ci", slopes, r)


def bent_about(problem: LeastSquaresProblem, found: FitSolution) -> CurvedPosterior:
    """Expand the predictions to second order: derivatives one prior width to either side."""

    def there(values: FloatArray) -> tuple[FloatArray, FloatArray]:
        residuals, slopes = [], []
        for data, scale, (value, slope) in zip(
            problem.sets, found.scales, problem.predict(values), strict=True
        ):
            if data.fitted:
                errors = scale * data.errors
                residuals.append((value - data.values) / errors)
                slopes.append(slope * problem.spreads / errors[:, None])
        return np.concatenate(residuals), np.concatenate(slopes)

    residual, first = there(found.values)
    steps = np.diag(problem.spreads)
    turns = [
        0.5 * (there(found.values + step)[1] - there(found.values - step)[1])
        for step in steps
    ]
    second = np.moveaxis(np.array(turns), 0, -1)
    return CurvedPosterior(residual, first, 0.5 * (second + np.swapaxes(second, 1, 2)))


def sample_posterior(
    problem: LeastSquaresProblem,
    found: FitSolution,
    *,
    bent: CurvedPosterior | None = None,
    unknown: FloatArray | None = None,
    chains: int = CHAINS,
    steps: int = STEPS,
    seed: int = SEED,
) -> FloatArray:
    """Draw from the posterior of a fit at fixed scales of the errors.

    Parameters
    ----------
    problem : LeastSquaresProblem
        Parameters with priors, data and predictors.
    found : FitSolution
        Its solution.
    unknown : ndarray, shape (n, n), optional
        Covariance of the error of the predictions of the n fitted numbers, in units of their scaled
        errors; by default 0.
    chains, steps : int
        Number of chains, at least 1, and of draws that are kept of each.
    seed : int
        Seed of all random numbers.

    Returns
    -------
    draws : ndarray, shape (chains * steps, p)
        Values of the parameters [internal units].

    Raises
    ------
    ConvergenceError
        The chains do not agree (:data:`AGREED`).

    Notes
    -----
    Predictions to second order about the solution are computed, unless given as the keyword argument
    of type :class:`CurvedPosterior`.

    Examples
    --------
    One number that measures the sum of two parameters with a third of their prior widths:

    >>> from bfsensor.device.quantities import Prior
    >>> from bfsensor.fit.data import area_data
    >>> from bfsensor.fit.least_squares import solve
    >>> from bfsensor.fit.predictors import TangentPredictor
    >>> priors = tuple(Prior(name, 0.0, 1.0) for name in "ab")
    >>> data = area_data("sum", [[0.5]], [[1 / 3]], scaled=False)
    >>> sums = TangentPredictor(np.zeros(2), np.zeros(1), np.ones((1, 2)))
    >>> problem = LeastSquaresProblem(priors, (data,), (sums,))
    >>> draws = sample_posterior(problem, solve(problem), steps=500)
    >>> draws.shape, bool(0.28 < draws.sum(1).std() < 0.36)
    ((8000, 2), True)
    """
    bent = bent if bent is not None else bent_about(problem, found)
    bent = _whitened(bent, unknown)
    p = bent.first.shape[1]
    height = _make_height(problem, found.values, bent)
    rng = np.random.default_rng(seed)
    wide = np.linalg.cholesky(np.linalg.inv(bent.first.T @ bent.first + np.eye(p)))
    t = 0.5 * rng.standard_normal((chains, p)) @ wide.T
    now, slope = height(t)
    lost = ~np.isfinite(now)
    t[lost] = 0.0
    now, slope = height(t)
    step = 0.5 * float(np.min(np.linalg.svd(wide, compute_uv=False)))
    shortest = 0.1 * step
    kept = np.empty((chains, steps, p))
    for number in range(-steps // 2, steps):
        step_now = step * rng.uniform(0.8, 1.2)
        ends = _trajectory(t, slope, step_now, rng.standard_normal(t.shape), height)
        gained = now - ends[1] + ends[3]
        # Out of bounds, or diverged by too long a step: not finite, and refused.
        taken = np.log(rng.uniform(size=chains)) < np.where(
            np.isfinite(gained), gained, -np.inf
        )
        t = np.where(taken[:, None], ends[0], t)
        now, slope = np.where(taken, ends[1], now), np.where(taken[:, None], ends[2], slope)
        if number < 0:
            step = max(step * np.exp(0.3 * (np.mean(taken) - WANTED)), shortest)
        else:
            kept[:, number] = t
    _check_agreement(problem, kept)
    return np.asarray(found.values + problem.spreads * kept.reshape(-1, p))


def _whitened(bent: CurvedPosterior, unknown: FloatArray | None) -> CurvedPosterior:
    """Change units so that errors of data and predictions together are independent and 1."""
    n = len(bent.residual)
    root = np.linalg.cholesky(
        np.eye(n) + (np.zeros((n, n)) if unknown is None else unknown)
    )
    return CurvedPosterior(*(np.linalg.solve(root, part.reshape(n, -1)).reshape(part.shape)
                  for part in (bent.residual, bent.first, bent.second)))  # fmt: skip


def _make_height(
    problem: LeastSquaresProblem, best: FloatArray, bent: CurvedPosterior
) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
    """Make the function minus the logarithm of the posterior, of steps in prior widths."""
    spreads = problem.spreads
    off = (best - problem.means) / spreads
    low, high = (
        (np.array([getattr(prior, end) for prior in problem.priors]) - best) / spreads
        for end in ("low", "high")
    )
    pairs = ordered_pairs(problem)

    def height(t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values, infinite out of bounds, and gradients."""
        half, slopes = bent.at(t)
        half += 0.5 * np.sum((off + t) ** 2, axis=1)
        out = np.any((t < low) | (t > high), axis=1)
        there = best + t * spreads
        for lower, upper in pairs:
            out |= there[:, lower] > there[:, upper]
        return np.where(out, np.inf, half), slopes + off + t

    return height


def _check_agreement(problem: LeastSquaresProblem, kept: FloatArray) -> None:
    """Refuse draws, shape (chains, steps, p), if the chains do not agree."""
    if len(kept) == 1:
        return
    within = kept.var(axis=1, ddof=1).mean(0)
    ratio = np.sqrt(1 + kept.mean(1).var(axis=0, ddof=1) / within)
    if np.max(ratio) > AGREED:
        raise ConvergenceError(
            f"draws of {problem.priors[int(np.argmax(ratio))].name} differ between chains: their "
            f"spread is {np.max(ratio):.2f} times that within them, above {AGREED:g}",
            ratio.tolist(),
        )


def _trajectory(
    t: FloatArray,
    slope: FloatArray,
    step: float,
    speed: FloatArray,
    height: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Leapfrog steps: the end, height and gradient there, and the loss of kinetic energy."""
    begun = 0.5 * np.sum(speed**2, axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(max(int(LENGTH / step), 1)):
            speed = speed - 0.5 * step * slope
            t = t + step * speed
            there, slope = height(t)
            speed = speed - 0.5 * step * slope
        return t, there, slope, begun - 0.5 * np.sum(speed**2, axis=1)


def with_draws(found: FitSolution, draws: FloatArray) -> FitSolution:
    """Replace the covariance of a solution by the second moments of draws about its values."""
    off = draws - found.values
    return replace(found, covariance=off.T @ off / len(off))
