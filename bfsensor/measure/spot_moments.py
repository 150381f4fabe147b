r"""Adaptive elliptical moments of single spots, which assume no profile.

The weight is the Gaussian with the spot's own moments,
:math:`w = e^{-\frac12 \mathbf d^T M^{-1} \mathbf d}`, :math:`\mathbf d = \mathbf r - \mathbf r_0`,
found where

.. math::
    \sum w I\, \mathbf d = 0, \qquad
    \sum w I\, (\mathbf d \mathbf d^T - \tfrac12 M) = 0 .

For a Gaussian spot M is its covariance matrix.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor.errors import MeasurementError
from bfsensor.measure.ecsv import read_ecsv, same_fields, write_ecsv
from bfsensor.measure.spots import Stamps
from bfsensor.typing import FloatArray

SCHEMA = "bfsensor.SpotMoments 1"
"""Name of the kind of file that :meth:`SpotMoments.write` makes."""

PIXEL_VARIANCE = 1 / 12
"""Variance of a uniform distribution over a pixel [pixel^2], exact.

Integration over pixels adds it to the second moments of a spot.
"""

_UNITS = {
    "x": "pix",
    "y": "pix",
    "centre_x": "pix",
    "centre_y": "pix",
    "xx": "pix2",
    "xy": "pix2",
    "yy": "pix2",
    "flux": "electron",
    "centre_x_error": "pix",
    "centre_y_error": "pix",
    "xx_error": "pix2",
    "xy_error": "pix2",
    "yy_error": "pix2",
    "flux_error": "electron",
    "status": None,
}


class MeanWidths(NamedTuple):
    """Rms widths of a region's spots without the pixel's own, and their standard errors [pixel]."""

    sigma_x: float
    sigma_y: float
    sigma_x_error: float
    sigma_y_error: float


@dataclass(frozen=True, eq=False)
class SpotMoments:
    """Moments of single spots, as arrays of shape (n,).

    Parameters
    ----------
    x, y : ndarray of int
        Column and row of the stamps' central pixels.
    centre_x, centre_y : ndarray
        Centroid from the middle of the central pixel [pixel].
    xx, xy, yy : ndarray
        Elements of M [pixel^2], with the pixel's own width: those of an integrated Gaussian
        exceed its variance by about 1/12 in xx and yy.
    flux : ndarray
        Twice the weighted sum, which is the flux of a Gaussian [e-].
    centre_x_error, centre_y_error, xx_error, xy_error, yy_error, flux_error : ndarray
        Standard errors by the noise of the pixels, to first order.  The second order is not
        corrected: for 300 spots with 500 e- in the peak the mean width is too small by a quarter
        of its error.
    status : ndarray of str
        ``used``, ``masked`` (a bad pixel in the stamp), ``diverged`` (no solution, or one wider
        than a quarter of the stamp) or ``faint`` (flux below 5 times its error); moments are
        nan unless the status is ``used``.

    Examples
    --------
    :func:`measure_moments` makes one; its example shows mean widths.
    """

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    centre_x: FloatArray
    centre_y: FloatArray
    xx: FloatArray
    xy: FloatArray
    yy: FloatArray
    flux: FloatArray
    centre_x_error: FloatArray
    centre_y_error: FloatArray
    xx_error: FloatArray
    xy_error: FloatArray
    yy_error: FloatArray
    flux_error: FloatArray
    status: NDArray[np.str_]

    @property
    def used(self) -> NDArray[np.bool_]:
        """Mask of the spots that have moments, shape (n,)."""
        return np.asarray(self.status == "used")

    def mean_widths(self) -> MeanWidths:
        r"""Compute mean widths of the region's spots, weighted by flux.

        :math:`\sigma_x^2 = \langle M_{xx} \rangle - 1/12`.  Weights by the moments' own errors
        would favour spots that noise made small.  The pixel's box is not a Gaussian: for a true
        width of 1 pixel the result is 1.0010, for 2 pixels 2.0001.

        Returns
        -------
        widths : MeanWidths
            Rms widths in x and y, and their standard errors [pixel].

        Raises
        ------
        MeasurementError
            No spot is used, or the spots are narrower than a pixel's own width.
        """
        weight = self.flux[self.used]
        if weight.size == 0:
            raise MeasurementError(f"none of {len(self.status)} spots has moments")
        weight = weight / weight.sum()
        found = []
        for moment, error in ((self.xx, self.xx_error), (self.yy, self.yy_error)):
            m, e = moment[self.used], error[self.used]
            mean = float(weight @ m)
            if not mean > PIXEL_VARIANCE:
                raise MeasurementError(
                    f"a mean moment of {mean:.3g} pixel^2 is less than a pixel's own, 1/12: the "
                    "spots are too narrow for moments; use fit_spots"
                )
            sigma = float(np.sqrt(mean - PIXEL_VARIANCE))
            noise = float(np.sqrt(weight**2 @ e**2)) / (2 * sigma)
            found.append((sigma, noise))
        (sx, ex), (sy, ey) = found
        return MeanWidths(sx, sy, ex, ey)

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the moments as ECSV, a row for each spot.

        Parameters
        ----------
        path : path-like
            File to write, under another name first and then renamed.
        overwrite : bool
            Replace an existing file.

        Raises
        ------
        MeasurementError
            The file exists and ``overwrite`` is False, or it cannot be written.
        """
        columns = {name: (getattr(self, name), unit, "") for name, unit in _UNITS.items()}
        write_ecsv(path, SCHEMA, columns, {}, overwrite=overwrite)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> SpotMoments:
        """Read a file that :meth:`write` made.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        moments : SpotMoments
            Equal to the one that was written.

        Raises
        ------
        MeasurementError
            The file is missing, damaged or of another kind, or lacks a column.
        """
        return cls(**read_ecsv(path, SCHEMA, tuple(_UNITS), ())[0])


