"""Overscans after flats: the mean profile of their first pixels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bfsensor.diagnose.data.channels import Channel, step_of
from bfsensor.diagnose.data.flat_channels import TAIL
from bfsensor.diagnose.kinds.channel_kind import ChannelKind, Picture
from bfsensor.diagnose.kinds.scan_shapes import amplifiers
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.effects.effect import Axes, Effect, Layout
from bfsensor.plots import residuals as show
from bfsensor.typing import FloatArray


class Overscan(ChannelKind):
    """Mean profile of an overscan's first pixels after flats, by level and amplifier."""

    def __init__(self, name: str, title: str) -> None:
        self.name, self.title = name, title

    def change(self, effect: Effect, axes: Axes, layout: Layout) -> FloatArray:
        return super().change(effect, axes, layout) - in_overscan(
            effect, self.name, axes, layout, TAIL
        )

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Patterns of overscans: single pixels and exponential tails by level and amplifier."""
        x = g.axes
        k, level = x["k"].astype(float), x["level"].astype(float)
        unit = level / level.max()
        span = (float(level.min()), float(level.max()))
        for name, here in amplifiers(x):
            for one in np.unique(k):
                for p in (0, 1):
                    yield "overscan pixel x power", np.where(here & (k == one), unit**p, 0.0), {
                        "amp": name, "k": (int(one), int(one)), "level": span, "power": p,
                    }  # fmt: skip
            for length in (1.0, 2.0, 4.0, 8.0):
                tail = np.exp(-(k - 1) / length)
                for p in (0, 1):
                    yield "overscan tail x power", np.where(here, tail * unit**p, 0.0), {
                        "amp": name, "k": (1, int(k.max())), "length": length, "level": span, "power": p,
                    }  # fmt: skip
                for time in np.unique(step_of(x)):
                    own = here & (step_of(x) == time)
                    yield "overscan tail x level", np.where(own, tail, 0.0), {
                        "amp": name, "k": (1, int(k.max())), "length": length,
                        "level": (float(level[own].min()), float(level[own].max())),
                    }  # fmt: skip

    def picture(self, channel: Channel, pulls: FloatArray) -> Picture:
        left = channel.unwhiten(pulls)
        return Picture(
            f"{self.title.capitalize()}: residuals of the mean profile [ADU] of the brightest flats.",
            (5.2, 3.4), (lambda ax: show.draw_overscan(channel.axes, left, channel.errors, ax),),
        )  # fmt: skip


def in_overscan(
    effect: Effect, word: str, axes: Axes, layout: Layout, last: int | None
) -> FloatArray:
    """Mean change of an overscan's last pixels, or of its second half, by an effect [e-]."""
    out = np.zeros(len(axes["amp"]))
    if word not in effect.touches:
        return out
    depth = layout.of_amp(word, axes["amp"]).astype(int)
    for deep in np.unique(depth[depth > 0]):
        rows = depth == deep
        here = {k: v[rows] for k, v in axes.items()}
        first = deep // 2 if last is None else deep - last
        change = [
            getattr(effect, word)({**here, "k": np.full(rows.sum(), float(k))}, layout)
            for k in range(first + 1, deep + 1)
        ]
        out[rows] = np.mean(change, axis=0)
    return out
