"""Bounds of a parameter from its profile likelihood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bfsensor.typing import FloatArray

LEVELS = {"68 %": 1.0, "95 %": 3.84}
"""Rise of the minimum at the bounds: quantiles of chi2 with one degree of freedom."""


class Bounds(NamedTuple):
    """Interval of a parameter [internal unit].

    An end is infinite where the profile does not rise as far: at the end of what can be, or of what
    was asked for.
    """

    low: float
    high: float


def profile_bounds(values: FloatArray, rise: FloatArray, level: float) -> Bounds:
    """Where a profile rises to a level.

    Between points the root of the rise is taken as straight, which of a parabola it is.

    Parameters
    ----------
    values, rise : ndarray, shape (n,)
        The profile, values in order.
    level : float
        Above the minimum.

    Examples
    --------
    >>> at = np.linspace(-3.0, 3.0, 7)
    >>> bounds = profile_bounds(at, at**2, 1.0)
    >>> float(bounds.low), float(bounds.high)
    (-1.0, 1.0)
    >>> float(profile_bounds(at[2:], at[2:] ** 2, 3.84).low)
    -inf
    """
    height = np.sqrt(np.maximum(rise, 0.0))
    lowest, wanted = int(np.argmin(rise)), np.sqrt(level)
    ends = []
    for side in (-1, 1):
        end = side * np.inf
        n = lowest
        while 0 <= n + side < len(values):
            if height[n + side] >= wanted:
                part = (wanted - height[n]) / (height[n + side] - height[n])
                end = values[n] + part * (values[n + side] - values[n])
                break
            n += side
        ends.append(float(end))
    return Bounds(ends[0], ends[1])
