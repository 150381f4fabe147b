r"""Fit of the image-charge model to a_ij, as in LSST's pipeline.

.. math:: a_{ij} = \alpha\, m_{ij}(z_q, z_{sh}, z_{sv}, a, b) + \beta

with the relative area changes m of charge rectangles between conducting planes
(:mod:`bfsensor.simulate.image_charge`), a strength :math:`\alpha` that absorbs the drift field, and
an offset :math:`\beta` common to all lags.  The heights :math:`z_{sh}` and :math:`z_{sv}`, at which
the boundaries between rows and columns end, stay above the height of the charge :math:`z_q`; a and b
are the half sides of its rectangle.

The field of a charge close to its plane is that of a dipole :math:`\alpha z_q`; the next order
depends on :math:`a^2 - b^2` and :math:`z_q^2 - (a^2 + b^2)/2`.  Data constrain the dipole, the two
heights and these two combinations, but hardly z_q, alpha, a and b separately.  Hence the fit is
repeated at fixed heights of the charge, and the result holds chi2 at each of them.  Errors follow
from the curvature at the minimum; they are valid where they are small relative to the values.  The
offset has no physical meaning: it absorbs long-range differences from the model.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from bfsensor.errors import MeasurementError
from bfsensor.fit.image_charge_problem import (
    SCALES,
    SHAPE,
    ImageChargeProblem,
    parameter_slopes,
)
from bfsensor.measure.ecsv import read_ecsv, same_fields, square_lags, write_ecsv
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.typing import FloatArray

_SCHEMA = "bfsensor-image-charge-fit-1"
_AT_BOUND = 0.01
"""Distance from a bound below which a parameter counts as held there [um, logarithm of the strength,
offset in units of the largest a_ij].

