"""Positions of spots by exposure, and the widening of spots by the persistence of earlier ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from bfsensor.typing import FloatArray

NEAR = 3.0
"""Distance up to which spots of two exposures belong to the same pinhole [pixel].  Chosen:
larger than dithers within a pixel, smaller than half the pitch of spots; with 6, another pinhole
up to 6 pixels away is taken for the same one where that is missing."""

LEAST = 4
"""Number of common pinholes below which no widening is computed.  Chosen: with 8, exposures with
4 to 7 common pinholes are predicted without it."""


PIXEL = 1 / 12
"""Variance of a uniform distribution over one pixel [pixel^2]: exact."""


class PlacedSpots(NamedTuple):
    """Spots of one exposure.

    Attributes
    ----------
    number : int
        Number of the exposure.
    flux : float
        Mean flux of a spot [e-], by rough gains.
    sigma : (float, float)
        Gaussian widths along x and y [pixel].
    places : ndarray, shape (n, 2)
        Centres (x, y) on the sensor [pixel].
    """

    number: int
    flux: float
    sigma: tuple[float, float]
    places: FloatArray


def widening(later: Sequence[PlacedSpots], earlier: Sequence[PlacedSpots]) -> FloatArray:
    r"""Increase of a spot's fitted variance per part of its charge that is an earlier spot's.

    A Gaussian :math:`G` is fitted by least squares, with free flux, centre and variances, to a
    spot to which a small share of another Gaussian at a distance is added.  To first order the
    parameters change by the projection of the second one on :math:`G` and its derivatives; all
    their products are Gaussians of the distance.  For small distances :math:`d` and equal widths
    the variance changes by :math:`d^2` per share.  Means are over the pinholes.

    Parameters
    ----------
    later, earlier : sequence of PlacedSpots
        Spots of n and m exposures.

    Returns
    -------
    gained : ndarray, shape (2, n, m)
        Derivative of the variances along x and y by the share [pixel^2]; 0 where fewer than
        :data:`LEAST` pinholes are common.

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
            # A Gaussian solves the heat equation: its second derivative by position is twice its
            # derivative by the variance.
            out[:, n, m] = 2 * np.linalg.solve(gram, _products(moved, both).mean(0))[1:]
    return out


def _products(moved: FloatArray, both: FloatArray) -> FloatArray:
    """Scalar products of G and its second derivatives with a Gaussian at distances, (n, 3).

    ``both``: sums of their variances along x and y [pixel^2].
    """
    bell = np.exp(-0.5 * (moved**2 / both).sum(1)) / (2 * np.pi * np.sqrt(both.prod()))
    bent = moved**2 / both**2 - 1 / both
    return bell[:, None] * np.column_stack([np.ones(len(moved)), bent])


def _gram(alone: FloatArray, both: FloatArray) -> FloatArray:
    """Scalar products of G and its second derivatives with one another, shape (3, 3)."""
    first, bent = alone[0], -1 / both
    out = np.empty((3, 3))
    out[0], out[1:, 0] = alone, alone[1:]
    out[1:, 1:] = first * (np.multiply.outer(bent, bent) + 2 * np.diag(bent**2))
    return out
