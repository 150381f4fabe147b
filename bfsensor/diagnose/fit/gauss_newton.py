r"""Gauss-Newton solver of the joint fit of device, gains, linear terms, effects, random effects.

The whitened values :math:`y` of all channels are modelled as

.. math::
    y = f(\theta) + L \beta + M(\theta) u + \epsilon, \qquad
    \epsilon \sim N(0, 1), \quad u \sim N(0, 1),

with non-linear parameters :math:`\theta` (device, gains, effects), linear ones :math:`\beta` and
random effects :math:`u`, whose strength is in the modes :math:`M`.  A step minimises the penalised
sum of squares

.. math::
    |y - f(\theta) - L \beta - M u|^2 + |u|^2 + |\theta_\mathrm{prior}|^2
    + |t - R (\theta - \theta_0)|^2

to first order in :math:`\theta` (Henderson's mixed-model equations).  For given :math:`M` that is
least squares with the covariance :math:`1 + M M^T` (Woodbury's identity).  The last term is the
score of the restricted likelihood for parameters that enter through :math:`M`
(:mod:`bfsensor.diagnose.fit.random_effects`).

References
----------
Henderson 1975, Biometrics 31, 423 (mixed-model equations); Golub & Pereyra 1973, SIAM J. Numer.
Anal. 10, 413 (linear parameters projected out).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.fit.random_effects import no_score, score_of, scored
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect
from bfsensor.errors import ConvergenceError
from bfsensor.inference.bounded_lsq import SINGULAR, BoundedSolution, solve_within
from bfsensor.typing import FloatArray

ROUNDS = 20
"""Largest number of Gauss-Newton rounds.  If parameters still move after them, :meth:`Steps.go`,
and :meth:`Steps.go_carefully` with effects, raise :class:`ConvergenceError`; without effects the
latter ends where it is.  Chosen: twice as many doubles the time that a fit which does not converge
takes, and changes no fit that converges within 20."""

HALVINGS = 5
"""Lengths at which a step is tried, each half of the one before: 1 to 1/16.  If none keeps the
chi-square within :data:`NO_HARM`, the step is refused.  Chosen: twice as many would try lengths
from 1/32 to 1/512, for which a linear model promises 6 to 0.4 % of the full step's gain."""

MISLED = 2
"""Lengths of a step (1 and 1/2) that are tried with derivatives borrowed from another fit; if
both fail, the fit finds its own derivatives.  Chosen, to be derived: with 4, two more
predictions are spent before that; the point where the fit ends hardly depends on it."""

STALLED = 4
"""Last rounds among which the chi-square must have changed by at least twice :data:`NO_HARM`;
otherwise no further step is taken, however many errors long it would be.  Chosen, to be derived:
twice as large lets fits along flat directions run 4 rounds longer."""

REFRESHED = 2, 4
"""Rounds, counted from 0, at whose start the modes of the random effects are computed again with
the parameters of that round; in between they are constant, so that the chi-square of successive
rounds can be compared.  Chosen, to be derived: with 4 and 8 a fit that converges within four
rounds would keep the modes of its starting values."""

ANEW, AWAY = 8, 0.1
"""Largest number of times that the modes and the score of the variance parameters are linearised
again after the steps have converged, and the distance [standard errors] of such a parameter from
the last point of linearisation above which that is done.  Chosen, to be derived: after twice as
many times, or within 0.2 errors, an estimate may differ by the curvature of the restricted
likelihood, of second order in that distance."""

SMALL = 0.05
"""Largest step of any parameter [standard errors] at which the fit has converged; that step is
taken, too.  Chosen: for a single parameter it lowers the chi-square by 0.0025, with 0.1 by 0.01."""

NO_HARM = 0.01
"""Rise of the chi-square up to which a step is accepted.  Chosen: it moves a parameter by 0.1 of
its error (the square root); twice as large, by 0.14."""

IDLE = 1.0
"""Decrease of the chi-square promised by the derivatives below which parameters count as fitted
although the last step was refused: the residuals returned are then orthogonal to their columns.
Also the promised decrease above which :data:`POOR` is tested.  Chosen, to be derived: a decrease
of 1 is what noise makes of one free parameter; with 2, residuals would be projected on a linear
model that missed the minimum by up to 1.4 errors."""

POOR = 0.5
"""Part of the promised decrease of the chi-square that a round must reach; otherwise derivatives
by all parameters, not only by those of effects, are found again in the next round.  Chosen, to
be derived: with 1 they are found in most rounds, which costs time and no accuracy."""

Seen = tuple[list[FloatArray], FloatArray]
"""Predictions of each channel, and the whitened residuals of all."""


