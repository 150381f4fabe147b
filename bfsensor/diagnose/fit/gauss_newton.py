"""Steps of the joint fit: what is left at a point, derivatives there, and how far to go."""

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
"""Of steps that were taken, before a fit is given up."""

HALVINGS = 5
"""Of a step that does harm, before it is given up and the fit taken for arrived."""

MISLED = 2
"""Halvings of a step by another fit's derivatives after which a fit finds its own."""

STALLED = 4
"""Rounds without gain after which a fit with effects has arrived, whatever their steps."""

REFRESHED = 2, 4
"""Rounds in which what is left to chance is taken as strong as the effects then are."""

ANEW, AWAY = 8, 0.1
"""Times that what is left to chance is taken anew where scatter tells its strength, and distance
[errors] of such parameters from where it was taken last from which on it is."""

SMALL = 0.05
"""Largest step of a parameter [of its error] at which the fit has arrived."""

NO_HARM = 0.01
"""Rise of the chi-square that is none."""

IDLE = 1.0
"""Gain of a chi-square by derivatives alone that is not worth a step: the parameters count as
fitted, and what is left is orthogonal to their columns."""

POOR = 0.5
"""Part of the gain that derivatives promised below which they are another point's: found anew."""

Seen = tuple[list[FloatArray], FloatArray]