def measure_moments(
    stamps: Stamps,
    *,
    background: ArrayLike = 0.0,
    read_noise: float = 0.0,
) -> SpotMoments:
    """Measure the adaptive moments of every spot, with errors.

    Parameters
    ----------
    stamps : Stamps
        Stamps of the spots; those with a bad pixel get no moments.
    background : float or array_like, shape (n,)
        Signal below each spot [e-], which is subtracted; its own error is neglected.  A
        background of 0.1 % of the peak that is not subtracted makes a spot 0.4 % wider.
    read_noise : float
        Rms noise of each pixel besides its Poisson noise [e-], 0 or more; not used where the
        stamps have variances.

    Returns
    -------
    moments : SpotMoments
        Moments in the order of the stamps.

    Raises
    ------
    MeasurementError
        The background has another length or is not finite, or the read noise is below 0.

    References
    ----------
    Bernstein & Jarvis 2002, AJ 123, 583, section 3; Hirata & Seljak 2003, MNRAS 343, 459.

    Examples
    --------
    >>> from bfsensor.measure.spot_model import Shape, integrate_gaussian
    >>> spots = 1e5 * integrate_gaussian([0.1, 0.3], [0.2, 0.0], Shape(2.0, 2.2), 17)
    >>> moments = measure_moments(Stamps(spots))
    >>> widths = moments.mean_widths()
    >>> print(f"{widths.sigma_x:.3f} {widths.sigma_y:.3f}")
    2.000 2.200
    """
    n, ny, nx = stamps.electrons.shape
    below = np.asarray(background, float)
    if below.shape not in ((), (n,)):
        raise MeasurementError(f"background has the shape {below.shape}, the spots ({n},)")
    if not np.all(np.isfinite(below)):
        raise MeasurementError(f"background = {background!r} e- must be finite")
    if not (read_noise >= 0 and np.isfinite(read_noise)):
        raise MeasurementError(f"read_noise = {read_noise} e- must be 0 e- or more")
    data = stamps.electrons.reshape(n, -1)
    light = data - np.broadcast_to(below, (n,))[:, None]
    if stamps.variance is None:
        # The weights do not depend on the variances: the data may serve as estimates of them.
        variance = np.maximum(data, 0.0) + read_noise**2
    else:
        variance = stamps.variance.reshape(n, -1)
    x = np.tile(np.arange(nx) - nx // 2, ny).astype(float)
    y = np.repeat(np.arange(ny) - ny // 2, nx).astype(float)
    status = np.full(n, "used", dtype="<U8")
    status[~stamps.good.reshape(n, -1).all(axis=1)] = "masked"
    values, errors = np.full((6, n), np.nan), np.full((6, n), np.nan)
    whole = np.nonzero(status == "used")[0]
    if whole.size:
        found, settled = _solve(light[whole], x, y, min(nx, ny))
        values[:, whole], errors[:, whole] = _with_errors(
            light[whole], variance[whole], x, y, found
        )
        status[whole[~settled]] = "diverged"
        faint = (status == "used") & ~(values[5] > 5 * errors[5])
        status[faint] = "faint"
    values[:, status != "used"] = errors[:, status != "used"] = np.nan
    (cx, cy, xx, xy, yy, flux), (ex, ey, exx, exy, eyy, eflux) = values, errors
    return SpotMoments(
        stamps.x, stamps.y, cx, cy, xx, xy, yy, flux, ex, ey, exx, exy, eyy, eflux, status
    )


def _equations(
    light: FloatArray,
    x: FloatArray,
    y: FloatArray,
    theta: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Equations of the moments: their sums, each pixel's coefficients, and the Jacobian.

    The sums (n, 6) are the five that must vanish and the weighted sum of the light; coefficients
    are (n, 6, pixels).  ``theta`` (n, 5) is centre, xx, xy and yy.
    """
    cx, cy, xx, xy, yy = theta.T[:, :, None]
    dx, dy = x - cx, y - cy
    det = xx * yy - xy * xy
    ux, uy = (yy * dx - xy * dy) / det, (xx * dy - xy * dx) / det
    weight = np.exp(-0.5 * (dx * ux + dy * uy))
    enter = weight[:, None] * np.stack(
        [dx, dy, dx * dx - xx / 2, dx * dy - xy / 2, dy * dy - yy / 2, np.ones_like(dx)],
        axis=1,
    )
    sums = np.einsum("nkp,np->nk", enter, light)
    log_weight = np.stack([ux, uy, ux * ux / 2, ux * uy, uy * uy / 2], axis=1)
    slopes = (enter * light[:, None]) @ log_weight.transpose(0, 2, 1)
    # Derivatives by the parameters outside the weight.
    total = sums[:, 5]
    slopes[:, 0, 0] -= total
    slopes[:, 1, 1] -= total
    slopes[:, 2, 0] -= 2 * sums[:, 0]
    slopes[:, 3, 0] -= sums[:, 1]
    slopes[:, 3, 1] -= sums[:, 0]
    slopes[:, 4, 1] -= 2 * sums[:, 1]
    for k in (2, 3, 4):
        slopes[:, k, k] -= total / 2
    return sums, enter, slopes


def _solve(
    light: FloatArray, x: FloatArray, y: FloatArray, size: int
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Centres and moments, (n, 5), and the mask of spots whose iteration converged.

    Twice the weighted moments are a stable iteration, which halves the error for a Gaussian in
    each step; after twelve steps Newton's method takes over.
    """
    n = len(light)
    theta = np.zeros((n, 5))
    theta[:, 2] = theta[:, 4] = (size / 6) ** 2
    settled = np.zeros(n, bool)
    with np.errstate(all="ignore"):
        for count in range(40):
            sums, _, slopes = _equations(light, x, y, theta)
            total = np.where(sums[:, 5] > 0, sums[:, 5], np.nan)[:, None]
            step = 2 * sums[:, :5] / total
            if count >= 12:
                step = _newton(sums[:, :5], slopes[:, :5], step)
            theta = theta + step
            lost = ~_sane(theta, size)
            theta[lost] = [0.0, 0.0, 1.0, 0.0, 1.0]
            settled = ~lost & (np.abs(step).max(axis=1) < 1e-10)
            if np.all(settled | lost) and count >= 14:
                break
    return theta, settled


def _newton(sums: FloatArray, slopes: FloatArray, otherwise: FloatArray) -> FloatArray:
    """Newton's step, at most 0.5 in each parameter; ``otherwise`` where the Jacobian is singular."""
    fine = np.all(np.isfinite(slopes), axis=(1, 2)) & (np.linalg.cond(slopes) < 1e12)
    step = otherwise.copy()
    step[fine] = np.linalg.solve(slopes[fine], -sums[fine][:, :, None])[:, :, 0]
    return np.clip(step, -0.5, 0.5)


def _sane(theta: FloatArray, size: int) -> NDArray[np.bool_]:
    """Mask of solutions with the centre in the stamp and an ellipse that fits into it."""
    cx, cy, xx, xy, yy = theta.T
    half = size / 2
    return np.asarray(
        (np.abs(cx) < half)
        & (np.abs(cy) < half)
        & (np.minimum(xx, yy) > 0.01)
        & (np.maximum(xx, yy) < (half / 2) ** 2)
        & (xx * yy - xy * xy > 1e-4)
    )


def _with_errors(
    light: FloatArray,
    variance: FloatArray,
    x: FloatArray,
    y: FloatArray,
    theta: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Centre, moments and flux, (6, n), and their errors."""
    sums, enter, slopes = _equations(light, x, y, theta)
    # With the weight of its own moments half of a Gaussian's light is in the sum, for any size.
    flux = 2 * sums[:, 5]
    moved = -np.linalg.pinv(slopes[:, :5]) @ enter[:, :5]
    by_flux = 2 * (enter[:, 5:] + slopes[:, 5:] @ moved)
    by_pixel = np.concatenate([moved, by_flux], axis=1)
    errors = np.sqrt(np.einsum("nkp,np->nk", by_pixel**2, variance))
    return np.column_stack([theta, flux]).T, errors.T