class Steps:
    """Gauss-Newton iteration around a point, which :meth:`go` and :meth:`go_carefully` move.

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
    history : list of float
        Largest step of each round [standard errors].
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
        self._shape = predictor.shapes()
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
        self.history: list[float] = []
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
        self._whole, triangle = np.linalg.qr(both)
        self._span = self._whole[: self.total]
        size = np.abs(np.diag(triangle))
        self._apart = chance > 0 and bool((size > SINGULAR * size.max(initial=0.0)).all())
        self._update_score()

    def _update_score(self) -> None:
        """Linearise the score of the variance parameters at the point."""
        self.score = no_score(self.point)
        if len(self._scored):
            self.score = score_of(
                self.predictor, self.channels, self.point, self.modes, self._span,
                self.residuals(self.point)[1],
            )  # fmt: skip

    def _reach(self, point: FloatArray) -> FloatArray:
        """Smallest and largest steps, shape (2, p).

        Variance parameters stay between half and twice the value at which their score was
        linearised: their information goes with the inverse square of the value, so that the
        linear score says nothing farther away.
        """
        ends = np.array(self.predictor.reach(point), float)
        own = self._scored[(self.score.rows[:, self._scored] != 0).any(0)]
        there = self.predictor.reach(self.score.origin)[:, own]
        size = np.abs(self.score.origin[own])
        there = np.clip(there, -0.5 * size, size) + self.score.origin[own] - point[own]
        ends[:, own] = np.clip(
            ends[:, own], np.minimum(there[0], 0), np.maximum(there[1], 0)
        )
        return ends

    def _behind(self) -> bool:
        """Whether a variance parameter has moved by more than AWAY since its score was found."""
        errors = self.solved.errors[self._scored]
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

    def square(self, residuals: FloatArray, point: FloatArray) -> float:
        """Chi-square with linear parameters and random effects at their best, priors included."""
        given = self._span.T @ residuals
        held = point[self.predictor.prior_rows]
        told = self.score.left(point)
        square = float(residuals @ residuals) - float(given @ given)
        return square + float(held @ held) + float(told @ told)

    def differentiate(
        self,
        which: NDArray[np.bool_],
        point: FloatArray,
        predicted: Sequence[FloatArray],
        *,
        forgiving: bool = False,
    ) -> None:
        """Find derivatives by some parameters; ``forgiving`` keeps old ones where that fails."""
        for n in map(int, np.flatnonzero(which)):
            for channel, start, here in zip(
                self.channels, self.starts, predicted, strict=False
            ):
                if not self.predictor.depends(channel)[n]:
                    continue
                try:
                    with np.errstate(over="ignore", invalid="ignore"):
                        change = self.predictor.slope(channel, point, n, here)
                    if not np.isfinite(change).all():
                        raise ConvergenceError(
                            f"the derivative by {self.predictor.names[n]}"
                        )
                except ConvergenceError:
                    # At the edge of the range in which widths of spots can be computed.
                    if not forgiving:
                        raise
                    continue
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

    def solve(
        self,
        residuals: FloatArray,
        point: FloatArray,
        held: NDArray[np.bool_] | None = None,
    ) -> BoundedSolution:
        """Best step of all parameters within their reach, some non-linear ones held."""
        design, target = self.problem(residuals, point)
        ends = np.repeat([[-np.inf], [np.inf]], design.shape[1], axis=1)
        ends[:, : self.count] = self._reach(point)
        if held is not None:
            ends[:, : self.count][:, held] = 0.0
        return solve_within(design, target, *ends)

    def _solve(
        self,
        residuals: FloatArray,
        point: FloatArray,
        held: NDArray[np.bool_] | None = None,
    ) -> BoundedSolution:
        """Solve for the non-linear parameters alone, all others projected out.

        With hundreds of random effects that is a small problem in place of a large one (variable
        projection).  The solution returned holds the non-linear parameters only, and its basis
        is that of the projected problem.
        """
        if not self._apart:
            return self.solve(residuals, point, held)
        rows = self.predictor.prior_rows
        # Unlike in problem(), rows of random effects come before those of the device's priors.
        first = len(self._whole)
        last = first + self._priors
        design = np.zeros((last + len(self.score.target), self.count + 1))
        design[: self.total, :-1], design[: self.total, -1] = self.slopes, residuals
        design[first + np.arange(self._priors), rows] = 1.0
        design[first:last, -1] = -point[rows]
        design[last:, :-1], design[last:, -1] = self.score.rows, self.score.left(point)
        design[:first] -= self._whole @ (self._span.T @ design[: self.total])
        ends = self._reach(point)
        if held is not None:
            ends[:, held] = 0.0
        # A column of which the projection leaves rounding errors alone would get a random step.
        norms = np.sqrt((self.slopes**2).sum(0) + (self.score.rows**2).sum(0))
        norms[rows] = np.hypot(norms[rows], 1.0)
        gone = np.sqrt((design[:, :-1] ** 2).sum(0)) < SINGULAR * norms
        design[:, :-1][:, gone] = 0.0
        return solve_within(design[:, :-1], design[:, -1], *ends)

    def _step(self, solved: BoundedSolution) -> float:
        """Move the point by a full step; returns the largest step [standard errors]."""
        self._note(solved)
        self.point = self.point + solved.solution[: self.count]
        return self.history[-1]

    def _note(self, solved: BoundedSolution) -> None:
        """Store a solution and its largest step [standard errors]."""
        self.solved = solved
        step, errors = solved.solution[: self.count], solved.errors[: self.count]
        moved = np.abs(step) / np.maximum(errors, 1e-300)
        self.history.append(float(np.max(moved, where=errors > 0, initial=0.0)))

    def go(self) -> None:
        """Take full steps, with derivatives found in the first two rounds.

        Derivatives by parameters of effects are found in every round; all others hardly change
        (a chord method), and the residuals, which decide where the iteration ends, are exact.

        Raises
        ------
        ConvergenceError
            The parameters still move after :data:`ROUNDS` rounds.
        """
        for turn in range(ROUNDS):
            predicted, residuals = self.residuals(self.point)
            if turn in REFRESHED and self._chance:
                self.update_chance()
            fresh = turn < 2 and not self._borrowed
            self.differentiate(self.effect | fresh, self.point, predicted)
            if self._step(self.solve(residuals, self.point)) < SMALL:
                return
        raise self._unsettled()

    def go_carefully(self) -> None:
        """Take steps that do not raise the chi-square, with effects' derivatives of each round.

        A step that raises it is first corrected: the effects' amplitudes are refitted at the new
        shapes, because minima along curved directions have correlated amplitudes and shapes.
        Then it is halved, up to :data:`HALVINGS` lengths.  A fit without effects that does not
        converge ends where it is.

        Raises
        ------
        ConvergenceError
            The effects' parameters still move after :data:`ROUNDS` rounds.
        """
        own = not self.effect.any()
        squares: list[float] = []
        promised, anew = 0.0, 0
        for turn in range(ROUNDS):
            predicted, residuals = self.residuals(self.point)
            if turn in REFRESHED and self._chance:
                self.update_chance()
                squares.clear()
            here = self.square(residuals, self.point)
            squares.append(here)
            poor = promised > IDLE and -np.diff(squares[-2:]).sum() < POOR * promised
            fresh = own or (turn < 2 and not self._borrowed) or poor
            self.differentiate(self._anew | fresh, self.point, predicted, forgiving=True)
            stalled = len(squares) > STALLED and np.ptp(squares[-STALLED:]) < 2 * NO_HARM
            start = self.point
            solved = self._solve(residuals, start)
            promised = here - float(solved.left @ solved.left)
            if stalled or not self._gainful(solved, here):
                if self._borrowed:
                    # Derivatives borrowed from a fit without these effects gave no gain: find own.
                    self._borrowed = False
                    self.differentiate(~self.effect, self.point, predicted, forgiving=True)
                    solved = self._solve(residuals, self.point)
                    if self._gainful(solved, here):
                        continue
                # With the effects' parameters held the others may still lower the chi-square.
                if own or not self._gainful(
                    self._solve(residuals, self.point, self.effect), here
                ):
                    break
                here = self.square(self.residuals(self.point)[1], self.point)
                if squares[-1] - here < 2 * NO_HARM:
                    break
                continue
            if self.history[-1] < SMALL:
                if anew < ANEW and self._behind():
                    anew += 1
                    self.update_chance()
                    squares.clear()
                    continue
                if self._apart:
                    self.solved = self.solve(residuals, start)
                return
        else:
            if not own:
                raise self._unsettled()
        self._end()

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

    def _gainful(self, solved: BoundedSolution, least: float) -> bool:
        """Move by the largest tried length of a step that does no harm; False if none does not."""
        start, step = self.point, solved.solution[: self.count]
        self._note(solved)
        if self.history[-1] < SMALL:
            self.point = start + step
            return True
        for halved in range(HALVINGS):
            there = start + 0.5**halved * step
            try:
                for tried in self._tries(there):
                    if self.square(self.residuals(tried)[1], tried) <= least + NO_HARM:
                        self.point = tried
                        return True
            except ConvergenceError:
                # Nothing can be predicted there: the same as a rise of the chi-square.
                continue
            if self._borrowed and halved + 1 == MISLED:
                return False
        return False

    def _tries(self, there: FloatArray) -> Iterator[FloatArray]:
        """Yield a point, then the same point with the effects' amplitudes refitted.

        First all but amplitudes are held: a full well has to follow the gain to one part in 1e5.
        Then only the shapes of effects are held.
        """
        yield there
        amplitudes = self.effect & ~self._shape
        for held in (~amplitudes, self._shape):
            if not held.any() or not amplitudes.any():
                continue
            predicted, residuals = self.residuals(there)
            kept = self.slopes.copy()
            self.differentiate(amplitudes, there, predicted)
            solved = self._solve(residuals, there, held)
            self.slopes = kept
            yield there + solved.solution[: self.count]

    def _unsettled(self) -> ConvergenceError:
        steps = ", ".join(f"{h:.2g}" for h in self.history)
        return ConvergenceError(
            f"the fit did not converge: after {ROUNDS} rounds its parameters still move by up to "
            f"{self.history[-1]:.2g} standard errors, {SMALL} allowed (rounds: {steps})"
        )
