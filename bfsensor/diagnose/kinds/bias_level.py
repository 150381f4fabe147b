"""Levels of biases, of their rows and of their frames."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.bias_cov import row_columns
from bfsensor.diagnose.kinds.channel_kind import ChannelKind
from bfsensor.diagnose.kinds.scan_shapes import amplifiers
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.effects.effect import Axes
from bfsensor.typing import FloatArray


class BiasLevels(ChannelKind):
    """Levels of biases above the overscan, and variances of the levels of rows and of frames."""

    name = "bias_level"
    title = "bias levels"

    def in_unit(self, change: FloatArray, own: FloatArray, axes: Axes) -> FloatArray:
        # Values are variances relative to white noise; those of frames are their logarithms.
        what, ratio = axes["what"], change / own / axes["white"]
        out = np.where(what == "rows", ratio, change)
        return np.where(what == "frames", np.log1p(np.maximum(ratio, 0.0)), out)

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        del rows, measured
        return _level_columns(channel) | row_columns(channel)

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Patterns of bias levels by amplifier and exposure."""
        x = g.axes
        for what in (w for w in dict.fromkeys(x["what"]) if w != "usual rows"):
            for name, here in amplifiers(x):
                rows = here & (x["what"] == what)
                yield "bias", np.where(rows, 1.0, 0.0), {"amp": name, "what": str(what)}
                for one in np.unique(x["exposure"][rows]):
                    yield "bias, one exposure", np.where(rows & (x["exposure"] == one), 1.0, 0.0), {
                        "amp": name, "what": str(what), "exposure": (int(one), int(one)),
                    }  # fmt: skip


def _level_columns(channel: Channel) -> dict[str, FloatArray]:
    """Level of each amplifier's fixed bias structure above its overscan."""
    x = channel.axes
    level = x["what"] == "level"
    return {
        f"bias level {int(amp)}": np.where(level & (x["amp"] == amp), 1.0, 0.0)
        for amp in np.unique(x["amp"][level])
    }
