"""Covariances of the noise of biases in readout order."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.channel_kind import ChannelKind, ChannelModel, Picture
from bfsensor.diagnose.kinds.scan_shapes import amplifiers
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.plots import residuals as show
from bfsensor.typing import FloatArray


class BiasCovariances(ChannelKind):
    """Covariances of the noise of biases by lag in readout order."""

    name = "bias_cov"
    title = "noise in readout order"

    def depends(self, channel: Channel, *, changed: bool) -> tuple[str, ...]:
        del channel, changed
        return ("noise",)

    def predict(self, channel: Channel, model: ChannelModel) -> FloatArray:
        own = model.noise[channel.axes["amp"].astype(int)]
        return np.where(channel.axes["lag"] == 0, own, 0.0) + super().predict(
            channel, model
        )

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        del rows, measured
        return noise_columns(channel)

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Patterns of noise covariances in readout order: single lags, tails, waves, by amplifier."""
        x = g.axes
        lag = x["lag"].astype(float)
        for name, here in amplifiers(x):
            for one in np.unique(lag):
                yield (
                    "noise lag",
                    np.where(here & (lag == one), 1.0, 0.0),
                    {"amp": name, "k": (int(one), int(one))},
                )
            for length in (1.0, 2.0, 4.0, 8.0, 1e9):
                yield "noise tail", np.where(here & (lag > 0), np.exp(-lag / length), 0.0), {
                    "amp": name, "k": (1, int(lag.max())), "length": length,
                }  # fmt: skip
            for period in np.geomspace(2.0, lag.max(), 24):
                yield "noise wave", np.where(here & (lag > 0), np.cos(2 * np.pi * lag / period), 0.0), {
                    "amp": name, "period": float(period),
                }  # fmt: skip

    def picture(self, channel: Channel, pulls: FloatArray) -> Picture:
        return Picture(
            "Covariances of the noise in biases: pulls against lag in readout order [pixel].",
            (5.2, 3.4), (lambda ax: show.draw_noise(channel.axes, pulls, ax),),
        )  # fmt: skip


def noise_columns(channel: Channel) -> dict[str, FloatArray]:
    """Covariance of the pulses of each amplifier's noise, where biases show any; levels of its rows."""
    return _by_amplifier(channel, "pulse", "pulses") | row_columns(channel)


def row_columns(channel: Channel) -> dict[str, FloatArray]:
    """Variance of the levels of each amplifier's rows, which values of usual sensors hold near 0."""
    return _by_amplifier(channel, "same_row", "row noise")


def _by_amplifier(channel: Channel, axis: str, name: str) -> dict[str, FloatArray]:
    """Columns, one for each amplifier, of the shape that an axis of the channel holds."""
    x, shape = channel.axes, channel.axes.get(axis)
    if shape is None:
        return {}
    own = {int(a): np.where(x["amp"] == a, shape, 0.0) for a in np.unique(x["amp"])}
    return {f"{name} {amp}": column for amp, column in own.items() if column.any()}
