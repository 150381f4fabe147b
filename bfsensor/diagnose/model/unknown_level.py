"""The level of flats as a free parameter of a baseline, where tables of a_ij do not state it."""

from __future__ import annotations

from dataclasses import replace

from bfsensor.diagnose.data.channels import PER_ELECTRON
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.response.edge_response import LEVEL

NAME = "recording.level"
"""Name of the parameter among the baseline's."""

SPREAD = LEVEL / 3**0.5
"""Standard deviation of an unknown level [e-]: that of even odds between 0 and twice the usual level.
Derived: (2 LEVEL) / sqrt(12)."""


def float_unknown_level(measured: MeasuredChannels, baseline: Baseline) -> Baseline:
    """Let the level float at which a_ij were measured, where no table states it.

    Area changes fall with the level, a_00 by 1 % for 8,000 e- (ITL) or 18,000 e- (E2V device), so
    that a level that is merely assumed would look like a wrong a_00.

    Parameters
    ----------
    measured : MeasuredChannels
        Channels of tables of a_ij; others leave the baseline as it is.
    baseline : Baseline
        Baseline, whose ``slopes`` hold the change with level.

    Returns
    -------
    Baseline
        With the free parameter :data:`NAME` [e-], from 0 to twice the usual level, where it can be
        known at all.
    """
    flats = [c for c in measured.channels if c.unit == PER_ELECTRON]
    if not flats or not baseline.slopes or any(c.axes["stated"].any() for c in flats):
        return baseline
    slopes = {key: baseline.slopes[key] for key in baseline.edges if key in baseline.slopes}
    own = slopes.get(baseline.reference, next(iter(slopes.values())))
    held = {
        key: {
            **baseline.held.get(key, {}),
            **({NAME: slopes[key]} if key in slopes else {}),
        }
        for key in baseline.edges
    }
    return replace(
        baseline,
        derivatives={**baseline.derivatives, NAME: own},
        spread={**baseline.spread, NAME: SPREAD},
        bounds={**baseline.bounds, NAME: (-LEVEL, LEVEL)},
        held=held,
    )
