"""Widths, fluxes, asymmetry and wings of spots."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import label_of
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.channel_kind import ChannelKind, ChannelModel, Picture
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.plots import residuals as show
from bfsensor.typing import FloatArray


class Spots(ChannelKind):
    """Widths, fluxes, asymmetry and wings of spots by exposure and condition."""

    name = "spot"
    title = "spots"
    level = "flux"

    def depends(self, channel: Channel, *, changed: bool) -> tuple[str, ...]:
        del channel, changed
        return "gain", "device", "width"

    def predict(self, channel: Channel, model: ChannelModel) -> FloatArray:
        return model.spots(channel)

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        x = channel.axes
        out = {}
        for condition, own in rows.items():
            for what in ("flux", "skew_x", "skew_y"):
                here = own[x["what"][own] == what]
                column = np.zeros(len(channel))
                column[here] = x["light"][here] if what == "flux" else 1.0
                out[f"spot {what} {label_of(condition)}"] = column
        return out

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Patterns of spots' widths, wings and fluxes by power of the flux, condition and exposure."""
        x = g.axes
        flux = x["flux"].astype(float)
        unit = flux / flux.max()
        sizes = np.isin(x["what"], ("sigma_x", "sigma_y"))
        named = {str(w): x["what"] == w for w in dict.fromkeys(x["what"])}
        for what, here in {**named, "sizes": sizes}.items():
            if not here.any():
                continue
            for p in (0, 1, 2, 3):
                yield "spots x power", np.where(here, unit**p, 0.0), {
                    "what": what, "level": (float(flux.min()), float(flux.max())), "power": p,
                }  # fmt: skip
            for condition in dict.fromkeys(g.condition):
                own = here & (g.condition == condition)
                for p in (0, 1):
                    yield "spots x condition", np.where(own, unit**p, 0.0), {
                        "what": what, "condition": condition, "power": p,
                    }  # fmt: skip
            for one in np.unique(x["exposure"][here]):
                yield "spots, one exposure", np.where(here & (x["exposure"] == one), 1.0, 0.0), {
                    "what": what, "exposure": (int(one), int(one)),
                }  # fmt: skip

    def picture(self, channel: Channel, pulls: FloatArray) -> Picture:
        return Picture(
            "Spots: pulls of widths, flux, asymmetry and wings against flux [million e-].",
            (5.2, 3.6), (lambda ax: show.draw_spots(channel.axes, pulls, ax),),
        )  # fmt: skip
