r"""From errors of a PSF to biases of a shear.

Unweighted second moments add under convolution.  A galaxy of trace :math:`T_g` behind a PSF of
trace :math:`T` and ellipticity :math:`e = (Q_{xx} - Q_{yy}) / T`, whose size is corrected with a
PSF model of :math:`T + \delta T` and :math:`e + \delta e`, comes out with

.. math:: \hat e_g = \frac{T_g e_g - T \delta e - (e + \delta e)\,\delta T}{T_g - \delta T} ,

so that, with :math:`r = T / T_g` and :math:`s = \delta T / T`, a shear :math:`g` (mean ellipticity
of round galaxies :math:`2 g`) is measured as :math:`(1 + m) g + c`,

.. math:: m = \frac{r s}{1 - r s} , \qquad
          c = -\frac{r}{2}\,\frac{\delta e\,(1 + s) + e\,s}{1 - r s} .

To first order this is Paulin-Henriksson et al. (2008, A&A 484, 67), section 3, and the PSF terms of
Massey et al. (2013, MNRAS 429, 661): :math:`\delta e_g = (e_g - e)\,\delta T / T_g - (T / T_g)\,
\delta e`.  A model too large makes a shear too large.  Exact for unweighted moments; those of a
noisy image are weighted, which changes both by a factor of order one
(:func:`regaussianised_bias` measures it).
"""

from __future__ import annotations

from typing import NamedTuple

import galsim
import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import MeasurementError

# By default re-Gaussianisation cuts its profiles at 3 sigma, in whole pixels: where a size passes one
# step m jumps by a tenth of itself.
_PRECISE = galsim.hsm.HSMParams(
    convergence_threshold=1e-9, max_mom2_iter=1000, nsig_rg=5.0, nsig_rg2=6.0
)


class Bias(NamedTuple):
    """Multiplicative and additive bias of a shear; arrays where errors of the PSF are."""

    m: NDArray[np.float64] | float
    c: NDArray[np.float64] | float


class Shape(NamedTuple):
    """Trace of the second moments [pixel^2] and the two ellipticities (distortions)."""

    trace: float
    e1: float
    e2: float


def shear_bias(size_error, shape_error, *, psf_shape=0.0, size_ratio=1.0) -> Bias:
    """Biases of a shear that is measured with a wrong PSF.

    Parameters
    ----------
    size_error : array_like
        Trace of the PSF model over the true one, less 1.
    shape_error : array_like
        Ellipticity of the PSF model less the true one, one component (distortion).
    psf_shape : float
        The true ellipticity of the PSF, the same component.
    size_ratio : float
        Trace of the PSF over that of the galaxy before the PSF, above 0.

    Returns
    -------
    Bias
        ``c`` is a shear, half a distortion.

    Raises
    ------
    MeasurementError
        A ratio that is not above 0; a PSF model as large as the image of the galaxy.

    Examples
    --------
    >>> bias = shear_bias(1e-3, 2e-4)
    >>> print(f"{bias.m:.6f} {bias.c:.6f}")
    0.001001 -0.000100
    """
    if not size_ratio > 0:
        raise MeasurementError(f"size_ratio = {size_ratio} must be above 0")
    s, d = np.asarray(size_error, float), np.asarray(shape_error, float)
    left = 1 - size_ratio * s
    if np.any(left <= 0):
        raise MeasurementError(
            f"size_error = {np.max(s)}: at size_ratio = {size_ratio} the PSF model leaves nothing "
            f"of the galaxy; it must be below {1 / size_ratio}"
        )
    return Bias(
        size_ratio * s / left, -0.5 * size_ratio * (d * (1 + s) + psf_shape * s) / left
    )


def adaptive_shape(pixels: NDArray[np.floating]) -> Shape:
    """Second moments under the Gaussian weight that fits best (galsim.hsm).

    Shear estimators weight, and unweighted moments of a star seen through the atmosphere have
    no limit: half of what a Kolmogorov profile holds is noise and edge of the stamp.

    Parameters
    ----------
    pixels : ndarray, shape (ny, nx)
        A star without its sky.

    Raises
    ------
    MeasurementError
        No Gaussian fits.
    """
    image = galsim.ImageD(np.ascontiguousarray(pixels, float))
    found = galsim.hsm.FindAdaptiveMom(image, hsmparams=_PRECISE, strict=False)
    if found.moments_status != 0:
        raise MeasurementError(f"no adaptive moments: {found.error_message}")
    shape = found.observed_shape
    trace = 2 * found.moments_sigma**2 / np.sqrt(1 - shape.e**2)
    return Shape(float(trace), float(shape.e1), float(shape.e2))


def open_shape(
    pixels: NDArray[np.floating], centre: tuple[float, float], radius: float
) -> Shape:
    """Second moments about a centre without weights, in a circle.

    Parameters
    ----------
    pixels : ndarray, shape (ny, nx)
        A star without its sky.
    centre : tuple of float
        (x, y) [pixel] from the middle of the stamp.
    radius : float
        Of the circle [pixel].
    """
    ny, nx = pixels.shape
    y, x = np.mgrid[:ny, :nx] - np.array([(ny - 1) / 2, (nx - 1) / 2])[:, None, None]
    x, y = x - centre[0], y - centre[1]
    inside = np.where(x**2 + y**2 < radius**2, pixels, 0.0)
    total = inside.sum()
    xx, yy, xy = ((inside * q).sum() / total for q in (x * x, y * y, x * y))
    return Shape(float(xx + yy), float((xx - yy) / (xx + yy)), float(2 * xy / (xx + yy)))


def regaussianised_bias(
    psf: galsim.GSObject,
    change: NDArray[np.floating],
    *,
    centre: tuple[float, float] = (0.0, 0.0),
    size_ratio: float = 1.0,
    shear: float = 0.02,
) -> Bias:
    """Bias of galsim's re-Gaussianisation (Hirata & Seljak 2003), measured without the formula.

    A round Gaussian galaxy is sheared both ways, seen through the true PSF, and measured with
    the true and with the wrong PSF.

    Parameters
    ----------
    psf : galsim.GSObject
        The true PSF without pixel, lengths in pixels, flux 1.
    change : ndarray, shape (n, n)
        Image of the wrong PSF less that of the true one, in parts of the star's flux.
    centre : tuple of float
        (x, y) [pixel] of the PSF from the middle of its stamp.
    size_ratio : float
        Adaptive trace of the PSF with its pixel over that of the galaxy.
    shear : float
        Put on the galaxy, both signs.
    """
    side = len(change)
    draw = {"scale": 1.0, "offset": centre, "dtype": float}
    true = psf.drawImage(nx=side, ny=side, **draw)
    wrong = galsim.ImageD(true.array + change, scale=1.0)
    sigma = np.sqrt(adaptive_shape(true.array).trace / (2 * size_ratio))

    def ellipticities(model: galsim.Image) -> tuple[float, float]:
        out = []
        for g in (shear, -shear):
            seen = galsim.Convolve(psf, galsim.Gaussian(sigma=sigma).shear(g1=g))
            image = seen.drawImage(nx=2 * side + 1, ny=2 * side + 1, **draw)
            found = galsim.hsm.EstimateShear(image, model, hsmparams=_PRECISE)
            out.append(found.corrected_e1)
        return 0.5 * (out[0] - out[1]) / shear, 0.5 * (out[0] + out[1])

    (slope, zero), (wrong_slope, wrong_zero) = ellipticities(true), ellipticities(wrong)
    return Bias(wrong_slope / slope - 1, (wrong_zero - zero) / slope)
