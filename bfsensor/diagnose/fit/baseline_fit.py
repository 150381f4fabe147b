"""The baseline fitted with all that may float, and what is left of the channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.data.ptc_turnoff import TurnOff, below, find_turn_off
from bfsensor.diagnose.fit.gauss_newton import Steps
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.predictor import Predictor, used_channels
from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

UNSETTLED = (
    "the recordings are so unlike the baseline that its parameters did not settle: what is left is "
    "of the best that was found"
)
"""Note of fits whose free steps led away."""


@dataclass(frozen=True, eq=False)
class BaselineFit:
    """A joint fit of all channels by the baseline.

    Attributes
    ----------
    channels : tuple of Channel
        What was fitted.
    names : tuple of str
        Non-linear parameters, then linear ones, then strengths of what effects leave to chance.
    values, errors : ndarray
        Of the parameters.
    residuals : ndarray, shape (n,)
        Whitened, all channels one after another.
    basis : ndarray, shape (n + priors, p)
        Orthonormal columns that the parameters span, priors' rows last: noise in them is
        fitted away.
    starts : ndarray of int, shape (channels + 1,)
        Where each channel's residuals begin.
    pulls : dict of str to float
        Device parameters in units of their spread.
    covariance : ndarray, shape (p, p)
        Of the parameters, in the order of ``names``.
    slopes : ndarray, shape (n, non-linear parameters)
        Whitened derivatives.
    left : ndarray, shape (n + priors,)
        Residuals with those of the priors after them, what the basis spans taken off.
    chance : float
        Logarithm by which what effects leave to chance widens the errors of all values together
        (of the determinant of their covariance).
    scores : int
        Rows at the end of ``left`` and of ``basis`` that stand for what scatter tells.
    notes : tuple of str
        What the prediction had to assume.
    """

    channels: tuple[Channel, ...]
    names: tuple[str, ...]
    values: FloatArray
    errors: FloatArray
    residuals: FloatArray
    basis: FloatArray = field(repr=False)
    starts: NDArray[np.int64] = field(repr=False)
    pulls: dict[str, float]
    covariance: FloatArray = field(repr=False, default_factory=lambda: np.zeros((0, 0)))
    left: FloatArray = field(repr=False, default_factory=lambda: np.zeros(0))
    slopes: FloatArray = field(repr=False, default_factory=lambda: np.zeros((0, 0)))
    chance: float = 0.0
    scores: int = 0
    notes: tuple[str, ...] = ()

    def of(self, word: str) -> NDArray[np.bool_]:
        """Which residuals belong to a channel word."""
        out = np.zeros(len(self.residuals), bool)
        for channel, start in zip(self.channels, self.starts, strict=False):
            if channel.word == word:
                out[start : start + len(channel)] = True
        return out

    def chi2(self) -> dict[str, tuple[float, float]]:
        """Chi-square and degrees of freedom of each channel word.

        The parameters' degrees are shared out as the basis lies in the channels.
        """
        leverage = (self.basis[: len(self.residuals)] ** 2).sum(1)
        out = {}
        for word in dict.fromkeys(c.word for c in self.channels):
            rows = self.of(word)
            out[word] = (
                float(self.residuals[rows] @ self.residuals[rows]),
                float(rows.sum() - leverage[rows].sum()),
            )
        return out

    @property
    def total(self) -> float:
        """Chi-square of the residuals and of the priors; wider errors cost their logarithm."""
        left = self.left[: len(self.left) - self.scores]
        return float(left @ left) + self.chance

    def draw(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Residuals that noise alone leaves, shape (count, n), the fit linear about its end."""
        return self.draw_all(rng, count)[:, : len(self.residuals)]

    def draw_all(self, rng: np.random.Generator, count: int) -> FloatArray:
        """As :meth:`draw`, those of the priors after them."""
        noise = rng.standard_normal((count, len(self.basis)))
        noise -= (noise @ self.basis) @ self.basis.T
        return noise


