"""A baseline for sensors of which nothing is known: white noise, and near areas that float."""

from __future__ import annotations

import numpy as np

from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.typing import Edges, FloatArray

NAME = "none: white noise, near a_ij that float"

SPREAD = 4e-6
"""Width of the priors of the a_ij [1/e-]: ten times the largest neighbour's of thick CCDs with
pixels of 10 um, so that data of any use decide alone."""

HALF = 5


def free_baseline() -> Baseline:
    """White noise of light and readout, and a brighter-fatter effect of any near shape.

    The area changes a_10, a_01, a_20, a_02 and a_11 float, alike in all four quadrants and not
    below 0: charges repel, so that neighbours of a full pixel grow.  a_00 follows, for areas
    are conserved; further lags stay at 0.  Boundaries shift as the areas ask, towards the
    charge.  Nothing is assumed of wavelength or voltage: all conditions share one matrix.

    Returns
    -------
    Baseline
        Its parameters float with priors that any data of use override.

    Notes
    -----
    At one level of the light a positive covariance of near neighbours is taken by these a_ij,
    whatever made it; several levels part what goes with the level's square from the rest.

    Examples
    --------
    >>> free_baseline().parameters
    ('a10', 'a01', 'a20', 'a02', 'a11')
    """
    side = 2 * HALF + 1
    zero = np.zeros((side, side))
    # What grows at one place was taken from the pixel in the middle, across all edges between.
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
    """Shifts towards the middle of edges in x: by row, and number of the edge to either side."""
    out = np.zeros((2 * HALF + 1, 2 * HALF + 1))
    for (dy, edge), shift in shifts.items():
        # Element dx is the right edge of the pixel dx.
        out[HALF + dy, HALF + edge - 1] -= shift
        out[HALF + dy, HALF - edge] += shift
    return out
