r"""The posterior of a fit whose predictions bend, by draws.

Where parameters that the data hardly determine move by the spreads of their priors, a_ij bend by
more than their errors, and the combination that is measured best is another one from place to
place: a Gaussian of the tangent at the best values is too narrow along its own best combinations.

Predictions are taken to second order about the best values, which is what an emulator gives; draws
are made by Hamiltonian steps in spreads of the priors (Neal 2011, Handbook of Markov Chain Monte
Carlo, section 5.3), many chains at once.  Elliptical slices of a Gaussian stick in the bent tails.
Covariances are about the best values, not the mean: what is stated with a value is how far the
truth is from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bfsensor.errors import ConvergenceError
from bfsensor.fit.least_squares import FitSolution, LeastSquaresProblem, ordered_pairs
from bfsensor.typing import FloatArray

CHAINS, STEPS = 16, 300
"""Chains, and draws of each, after half as many that set the step and are left out."""

LENGTH = np.pi / 2
"""Of a trajectory: a quarter turn where the data say nothing, after which it forgot its start."""

WANTED = 0.85
"""Share of the trajectories that end where they are accepted, to which the step is set."""

AGREED = 1.1
"""Largest spread of all chains over that within them (Gelman and Rubin 1992), by parameter."""

SEED = 4409


@dataclass(frozen=True, eq=False)
class CurvedPosterior:
    """Fitted numbers to second order, in errors of the data and spreads of the priors.

    Attributes
    ----------
    residual : ndarray, shape (n,)
        Predicted less measured at the middle.
    first, second : ndarray, shape (n, p) and (n, p, p)
        Derivatives there.
    """

    residual: FloatArray
    first: FloatArray
    second: FloatArray

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Halves of chi2, shape (chains,), and slopes at steps from the middle, (chains, p)."""
        turned = np.einsum("nij,cj->cni", self.second, t, optimize=True)
        slopes = self.first + turned
        r = self.residual + np.einsum("cni,ci->cn", self.first + 0.5 * turned, t)
        return 0.5 * np.sum(r**2, axis=1), np.einsum("cni,cn->ci", slopes, r)


def bent_about(problem: LeastSquaresProblem, found: FitSolution) -> CurvedPosterior:
    """Second derivatives from first ones a spread to either side of the solution."""

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
    """Draw from the posterior, the scales of the errors held.

    Parameters
    ----------
    problem, found
        The fit, where it ends.
    bent : CurvedPosterior, optional
        :func:`bent_about` them.
    unknown : ndarray, shape (n, n), optional
        Covariance of what the prediction of the fitted numbers misses, in their scaled errors.
    chains, steps : int
        How many, and how long.
    seed : int
        Of the draws.

    Returns
    -------
    draws : ndarray, shape (m, p)
        [internal units].

    Raises
    ------
    ConvergenceError
        The chains do not agree.
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
        # Out of bounds, or thrown far off by too long a step: infinite or not a number.
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
    """Count what predictions miss with the errors: in units of both they are independent."""
    n = len(bent.residual)
    root = np.linalg.cholesky(
        np.eye(n) + (np.zeros((n, n)) if unknown is None else unknown)
    )
    return CurvedPosterior(*(np.linalg.solve(root, part.reshape(n, -1)).reshape(part.shape)
                  for part in (bent.residual, bent.first, bent.second)))  # fmt: skip


def _make_height(
    problem: LeastSquaresProblem, best: FloatArray, bent: CurvedPosterior
) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
    """Make minus the logarithm of the posterior, by steps from the best values in spreads."""
    spreads = problem.spreads
    off = (best - problem.means) / spreads
    low, high = (
        (np.array([getattr(prior, end) for prior in problem.priors]) - best) / spreads
        for end in ("low", "high")
    )
    pairs = ordered_pairs(problem)

    def height(t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Its values and slopes; infinite out of bounds."""
        half, slopes = bent.at(t)
        half += 0.5 * np.sum((off + t) ** 2, axis=1)
        out = np.any((t < low) | (t > high), axis=1)
        there = best + t * spreads
        for lower, upper in pairs:
            out |= there[:, lower] > there[:, upper]
        return np.where(out, np.inf, half), slopes + off + t

    return height


def _check_agreement(problem: LeastSquaresProblem, kept: FloatArray) -> None:
    """Refuse draws, shape (chains, steps, p), of chains that lie apart."""
    if len(kept) == 1:
        return
    within = kept.var(axis=1, ddof=1).mean(0)
    ratio = np.sqrt(1 + kept.mean(1).var(axis=0, ddof=1) / within)
    if np.max(ratio) > AGREED:
        raise ConvergenceError(
            f"draws of {problem.priors[int(np.argmax(ratio))].name} differ between chains: "
            f"{np.max(ratio):.2f} above {AGREED:g}",
            ratio.tolist(),
        )


def _trajectory(
    t: FloatArray,
    slope: FloatArray,
    step: float,
    speed: FloatArray,
    height: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Leapfrog: where it ends, height and slopes there, and kinetic energy that was lost."""
    begun = 0.5 * np.sum(speed**2, axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(max(int(LENGTH / step), 1)):
            speed = speed - 0.5 * step * slope
            t = t + step * speed
            there, slope = height(t)
            speed = speed - 0.5 * step * slope
        return t, there, slope, begun - 0.5 * np.sum(speed**2, axis=1)


def with_draws(found: FitSolution, draws: FloatArray) -> FitSolution:
    """Give the solution with the covariance of draws about its values."""
    off = draws - found.values
    return replace(found, covariance=off.T @ off / len(off))
