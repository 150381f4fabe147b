r"""Errors of a star's growth that is computed from a camera's a_ij.

The growth of a star follows from the shifts of edges, these from the parameters p of the image-charge
model, whose covariance is that of the fit:

.. math:: \sigma_g^2 = \nabla g^T\, C\, \nabla g, \qquad
          C^{-1} = J^T (\Sigma / n + M)^{-1} J + P^{-1},

with the derivatives J of the a_ij, their covariance :math:`\Sigma` by noise, the model's own accuracy M,
and the priors P.  With n times as many flat pairs only the noise falls.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from bfsensor.errors import MeasurementError
from bfsensor.fit.camera_fit import CameraFit
from bfsensor.measure.correct import correct_edges
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes, edge_shifts
from bfsensor.typing import FloatArray

REACH = 4
"""Largest lag of the shifts, as in tables [pixel].

Chosen: with 8 the growth of a star with a sigma of 1.5 pixel is 1.1 % larger (tables of LSST's devices
reach 4)."""

PEAK = 50e3
"""Charge in the star's brightest pixel [e-].  Chosen: of a linear response the relative error does not
depend on it; at twice as much neither."""

MOST_PAIRS = 1e4
"""Largest factor on the number of flat pairs that is tried.

Chosen: above it only the model's accuracy is left; with twice as much the answer is the same."""

_STEP = 1e-2
"""Step of numerical derivatives, in the parameters' errors.

Chosen: twice as large changes no digit of the result."""


class CorrectionError(NamedTuple):
    """Growth of a star by the fitted model, and its errors.

    Attributes
    ----------
    growth : tuple of float
        Relative growth of the second moments in x and y of a star of :data:`PEAK`.
    error : tuple of float
        Standard errors of these, relative to them: the part of the effect that the calibration leaves.
    noise : tuple of float
        Part of the errors that more flats would take away; the rest is the model's own accuracy and
        what priors hold.
    pairs : float
        Factor on the number of flat pairs at which the larger error is half of what it is; inf where
        no number of flats suffices.
    """

    growth: tuple[float, float]
    error: tuple[float, float]
    noise: tuple[float, float]
    pairs: float


def correction_error(found: CameraFit, *, sigma: float = 1.5) -> CorrectionError:
    """Carry the errors of a camera's a_ij to the growth of a star, and so to its corrected size.

    Parameters
    ----------
    found : CameraFit
        Fit of the image-charge model, from :func:`bfsensor.fit.camera_fit.fit_camera`.
    sigma : float
        Width of the star, 0.5 to 5 [pixel].

    Returns
    -------
    CorrectionError

    Raises
    ------
    MeasurementError
        The width is out of range.

    Examples
    --------
    >>> from bfsensor.fit.camera_areas import CameraAreas
    >>> from bfsensor.fit.camera_fit import fit_camera
    >>> true = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0)
    >>> a = area_changes(true, depth=100.0, reach=4)[4:, 4:]
    >>> areas = CameraAreas(a, 0.01 * abs(a), np.isfinite(a), "simulated")
    >>> known = correction_error(fit_camera(areas, base=true))
    >>> known.growth[1] > known.growth[0] > 0.005, 0.01 < known.error[0] < 0.05
    (True, True)
    """
    if not 0.5 <= sigma <= 5:
        raise MeasurementError(f"sigma = {sigma} must be from 0.5 to 5 pixels")
    fit = found.fit
    names = [name for name in fit.names if name != "offset"]
    chosen = [fit.names.index(name) for name in names]
    # The offset is in no table: what it shares with the parameters is in their covariance.
    covariance = fit.covariance[np.ix_(chosen, chosen)]
    values = np.array([fit.values[name] for name in names])
    steps = _STEP * np.sqrt(np.diag(covariance))
    growth = star_growth(found.model, depth=fit.depth, sigma=sigma)
    slopes, areas = [], []
    for n in range(len(names)):
        pair = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[n] += sign * steps[n]
            model, strength = _model_of(found, dict(zip(names, moved, strict=True)))
            pair.append((
                star_growth(model, depth=fit.depth, sigma=sigma, strength=strength),
                _areas(model, fit.depth, len(fit.a), strength)[fit.used],
            ))  # fmt: skip
        (up, a_up), (down, a_down) = pair
        slopes.append((up - down) / (2 * steps[n]))
        areas.append((a_up - a_down) / (2 * steps[n]))
    gradient, jacobian = np.array(slopes), np.array(areas).T
    noise, own = _noise_and_own(found)
    rest = np.linalg.inv(covariance) - _information(jacobian, noise + own)

    def errors(factor: float) -> FloatArray:
        c = np.linalg.inv(rest + _information(jacobian, noise / factor + own))
        return np.sqrt(np.einsum("ng,nm,mg->g", gradient, c, gradient)) / growth

    now, never = errors(1.0), errors(MOST_PAIRS)
    part = np.sqrt(np.maximum(now**2 - never**2, 0.0))
    worst = int(np.argmax(now))
    pairs = float("inf")
    if never[worst] < 0.5 * now[worst]:
        low, high = 1.0, MOST_PAIRS
        while high / low > 1.001:
            middle = float(np.sqrt(low * high))
            if errors(middle)[worst] > 0.5 * now[worst]:
                low = middle
            else:
                high = middle
        pairs = high
    return CorrectionError(_pair(growth), _pair(now), _pair(part), pairs)


