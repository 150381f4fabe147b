"""Means of flats against the lamp."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel, step_of
from bfsensor.diagnose.data.exposure_info import label_of
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.channel_kind import ChannelKind, Picture
from bfsensor.diagnose.kinds.overscan import in_overscan
from bfsensor.diagnose.kinds.scan_shapes import amplifiers
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.effects.effect import Axes, Effect, Layout
from bfsensor.plots import residuals as show
from bfsensor.typing import FloatArray

KNOTS, EACH = 6, 8
"""Largest number of times between which the light of a lamp without a monitor drifts linearly, and
number of flats for each.  Chosen: light that changes at random by s a flat departs from a line over
n flats by s (n / 6)^(1/2), 3.7e-4 for s = 2e-4 in a campaign of 100 flats; with 12 knots, 2.5e-4."""


class FlatMeans(ChannelKind):
    """Mean of each flat and amplifier above its overscan, against the lamp."""

    name = "flat_mean"
    title = "mean of flats against the lamp"

    def depends(self, channel: Channel, *, changed: bool) -> tuple[str, ...]:
        del channel
        return ("gain",) if changed else ()

    def change(self, effect: Effect, axes: Axes, layout: Layout) -> FloatArray:
        return super().change(effect, axes, layout) - in_overscan(
            effect, "serial_overscan", axes, layout, None
        )

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        x = channel.axes
        out = {}
        light = x["time"] * x["lamp"]
        setting = x.get("setting", np.zeros(len(channel)))
        for condition, own in rows.items():
            for amp in np.unique(x["amp"][own]):
                here = (x["amp"] == amp) & np.isin(np.arange(len(channel)), own)
                column = np.where(here, light, 0.0)
                out[f"light {int(amp)} {label_of(condition)}"] = column
            # One factor between the lamp's settings, whatever the amplifier.
            for n in np.unique(setting[own][setting[own] > 0]):
                here = (setting == n) & np.isin(np.arange(len(channel)), own)
                column = np.where(here, x["level"], 0.0)
                out[f"lamp {int(n)} {label_of(condition)}"] = column
        # Without an overscan the bias level of flats is another than that of biases.
        unknown = ~x.get("zeroed", np.ones(len(channel))).astype(bool)
        for amp in np.unique(x["amp"]):
            out[f"dark {int(amp)}"] = np.where(x["amp"] == amp, x["time"], 0.0)
            if unknown.any():
                out[f"zero {int(amp)}"] = np.where((x["amp"] == amp) & unknown, 1.0, 0.0)
        return out | _drift_columns(channel, measured)

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Patterns of means by power of the level, exposure, steps and slopes in time, by amplifier."""
        x = g.axes
        level = x["level"].astype(float)
        unit = level / level.max()
        order = x["exposure"].astype(float)
        span = (float(level.min()), float(level.max()))
        for name, here in amplifiers(x):
            for p in (0, 2, 3, 4):
                yield (
                    "mean x power",
                    np.where(here, unit**p, 0.0),
                    {"amp": name, "level": span, "power": p},
                )
            for time in np.unique(step_of(x)):
                own = here & (step_of(x) == time)
                if own.any():
                    yield "mean x level", np.where(own, unit, 0.0), {
                        "amp": name, "level": (float(level[own].min()), float(level[own].max())),
                    }  # fmt: skip
            for cut in np.unique(order)[1::2]:
                yield "mean, step in time", np.where(here & (order >= cut), unit, 0.0), {
                    "amp": name, "exposure": (int(cut), int(order.max())),
                }  # fmt: skip
            yield "mean, slope in time", np.where(here, unit * (order - order.mean()), 0.0), {
                "amp": name, "exposure": (int(order.min()), int(order.max())),
            }  # fmt: skip
            for one in np.unique(order):
                yield "mean, one exposure", np.where(here & (order == one), unit, 0.0), {
                    "amp": name, "exposure": (int(one), int(one)),
                }  # fmt: skip

    def picture(self, channel: Channel, pulls: FloatArray) -> Picture:
        left = channel.unwhiten(pulls) / np.maximum(channel.values, 1e-9)
        return Picture(
            "Means of flats: residuals [%] against level [1000 ADU].", (5.2, 3.4),
            (lambda ax: show.draw_means(channel.axes, left, ax),),
        )  # fmt: skip


def _drift_columns(channel: Channel, measured: MeasuredChannels) -> dict[str, FloatArray]:
    """Slow drift of a lamp that no monitor records, piecewise linear in the order of exposures."""
    x = channel.axes
    unknown = ~x.get("monitored", np.ones(len(channel))).astype(bool)
    if not unknown.any():
        return {}
    flats = [c.axes["exposure"] for c in measured.channels if c.word == "flat_mean"]
    every = np.unique(np.concatenate(flats))
    count = min(KNOTS, len(every) // EACH)
    knots = np.linspace(float(every[0]), float(every[-1]), max(count, 1))
    # The constant part is the light itself: one knot stays at 0.
    return {
        f"lamp at {n}": np.where(
            unknown,
            np.interp(x["exposure"], knots, np.eye(count)[n]) * x["level"],
            0.0,
        )
        for n in range(1, count)
    }
