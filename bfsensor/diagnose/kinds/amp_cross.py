"""Noise shared by amplifiers, and crosstalk between them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bfsensor.diagnose.kinds.channel_kind import ChannelKind
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern


class AmplifierPairs(ChannelKind):
    """Noise shared by each pair of amplifiers, and crosstalk from one to the other."""

    name = "amp_cross"
    title = "amplifiers against one another"

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Every value alone: crosstalk of each pair of amplifiers."""
        x = g.axes
        for n in range(g.size):
            yield "amplifiers", np.eye(g.size)[n], {
                "amp": int(x["amp"][n]), "other": int(x["other"][n]), "what": str(x["what"][n]),
            }  # fmt: skip
