r"""Joint fit of device, gains, linear terms, effects and random effects within a trust region.

The whitened values :math:`y` of all channels are modelled as

.. math::
    y = f(\theta) + L \beta + M(\theta) u + \epsilon, \qquad
    \epsilon \sim N(0, 1), \quad u \sim N(0, 1),

with non-linear parameters :math:`\theta` (device, gains, effects), linear ones :math:`\beta` and
random effects :math:`u`, whose strength is in the modes :math:`M`.  The fit minimises the penalised
sum of squares

.. math::
    |y - f(\theta) - L \beta - M u|^2 + |u|^2 + |\theta_\mathrm{prior}|^2
    + |t - R (\theta - \theta_0)|^2

(Henderson's mixed-model equations), by :func:`scipy.optimize.least_squares` in :math:`\theta` with
:math:`\beta` and :math:`u` projected out.  For given :math:`M` that is least squares with the
covariance :math:`1 + M M^T` (Woodbury's identity).  The last term is the score of the restricted
likelihood for parameters that enter through :math:`M`
(:mod:`bfsensor.diagnose.fit.random_effects`).

References
----------
Henderson 1975, Biometrics 31, 423 (mixed-model equations); Golub & Pereyra 1973, SIAM J. Numer.
Anal. 10, 413 (linear parameters projected out); Branch, Coleman & Li 1999, SIAM J. Sci. Comput. 21,
1 (trust region with bounds).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import OptimizeResult, least_squares

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.fit.random_effects import no_score, score_of, scored
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect
from bfsensor.errors import ConvergenceError
from bfsensor.inference.bounded_lsq import SINGULAR, BoundedSolution, solve_within, span
from bfsensor.typing import FloatArray

ROUNDS = 40
"""Largest number of points that one minimisation evaluates; a fit that needs more ends at its best
point, marked as not converged.  Chosen: twice as many doubles the time that a fit which does not
converge takes, and changes none that does; fits of ``python -m tests.golden`` need 3 to 15."""

NEAR = 0.01
"""Decrease of the chi-square, for residuals of unit variance, below which a fit has converged.
Chosen: the square of 0.1, the distance in standard errors of the minimum along one direction; twice
as large, of 0.14."""

FIRST, STILL = 1e4, 1e-6
"""First radius of the trust region [standard errors], and the part of it below which the minimiser
ends.  Chosen: baselines start within 1e4 errors of the minimum, and the first step is a full
Gauss-Newton step; at twice as many the region shrinks once more where that misleads.  The part is
0.01 errors."""

SHRUNK = 3
"""Status of :func:`scipy.optimize.least_squares` where only :data:`STILL` ended it, by
scipy's definition."""

ANEW, AWAY = 8, 0.1
"""Largest number of times that the modes and the score of the variance parameters are linearised
again, and the distance [standard errors] of such a parameter from the last point of linearisation
above which that is done.  Chosen, to be derived: after twice as many times, or within 0.2 errors, an
estimate may differ by the curvature of the restricted likelihood, of second order in that distance."""

IDLE = 1.0
"""Decrease of the chi-square promised by the derivatives below which parameters count as fitted:
the residuals returned are then orthogonal to their columns.  Chosen, to be derived: a decrease
of 1 is what noise makes of one free parameter; with 2, residuals would be projected on a linear
model that missed the minimum by up to 1.4 errors."""

Seen = tuple[list[FloatArray], FloatArray]
"""Predictions of each channel, and the whitened residuals of all."""


