"""Weights of values at nodes for the value between them."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from bfsensor.typing import FloatArray


def polynomial_weights(nodes: FloatArray, at: float) -> FloatArray:
    """Weights of the polynomial through ``nodes`` at ``at``."""
    ratios = (at - nodes) / (nodes[:, None] - nodes + np.eye(len(nodes)))
    np.fill_diagonal(ratios, 1.0)
    return np.asarray(ratios.prod(axis=1))


def spline_weights(nodes: FloatArray, at: float) -> FloatArray:
    """Weights of the cubic spline through ``nodes`` at ``at`` (a polynomial below four)."""
    if len(nodes) < 4:
        return polynomial_weights(nodes, at)
    return np.asarray(CubicSpline(nodes, np.eye(len(nodes)))(at))
