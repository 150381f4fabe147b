r"""B-F slopes of spots in closed form, as a linear function of the boundary shifts.

A spot of S electrons puts :math:`S f_s` into pixel s while the edges of pixels move, on average over
the exposure by half of the final shift.  Light of the line density :math:`g_p` at the right edge of
pixel p changes from its neighbour to it, in x by

.. math:: \delta_p = \tfrac12 S^2 (g_p \Delta_p - g_{p-1} \Delta_{p-1}), \qquad
    \Delta_p = \sum_s k_x(p - s) f_s,

and the width of a least-squares fit of Gaussians is a linear functional of so small a change.  The
slope is then a sum over offsets of :math:`k_x` and :math:`k_y` with weights that depend on the width
of the spot only.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from bfsensor.errors import FitError
from bfsensor.typing import FloatArray

UNIT_PEAK = 50_000.0
"""Charge of the central pixel [e-] for which slopes are defined (published: Lage et al. 2017)."""

SIGMA = 1.02
"""Gaussian sigma of the published spots [pixel].  Derived: sqrt(10^2 + 2^2) um over pixels of 10 um,
the second term being Einstein's diffusion."""

PHASES = 8
"""Number of places of the spots within a pixel along each axis.

Measured with :func:`slope_weights` and shifts that fall with the cube of the distance: 16 places
change slopes by 0.1 %."""

STAMP = 9
"""Side of the postage stamp that is fitted [pixel], as published: Lage et al. 2017, section 2.1."""


class SlopeWeights(NamedTuple):
    """Weights of the boundary shifts in the B-F slopes.

    ``(x * kx + y * ky).sum((1, 2))`` are the slopes in x and y: growth of the width, in per cent of
    a pixel, for 50,000 e- in the central pixel.

    Parameters
    ----------
    x, y : ndarray, shape (2, n, n)
        Weights of ``kx`` and ``ky`` [% per (pixel/e-)], for the slopes in x and in y.
    """

    x: FloatArray
    y: FloatArray

    def slopes(self, kx: FloatArray, ky: FloatArray) -> FloatArray:
        """Give the slopes in x and y for given shifts.

        Parameters
        ----------
        kx, ky : ndarray, shape (..., m, m)
            Shifts of right and upper edges [pixel/e-], odd sides; offsets beyond the reach of the
            weights are ignored.

        Returns
        -------
        slopes : ndarray, shape (2, ...)
            Slopes [% of a pixel for 50,000 e-], first axis x and y.
        """
        half = self.x.shape[-1] // 2
        there = kx.shape[-1] // 2
        reach = min(half, there)
        mine = slice(half - reach, half + reach + 1)
        theirs = slice(there - reach, there + reach + 1)
        return np.asarray(
            np.einsum("aji,...ji->...a", self.x[:, mine, mine], kx[..., theirs, theirs])
            + np.einsum("aji,...ji->...a", self.y[:, mine, mine], ky[..., theirs, theirs])
        )


@lru_cache(maxsize=16)
def slope_weights(
    sigma: float = SIGMA, *, background: bool = False, reach: int = 8, phases: int = PHASES
) -> SlopeWeights:
    """Find the weight of each shift in the slopes of spots placed uniformly over a pixel.

    Parameters
    ----------
    sigma : float
        Gaussian width in x and y with diffusion [pixel], 0.3 to 3.
    background : bool
        Whether the fit of each spot has a free background;
        :func:`bfsensor.measure.growth.measure_growth` fixes it.
    reach : int
        Largest offset of the shifts [pixel].
    phases : int
        Number of places along each axis.

    Returns
    -------
    weights : SlopeWeights
        Weights of the shifts of right and of upper edges.

    Raises
    ------
    FitError
        The width is out of range.

    Notes
    -----
    Slopes are of first order in the charge, for shifts at one level: at 80,000 e- the effect itself
    takes some per cent of the charge of the central pixel.  All pixels have equal weight in the
    fit, and all spots share one width, as in the publication.

    Examples
    --------
    >>> weights = slope_weights()
    >>> kx = np.zeros((3, 3)); kx[1, 1], kx[1, 0] = -2e-7, 2e-7
    >>> x, y = weights.slopes(kx, kx.T)
    >>> bool(abs(x - y) < 1e-9), 0.2 < float(x) < 0.5
    (True, True)
    """
    if not 0.3 <= sigma <= 3.0:
        raise FitError(f"sigma = {sigma:g} pixels of spots must be from 0.3 to 3 pixels")
    side = STAMP + 2 * reach
    places = (np.arange(phases) + 0.5) / phases - 0.5
    lines = [_WidthLine(side, place, sigma) for place in places]
    spots = [(one, other) for one in lines for other in lines]
    columns = [_fit_columns(x, y, reach, background) for x, y in spots]
    both = sum(wide.T @ wide for wide in columns)
    answer = [np.linalg.solve(both, wide.T) for wide in columns]
    weights = np.zeros((2, 2, 2 * reach + 1, 2 * reach + 1))
    central = 0.0
    for (x, y), functional in zip(spots, answer, strict=True):
        light = y.pixels[:, None] * x.pixels
        central += light[side // 2, side // 2] / len(spots)
        wide = np.zeros((2, side, side))
        inner = slice(reach, side - reach)
        wide[:, inner, inner] = functional.reshape(2, STAMP, STAMP)
        # Light that crosses an edge is gained by one pixel and lost by the next.
        gain_x = wide - np.roll(wide, -1, 2)
        gain_y = wide - np.roll(wide, -1, 1)
        over_x = 0.5 * gain_x * y.pixels[:, None] * x.edges
        over_y = 0.5 * gain_y * y.edges[:, None] * x.pixels
        for n, over in enumerate((over_x, over_y)):
            weights[n] += _correlate(over, light, reach)
    weights *= 100 * UNIT_PEAK / central
    return SlopeWeights(weights[0], weights[1])


class _WidthLine:
    """Gaussian along one axis: its integral in each pixel, value at each far edge, derivatives."""

    def __init__(self, side: int, place: float, sigma: float) -> None:
        t = (np.arange(side + 1) - 0.5 * side - place) / sigma
        density = np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi) / sigma
        self.pixels = np.diff(ndtr(t))
        self.edges = density[1:]
        self.by_place = -np.diff(density)
        self.by_width = -np.diff(t * density)


def _fit_columns(x: _WidthLine, y: _WidthLine, reach: int, background: bool) -> FloatArray:
    """Derivatives of a stamp by both widths, orthogonal to those by its own parameters."""
    inner = slice(reach, len(x.pixels) - reach)

    def plane(along_y: FloatArray, along_x: FloatArray) -> NDArray:
        return np.outer(along_y[inner], along_x[inner]).ravel()

    own = [
        plane(y.pixels, x.pixels), plane(y.pixels, x.by_place), plane(y.by_place, x.pixels)
    ]  # fmt: skip
    if background:
        own.append(np.ones(STAMP * STAMP))
    basis = np.linalg.qr(np.array(own).T)[0]
    wide = np.array([plane(y.pixels, x.by_width), plane(y.by_width, x.pixels)]).T
    return np.asarray(wide - basis @ (basis.T @ wide))


def _correlate(over: FloatArray, light: FloatArray, reach: int) -> FloatArray:
    """Sum over pixels p of ``over[p] light[p - d]``, for all offsets d up to the reach."""
    spectrum = np.fft.rfft2(over) * np.conj(np.fft.rfft2(light))
    whole = np.fft.irfft2(spectrum, s=light.shape)
    at = np.arange(-reach, reach + 1)
    return np.asarray(whole[:, at[:, None], at])
