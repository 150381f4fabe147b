"""Bounds of a parameter from its profile likelihood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bfsensor.typing import FloatArray

LEVELS = {"68 %": 1.0, "95 %": 3.84}
"""Rise of chi2 above its minimum at the bounds, by confidence level.

Derived: quantiles of the chi2 distribution with one degree of freedom, 1 at 68.27 % and 3.841 at
95 % (Wilks 1938)."""


class Bounds(NamedTuple):
    """Confidence interval of a parameter.

    A bound is infinite where the profile does not rise to the level within the values that were
    computed, because the parameter cannot go further or the profile was not taken further.

    Parameters
    ----------
    low, high : float
        Lower and upper bound [internal unit].
    """

    low: float
    high: float


def profile_bounds(values: FloatArray, rise: FloatArray, level: float) -> Bounds:
    """Find the values on both sides of the minimum at which a likelihood profile rises to a level.

    Between points the square root of the rise is interpolated linearly, which is exact for a
    parabola whose minimum is one of the points.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Values of the parameter [internal unit], ascending.
    rise : ndarray, shape (n,)
        Rise of chi2 above its minimum at these values.
    level : float
        Rise of chi2 at the bounds (:data:`LEVELS`), above 0.

    Returns
    -------
    bounds : Bounds
        Lower and upper bound, infinite where the profile does not reach the level.

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
