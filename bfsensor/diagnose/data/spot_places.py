"""Where spots of each exposure lie, and how what earlier ones left widens later ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from bfsensor.typing import FloatArray

NEAR = 3.0
"""Distance [pixel] up to which spots of two exposures are of the same pinhole."""

LEAST = 4
"""Spots of the same pinholes that are needed to say how far they moved."""


PIXEL = 1 / 12
"""Variance of a pixel, over which light is summed up [pixel^2]."""


class PlacedSpots(NamedTuple):
    """Spots of one exposure.

    Attributes
    ----------
    number : int
        Of the exposure.
    flux : float
        Mean of a spot [e-], by rough gains.
    sigma : (float, float)
        Widths along x and y [pixel].
    places : ndarray, shape (n, 2)
        Centres on the sensor [pixel].
    """

    number: int
    flux: float
    sigma: tuple[float, float]
    places: FloatArray


def widening(later: Sequence[PlacedSpots], earlier: Sequence[PlacedSpots]) -> FloatArray:
    r"""What the variance of a spot gains for each part of its charge that is an earlier one's.

    A Gaussian :math:`G` is fitted by least squares, its flux, centre and variances free, to which
    a small share of another one at a distance is added.  What it changes is that one projected
    on :math:`G` and its derivatives, all of whose products are Gaussians of the distance.  Of
    small distances :math:`d` and equal widths it is :math:`d^2`; means are over the pinholes.

    Parameters
    ----------
    later, earlier : sequence of PlacedSpots
        Of n and m exposures.

    Returns
    -------
    gained : ndarray, shape (2, n, m)
        Along x and y [pixel^2]; 0 where too few spots are the same.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(3) * 30.0, np.arange(3) * 30.0)
    >>> first = PlacedSpots(1, 1e4, (1.0, 1.0), np.column_stack([x.ravel(), y.ravel()]))
    >>> moved = PlacedSpots(2, 1e3, (1.0, 1.0), first.places + [0.1, 0.0])
    >>> widening([moved], [first]).ravel().round(4).tolist()
    [0.01, -0.0]
    """
    out = np.zeros((2, len(later), len(earlier)))
    trees = [cKDTree(e.places) for e in earlier]
    for n, one in enumerate(later):
        variances = np.square(one.sigma) + PIXEL
        alone = _products(np.zeros((1, 2)), 2 * variances)
        gram = _gram(alone[0], 2 * variances)
        for m, (other, tree) in enumerate(zip(earlier, trees, strict=True)):
            away, which = tree.query(one.places, distance_upper_bound=NEAR)
            same = np.isfinite(away)
            if same.sum() < LEAST:
                continue
            moved = one.places[same] - other.places[which[same]]
            both = variances + np.square(other.sigma) + PIXEL
            # The second derivative by a place is twice the derivative by a variance.
            out[:, n, m] = 2 * np.linalg.solve(gram, _products(moved, both).mean(0))[1:]
    return out


def _products(moved: FloatArray, both: FloatArray) -> FloatArray:
    """Products of G and its second derivatives in x and y with a Gaussian at distances, (n, 3).

    ``both``: sums of their variances.
    """
    bell = np.exp(-0.5 * (moved**2 / both).sum(1)) / (2 * np.pi * np.sqrt(both.prod()))
    bent = moved**2 / both**2 - 1 / both
    return bell[:, None] * np.column_stack([np.ones(len(moved)), bent])


def _gram(alone: FloatArray, both: FloatArray) -> FloatArray:
    """Products of G and its second derivatives with one another."""
    first, bent = alone[0], -1 / both
    out = np.empty((3, 3))
    out[0], out[1:, 0] = alone, alone[1:]
    out[1:, 1:] = first * (np.multiply.outer(bent, bent) + 2 * np.diag(bent**2))
    return out
