"""Rows of a channel, condition by condition."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposures import Condition

Rows = dict[tuple[str, ...], NDArray[np.int64]]
"""Of each condition, by its key."""


def rows_by_condition(channel: Channel) -> Rows:
    """Rows of each condition."""
    columns = np.column_stack([channel.axes[n].astype(float) for n in Condition._fields])
    # nan equals nan here.
    _, first, index = np.unique(
        np.nan_to_num(columns, nan=-1e99), axis=0, return_index=True, return_inverse=True
    )
    return {
        Condition(*(float(v) for v in columns[row])).key: np.nonzero(index.ravel() == n)[0]
        for n, row in enumerate(first)
    }


def condition_at(channel: Channel, row: int | np.integer) -> Condition:
    """Condition of one row."""
    return Condition(*(float(channel.axes[n][row]) for n in Condition._fields))
