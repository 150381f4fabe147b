"""A baseline for unknown sensors: white noise, and free area changes of the nearest neighbours."""

from __future__ import annotations

import numpy as np

from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.typing import Edges, FloatArray

NAME = "none: white noise, near a_ij that float"
"""Name of the baseline in reports."""

SPREAD = 4e-6
"""Standard deviation of the priors of the a_ij [1/e-]. Chosen: ten times the largest neighbour's a_ij
of thick CCDs with 10 um pixels, so that flats of any use constrain them far better than the prior;
twice as large changes no fit of such flats."""

HALF = 5
"""Half side of the shifts' window [pixel]. Chosen: wider than the two lags that are free; twice as
large changes nothing but the window, as all other shifts are 0."""


def free_baseline() -> Baseline:
    """Make a baseline of white noise and a brighter-fatter effect of free short-range shape.

    The area changes a_10, a_01, a_20, a_02 and a_11 are free, equal in all four quadrants and not
    below 0: charges repel, so that neighbours of a full pixel grow.  a_00 follows from the
    conservation of area; farther lags are 0.  Boundaries shift towards the charge by as much as
    these areas require.  All wavelengths and voltages share one matrix.

    Returns
    -------
    Baseline
        Baseline with five free parameters and wide priors.

    Notes
    -----
    With flats of one level, these a_ij take up any positive covariance of near neighbours,
    whatever its cause; several levels separate covariances that grow with the level's square.

    Examples
    --------
    >>> free_baseline().parameters
    ('a10', 'a01', 'a20', 'a02', 'a11')
    """
    side = 2 * HALF + 1
    zero = np.zeros((side, side))
    # Area that a pixel gains comes from the central pixel, across all edges between the two.
    near, second = _towards({(0, 1): 1.0}), _towards({(0, 1): 1.0, (0, 2): 1.0})
    diagonal = _towards({(0, 1): 1.0, (1, 1): 0.5, (-1, 1): 0.5})
    edges: dict[str, Edges] = {
        "a10": (near, zero), "a01": (zero, near.T), "a20": (second, zero),
        "a02": (zero, second.T), "a11": (diagonal, diagonal.T),
    }  # fmt: skip
    return Baseline(
        NAME, {(np.nan, np.nan): (zero, zero)}, edges, dict.fromkeys(edges, SPREAD),
        (np.nan, np.nan), not_below=tuple(edges),
    )  # fmt: skip


def _towards(shifts: dict[tuple[int, int], float]) -> FloatArray:
    """Kernel of shifts towards the centre along x; keys: row, and edge counted from the centre."""
    out = np.zeros((2 * HALF + 1, 2 * HALF + 1))
    for (dy, edge), shift in shifts.items():
        # Element dx is the right edge of the pixel dx.
        out[HALF + dy, HALF + edge - 1] -= shift
        out[HALF + dy, HALF - edge] += shift
    return out
