"""A fitted model (baseline, effects, linear terms), and its chi-square of held-out recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.fit.baseline_fit import BaselineFit, fit_baseline
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.predictor import Columns, Predictor, used_channels
from bfsensor.effects.effect import Effect
from bfsensor.typing import FloatArray

LEFT_OUT, LAGS_ACROSS = 5, 2
"""Number of sets of lags of which one at a time is left out of fits, and the weight of the lag in y:
lag (i, j) belongs to set (i + 2 j) mod 5.  Chosen: a knight's move, by which no two of the five lags
(0, 0), (1, 0), (0, 1), (2, 0), (0, 2) are in one set; with ten sets each fit would miss half as
many lags, and take as long twice."""


class Model:
    """The baseline with some effects and further linear terms, fitted to channels.

    Parameters
    ----------
    predictor : Predictor
        Predicts the channels, with the effects.
    fit : BaselineFit
        Its fit.
    """

    def __init__(self, predictor: Predictor, fit: BaselineFit) -> None:
        self.predictor, self.fit = predictor, fit

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects with their fitted parameters."""
        return self.predictor.effects_at(self.fit.values[: len(self.predictor.names)])

    def with_effects(self, effects: Sequence[Effect]) -> Model:
        """Fit again with these effects in place of the present ones, from the present values."""
        predictor = self.predictor.with_effects(effects, self.fit.values)
        return Model(predictor, fit_baseline(predictor, self.fit.channels, like=self.fit))

    def with_columns(self, columns: Columns) -> Model:
        """Fit again with further linear parameters, from the present values."""
        predictor = self.predictor.with_columns(columns, self.fit.values)
        return Model(predictor, fit_baseline(predictor, self.fit.channels, like=self.fit))

    def errors(self, n: int) -> dict[str, float]:
        """Linear standard errors of the parameters of the n-th effect, by name, in their units.

        A parameter that changes no prediction at its value, as beyond the end of its range, has none.
        """
        rows = self.predictor.space.rows("effect", n)
        return {
            p.name: float(self.fit.errors[row])
            for p, row in zip(fitted(self.effects[n]), rows, strict=True)
            if self.fit.errors[row] > 0
        }

    def left(self, channel: Channel) -> FloatArray:
        """Whitened residuals of a channel, fitted or held out, at the fitted parameters.

        They are whitened by the covariance 1 + M M^T of errors and random effects, shape (n,).
        """
        values = dict(zip(self.fit.names, self.fit.values, strict=True))
        point = self.fit.values[: len(self.predictor.names)]
        predicted = self.predictor.predict(channel, point)
        for name, column in self.predictor.linear(channel).items():
            predicted = predicted + values.get(name, 0.0) * column
        left = channel.whiten(channel.values - predicted)
        modes = self.predictor.modes(channel, point)
        if not modes.shape[1]:
            return left
        shapes, sizes, _ = np.linalg.svd(channel.whiten(modes), full_matrices=False)
        # (1 + M M^T)^(-1/2) = 1 - U (1 - (1 + s^2)^(-1/2)) U^T with M = U s V^T.
        wider = 1 - 1 / np.sqrt(1 + sizes**2)
        return np.asarray(left - shapes @ (wider * (shapes.T @ left)))


def compare_held_out(before: Model, after: Model) -> dict[str, tuple[float, float, int]]:
    """Chi-squares of the held-out fold by two models, by channel.

    Parameters
    ----------
    before, after : Model
        Two fits of the same measured channels.

    Returns
    -------
    dict of str to (float, float, int)
        By name of the channel: chi-square before, after, and number of values.  Tables of a_ij
        have no held-out fold: each of :data:`LEFT_OUT` sets of lags is predicted by fits to the others.
    """
    out: dict[str, tuple[float, float, int]] = {}
    for channel in before.fit.channels:
        if channel.unit == PER_ELECTRON:
            squares = [_left_out(m, channel) for m in (before, after)]
            out[channel.word] = squares[0], squares[1], len(channel)
    for channel in used_channels(before.predictor.measured.channels, ("held-out",)):
        if not len(channel):
            continue
        squares = [
            float(left @ left) for left in (m.left(channel) for m in (before, after))
        ]
        old = out.get(channel.word, (0.0, 0.0, 0))
        out[channel.word] = (
            old[0] + squares[0], old[1] + squares[1], old[2] + len(channel)
        )  # fmt: skip
    return out


def _left_out(model: Model, channel: Channel) -> float:
    """Chi-square of values of a channel, each predicted by a fit without its set of lags.

    The errors are those of the values and of the prediction, to first order in the parameters.
    """
    square = 0.0
    lags = channel.axes["i"].astype(int) + LAGS_ACROSS * channel.axes["j"].astype(int)
    for n in range(LEFT_OUT):
        out = lags % LEFT_OUT == n
        if not out.any() or out.all():
            continue
        predictor, own = model.predictor, channel.take(out)
        fit = fit_baseline(predictor, [channel.take(~out)])
        point = fit.values[: len(predictor.names)]
        here = predictor.predict(own, point)
        slopes = [predictor.slope(own, point, k, here) for k in range(len(point))]
        linear = predictor.linear(own)
        slopes += [linear.get(name, np.zeros(len(own))) for name in fit.names[len(point) :]]
        change = own.whiten(np.array(slopes).T.reshape(len(own), -1))
        spread = np.eye(len(own)) + change @ fit.covariance @ change.T
        left = Model(predictor, fit).left(own)
        square += float(left @ np.linalg.solve(spread, left))
    return square