Chosen: twice as large, half sides within 0.02 um of half a pixel get no error."""


@dataclass(frozen=True, eq=False)
class ImageChargeFit:
    """Parameters of the image-charge model fitted to a_ij.

    Parameters
    ----------
    model : ImageCharge
        Model with the fitted heights and half sides [um].
    strength, offset : float
        Factor alpha, and offset beta [1/e-].
    depth : float
        Conversion depth [um above the gates].
    names : tuple of str
        Free parameters, in the order of ``covariance``.
    covariance : ndarray, shape (p, p)
        Covariance from the errors as given, in um, 1 and 1/e-; nan at a bound.
    a, errors, predicted : ndarray, shape (n, n)
        Measured a_ij, their errors, and those of the model, ``[j, i]`` [1/e-].
    used : ndarray of bool, shape (n, n)
        Lags that were fitted.
    chi2 : float
        Chi-square of the fitted lags with the errors as given.
    bounded : tuple of str
        Parameters that ended at a bound: the data do not determine them.  They have no error, and
        the errors of the others hold with these fixed.
    profile_heights, profile_chi2 : ndarray, shape (m,)
        Heights of the charge [um above the gates] and the least chi2 at each, up to about 100
        above the best.  Where it hardly changes, z_q, alpha, a and b are not known separately.

    Examples
    --------
    >>> from bfsensor.simulate.image_charge import area_changes
    >>> true = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0)
    >>> a = area_changes(true, depth=100.0, reach=4)[4:, 4:]
    >>> fit = fit_image_charge(a, 0.01 * abs(a), base=true)
    >>> fit.names[0], fit.degrees_of_freedom
    ('charge_height', 18)
    """

    model: ImageCharge
    strength: float
    offset: float
    depth: float
    names: tuple[str, ...]
    covariance: FloatArray
    a: FloatArray
    errors: FloatArray
    predicted: FloatArray
    used: NDArray[np.bool_]
    chi2: float
    bounded: tuple[str, ...]
    profile_heights: FloatArray
    profile_chi2: FloatArray

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    @property
    def values(self) -> dict[str, float]:
        """Values of the free parameters by name [um, 1, 1/e-]."""
        return {name: _value(self, name) for name in self.names}

    @property
    def parameter_errors(self) -> dict[str, float]:
        """Errors of the free parameters from the errors of a_ij as given; nan at a bound.

        Where a parameter ended at a bound, the errors of the height and the strength are too
        small: use the profile of chi2 instead.
        """
        return dict(
            zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True)
        )

    @property
    def dipole(self) -> tuple[float, float]:
        """Dipole, strength times height of the charge above the plane, and its error [um]."""
        height = self.model.charge_height - self.model.plane_height
        slope = np.array([
            {"charge_height": self.strength, "strength": height}.get(n, 0.0) for n in self.names
        ])  # fmt: skip
        known = np.nan_to_num(
            self.covariance
        )  # parameters at a bound have nan: they add no error
        return self.strength * height, float(np.sqrt(slope @ known @ slope))

    @property
    def degrees_of_freedom(self) -> int:
        """Number of fitted lags minus that of free parameters."""
        return int(self.used.sum()) - len(self.names)

    @property
    def error_scale(self) -> float:
        """Factor on all errors at which chi2 equals the degrees of freedom."""
        return float(np.sqrt(self.chi2 / self.degrees_of_freedom))

    @property
    def residuals(self) -> FloatArray:
        """Measured minus predicted a_ij by lag [1/e-]."""
        return self.a - self.predicted

    @property
    def ratio(self) -> FloatArray:
        """Predicted over measured a_ij by lag."""
        return self.predicted / self.a

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write an ECSV file: a row for each lag, parameters in the header.

        Parameters
        ----------
        path : str or path-like
            File to write.
        overwrite : bool
            Whether an existing file is replaced.

        Raises
        ------
        MeasurementError
            The file exists and ``overwrite`` is not set, or it cannot be written.
        """
        j, i = (n.ravel() for n in np.indices(self.a.shape))
        unit = "electron-1"
        columns = {
            "i": (i, None, "lag in x"),
            "j": (j, None, "lag in y"),
            "a": (self.a.ravel(), unit, "given"),
            "error": (self.errors.ravel(), unit, ""),
            "predicted": (self.predicted.ravel(), unit, ""),
            "used": (self.used.ravel(), None, "fitted"),
        }
        meta = {
            "model": json.dumps(dataclasses.asdict(self.model)),
            "strength": self.strength, "offset": self.offset, "depth": self.depth,
            "names": list(self.names), "covariance": self.covariance, "chi2": self.chi2,
            "bounded": list(self.bounded), "profile_heights": self.profile_heights,
            "profile_chi2": self.profile_chi2,
        }  # fmt: skip
        write_ecsv(path, _SCHEMA, columns, meta, overwrite=overwrite)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> ImageChargeFit:
        """Read a file of :meth:`write`.

        Parameters
        ----------
        path : str or path-like
            File to read.

        Returns
        -------
        fit : ImageChargeFit
            Equal to the one that was written.

        Raises
        ------
        MeasurementError
            The file is missing, damaged, or of another kind.
        """
        names = ("i", "j", "a", "error", "predicted", "used")
        heads = (
            "model",
            "strength",
            "offset",
            "depth",
            "names",
            "covariance",
            "chi2",
            "bounded",
            "profile_heights",
            "profile_chi2",
        )
        columns, meta = read_ecsv(path, _SCHEMA, names, heads)
        lags = square_lags(path, columns)
        given = json.loads(meta["model"])
        if isinstance(given["drift_field"], list):
            given["drift_field"] = tuple(map(tuple, given["drift_field"]))
        return cls(
            ImageCharge(**given), meta["strength"], meta["offset"], meta["depth"],
            tuple(meta["names"]), np.array(meta["covariance"], float), lags["a"], lags["error"],
            lags["predicted"], lags["used"].astype(bool), meta["chi2"], tuple(meta["bounded"]),
            np.array(meta["profile_heights"]), np.array(meta["profile_chi2"]),
        )  # fmt: skip


def _value(fit: ImageChargeFit, name: str) -> float:
    """Value of a free parameter, of the model or of the fit."""
    return float(getattr(fit.model if name in SHAPE else fit, name))


