"""Gaussian widths of noiseless predicted spots, as the fit of recorded spots gives them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

ROUNDS = 40
"""Largest number of Gauss-Newton rounds; beyond it :class:`ConvergenceError` is raised.  Chosen:
with 80 a fit that fails takes twice the time."""

TOLERANCE = 1e-7
"""Largest last step of widths and centres [pixel] at convergence.  Chosen: far below errors of
measured widths; with 2e-7 derivatives of widths by finite differences are twice as inexact."""

# Profiles along an axis: integral, its derivatives by centre and by width, one.
_INTEGRAL, _CENTRE, _WIDTH, _ONE = range(4)
# Columns of the model as products of profiles in y and in x: flux, x, y, background; widths.
_IN_Y = np.array([_INTEGRAL, _INTEGRAL, _CENTRE, _ONE, _INTEGRAL, _WIDTH])
_IN_X = np.array([_INTEGRAL, _CENTRE, _INTEGRAL, _ONE, _WIDTH, _INTEGRAL])
_OWN = 4
"""Number of columns that each spot has of its own: exact, flux, x, y and background."""


class FittedWidths(NamedTuple):
    """Widths of each image's spots, shape (k,), and centre of each spot, shape (k, n) [pixel]."""

    sigma_x: FloatArray
    sigma_y: FloatArray
    centre_x: FloatArray
    centre_y: FloatArray


def fit_widths(
    stamps: FloatArray,
    sigma: tuple[float, float],
    centres: FloatArray,
) -> FittedWidths:
    """Fit one Gaussian shape to the spots of each image, all pixels of equal weight.

    The result is that of :func:`bfsensor.measure.spot_fit.fit_spots` with ``weights='equal'``,
    without its rejection of outlying spots.  The model is a product of two profiles, so that
    its normal equations are products of sums along the axes.

    Parameters
    ----------
    stamps : ndarray, shape (k, n, ny, nx)
        Images of n spots [e-], odd sides.
    sigma : (float, float)
        Starting widths along x and y [pixel].
    centres : ndarray, shape (n, 2) or (k, n, 2)
        Starting centres (x, y) from the middle of the stamps [pixel].

    Returns
    -------
    FittedWidths

    Raises
    ------
    ConvergenceError
        Widths or centres still move after :data:`ROUNDS` rounds, or the stamps hold no spots.

    Examples
    --------
    >>> from bfsensor.measure.spot_model import Shape, integrate_gaussian
    >>> spots = 1e5 * integrate_gaussian([0.1, -0.3], [0.2, 0.0], Shape(1.02, 1.05), 9)
    >>> found = fit_widths(spots[None] + 20.0, (1.1, 1.1), np.zeros((2, 2)))
    >>> found.sigma_x.round(6), found.centre_x.round(6)
    (array([1.02]), array([[ 0.1, -0.3]]))
    """
    count, n, ny, nx = stamps.shape
    shape = np.tile(np.asarray(sigma, float), (count, 1))
    x, y = np.moveaxis(np.broadcast_to(centres, (count, n, 2)), -1, 0).copy()
    flux = stamps.sum((2, 3))
    background = np.zeros((count, n))
    history: list[float] = []
    for _ in range(ROUNDS):
        in_x = _profiles(x, shape[:, 0], nx)
        in_y = _profiles(y, shape[:, 1], ny)
        sums_x, sums_y = (p @ p.swapaxes(-1, -2) for p in (in_x, in_y))
        data = (in_y @ stamps @ in_x.swapaxes(-1, -2))[..., _IN_Y, _IN_X]
        normal = sums_y[..., _IN_Y[:, None], _IN_Y] * sums_x[..., _IN_X[:, None], _IN_X]
        score = (
            data - flux[..., None] * normal[..., 0] - background[..., None] * normal[..., 3]
        )
        # Derivatives by centres and widths are in proportion to the flux.
        scale = np.ones((count, n, 6))
        scale[..., [1, 2, 4, 5]] = flux[..., None]
        normal *= scale[..., None] * scale[..., None, :]
        score *= scale
        # Each spot's own parameters are eliminated (Schur complement); two widths are left.
        own, cross = normal[..., :_OWN, :_OWN], normal[..., :_OWN, _OWN:]
        both = np.concatenate([cross, score[..., :_OWN, None]], axis=-1)
        try:
            eliminated = np.linalg.solve(own, both)
            turned = cross.swapaxes(-1, -2) @ eliminated
            rest = (normal[..., _OWN:, _OWN:] - turned[..., :2]).sum(1)
            wanted = (score[..., _OWN:] - turned[..., 2]).sum(1)
            step = np.linalg.solve(rest, wanted[..., None])
        except np.linalg.LinAlgError:
            raise ConvergenceError(
                f"predicted spots have no shape after {len(history)} rounds: widths from "
                f"{shape.min():.3g} to {shape.max():.3g} pixel, fluxes from {flux.min():.3g} to "
                f"{flux.max():.3g} e-",
                history,
            ) from None
        step = np.clip(step[..., 0], -0.2 * shape, 0.2 * shape)
        moved = eliminated[..., 2] - np.einsum("knab,kb->kna", eliminated[..., :2], step)
        shape += step
        flux += moved[..., 0]
        x += np.clip(moved[..., 1], -0.3, 0.3)
        y += np.clip(moved[..., 2], -0.3, 0.3)
        background += moved[..., 3]
        history.append(float(max(np.abs(step).max(), np.abs(moved[..., 1:3]).max())))
        if history[-1] < TOLERANCE:
            return FittedWidths(shape[:, 0], shape[:, 1], x, y)
    raise ConvergenceError(
        f"predicted widths of spots still move by {history[-1]:.2g} pixel after {ROUNDS} rounds",
        history,
    )


def _profiles(centre: FloatArray, width: FloatArray, size: int) -> FloatArray:
    """Profiles along one axis, shape (k, n, 4, size)."""
    width = width[:, None, None]
    t = (np.arange(size + 1) - 0.5 * size - centre[..., None]) / width
    density = np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi)
    out = np.ones((*centre.shape, 4, size))
    for n, edges in (
        (_INTEGRAL, ndtr(t)),
        (_CENTRE, -density / width),
        (_WIDTH, -t * density / width),
    ):
        np.subtract(edges[..., 1:], edges[..., :-1], out=out[..., n, :])
    return out
