"""Frequencies of converter codes in flats."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.channel_kind import ChannelKind
from bfsensor.diagnose.kinds.scan_shapes import amplifiers
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.typing import FloatArray


class CodeHistogram(ChannelKind):
    """Relative frequencies of converter codes by their last bits, and below high bits."""

    name = "code_hist"
    title = "converter codes"

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        """Excess of even codes by amplifier.

        The lowest bit of every converter, and ties that rounding turns to even codes, make odd and even
        codes unequally frequent; millions of pixels show a thousandth of it, which says nothing else.
        """
        even = np.where(channel.axes["code"].astype(int) % 2 == 0, 1.0, -1.0)
        amps = channel.axes["amp"]
        return {
            f"codes even {int(a)}": np.where(amps == a, even, 0.0) for a in np.unique(amps)
        }

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Patterns of the histogram of converter codes: bits, single codes, codes below high bits."""
        x = g.axes
        code, multiple = x["code"].astype(int), x["bit"].astype(int)
        for name, amp in amplifiers(x):
            here = amp & (code >= 0)
            bit = 1
            while bit <= code.max():
                yield "code bits", np.where(here, np.where(code & bit, 1.0, -1.0), 0.0), {
                    "amp": name, "bit": bit,
                }  # fmt: skip
                bit *= 2
            for one in np.unique(code[here]):
                yield (
                    "codes",
                    np.where(here & (code == one), 1.0, 0.0),
                    {"amp": name, "code": int(one)},
                )
            for power, below in sorted(
                set(zip(multiple[code < 0], code[code < 0], strict=True))
            ):
                yield "codes below high bits", np.where(
                    amp & (multiple == power) & (code == below), 1.0, 0.0
                ), {"amp": name, "bit": 2 ** int(power), "code": int(below)}  # fmt: skip