class Steps:
    """Least squares around a point, which :meth:`go` and :meth:`go_carefully` move.

    Parameters
    ----------
    predictor : Predictor
        Predicts the channels.
    channels : sequence of Channel
        What to fit.
    slopes : ndarray, shape (values, plain parameters), optional
        Derivatives of another fit, of all parameters that are no effect's.

    Attributes
    ----------
    point : ndarray
        Non-linear parameters.
    solved : BoundedSolution
        The last solution: non-linear parameters, linear ones, strengths of what is left to
        chance.
    slopes : ndarray, shape (values, non-linear parameters)
        Whitened derivatives.
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
        # With effects on flats means depend on gains, as they do not without.
        flats = any("flat_mean" in e.touches for e in predictor.effects)
        gains = np.char.startswith(np.array(predictor.names, str), "gain ")
        self._anew = self.effect | (gains & flats)
        self.point = predictor.start.astype(float).copy()
        self.slopes = np.zeros((self.total, self.count))
        # Where flats fill up, what the device did to their covariances is gone.
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
        # A parameter that no value depends on is none.
        columns = {k: v for k, v in columns.items() if np.abs(v).max() > 0}
        self.columns = tuple(columns)
        linear = np.array(list(columns.values())).T.reshape(self.total, len(columns))
        self.scales = np.sqrt((linear**2).sum(0))
        self._linear = linear / self.scales

    def update_chance(self) -> None:
        """Take what effects leave to chance as strong as they are at the point."""
        found = [self.predictor.modes(c, self.point) for c in self.channels]
        found = [
            c.whiten(m) if m.shape[1] else m
            for c, m in zip(self.channels, found, strict=True)
        ]
        some = any(m.shape[1] for m in found)
        self.modes = block_diag(*found) if some else np.zeros((self.total, 0))
        # Orthonormal columns of linear parameters and of chance, whose priors' rows are the last.
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
        """Take what scatter tells about parameters as it does at the point."""
        self.score = no_score(self.point)
        if len(self._scored):
            self.score = score_of(
                self.predictor, self.channels, self.point, self.modes, self._span,
                self.residuals(self.point)[1],
            )  # fmt: skip

    def _reach(self, point: FloatArray) -> FloatArray:
        """Smallest and largest steps; where scatter tells, half or twice what it was taken at."""
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
        """Whether what scatter tells was found far from here."""
        errors = self.solved.errors[self._scored]
        away = np.abs(self.point - self.score.origin)[self._scored]
        return bool((away > AWAY * errors).any())

    def residuals(self, point: FloatArray) -> Seen:
        """Predictions, and what they leave of the values, whitened; the last ones are kept."""
        if self._last is not None and np.array_equal(self._last[0], point):
            return self._last[1]
        # Far from what pixels can do numbers overflow: such points are none.
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
        """Chi-square with the linear parameters at their best, priors included."""
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
        """Find derivatives by some parameters; forgiving keeps old ones where there are no new."""
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
                    # At the end of where spots have a shape.
                    if not forgiving:
                        raise
                    continue
                self.slopes[start : start + len(channel), n] = channel.whiten(change)

    def problem(
        self, residuals: FloatArray, point: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Columns of all parameters and what they should make.

        Rows of values, of priors, of chance and of what scatter tells.
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
        """Best step of all parameters, some of the non-linear ones held."""
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
        """Solve for the non-linear parameters alone, what the others take projected out.

        With hundreds of columns of chance that is a small problem in place of a large one; of the
        solution only that part is told, and no basis.
        """
        if not self._apart:
            return self.solve(residuals, point, held)
        rows = self.predictor.prior_rows
        # Rows of chance come before those of priors.
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
        # A column that is projected out but for rounding is none.
        norms = np.sqrt((self.slopes**2).sum(0) + (self.score.rows**2).sum(0))
        norms[rows] = np.hypot(norms[rows], 1.0)
        gone = np.sqrt((design[:, :-1] ** 2).sum(0)) < SINGULAR * norms
        design[:, :-1][:, gone] = 0.0
        return solve_within(design[:, :-1], design[:, -1], *ends)

    def _step(self, solved: BoundedSolution) -> float:
        """Move the point; gives the largest move over errors."""
        self._note(solved)
        self.point = self.point + solved.solution[: self.count]
        return self.history[-1]

    def _note(self, solved: BoundedSolution) -> None:
        """Keep a solution, and how far it wants to go."""
        self.solved = solved
        step, errors = solved.solution[: self.count], solved.errors[: self.count]
        moved = np.abs(step) / np.maximum(errors, 1e-300)
        self.history.append(float(np.max(moved, where=errors > 0, initial=0.0)))

    def go(self) -> None:
        """Full steps, with the derivatives of the second round for all later ones.

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
        """Take steps that do no harm, those of effects with derivatives of each round.

        A step that does harm is first mended: where it put all else, effects' amplitudes are
        brought to their best, for they follow along curved valleys.  Then it is halved, at last
        given up.  Without effects a fit that does not settle ends where it is.

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
                    # Derivatives of a fit without these effects lead nowhere: their own are found.
                    self._borrowed = False
                    self.differentiate(~self.effect, self.point, predicted, forgiving=True)
                    solved = self._solve(residuals, self.point)
                    if self._gainful(solved, here):
                        continue
                # What effects stop, all others may still do.
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
        """End here: of what steps would still gain, told is none but what counts for nothing."""
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
        """End at a point that other values told, whatever is left here.

        Derivatives count in the errors only: what is left is none of these parameters'.
        """
        self.point = point.copy()
        predicted, residuals = self.residuals(self.point)
        everything = np.ones(self.count, bool)
        self.differentiate(everything, self.point, predicted)
        self.solved = self.solve(residuals, self.point, everything)

    def _gainful(self, solved: BoundedSolution, least: float) -> bool:
        """Go as far as a step does no harm; False: nowhere."""
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
                # So far off that spots have no shape any more: a step that does harm.
                continue
            if self._borrowed and halved + 1 == MISLED:
                return False
        return False

    def _tries(self, there: FloatArray) -> Iterator[FloatArray]:
        """Give a point, and after it the best ones near it.

        First all but amplitudes held: a full well has to follow the gain to one part in 1e5.
        Then the shapes of effects held.
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
            f"the baseline's parameters still move by {self.history[-1]:.2g} of their errors after "
            f"{ROUNDS} rounds (steps {steps})"
        )
