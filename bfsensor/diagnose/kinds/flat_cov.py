"""Covariances of flats, and a_ij that replace them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel, step_of
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.bias_cov import noise_columns
from bfsensor.diagnose.kinds.channel_kind import ChannelKind, ChannelModel, Picture
from bfsensor.diagnose.kinds.scan_shapes import own_shapes
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.plots import residuals as show
from bfsensor.typing import FloatArray

POWERS = (0, 1, 2, 3)
"""Powers of the signal level with which covariances are scanned.  Chosen: noise is constant, shot
noise goes with the first, the brighter-fatter effect with the second and, next, third power; twice
as many powers are nearly degenerate with these and raise the deviate of an alarm slightly."""

LAGS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
"""Lags (x, y) [pixel] whose pulls are drawn against level.  Chosen: the nearest, where the
brighter-fatter effect is largest; more lags make the figure unreadable and change no result."""


class FlatCovariances(ChannelKind):
    """Covariances of pairs of flats by lag, level, amplifier and condition; or reduced a_ij."""

    name = "flat_cov"
    title = "covariances of flats"

    def depends(self, channel: Channel, *, changed: bool) -> tuple[str, ...]:
        del changed
        reduced = channel.unit == PER_ELECTRON
        return ("device",) if reduced else ("gain", "noise", "device")

    def predict(self, channel: Channel, model: ChannelModel) -> FloatArray:
        return model.covariances(channel)

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        del rows, measured
        return noise_columns(channel)

    def fitted_patterns(self, g: Group, residuals: FloatArray) -> Iterator[Pattern]:
        if g.members[0][0].unit != PER_ELECTRON:
            yield from own_shapes(g, residuals)

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Single lags and sets of lags by power of the level, level, amplifier and condition."""
        if g.members[0][0].unit == PER_ELECTRON:
            yield from _areas(g)
            return
        x = g.axes
        i, j, level = x["i"].astype(int), x["j"].astype(int), x["level"].astype(float)
        unit = level / level.max()
        lags = sorted(set(zip(i.tolist(), j.tolist(), strict=True)))
        low, high = float(level.min()), float(level.max())
        for a, b in lags:
            here = (i == a) & (j == b)
            base = {"lags": [(a, b)], "level": (low, high)}
            for p in POWERS:
                yield "lag x power", np.where(here, unit**p, 0.0), {**base, "power": p}
            for condition in dict.fromkeys(g.condition):
                own = here & (g.condition == condition)
                rest = here & ~own
                if rest.any():
                    yield (
                        "lag x condition", np.where(own, unit**2, 0.0), {**base, "condition": condition}
                    )  # fmt: skip
            for amp in np.unique(x["amp"]):
                yield (
                    "lag x amplifier", np.where(here & (x["amp"] == amp), unit**2, 0.0),
                    {**base, "amp": int(amp)},
                )  # fmt: skip
            for time in np.unique(step_of(x)):
                own = here & (step_of(x) == time)
                span = (float(level[own].min()), float(level[own].max()))
                yield (
                    "lag x level",
                    np.where(own, 1.0, 0.0),
                    {"lags": [(a, b)], "level": span},
                )
        for name, here in _lags_together(i, j).items():
            chosen = sorted(set(zip(i[here].tolist(), j[here].tolist(), strict=True)))
            for p in POWERS:
                yield "lags together", np.where(here, unit**p, 0.0), {
                    "lags": chosen, "level": (low, high), "power": p, "set": name,
                }  # fmt: skip

    def picture(self, channel: Channel, pulls: FloatArray) -> Picture:
        caption = "Covariances of flats: pulls (residual over standard error) by lag"
        panels = [lambda ax: show.draw_lags(channel.axes, pulls, ax)]
        if channel.unit != PER_ELECTRON:
            caption += ", weighted by the square of the level, and of the nearest lags against level"
            panels.append(
                lambda ax: show.draw_lag_levels(channel.axes, pulls, ax, lags=LAGS)
            )
        return Picture(f"{caption}.", (5.2, 3.5 * len(panels)), tuple(panels))


def _areas(g: Group) -> Iterator[Pattern]:
    """Single lags and sets of lags, for reduced a_ij, which have no signal level."""
    i, j = g.axes["i"].astype(int), g.axes["j"].astype(int)
    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        yield "lags", np.where((i == a) & (j == b), 1.0, 0.0), {"lags": [(a, b)]}
    for name, here in _lags_together(i, j).items():
        chosen = sorted(zip(i[here].tolist(), j[here].tolist(), strict=True))
        yield "lags together", np.where(here, 1.0, 0.0), {"lags": chosen, "set": name}


def _lags_together(
    i: NDArray[np.int64], j: NDArray[np.int64]
) -> dict[str, NDArray[np.bool_]]:
    """Masks of sets of lags, by name: rows, columns, near and far ones."""
    radius = np.hypot(i, j)
    return {
        "row of lags": (j == 0) & (i > 0), "column of lags": (i == 0) & (j > 0),
        "first neighbours": radius == 1,
        "near lags": (radius > 0) & (radius < 1.5), "far lags": radius > 2.5,
    }  # fmt: skip
