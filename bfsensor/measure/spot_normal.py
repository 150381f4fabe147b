r"""Normal equations of a region's spots, with each spot's own parameters eliminated.

The matrix has the form of an arrow: the shape's few parameters are coupled to those of every
spot, parameters of different spots are not coupled.  Each spot's own parameters are eliminated
from its own block, which leaves a system of two or three equations for the shape, at a cost in
proportion to the number of spots.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bfsensor.measure.spot_model import Shape, gradients
from bfsensor.measure.spots import Stamps
from bfsensor.typing import FloatArray

LEAST_VARIANCE = 1.0
"""Smallest variance of a pixel in the weights [e-^2].

Chosen: without a limit and without read noise, wings with hundredths of an electron would dominate
chi-square.  At twice the value pixels between 1 and 2 e- of signal also count less; with a read
noise above 1.5 e- neither value acts.
"""


class Spots(NamedTuple):
    """Each spot's own parameters, arrays of shape (n,) that the solver changes in place."""

    flux: FloatArray
    x: FloatArray
    y: FloatArray
    background: FloatArray


class Normal(NamedTuple):
    """Normal equations of n spots with ``own`` parameters each and ``shared`` ones.

    ``own_inverse`` (n, own, own) is the inverse of each spot's own block, ``cross`` (n, own,
    shared) the block that couples it to the shape.  ``rest`` (n, shared, shared) and ``score``
    (n, shared) are each spot's parts of the shape's block and right side after its own parameters
    are eliminated; ``own_score`` (n, own) is the right side of its own parameters.  ``weighted``
    (n, own + shared, pixels) are derivatives times weights.  ``own_covariance`` is the covariance
    matrix of each spot's own parameters at the fitted shape, and ``score_variance`` that of its
    score, from the noise of its pixels; where weights are the inverse variances they equal
    ``own_inverse`` and ``rest``.  ``chi2`` (n,) is each spot's chi-square by its noise.
    """

    own_inverse: FloatArray
    cross: FloatArray
    rest: FloatArray
    own_score: FloatArray
    score: FloatArray
    weighted: FloatArray
    own_covariance: FloatArray
    score_variance: FloatArray
    chi2: FloatArray


class SpotProblem:
    """Stamps with their noise and weights, and the choice of free parameters."""

    def __init__(
        self,
        stamps: Stamps,
        read_noise: float,
        *,
        equal_weights: bool,
        free_background: bool,
        free_tilt: bool,
    ) -> None:
        self.stamps = stamps
        self.ny, self.nx = stamps.electrons.shape[1:]
        self.data = stamps.electrons.reshape(len(stamps), -1)
        self.good = stamps.good.reshape(len(stamps), -1)
        self.known = (
            None if stamps.variance is None else stamps.variance.reshape(len(stamps), -1)
        )
        self.read_noise = read_noise
        self.equal_weights = equal_weights
        self.own = 4 if free_background else 3
        self.shared = 3 if free_tilt else 2

    def derivatives(self, spots: Spots, shape: Shape) -> FloatArray:
        """Fractions of the flux in each pixel and their derivatives, shape (6, n, pixels)."""
        slopes = gradients(spots.x, spots.y, shape, self.ny, self.nx)
        return slopes.reshape(6, len(self.data), -1)

    def variance(self, model: FloatArray) -> FloatArray:
        """Variance of each pixel [e-^2]."""
        if self.known is not None:
            return self.known
        # The model's signal, not the data's: pixels that fluctuated low would count for more.
        return np.maximum(np.maximum(model, 0.0) + self.read_noise**2, LEAST_VARIANCE)

    def jacobian(self, flux: FloatArray, slopes: FloatArray) -> FloatArray:
        """Derivatives of the model by each spot's own and the shared parameters."""
        # Without flux the derivatives by the centre vanish and the block is singular: 1 e- at least.
        flux = np.maximum(flux, 1.0)[:, None]
        rows = [slopes[0], flux * slopes[1], flux * slopes[2]]
        if self.own == 4:
            rows.append(np.ones_like(slopes[0]))
        rows += [flux * slopes[3 + k] for k in range(self.shared)]
        return np.stack(rows, axis=1)

    def linearise(
        self, spots: Spots, slopes: FloatArray, *, with_noise: bool = False
    ) -> Normal:
        """Normal equations at the present parameters.

        With equal weights ``own_covariance``, ``score_variance`` and ``chi2`` are correct only
        if ``with_noise`` is set.
        """
        model = spots.flux[:, None] * slopes[0] + spots.background[:, None]
        variance = self.variance(model)
        by_noise = self.good / variance
        weight = self.good.astype(float) if self.equal_weights else by_noise
        residual = self.data - model
        jacobian = self.jacobian(spots.flux, slopes)
        weighted = jacobian * weight[:, None]
        blocks = weighted @ jacobian.transpose(0, 2, 1)
        scores = (weighted @ residual[:, :, None])[:, :, 0]
        own = self.own
        inverse = invert(blocks[:, :own, :own])
        cross = blocks[:, :own, own:]
        eliminate = np.einsum("nai,nab->nib", cross, inverse)
        rest = blocks[:, own:, own:] - eliminate @ cross
        own_covariance, score_variance = inverse, rest
        chi2 = np.einsum("np,np->n", by_noise * residual, residual)
        if self.equal_weights and with_noise:
            noise = (weighted * variance[:, None]) @ weighted.transpose(0, 2, 1)
            own_covariance = inverse @ noise[:, :own, :own] @ inverse
            turn = np.concatenate(
                [-eliminate, np.broadcast_to(np.eye(self.shared), rest.shape)], axis=2
            )
            score_variance = turn @ noise @ turn.transpose(0, 2, 1)
            # With equal weights the spots' own parameters do not minimise chi-square, and its
            # excess has a long tail.  The drop to its minimum, to first order, is subtracted.
            closer = jacobian[:, :own] * by_noise[:, None]
            gain = np.einsum("nap,np->na", closer, residual)
            best = invert(closer @ jacobian[:, :own].transpose(0, 2, 1))
            chi2 = chi2 - np.einsum("na,nab,nb->n", gain, best, gain)
        return Normal(
            inverse,
            cross,
            rest,
            scores[:, :own],
            scores[:, own:] - np.einsum("nib,nb->ni", eliminate, scores[:, :own]),
            weighted,
            own_covariance,
            score_variance,
            chi2,
        )


def invert(blocks: FloatArray) -> FloatArray:
    """Inverses of small positive matrices, scaled to a unit diagonal before."""
    size = np.sqrt(np.maximum(np.einsum("naa->na", blocks), 1e-300))
    scaled = blocks / (size[:, :, None] * size[:, None, :])
    # Far below the effect of noise; without it a spot without good pixels would make the whole
    # inversion fail.
    scaled += 1e-12 * np.eye(blocks.shape[1])
    return np.asarray(np.linalg.inv(scaled) / (size[:, :, None] * size[:, None, :]))
