"""Levels and columns of darks, and pixels struck by particles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.channel_kind import ChannelKind
from bfsensor.diagnose.kinds.scan_shapes import amplifiers
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.effects.dark_hot import warmth
from bfsensor.typing import FloatArray


class DarkMaps(ChannelKind):
    """Levels of darks, current after light, single columns, struck pixels and tracks."""

    name = "dark_map"
    title = "darks"

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        """Dark current and its offset, which values of usual sensors hold near 0; level of columns."""
        x = channel.axes
        out, what = {}, x["what"]
        for amp in np.unique(x["amp"][what == "level"]):
            here = x["amp"] == amp
            for name, each, usual in (
                ("dark", x["time"] * warmth(x["temperature"]), "usual"),
                ("dark level", 1.0, "usual offset"),
            ):  # fmt: skip
                column = np.where(what == "level", each, np.where(what == usual, 1.0, 0.0))
                out[f"{name} {int(amp)}"] = np.where(here, column, 0.0)
            out[f"dark column {int(amp)}"] = np.where(here & (what == "column"), 1.0, 0.0)
        return out

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Patterns of darks: current, current after light, struck pixels, single columns."""
        x = g.axes
        after = x["after"].astype(float)
        for name, here in amplifiers(x):
            if name == -1:
                continue  # tracks are counted in all amplifiers together
            level, struck = (here & (x["what"] == w) for w in ("level", "struck"))
            if after.max() > 0:
                yield (
                    "dark after light",
                    np.where(level, after / after.max(), 0.0),
                    {"amp": name, "what": "after light"},
                )
            if (x["what"] == "usual").any():
                yield (
                    "dark current",
                    np.where(level, x["time"] * warmth(x["temperature"]), 0.0),
                    {"amp": name, "what": "level"},
                )
            yield (
                "struck pixels",
                np.where(struck, 1.0, 0.0),
                {"amp": name, "what": "struck"},
            )
        yield "tracks", np.where(x["what"] == "tracks", 1.0, 0.0), {"what": "tracks"}
        # Columns belong to one amplifier, also where there is no other.
        for amp in np.unique(x["amp"]):
            column = (x["amp"] == amp) & (x["what"] == "column")
            for one in np.unique(x["x"][column]):
                yield "dark columns", np.where(column & (x["x"] == one), 1.0, 0.0), {
                    "amp": int(amp), "x": (int(one), int(one) + 1), "what": "column",
                }  # fmt: skip
