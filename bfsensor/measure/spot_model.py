r"""A two-dimensional Gaussian integrated over pixels, with its derivatives.

A spot of one electron about (x, y) with rms widths :math:`\sigma_x, \sigma_y` and the
correlation :math:`\rho` puts into a pixel the difference of its cumulative distribution
over the pixel's four corners.  At :math:`\rho = 0` that is a product of differences of
error functions.  For the rest, with :math:`h, k` the corner's place in units of the widths,
Plackett's identity :math:`\partial \Phi_2 / \partial \rho = \phi_2(h, k, \rho)` makes the
distribution an integral over the correlation alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from bfsensor.errors import MeasurementError
from bfsensor.typing import FloatArray

LARGEST_CORRELATION = 0.8
"""Largest absolute correlation of x and y in a spot.

Measured in tests/measure/test_spot_model.py: the ten nodes of the quadrature over the correlation
leave an error below 5e-10 of a pixel's fraction at 0.8, and above 1e-8 at 0.9.
"""

SMALLEST_WIDTH, LARGEST_WIDTH = 0.1, 100.0
"""Smallest and largest rms width of a spot [pixel].

Chosen: below, a spot in the middle of a pixel puts about 1e-6 of its charge or less into others,
which do not constrain the width; beyond, it is flat over any stamp.  Limits of half and twice the
values would allow widths that no stamp can measure.
"""

_ROOT_2PI = np.sqrt(2 * np.pi)
"""Norm of the standard normal distribution, exact."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
"""Gauss-Legendre quadrature over the correlation; the number of nodes is chosen.

Ten nodes reach round-off at a correlation of 0.5, see LARGEST_CORRELATION; twenty would take twice
the time where spots are tilted.
"""


class Shape(NamedTuple):
    """Shape that the spots of a region share: rms widths [pixel] and their correlation."""

    sigma_x: float
    sigma_y: float
    correlation: float = 0.0


class Along(NamedTuple):
    """Integrals along one axis with derivatives, and the pixel edges in units of the width."""

    integral: FloatArray
    by_centre: FloatArray
    by_width: FloatArray
    place: FloatArray


def check_shape(shape: Shape) -> None:
    """Raise MeasurementError for a shape outside the range in which the integrals are accurate."""
    for name in ("sigma_x", "sigma_y"):
        width = getattr(shape, name)
        if not SMALLEST_WIDTH <= width <= LARGEST_WIDTH:
            raise MeasurementError(
                f"{name} = {width:g} pixel must be from {SMALLEST_WIDTH:g} to "
                f"{LARGEST_WIDTH:g} pixel"
            )
    if not abs(shape.correlation) <= LARGEST_CORRELATION:
        raise MeasurementError(
            f"correlation = {shape.correlation:g} must be from -{LARGEST_CORRELATION:g} to "
            f"{LARGEST_CORRELATION:g}"
        )


def integrate_gaussian(
    centre_x: ArrayLike,
    centre_y: ArrayLike,
    shape: Shape,
    size: int | tuple[int, int],
) -> FloatArray:
    """Integrate Gaussian spots of one electron each over the pixels of their stamps.

    Parameters
    ----------
    centre_x, centre_y : array_like, shape (n,)
        Centres from the middle of the stamp's central pixel [pixel].
    shape : Shape
        Rms widths, 0.1 to 100 pixels, and correlation, -0.8 to 0.8.
    size : int or tuple of int
        Side of the stamp [pixel], or (ny, nx); odd.

    Returns
    -------
    fractions : ndarray, shape (n, ny, nx)
        Fraction of the spot's electrons in each pixel; its error is below 1e-9.

    Raises
    ------
    MeasurementError
        A width or the correlation is out of range.

    References
    ----------
    Plackett 1954, Biometrika 41, 351; Drezner & Wesolowsky 1990, J. Stat. Comput. Simul.
    35, 101.

    Examples
    --------
    >>> spot = integrate_gaussian([0.0], [0.0], Shape(1.0, 1.0), 9)
    >>> print(f"{spot[0, 4, 4]:.5f}")
    0.14663
    """
    check_shape(shape)
    ny, nx = (size, size) if isinstance(size, int) else size
    x = np.atleast_1d(np.asarray(centre_x, float))
    y = np.atleast_1d(np.asarray(centre_y, float))
    along_x, along_y = along(x, shape.sigma_x, nx), along(y, shape.sigma_y, ny)
    if shape.correlation == 0.0:
        return _outer(along_y.integral, along_x.integral)
    return _correlated(along_x, along_y, shape.correlation)


