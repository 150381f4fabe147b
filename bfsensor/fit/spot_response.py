r"""B-F slopes of spots in closed form: linear in the shifts of the pixels' edges.

A spot of S electrons puts :math:`S f_s` into pixel s while its edges move, on average over the
exposure by half of what they do at the end.  Light of line density :math:`g_p` at the right edge
of pixel p goes over to it from its neighbour, in x

.. math:: \delta_p = \tfrac12 S^2 (g_p \Delta_p - g_{p-1} \Delta_{p-1}), \qquad
    \Delta_p = \sum_s k_x(p - s) f_s,

and a least squares fit of Gaussians answers to so small a change by a linear functional of it.  What
remains is one weight for each offset of :math:`k_x` and :math:`k_y`, found once for a width.
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
"""Electrons in the central pixel for which slopes are given."""

SIGMA = 1.02
"""Width of the published spots [pixel]: 10 um drawn, 2 um of Einstein's diffusion."""

PHASES = 8
"""Places of the spots within a pixel along each axis: slopes change by 0.1 % with 16."""

STAMP = 9
"""Side of the stamp that is fitted [pixel]."""


class SlopeWeights(NamedTuple):
    """Weights of the shifts [%], shape (2, n, n): a row for the slope in x, one for y.

    ``(x * kx + y * ky).sum()`` is the slope: growth of the width in per cent of a pixel for
    50,000 e- in the central pixel.
    """

    x: FloatArray
    y: FloatArray

    def slopes(self, kx: FloatArray, ky: FloatArray) -> FloatArray:
        """Slopes in x and y [%] of shifts [pixel/e-], shape (..., n, n) each."""
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
    """Find what each shift adds to the slope of spots strewn evenly over a pixel.

    Parameters
    ----------
    sigma : float
        Width in x and y with diffusion [pixel].
    background : bool
        Whether each spot has a free background in the fit; the project's own measurement of
        simulated spots (``measure_growth``) holds it.
    reach : int
        Of the shifts [pixel].
    phases : int
        Places along each axis.

    Notes
    -----
    To first order in the charge, at the shifts' own level: at 80,000 e- the central pixel holds
    some per cent less by the effect itself.  All pixels have equal weight in the fit, and all
    spots share one width, as in the publication.

    Examples
    --------
    >>> weights = slope_weights()
    >>> kx = np.zeros((3, 3)); kx[1, 1], kx[1, 0] = -2e-7, 2e-7
    >>> x, y = weights.slopes(kx, kx.T)
    >>> bool(abs(x - y) < 1e-9), 0.2 < float(x) < 0.5
    (True, True)
    """
    if not 0.3 <= sigma <= 3.0:
        raise FitError(f"sigma = {sigma:g} pixels of spots must be from 0.3 to 3")
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
        # An edge gives to the pixel before it what it takes from the one behind.
        gain_x = wide - np.roll(wide, -1, 2)
        gain_y = wide - np.roll(wide, -1, 1)
        over_x = 0.5 * gain_x * y.pixels[:, None] * x.edges
        over_y = 0.5 * gain_y * y.edges[:, None] * x.pixels
        for n, over in enumerate((over_x, over_y)):
            weights[n] += _correlate(over, light, reach)
    weights *= 100 * UNIT_PEAK / central
    return SlopeWeights(weights[0], weights[1])


class _WidthLine:
    """A Gaussian along one axis: in each pixel, at each far edge, and its derivatives."""

    def __init__(self, side: int, place: float, sigma: float) -> None:
        t = (np.arange(side + 1) - 0.5 * side - place) / sigma
        density = np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi) / sigma
        self.pixels = np.diff(ndtr(t))
        self.edges = density[1:]
        self.by_place = -np.diff(density)
        self.by_width = -np.diff(t * density)


def _fit_columns(x: _WidthLine, y: _WidthLine, reach: int, background: bool) -> FloatArray:
    """Change of a spot's stamp with both widths, less what its own parameters take of it."""
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
    """Sum over pixels of ``over[p] light[p - d]`` for all offsets d to the reach."""
    spectrum = np.fft.rfft2(over) * np.conj(np.fft.rfft2(light))
    whole = np.fft.irfft2(spectrum, s=light.shape)
    at = np.arange(-reach, reach + 1)
    return np.asarray(whole[:, at[:, None], at])
