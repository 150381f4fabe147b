"""Joint fit of device, gains, linear terms, effects and random effects to the channels.

The statistics are in :mod:`bfsensor.inference.mixed_model`; here is what they are asked for:
predictions of the channels with their derivatives, linear terms and modes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.fit.random_effects import mode_slope, scored
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.errors import ConvergenceError
from bfsensor.inference.mixed_model import MixedModelFit
from bfsensor.typing import FloatArray


class Steps(MixedModelFit):
    """Fit of all channels by a predictor.

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
    starts : ndarray of int, shape (channels + 1,)
        Index at which each channel's values begin, and the number of all.
    columns : tuple of str
        Names of the linear terms.
    scales : ndarray, shape (len(columns),)
        Lengths of their whitened columns, which the fit scales to 1.
    """

    def __init__(
        self,
        predictor: Predictor,
        channels: Sequence[Channel],
        slopes: FloatArray | None = None,
    ) -> None:
        self.predictor, self.channels = predictor, channels
        self.starts = np.concatenate([[0], np.cumsum([len(c) for c in channels])])
        self._last: tuple[FloatArray, list[FloatArray], FloatArray] | None = None
        effect, gains = predictor.space.of("effect"), predictor.space.of("gain")
        # An effect in electrons on means of flats [ADU] makes them depend on the gains, whose
        # derivatives are then found again in each round, too.
        flats = any("flat_mean" in e.touches for e in predictor.effects)
        # At full well covariances no longer depend on the device: derivatives of a fit without
        # saturation do not hold.
        full = any(np.isfinite(e.law().full_well) for e in predictor.effects)
        borrowed = None
        if slopes is not None and not full:
            plain = int((~effect).sum())
            borrowed = np.zeros((int(self.starts[-1]), len(predictor.names)))
            borrowed[:, :plain] = slopes[:, :plain]
        self._scored = scored(predictor)
        super().__init__(
            predictor.start, self._columns(), prior_rows=predictor.space.prior_rows, curved=effect,
            renewed=effect | (gains & flats), variances=np.array(sorted(self._scored), int),
            random=any(e.changes("modes") for e in predictor.effects),
            slopes=borrowed,
        )  # fmt: skip

    def _columns(self) -> FloatArray:
        columns: dict[str, FloatArray] = {}
        for channel, start in zip(self.channels, self.starts, strict=False):
            for name, column in self.predictor.linear(channel).items():
                whole = columns.setdefault(name, np.zeros(int(self.starts[-1])))
                whole[start : start + len(channel)] += channel.whiten(column)
        # A column of zeros would make the QR decomposition singular.
        columns = {k: v for k, v in columns.items() if np.abs(v).max() > 0}
        self.columns = tuple(columns)
        linear = np.array(list(columns.values())).T
        linear = linear.reshape(int(self.starts[-1]), len(columns))
        self.scales = np.sqrt((linear**2).sum(0))
        return np.asarray(linear / self.scales)

    def limits(self) -> FloatArray:
        """Smallest and largest values of the parameters, shape (2, p)."""
        return self.predictor.space.limits

    def modes_at(self, point: FloatArray) -> FloatArray:
        """Whitened modes of the effects' random effects at a point, shape (n, m)."""
        found = [self.predictor.modes(c, point) for c in self.channels]
        found = [
            c.whiten(m) if m.shape[1] else m
            for c, m in zip(self.channels, found, strict=True)
        ]
        some = any(m.shape[1] for m in found)
        return np.asarray(block_diag(*found) if some else np.zeros((self.starts[-1], 0)))

    def mode_slopes(self, point: FloatArray) -> dict[int, FloatArray]:
        """Derivatives of the modes by each variance parameter, by its index."""
        return {
            n: mode_slope(self.predictor, self.channels, point, n, words)
            for n, words in self._scored.items()
        }

    def whitened(self, point: FloatArray) -> FloatArray:
        """Whitened residuals of all channels at a point, shape (n,)."""
        return self._seen(point)[1]

    def _seen(self, point: FloatArray) -> tuple[list[FloatArray], FloatArray]:
        """Predictions and whitened residuals at a point; those of the last point are cached."""
        if self._last is not None and np.array_equal(self._last[0], point):
            return self._last[1:]
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
        self._last = point.copy(), predicted, np.concatenate(left)
        return self._last[1:]

    def differentiate(self, which: NDArray[np.bool_], point: FloatArray) -> None:
        """Find derivatives by some parameters; where that fails old ones are kept."""
        predicted = self._seen(point)[0]
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