class Steps:
    """Minimisation of the penalised sum of squares from a point, which :meth:`go` moves.

    Parameters
    ----------
    predictor : Predictor
        Predicts the channels; its ``start`` is the first point.
    channels : sequence of Channel
        Values to fit.
    slopes : ndarray, shape (values, parameters), optional
        Whitened derivatives of another fit of the same channels, of which those by parameters
        other than effects' are used until they mislead; they hardly depend on the effects.

    Attributes
    ----------
    point : ndarray, shape (p,)
        Non-linear parameters.
    solved : BoundedSolution
        The last solution: steps of the non-linear parameters, linear parameters, random effects.
    slopes : ndarray, shape (values, p)
        Whitened derivatives of the predictions.
    modes : ndarray, shape (values, m)
        Whitened modes :math:`M` of the random effects.
    score : Score
        Score of the variance parameters.
    converged : bool
        Whether the last :meth:`go` ended at a minimum.
    """

    def __init__(
        self,
        predictor: Predictor,
        channels: Sequence[Channel],
        slopes: FloatArray | None = None,
    ) -> None:
        self.predictor, self.channels = predictor, channels
        self.starts = np.concatenate([[0], np.cumsum([len(c) for c in channels])])
        self.total = int(self.starts[-1])
        self._find_columns()
        self.count, self._priors = len(predictor.names), len(predictor.prior_rows)
        self.effect = np.char.startswith(np.array(predictor.names, str), "effect ")
        # An effect in electrons on means of flats [ADU] makes them depend on the gains, whose
        # derivatives are then found again in each round, too.
        flats = any("flat_mean" in e.touches for e in predictor.effects)
        gains = np.char.startswith(np.array(predictor.names, str), "gain ")
        self._anew = self.effect | (gains & flats)
        self.point = predictor.start.astype(float).copy()
        self.slopes = np.zeros((self.total, self.count))
        # At full well covariances no longer depend on the device: derivatives of a fit without
        # saturation do not hold.
        full = any(np.isfinite(e.law().full_well) for e in predictor.effects)
        self._borrowed = slopes is not None and not full
        self._chance = any(type(e).modes is not Effect.modes for e in predictor.effects)
        if slopes is not None and not full:
            plain = int((~self.effect).sum())
            self.slopes[:, :plain] = slopes[:, :plain]
        self.converged = False
        self._there: FloatArray | None = None
        self._fresh = 0
        self.solved: BoundedSolution
        self._last: tuple[FloatArray, Seen] | None = None
        self._scored = np.array(sorted(scored(predictor)), int)
        self.update_chance()

    def _find_columns(self) -> None:
        columns: dict[str, FloatArray] = {}
        for channel, start in zip(self.channels, self.starts, strict=False):
            for name, column in self.predictor.linear(channel).items():
                whole = columns.setdefault(name, np.zeros(self.total))
                whole[start : start + len(channel)] += channel.whiten(column)
        # A column of zeros would make the QR decomposition below singular.
        columns = {k: v for k, v in columns.items() if np.abs(v).max() > 0}
        self.columns = tuple(columns)
        linear = np.array(list(columns.values())).T.reshape(self.total, len(columns))
        self.scales = np.sqrt((linear**2).sum(0))
        self._linear = linear / self.scales

    def update_chance(self) -> None:
        """Compute the modes of the random effects, and the score, at the point."""
        found = [self.predictor.modes(c, self.point) for c in self.channels]
        found = [
            c.whiten(m) if m.shape[1] else m
            for c, m in zip(self.channels, found, strict=True)
        ]
        some = any(m.shape[1] for m in found)
        self.modes = block_diag(*found) if some else np.zeros((self.total, 0))
        # QR of [[L, M], [0, 1]], the rows below being the priors of u: with Q1 the upper rows of
        # its orthonormal columns, 1 - Q1 Q1^T = C^-1 - C^-1 L (L^T C^-1 L)^-1 L^T C^-1 of
        # C = 1 + M M^T, by Woodbury's identity, without inverting C (n x n).
        chance = self.modes.shape[1]
        both = np.zeros((self.total + chance, self._linear.shape[1] + chance))
        both[: self.total] = np.concatenate([self._linear, self.modes], axis=1)
        both[self.total :, self._linear.shape[1] :] = np.eye(chance)
        self._whole = span(both)
        self._span = self._whole[: self.total]
        self._update_score()

    def _update_score(self) -> None:
        """Linearise the score of the variance parameters at the point."""
        self.score = no_score(self.point)
        if len(self._scored):
            self.score = score_of(
                self.predictor, self.channels, self.point, self.modes, self._span,
                self.residuals(self.point)[1],
            )  # fmt: skip

    def _limits(self) -> FloatArray:
        """Smallest and largest values of the parameters, shape (2, p).

        Variance parameters stay between half and twice the value at which their score was
        linearised: their information goes with the inverse square of the value, so that the
        linear score says nothing farther away.
        """
        ends = np.array(self.predictor.limits(), float)
        own = self._scored[(self.score.rows[:, self._scored] != 0).any(0)]
        there = np.sort(self.score.origin[own] * np.array([[0.5], [2.0]]), axis=0)
        ends[:, own] = np.clip(there, *ends[:, own])
        # A value outside its range, such as a start, may only move towards it.
        ends[0] = np.minimum(ends[0], self.point)
        ends[1] = np.maximum(ends[1], self.point)
        return ends

    def _behind(self) -> bool:
        """Whether a variance parameter has moved by more than AWAY since its score was found."""
        rows = self._projected_slopes()[:, self._scored]
        errors = 1 / np.maximum(np.sqrt((rows**2).sum(0)), 1e-300)
        away = np.abs(self.point - self.score.origin)[self._scored]
        return bool((away > AWAY * errors).any())

    def residuals(self, point: FloatArray) -> Seen:
        """Predictions and whitened residuals at a point; those of the last point are cached."""
        if self._last is not None and np.array_equal(self._last[0], point):
            return self._last[1]
        # Far outside physical ranges predictions overflow: such a point is refused below.
        with np.errstate(over="ignore", invalid="ignore"):
            predicted = [self.predictor.predict(c, point) for c in self.channels]
        if not all(np.isfinite(p).all() for p in predicted):
            raise ConvergenceError(
                "predictions overflow: parameters are far from any sensor's"
            )
        left = [
            c.whiten(c.values - p) for c, p in zip(self.channels, predicted, strict=True)
        ]
        self._last = point.copy(), (predicted, np.concatenate(left))
        return self._last[1]

    def differentiate(
        self,
        which: NDArray[np.bool_],
        point: FloatArray,
        predicted: Sequence[FloatArray],
    ) -> None:
        """Find derivatives by some parameters; where that fails old ones are kept."""
        for n in map(int, np.flatnonzero(which)):
            for channel, start, here in zip(
                self.channels, self.starts, predicted, strict=False
            ):
                if not self.predictor.depends(channel)[n]:
                    continue
                try:
                    with np.errstate(over="ignore", invalid="ignore"):
                        change = self.predictor.slope(channel, point, n, here)
                except ConvergenceError:
                    # At the edge of the range in which widths of spots can be computed.
                    continue
                if np.isfinite(change).all():
                    self.slopes[start : start + len(channel), n] = channel.whiten(change)

    def problem(
        self, residuals: FloatArray, point: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Design matrix and target of one linear step.

        Rows: whitened values, priors of device parameters, priors of random effects, score.
        Columns: non-linear parameters, linear ones, random effects.
        """
        plainly, chance = self.count + self._linear.shape[1], self.modes.shape[1]
        rows = self.predictor.prior_rows
        count = self.total + self._priors + chance + len(self.score.target)
        design = np.zeros((count, plainly + chance))
        design[: self.total, : self.count] = self.slopes
        design[: self.total, self.count : plainly] = self._linear
        design[: self.total, plainly:] = self.modes
        design[self.total + np.arange(self._priors), rows] = 1.0
        last = self.total + self._priors + np.arange(chance)
        design[last, plainly + np.arange(chance)] = 1.0
        design[count - len(self.score.target) :, : self.count] = self.score.rows
        told = self.score.left(point)
        return design, np.concatenate([residuals, -point[rows], np.zeros(chance), told])

    def _projected(self, residuals: FloatArray, point: FloatArray) -> FloatArray:
        """Residuals with linear parameters and random effects at their best, priors included."""
        first = len(self._whole)
        out = np.zeros(first + self._priors + len(self.score.target))
        out[: self.total] = residuals
        out[:first] -= self._whole @ (self._span.T @ residuals)
        out[first : first + self._priors] = -point[self.predictor.prior_rows]
        out[first + self._priors :] = self.score.left(point)
        return out

    def _projected_slopes(self) -> FloatArray:
        """Derivatives of the prediction, projected as :meth:`_projected` does, priors included."""
        first = len(self._whole)
        out = np.zeros((first + self._priors + len(self.score.target), self.count))
        out[: self.total] = self.slopes
        out[:first] -= self._whole @ (self._span.T @ self.slopes)
        out[first + np.arange(self._priors), self.predictor.prior_rows] = 1.0
        out[first + self._priors :] = self.score.rows
        # A column of which the projection leaves rounding errors alone would get a random step.
        norms = np.sqrt((self.slopes**2).sum(0) + (self.score.rows**2).sum(0))
        norms[self.predictor.prior_rows] = np.hypot(norms[self.predictor.prior_rows], 1.0)
        out[:, np.sqrt((out**2).sum(0)) < SINGULAR * norms] = 0.0
        return out

    def solve(
        self,
        residuals: FloatArray,
        point: FloatArray,
        held: NDArray[np.bool_] | None = None,
    ) -> BoundedSolution:
        """Best step of all parameters within their reach, some non-linear ones held."""
        design, target = self.problem(residuals, point)
        ends = np.repeat([[-np.inf], [np.inf]], design.shape[1], axis=1)
        ends[:, : self.count] = self._limits() - point
        if held is not None:
            ends[:, : self.count][:, held] = 0.0
        return solve_within(design, target, *ends)

    def go(self) -> None:
        """Minimise by a trust region, and linearise the random effects again until they stay.

        Linear parameters and random effects are projected out, so that the minimiser sees the
        non-linear parameters alone.  The fit always ends: ``converged`` says whether at a minimum.
        """
        self.converged = self._descend()
        for turn in range(ANEW if self._chance else 0):
            if turn and not self._behind():
                break
            self.update_chance()
            self.converged = self._descend()
        self._end()

    def _descend(self) -> bool:
        """Move to the minimum for given modes; False if :data:`ROUNDS` points do not reach it.

        Derivatives by parameters other than effects' hardly change: those of the first two points,
        or of another fit, serve until the trust region shrinks to nothing, which shows that they
        mislead; the minimiser then goes on with derivatives of that point.
        """
        low, high = self._limits()
        while True:
            own = not self._borrowed
            self._fresh = 2 * own
            here = self._jacobian(self.point)
            # Without influence is, for example, the shape of an effect of no strength.
            idle = ~here.any(0)
            free = np.flatnonzero((low < high) & ~idle)
            if not len(free):
                return True
            found = self._minimise(
                free, low, high, 1 / np.sqrt((here[:, free] ** 2).sum(0))
            )
            woken = (idle & self.effect).any() and self._jacobian(self.point)[:, idle].any()
            if not woken and (own or found.status != SHRUNK):
                return bool(found.status > 0)
            self._borrowed = False

    def _minimise(
        self, free: NDArray[np.int64], low: FloatArray, high: FloatArray, unit: FloatArray
    ) -> OptimizeResult:
        """Move some parameters to the minimum between their limits.

        The minimiser counts them from the start in units of their errors, and takes the distance
        from its origin as the first radius: all have the same offset, of the length FIRST.
        """
        start, offset = self.point.copy(), FIRST / np.sqrt(len(free))

        def at(x: FloatArray) -> FloatArray:
            point = start.copy()
            point[free] += (x - offset) * unit
            return np.clip(point, low, high)

        def left(x: FloatArray) -> FloatArray:
            try:
                return self._projected(self.residuals(at(x))[1], at(x))
            except ConvergenceError:
                # The trust region shrinks where residuals are not finite.
                return np.full(
                    len(self._whole) + self._priors + len(self.score.target), np.nan
                )

        found = least_squares(
            left, np.full(len(free), offset), lambda x: -self._jacobian(at(x))[:, free] * unit,
            bounds=[(end - start)[free] / unit + offset for end in (low, high)], x_scale="jac",
            ftol=NEAR / self.total, xtol=STILL, gtol=None, max_nfev=ROUNDS,
        )  # fmt: skip
        self.point = at(found.x)
        for side, ends in ((-1, low), (1, high)):
            stopped = free[found.active_mask == side]
            self.point[stopped] = ends[stopped]
        return found

    def _jacobian(self, point: FloatArray) -> FloatArray:
        """Derivatives of the projected prediction; those that change are found at the point."""
        if (
            self._there is None
            or not np.array_equal(self._there, point)
            or self._fresh == 2
        ):
            every = self._fresh > 0
            self.differentiate(self._anew | every, point, self.residuals(point)[0])
            self._there, self._fresh = point.copy(), max(self._fresh - 1, 0)
        return self._projected_slopes()

    def _end(self) -> None:
        """Store the solution at a point where no step lowers the chi-square any more.

        The linear model may still promise a decrease that no step delivers; residuals with that
        decrease taken off would claim a fit that was not reached.  So parameters are held at the
        point in the last solution, unless freeing them (all, else all but effects') promises less
        than :data:`IDLE`.
        """
        residuals = self.residuals(self.point)[1]
        nothing, everything = np.zeros(self.count, bool), np.ones(self.count, bool)
        told = self.solve(residuals, self.point, everything)
        square = float(told.left @ told.left)
        for held in (nothing, self.effect):
            free = self.solve(residuals, self.point, held)
            if square - float(free.left @ free.left) < IDLE:
                told = free
                break
        self.solved = told

    def stay(self, point: FloatArray) -> None:
        """End at a point that a fit of other values found, whatever the residuals are here.

        Derivatives enter the errors only: the non-linear parameters are held, and nothing of
        the residuals is attributed to them.
        """
        self.point = point.copy()
        predicted, residuals = self.residuals(self.point)
        everything = np.ones(self.count, bool)
        self.differentiate(everything, self.point, predicted)
        self.solved = self.solve(residuals, self.point, everything)
        self.converged = True