def star_growth(
    model: ImageCharge, *, depth: float, sigma: float, strength: float = 1.0
) -> FloatArray:
    """Growth of a round Gaussian star by the shifts of a model, linear in charge.

    Parameters
    ----------
    model : ImageCharge
        Model with its drift field.
    depth : float
        Conversion depth [um above the gates].
    sigma : float
        Width of the star [pixel].
    strength : float
        Factor on all shifts.

    Returns
    -------
    growth : ndarray, shape (2,)
        Relative growth of the second moments in x and y at a peak of :data:`PEAK`.

    Examples
    --------
    >>> growth = star_growth(ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0), depth=100.0, sigma=1.5)
    >>> bool(0.005 < growth[0] < growth[1] < 0.03)
    True
    """
    shifts = edge_shifts(model, depth=depth, reach=REACH)
    north, east = (strength * a[REACH:, REACH:] for a in (shifts.north, shifts.east))
    half = int(np.ceil(6 * sigma)) + REACH
    at = np.arange(-half, half + 1)
    line = np.exp(-0.5 * (at / sigma) ** 2)
    star = PEAK * np.outer(line, line)
    change = star - correct_edges(star, north, east)
    total = star.sum()
    # To first order what was taken off with the opposite sign is what was added.
    return np.array([change.sum(axis) @ at**2 / total / (line @ at**2 / line.sum())
                     for axis in (0, 1)])  # fmt: skip


def _model_of(found: CameraFit, values: dict[str, float]) -> tuple[ImageCharge, float]:
    """Model with other parameters, in the fit's units, and its strength."""
    given = {k: v for k, v in values.items() if k != "strength"}
    return dataclasses.replace(found.fit.model, **given), values["strength"]


def _areas(model: ImageCharge, depth: float, lags: int, strength: float) -> FloatArray:
    """a_ij of a model by lag [1/e-]."""
    reach = lags - 1
    return np.asarray(
        strength * area_changes(model, depth=depth, reach=reach)[reach:, reach:]
    )


def _noise_and_own(found: CameraFit) -> tuple[FloatArray, FloatArray]:
    """Covariances of the fitted a_ij by noise and by the model's accuracy [1/e-^2]."""
    used = found.areas.used
    scale = found.error_scale**2
    noise = np.diag(found.areas.errors[used] ** 2)
    # The fit's errors hold both, added in quadrature.
    own = np.diag(np.maximum(found.fit.errors[used] ** 2 / scale - np.diag(noise), 0.0))
    if found.areas.matrix is not None:
        flat = used.ravel()
        noise = found.areas.matrix[np.ix_(flat, flat)]
    return scale * noise, scale * own


def _information(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(jacobian.T @ np.linalg.solve(covariance, jacobian))


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])