def fit_baseline(
    predictor: Predictor, channels: Sequence[Channel], *, like: BaselineFit | None = None
) -> BaselineFit:
    """Fit the baseline to channels: Gauss-Newton, device parameters held by their spread.

    Recordings that are nothing like the baseline may lead such steps ever farther away.  Without
    effects the fit is then made again by steps that may do no harm, and ends where they end:
    what is left is large, and told; ``notes`` say so.  Where flats are full, their variance being
    gone, what is below that alone is fitted, and all held against it.

    Parameters
    ----------
    predictor : Predictor
        Predicts them.
    channels : sequence of Channel
        What to fit.
    like : BaselineFit, optional
        A fit of the same channels by the same baseline, with other effects: its derivatives,
        which hardly change, are taken over.

    Raises
    ------
    ConvergenceError
        The parameters still move after :data:`ROUNDS` rounds.
    """
    slopes = None if like is None else like.slopes
    steps = Steps(predictor, channels, slopes)
    if predictor.effects:
        steps.go_carefully()
        return _as_fit(steps)
    off = find_turn_off(channels)
    if off is not None:
        point = (
            predictor.start if like is not None else _fit_faint(predictor, channels, off)
        )
        if point is not None:
            steps.stay(point)
            return _as_fit(steps, off.said)
    try:
        steps.go()
    except ConvergenceError:
        steps = Steps(predictor, channels, slopes)
        steps.go_carefully()
        return _as_fit(steps, UNSETTLED)
    return _as_fit(steps)


def _fit_faint(
    predictor: Predictor, channels: Sequence[Channel], off: TurnOff
) -> FloatArray | None:
    """Parameters of what is below the turn-off; None where they do not settle either."""
    faint = Steps(predictor, below(channels, off))
    try:
        faint.go()
    except ConvergenceError:
        return None
    return faint.point


def _as_fit(steps: Steps, *notes: str) -> BaselineFit:
    """What the steps have come to."""
    predictor, solved, count = steps.predictor, steps.solved, steps.count
    chance = steps.modes.shape[1]
    unit = np.concatenate([np.ones(count), steps.scales, np.ones(chance)])
    values = np.concatenate([steps.point, solved.solution[count:] / unit[count:]])
    return BaselineFit(
        channels=tuple(steps.channels),
        names=(*predictor.names, *steps.columns, *(f"chance {n}" for n in range(chance))),
        values=values,
        errors=solved.errors / unit,
        residuals=solved.left[: steps.total],
        basis=solved.basis,
        starts=steps.starts,
        pulls={
            predictor.names[n].removeprefix("device "): float(steps.point[n])
            for n in predictor.prior_rows
        },
        covariance=solved.covariance / np.outer(unit, unit),
        left=solved.left,
        slopes=steps.slopes,
        scores=len(steps.score.target),
        chance=float(np.linalg.slogdet(np.eye(chance) + steps.modes.T @ steps.modes)[1]),
        notes=(*predictor.notes, *notes),
    )


FITTED = ("fit", "select")
"""Folds that a fit of the baseline uses; the third, 'held-out', is kept for a check."""


def fit_bounded(
    measured: MeasuredChannels, baseline: Baseline
) -> tuple[Predictor, BaselineFit]:
    """Fit the baseline; parameters that come out below their bound are held at it, worst first.

    What is held is no parameter any more: of the noise in its direction the residuals keep the
    forbidden half, which the scans, two-sided, judge rightly.
    """
    while True:
        predictor = Predictor(measured, baseline)
        fit = fit_baseline(predictor, used_channels(measured.channels, FITTED))
        below = {n: fit.pulls[n] for n in baseline.not_below if fit.pulls[n] < 0}
        if not below:
            return predictor, fit
        baseline = baseline.without([min(below, key=lambda n: below[n])])


def held_out(predictor: Predictor, fit: BaselineFit, measured: MeasuredChannels) -> float:
    """Chi-square over number of the values that were not fitted, all parameters as fitted."""
    values = dict(zip(fit.names, fit.values, strict=True))
    point = fit.values[: len(predictor.names)]
    square, number = 0.0, 0
    for channel in used_channels(measured.channels, ("held-out",)):
        predicted = predictor.predict(channel, point)
        for name, column in predictor.linear(channel).items():
            predicted = predicted + values.get(name, 0.0) * column
        left = channel.whiten(channel.values - predicted)
        square += float(left @ left)
        number += len(channel)
    return square / number if number else np.nan
