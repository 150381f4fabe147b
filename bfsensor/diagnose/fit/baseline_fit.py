"""Joint fit of all channels by the baseline with its free parameters, and its residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.data.ptc_turnoff import below, find_turn_off
from bfsensor.diagnose.fit.gauss_newton import Steps
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.predictor import Predictor, used_channels
from bfsensor.typing import FloatArray

UNSETTLED = (
    "the fit did not converge, so unlike the model are the recordings: its residuals are those of "
    "the best point that was found, and errors of its parameters are those of that point"
)
"""Note of a fit that ended before it reached a minimum."""


@dataclass(frozen=True, eq=False)
class BaselineFit:
    """A joint fit of all channels by the baseline.

    Attributes
    ----------
    channels : tuple of Channel
        The channels that were fitted.
    names : tuple of str
        Non-linear parameters, then linear ones, then random effects ('chance 0', ...).
    values, errors : ndarray, shape (p,)
        Values of the parameters and their linear standard errors.
    residuals : ndarray, shape (n,)
        Whitened residuals of all channels, one after another.
    basis : ndarray, shape (n + priors, rank)
        Orthonormal columns that the parameters span, rows of the priors last: the fit absorbs
        noise along them.
    starts : ndarray of int, shape (channels + 1,)
        Index at which each channel's residuals begin.
    pulls : dict of str to float
        Departures of device parameters from nominal, in units of their prior's width.
    covariance : ndarray, shape (p, p)
        Covariance of the parameters, in the order of ``names``.
    slopes : ndarray, shape (n, non-linear parameters)
        Whitened derivatives of the predictions.
    left : ndarray, shape (n + priors,)
        Residuals with those of the priors after them, orthogonal to ``basis``.
    chance : float
        Logarithm of the determinant of the covariance 1 + M M^T of errors and random effects;
        0 without random effects.
    scores : int
        Number of rows at the end of ``left`` and of ``basis`` that belong to the score of
        variance parameters.
    notes : tuple of str
        Assumptions of the prediction, and conditions of the fit, in words.
    converged : bool
        Whether the fit ended at a minimum.
    unknown : tuple of str
        Device parameters whose pull says nothing about the device: those without a nominal value,
        which only have a bound, and errors of the calculation.
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
    converged: bool = True
    unknown: tuple[str, ...] = ()

    def of(self, word: str) -> NDArray[np.bool_]:
        """Mask of the residuals that belong to channels of one name, shape (n,)."""
        out = np.zeros(len(self.residuals), bool)
        for channel, start in zip(self.channels, self.starts, strict=False):
            if channel.word == word:
                out[start : start + len(channel)] = True
        return out

    def chi2(self) -> dict[str, tuple[float, float]]:
        """Chi-square and degrees of freedom by name of the channel.

        Each channel's degrees of freedom are its number of values less their leverage, the
        diagonal of ``basis @ basis.T``.
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
        """Chi-square of residuals and priors, plus the log determinant of the random effects.

        Minus twice the logarithm of the likelihood, up to a constant; the score's rows are
        left out.
        """
        left = self.left[: len(self.left) - self.scores]
        return float(left @ left) + self.chance

    def draw(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw residuals of pure noise after a linear fit, shape (count, n)."""
        return self.draw_all(rng, count)[:, : len(self.residuals)]

    def draw_all(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw as :meth:`draw`, with the rows of the priors, shape (count, n + priors)."""
        noise = rng.standard_normal((count, len(self.basis)))
        noise -= (noise @ self.basis) @ self.basis.T
        return noise


def fit_baseline(
    predictor: Predictor, channels: Sequence[Channel], *, like: BaselineFit | None = None
) -> BaselineFit:
    """Fit the baseline to channels, with Gaussian priors on device parameters.

    A fit always ends.  If it ends before it reaches a minimum, ``converged`` is False and ``notes``
    say so; its residuals are those of the best point that was found.  If flats reach full well,
    where their variance collapses, only fainter flats are fitted, and all are compared with that
    fit.

    Parameters
    ----------
    predictor : Predictor
        Predicts the channels; its ``start`` is the first point.
    channels : sequence of Channel
        Values to fit.
    like : BaselineFit, optional
        A fit of the same channels by the same baseline with other effects, whose derivatives,
        which hardly change, are used first.

    Returns
    -------
    BaselineFit

    Raises
    ------
    ConvergenceError
        Nothing can be predicted at the starting point.
    """
    slopes = None if like is None else like.slopes
    steps = Steps(predictor, channels, slopes)
    off = None if predictor.effects else find_turn_off(channels)
    if off is None:
        steps.go()
        return _as_fit(steps)
    point = predictor.start
    if like is None:
        faint = Steps(predictor, below(channels, off))
        faint.go()
        point = faint.point
    steps.stay(point)
    return _as_fit(steps, off.said)


def _as_fit(steps: Steps, *notes: str) -> BaselineFit:
    """Result of an iteration that has ended."""
    predictor, solved, count = steps.predictor, steps.solved, steps.count
    chance = steps.modes.shape[1]
    # Linear columns were scaled to unit length in the solver.
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
            str(predictor.space.parameters[n].owner): float(steps.point[n])
            for n in predictor.space.prior_rows
        },
        covariance=solved.covariance / np.outer(unit, unit),
        left=solved.left,
        slopes=steps.slopes,
        scores=len(steps.score.target),
        chance=float(np.linalg.slogdet(np.eye(chance) + steps.modes.T @ steps.modes)[1]),
        notes=(*predictor.notes, *notes, *(() if steps.converged else (UNSETTLED,))),
        converged=steps.converged,
        unknown=(*predictor.baseline.not_below, *predictor.baseline.accuracy),
    )


FITTED = ("fit", "select")
"""Folds of the campaign that a fit uses; the third, 'held-out', is compared with its prediction."""


def fit_bounded(
    measured: MeasuredChannels, baseline: Baseline
) -> tuple[Predictor, BaselineFit]:
    """Fit the baseline with some device parameters bounded below by their nominal values.

    Parameters of ``baseline.not_below`` that come out below nominal are fixed there, the most
    negative first, and the fit is repeated.  A fixed parameter no longer absorbs noise: half of
    the noise in its direction stays in the residuals, and the scans, which are two-sided, count it.

    Parameters
    ----------
    measured : MeasuredChannels
        The campaign.
    baseline : Baseline
        Nominal device with its free parameters.

    Returns
    -------
    predictor : Predictor
        Of the baseline without the fixed parameters.
    fit : BaselineFit

    Raises
    ------
    ConvergenceError
        Nothing can be predicted with the nominal baseline.
    """
    while True:
        predictor = Predictor(measured, baseline)
        fit = fit_baseline(predictor, used_channels(measured.channels, FITTED))
        below = {n: fit.pulls[n] for n in baseline.not_below if fit.pulls[n] < 0}
        if not below:
            return predictor, fit
        baseline = baseline.without([min(below, key=lambda n: below[n])])


def held_out(predictor: Predictor, fit: BaselineFit, measured: MeasuredChannels) -> float:
    """Chi-square per value of the held-out fold at the fitted parameters; nan without values."""
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
