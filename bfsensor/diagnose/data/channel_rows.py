"""Indices of a channel's values, by condition (wavelength, back bias, temperature)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import NUMBERS, condition_at

Rows = dict[Condition, NDArray[np.int64]]
"""Indices of a channel's values by condition."""


def rows_by_condition(channel: Channel) -> Rows:
    """Group the indices of a channel's values by condition, in a fixed order."""
    columns = np.column_stack([channel.axes[n].astype(float) for n in NUMBERS])
    # Numbers that are not known are nan, which np.unique would keep apart: nan equals nan here.
    _, first, index = np.unique(
        np.nan_to_num(columns, nan=-1e99), axis=0, return_index=True, return_inverse=True
    )
    return {
        condition_at(columns[row]): np.nonzero(index.ravel() == n)[0]
        for n, row in enumerate(first)
    }


def condition_of_row(channel: Channel, row: int | np.integer) -> Condition:
    """Condition of one value of a channel."""
    return condition_at(channel.axes[n][row] for n in NUMBERS)