def fit_image_charge(
    a: ArrayLike,
    errors: ArrayLike,
    *,
    base: ImageCharge,
    depth: float | None = None,
    used: ArrayLike | None = None,
    free: Sequence[str] = SCALES,
) -> ImageChargeFit:
    """Fit heights, half sides, strength and offset of the image-charge model by least squares.

    Parameters
    ----------
    a, errors : array_like, shape (n, n)
        Relative area changes per electron and their standard errors [1/e-], ``[j, i]`` from lag
        (0, 0); nan where not measured.  LSST's pipeline fits lags up to 8.
    base : ImageCharge
        Model with thickness, pitch, permittivity, plane and drift field; where ``strength`` is
        free, a uniform field of any value serves.  Its heights and half sides are not used.
    depth : float, optional
        Conversion depth [um above the gates]; by default the back surface.
    used : array_like of bool, shape (n, n), optional
        Lags to fit; by default all finite ones.  Exclude an a_00 that was computed from the sum
        of the others: it is no measurement.
    free : sequence of str
        Which of 'strength' and 'offset' are free; by default both.  A fixed strength is 1, a fixed
        offset 0.

    Returns
    -------
    fit : ImageChargeFit
        Best of the fits from :data:`bfsensor.fit.image_charge_problem.STARTS`.

    Raises
    ------
    MeasurementError
        Arrays are not square or differ in shape, an error is not above 0, there are no more lags
        than parameters, or a name is unknown.

    References
    ----------
    Astier & Regnault 2023, A&A 670, A118; LSST ``cp_pipe``, ``utils.ElectrostaticFit``.

    Examples
    --------
    >>> from bfsensor.simulate.image_charge import area_changes
    >>> true = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0)
    >>> a = 1.2 * area_changes(true, depth=100.0, reach=4)[4:, 4:]
    >>> fit = fit_image_charge(a, 0.01 * abs(a), base=true)
    >>> round(fit.model.column_height, 2), bool(fit.chi2 < 1e-3)
    (3.2, True)
    """
    given, sigma = np.array(a, float), np.array(errors, float)
    lags, names = _check(given, sigma, used, free)
    problem = ImageChargeProblem(
        given, sigma, lags, base, base.thickness if depth is None else float(depth), names
    )
    heights, fits = problem.profile()
    costs = np.array([fit.cost for fit in fits])
    middle = int(np.argmin(costs))
    lowest, highest = heights[max(middle - 1, 0)], heights[min(middle + 1, len(costs) - 1)]
    tried = {}

    def cost(log_height: float) -> float:
        tried[log_height] = problem.at(float(np.exp(log_height)), fits[middle].x)
        return float(tried[log_height].cost)

    found = minimize_scalar(
        cost, bounds=np.log([lowest, highest]), method="bounded", options={"xatol": 0.05}
    )
    height, best = float(np.exp(found.x)), tried[found.x]
    if costs[middle] < best.cost:
        height, best = float(heights[middle]), fits[middle]
    vector = np.array([np.log(height), *best.x])
    model, strength, offset = problem.unpack(vector)
    low, high = problem.bounds(height)
    near = np.array(
        [height in heights[[0, -1]], *(np.minimum(best.x - low, high - best.x) < _AT_BOUND)]
    )
    # Parameters at a bound are fixed there: their curvature says nothing of their errors.
    jacobian = problem.slopes(vector, np.flatnonzero(~near).tolist())
    slopes = parameter_slopes(vector, names, strength, problem.size)[:, ~near]
    covariance = slopes @ np.linalg.pinv(jacobian.T @ jacobian) @ slopes.T
    covariance[near] = covariance[:, near] = np.nan
    return ImageChargeFit(
        model, strength, offset, problem.depth, names, covariance, given, sigma,
        problem.predict(vector), lags, float(2 * best.cost),
        tuple(n for n, at in zip(names, near, strict=True) if at),
        base.plane_height + heights, 2 * costs,
    )  # fmt: skip


def _check(
    a: FloatArray,
    errors: FloatArray,
    used: ArrayLike | None,
    free: Sequence[str],
) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    """Check the data; give the lags to fit and the names of the free parameters."""
    if a.ndim != 2 or a.shape[0] != a.shape[1] or errors.shape != a.shape:
        raise MeasurementError(
            f"a and errors must be squares of one shape, from lag (0, 0), not {a.shape} and "
            f"{errors.shape}"
        )
    unknown = [name for name in free if name not in SCALES]
    if unknown or len(set(free)) != len(free):
        raise MeasurementError(
            f"free = {list(free)} must be some of {', '.join(SCALES)}, each once"
        )
    lags = np.isfinite(a) & np.isfinite(errors)
    if used is not None:
        wanted = np.array(used, bool)
        if wanted.shape != a.shape:
            raise MeasurementError(f"used has the shape {wanted.shape}, not {a.shape}")
        lags &= wanted
    if not np.all(errors[lags] > 0):
        raise MeasurementError("errors of fitted lags must be above 0")
    names = (*SHAPE, *(name for name in SCALES if name in free))
    if lags.sum() <= len(names):
        raise MeasurementError(
            f"{int(lags.sum())} lags do not determine {len(names)} parameters: give more lags, or "
            "fewer names in free"
        )
    return lags, names
