r"""Fit of non-linear and linear parameters and random effects, linear ones projected out once.

Whitened values :math:`y` are modelled as

.. math::
    y = f(\theta) + L \beta + M(\theta) u + \epsilon, \qquad
    \epsilon \sim N(0, 1), \quad u \sim N(0, 1),

with non-linear parameters :math:`\theta`, linear ones :math:`\beta` and random effects :math:`u`,
whose strength is in the modes :math:`M`.  The fit minimises the penalised sum of squares

.. math::
    |y - f(\theta) - L \beta - M u|^2 + |u|^2 + |\theta_\mathrm{prior}|^2
    + |t - R (\theta - \theta_0)|^2

(Henderson's mixed-model equations) in :math:`\theta` by
:func:`~bfsensor.inference.trust_region.minimise`, with :math:`\beta` and :math:`u` projected out.
For given :math:`M` that is least squares with the covariance :math:`1 + M M^T` (Woodbury's
identity).  The last term is the score of the restricted likelihood for parameters that enter
through :math:`M` (:mod:`bfsensor.inference.random_effects`).

References
----------
Henderson 1975, Biometrics 31, 423 (mixed-model equations); Golub & Pereyra 1973, SIAM J. Numer.
Anal. 10, 413 (linear parameters projected out).
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from bfsensor.inference.bounded_lsq import SINGULAR, BoundedSolution, solve_within, span
from bfsensor.inference.random_effects import no_score, score_of
from bfsensor.inference.trust_region import minimise
from bfsensor.typing import FloatArray

NEAR = 0.01
"""Decrease of the chi-square, for residuals of unit variance, below which a fit has converged.
Chosen: the square of 0.1, the distance in standard errors of the minimum along one direction; twice
as large, of 0.14."""

ANEW, AWAY = 8, 0.1
"""Largest number of times that the modes and the score of the variance parameters are linearised
again, and the distance [standard errors] of such a parameter from the last point of linearisation
above which that is done.  Chosen, to be derived: after twice as many times, or within 0.2 errors, an
estimate may differ by the curvature of the restricted likelihood, of second order in that distance."""

HALVED = 5
"""Largest number of times that a step of the variance parameters that raises minus the likelihood is
halved.  Chosen: the step is too long by the square of a random effect in units of its standard
deviation, which exceeds 32 with a probability of 1e-8; with 10, by one of 32 standard deviations."""

IDLE = 1.0
"""Decrease of the chi-square promised by the derivatives below which parameters count as fitted:
the residuals returned are then orthogonal to their columns.  Chosen, to be derived: a decrease
of 1 is what noise makes of one free parameter; with 2, residuals would be projected on a linear
model that missed the minimum by up to 1.4 errors."""


class MixedModelFit(ABC):
    """Minimisation of the penalised sum of squares from a point, which :meth:`go` moves.

    A subclass says what is predicted: :meth:`whitened`, :meth:`differentiate`, :meth:`modes_at`,
    :meth:`mode_slopes` and :meth:`limits`.

    Parameters
    ----------
    start : ndarray, shape (p,)
        First point.
    linear : ndarray, shape (n, q)
        Whitened columns :math:`L` of unit length.
    prior_rows : ndarray of int
        Indices of the parameters with a prior of mean 0 and width 1.
    curved : ndarray of bool, shape (p,)
        Parameters whose derivatives may hold near a point only.
    renewed : ndarray of bool, shape (p,)
        Parameters whose derivatives are found again at each point; others' serve on.
    variances : ndarray of int
        Indices of the variance parameters.
    random : bool
        Whether there are random effects.
    slopes : ndarray, shape (n, p), optional
        Whitened derivatives of another fit, which are used until they mislead.

    Attributes
    ----------
    point : ndarray, shape (p,)
        Non-linear parameters.
    solved : BoundedSolution
        The last solution: steps of the non-linear parameters; linear parameters and random effects
        at the point.
    slopes : ndarray, shape (n, p)
        Whitened derivatives of the predictions.
    modes : ndarray, shape (n, m)
        Whitened modes :math:`M` of the random effects.
    score : Score
        Score of the variance parameters.
    converged : bool
        Whether the last :meth:`go` ended at a minimum.
    """

    def __init__(
        self,
        start: FloatArray,
        linear: FloatArray,
        *,
        prior_rows: NDArray[np.int64],
        curved: NDArray[np.bool_],
        renewed: NDArray[np.bool_],
        variances: NDArray[np.int64],
        random: bool,
        slopes: FloatArray | None = None,
    ) -> None:
        self.point = start.astype(float).copy()
        self.total, self.count, self.linear = len(linear), len(start), linear
        self.prior_rows, self._priors = prior_rows, len(prior_rows)
        self.curved, self._renewed = curved, renewed
        self._variances, self._random = variances, random
        self._borrowed = slopes is not None
        self.slopes = np.zeros((self.total, self.count)) if slopes is None else slopes
        self.converged = False
        self._there: FloatArray | None = None
        self._fresh = 0
        self.solved: BoundedSolution
        self.linearise_random()

    @abstractmethod
    def whitened(self, point: FloatArray) -> FloatArray:
        """Whitened residuals :math:`y - f` at a point, shape (n,)."""

    @abstractmethod
    def differentiate(self, which: NDArray[np.bool_], point: FloatArray) -> None:
        """Write derivatives at a point by some parameters into :attr:`slopes`."""

    @abstractmethod
    def modes_at(self, point: FloatArray) -> FloatArray:
        """Whitened modes of the random effects at a point, shape (n, m)."""

    @abstractmethod
    def mode_slopes(self, point: FloatArray) -> dict[int, FloatArray]:
        """Derivatives of the modes by each variance parameter, by its index."""

    @abstractmethod
    def limits(self) -> FloatArray:
        """Smallest and largest values of the parameters, shape (2, p)."""

    def linearise_random(self) -> None:
        """Compute the modes of the random effects, and the score, at the point."""
        self._take_modes()
        self._take_score()

    def _take_modes(self) -> None:
        """Compute the modes of the random effects at the point, and what they span."""
        self.modes = self.modes_at(self.point)
        # QR of [[L, M], [0, 1]], the rows below being the priors of u: with Q1 the upper rows of
        # its orthonormal columns, 1 - Q1 Q1^T = C^-1 - C^-1 L (L^T C^-1 L)^-1 L^T C^-1 of
        # C = 1 + M M^T, by Woodbury's identity, without inverting C (n x n).
        chance, plainly = self.modes.shape[1], self.linear.shape[1]
        both = np.zeros((self.total + chance, plainly + chance))
        both[: self.total] = np.concatenate([self.linear, self.modes], axis=1)
        both[self.total :, plainly:] = np.eye(chance)
        if len(self._variances):
            self._volume = float(np.linalg.slogdet(both.T @ both)[1])
        self._whole = span(both)
        self._span = self._whole[: self.total]

    def _take_score(self) -> None:
        """Compute the score of the variance parameters at the point, for its modes."""
        self.score = no_score(self.point)
        if len(self._variances) and self.modes.shape[1]:
            self.score = score_of(
                self.point, self.modes, self.mode_slopes(self.point), self._span,
                self.whitened(self.point),
            )  # fmt: skip

    def _limits(self) -> FloatArray:
        """Smallest and largest values of the parameters, shape (2, p).

        Variance parameters stay between half and twice the value at which their score was
        linearised: their information goes with the inverse square of the value, so that the
        linear score says nothing farther away.
        """
        ends = np.array(self.limits(), float)
        own = self._variances[(self.score.rows[:, self._variances] != 0).any(0)]
        there = np.sort(self.score.origin[own] * np.array([[0.5], [2.0]]), axis=0)
        ends[:, own] = np.clip(there, *ends[:, own])
        # A value outside its range, such as a start, may only move towards it.
        ends[0] = np.minimum(ends[0], self.point)
        ends[1] = np.maximum(ends[1], self.point)
        return ends

    def _behind(self) -> bool:
        """Whether a variance parameter has moved by more than AWAY since its score was found."""
        rows = self._projected_slopes()[:, self._variances]
        errors = 1 / np.maximum(np.sqrt((rows**2).sum(0)), 1e-300)
        away = np.abs(self.point - self.score.origin)[self._variances]
        return bool((away > AWAY * errors).any())

    def problem(self, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Design matrix and target of one linear step.

        Rows: whitened values, priors of parameters, priors of random effects, score.
        Columns: non-linear parameters, linear ones, random effects.
        """
        plainly, chance = self.count + self.linear.shape[1], self.modes.shape[1]
        count = self.total + self._priors + chance + len(self.score.target)
        design = np.zeros((count, plainly + chance))
        design[: self.total, : self.count] = self.slopes
        design[: self.total, self.count : plainly] = self.linear
        design[: self.total, plainly:] = self.modes
        design[self.total + np.arange(self._priors), self.prior_rows] = 1.0
        last = self.total + self._priors + np.arange(chance)
        design[last, plainly + np.arange(chance)] = 1.0
        design[count - len(self.score.target) :, : self.count] = self.score.rows
        target = [self.whitened(point), -point[self.prior_rows], np.zeros(chance)]
        return design, np.concatenate([*target, self.score.left(point)])

    def _projected(self, point: FloatArray) -> FloatArray:
        """Residuals with linear parameters and random effects at their best, priors included."""
        residuals, first = self.whitened(point), len(self._whole)
        out = np.zeros(first + self._priors + len(self.score.target))
        out[: self.total] = residuals
        out[:first] -= self._whole @ (self._span.T @ residuals)
        out[first : first + self._priors] = -point[self.prior_rows]
        out[first + self._priors :] = self.score.left(point)
        return out

    def _projected_slopes(self) -> FloatArray:
        """Derivatives of the prediction, projected as :meth:`_projected` does, priors included."""
        first = len(self._whole)
        out = np.zeros((first + self._priors + len(self.score.target), self.count))
        out[: self.total] = self.slopes
        out[:first] -= self._whole @ (self._span.T @ self.slopes)
        out[first + np.arange(self._priors), self.prior_rows] = 1.0
        out[first + self._priors :] = self.score.rows
        # A column of which the projection leaves rounding errors alone would get a random step.
        norms = np.sqrt((self.slopes**2).sum(0) + (self.score.rows**2).sum(0))
        norms[self.prior_rows] = np.hypot(norms[self.prior_rows], 1.0)
        out[:, np.sqrt((out**2).sum(0)) < SINGULAR * norms] = 0.0
        return out

    def solve(
        self, point: FloatArray, held: NDArray[np.bool_] | None = None
    ) -> BoundedSolution:
        """Best step of all parameters within their reach, some non-linear ones held."""
        design, target = self.problem(point)
        ends = np.repeat([[-np.inf], [np.inf]], design.shape[1], axis=1)
        ends[:, : self.count] = self._limits() - point
        if held is not None:
            ends[:, : self.count][:, held] = 0.0
        return solve_within(design, target, *ends)

    def go(self) -> None:
        """Minimise by a trust region, and linearise the random effects again until they stay.

        The fit always ends: ``converged`` says whether at a minimum.
        """
        self.converged = self._descend()
        before, lowest = self.point, np.inf
        for turn in range(ANEW if self._random else 0):
            if turn and not self._behind():
                break
            self._take_modes()
            # A mode that a large random effect shows clearly is better known than Fisher's information,
            # an expectation over effects of all sizes, says: its step goes too far.
            for _ in range(HALVED if len(self._variances) else 0):
                if self._likelihood() <= lowest + NEAR:
                    break
                self.point = 0.5 * (before + self.point)
                self._take_modes()
            else:
                if len(self._variances) and self._likelihood() > lowest + NEAR:
                    # No step in this direction is a gain: the point before it is the best.
                    self.point = before
                    self.linearise_random()
                    break
            self._take_score()
            if len(self._variances):
                before, lowest = self.point, self._likelihood()
            self.converged = self._descend()
        self._end()

    def _likelihood(self) -> float:
        """Minus twice the logarithm of the restricted likelihood, priors included, up to a constant."""
        residuals, prior = self.whitened(self.point), self.point[self.prior_rows]
        told = self._span.T @ residuals
        square = residuals @ residuals - told @ told + prior @ prior
        return self._volume + float(square)

    def _descend(self) -> bool:
        """Move to the minimum for given modes; False if that many points do not reach it.

        Derivatives that are not renewed are those of the first two points, or of another fit, until
        the trust region shrinks to nothing, which shows that they mislead; the minimiser then goes
        on with derivatives of that point.
        """
        low, high = self._limits()
        while True:
            own = not self._borrowed
            self._fresh = 2 * own
            # Without influence is, for example, the shape of an effect of no strength.
            idle = ~self._jacobian(self.point).any(0)
            found = minimise(
                self._projected, lambda p: -self._jacobian(p), self.point,
                low=low, high=high, relative=NEAR / self.total,
            )  # fmt: skip
            self.point = found.values
            woken = (idle & self.curved).any() and self._jacobian(self.point)[:, idle].any()
            if not woken and (own or not found.shrunk):
                return found.converged
            self._borrowed = False

    def _jacobian(self, point: FloatArray) -> FloatArray:
        """Derivatives of the projected prediction; those that change are found at the point."""
        if (
            self._there is None
            or not np.array_equal(self._there, point)
            or self._fresh == 2
        ):
            self.differentiate(self._renewed | (self._fresh > 0), point)
            self._there, self._fresh = point.copy(), max(self._fresh - 1, 0)
        return self._projected_slopes()

    def _end(self) -> None:
        """Store the solution at a point where no step lowers the chi-square any more.

        The linear model may still promise a decrease that no step delivers; residuals with that
        decrease taken off would claim a fit that was not reached.  So parameters are held at the
        point in the last solution, unless freeing them (all, else all but these) promises less
        than :data:`IDLE`.  Linear parameters and random effects are those at the point: a step that
        promises as little may be long where they follow it.
        """
        nothing, everything = np.zeros(self.count, bool), np.ones(self.count, bool)
        told = self.solve(self.point, everything)
        square, here = float(told.left @ told.left), told.solution
        for held in (nothing, self.curved):
            free = self.solve(self.point, held)
            if square - float(free.left @ free.left) < IDLE:
                told = free
                break
        self.solved = told._replace(solution=here)

    def stay(self, point: FloatArray) -> None:
        """End at a point that a fit of other values found, whatever the residuals are here.

        Derivatives enter the errors only: the non-linear parameters are held, and nothing of
        the residuals is attributed to them.
        """
        self.point = point.copy()
        everything = np.ones(self.count, bool)
        self.differentiate(everything, self.point)
        self.solved = self.solve(self.point, everything)
        self.converged = True