def along(centre: FloatArray, width: float, size: int) -> Along:
    """Integrals along one axis, shape (n, size), and their derivatives."""
    edges = np.arange(size + 1) - 0.5 * size
    t = (edges - centre[:, None]) / width
    density = np.exp(-0.5 * t * t) / _ROOT_2PI
    # Edges above the centre are mirrored below it: differences of numbers near 1 lose digits.
    sign = np.where(t[:, :-1] + t[:, 1:] > 0, -1.0, 1.0)
    integral = np.abs(ndtr(sign * t[:, 1:]) - ndtr(sign * t[:, :-1]))
    return Along(
        integral,
        -np.diff(density) / width,
        -np.diff(t * density) / width,
        t,
    )


def gradients(x: FloatArray, y: FloatArray, shape: Shape, ny: int, nx: int) -> FloatArray:
    """Integrals and their derivatives by x, y, sigma_x, sigma_y, correlation, each (n, ny, nx).

    Shape (6, n, ny, nx).
    """
    along_x, along_y = along(x, shape.sigma_x, nx), along(y, shape.sigma_y, ny)
    out = np.empty((6, len(x), ny, nx))
    if shape.correlation == 0.0:
        out[0] = _outer(along_y.integral, along_x.integral)
        out[1] = _outer(along_y.integral, along_x.by_centre)
        out[2] = _outer(along_y.by_centre, along_x.integral)
        out[3] = _outer(along_y.integral, along_x.by_width)
        out[4] = _outer(along_y.by_width, along_x.integral)
        # A Gaussian obeys the diffusion equation: d/d(covariance) = d^2 / dx dy.
        out[5] = _outer(along_y.by_centre, along_x.by_centre)
        out[5] *= shape.sigma_x * shape.sigma_y
        return out
    rho = shape.correlation
    root = np.sqrt(1 - rho * rho)
    h, k = along_x.place[:, None, :], along_y.place[:, :, None]
    out[0] = _correlated(along_x, along_y, rho)
    # d Phi_2 / dh = phi(h) Phi((k - rho h) / root)
    by_h = np.exp(-0.5 * h * h) / _ROOT_2PI * ndtr((k - rho * h) / root)
    by_k = np.exp(-0.5 * k * k) / _ROOT_2PI * ndtr((h - rho * k) / root)
    out[1] = -_corners(by_h) / shape.sigma_x
    out[2] = -_corners(by_k) / shape.sigma_y
    out[3] = -_corners(h * by_h) / shape.sigma_x
    out[4] = -_corners(k * by_k) / shape.sigma_y
    out[5] = _corners(_density(h, k, rho))
    return out


def curvatures(
    slopes: FloatArray, shape: Shape
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Second derivatives by xx, yy and xy from what :func:`gradients` gives.

    A Gaussian obeys the equation of diffusion: its second derivative by x is twice its
    derivative by the variance in x.
    """
    by_covariance = slopes[5] / (shape.sigma_x * shape.sigma_y)
    ratio = shape.sigma_y / shape.sigma_x
    by_xx = slopes[3] / shape.sigma_x - shape.correlation * ratio * by_covariance
    by_yy = slopes[4] / shape.sigma_y - shape.correlation / ratio * by_covariance
    return by_xx, by_yy, by_covariance


def _correlated(along_x: Along, along_y: Along, rho: float) -> FloatArray:
    """Integrals at a correlation: those at 0 plus the density integrated over the correlation."""
    h, k = along_x.place[:, None, :], along_y.place[:, :, None]
    total = np.zeros(np.broadcast_shapes(h.shape, k.shape))
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        total += 0.5 * rho * weight * _density(h, k, 0.5 * rho * (1 + node))
    return _outer(along_y.integral, along_x.integral) + _corners(total)


def _density(h: FloatArray, k: FloatArray, rho: float) -> NDArray:
    """Bivariate normal density of unit widths."""
    rest = 1 - rho * rho
    return np.asarray(
        np.exp(-0.5 * (h * h - 2 * rho * h * k + k * k) / rest)
        / (2 * np.pi * np.sqrt(rest))
    )


def _corners(values: FloatArray) -> FloatArray:
    """Second difference of values at corners, for each pixel."""
    return np.diff(np.diff(values, axis=1), axis=2)


def _outer(of_y: FloatArray, of_x: FloatArray) -> FloatArray:
    return np.asarray(of_y[:, :, None] * of_x[:, None, :])
