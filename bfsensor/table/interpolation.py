"""Interpolation in a table as weights of its nodes: polynomials and cubic splines."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from bfsensor.typing import FloatArray


def polynomial_weights(nodes: FloatArray, at: float) -> FloatArray:
    """Return the weights, shape of ``nodes``, of the polynomial through the nodes at ``at``."""
    ratios = (at - nodes) / (nodes[:, None] - nodes + np.eye(len(nodes)))
    np.fill_diagonal(ratios, 1.0)
    return np.asarray(ratios.prod(axis=1))


def spline_weights(nodes: FloatArray, at: float) -> FloatArray:
    """Return the weights of the cubic spline through the nodes at ``at``.

    Fewer than four nodes have the polynomial through them instead.
    """
    if len(nodes) < 4:
        return polynomial_weights(nodes, at)
    return np.asarray(CubicSpline(nodes, np.eye(len(nodes)))(at))
