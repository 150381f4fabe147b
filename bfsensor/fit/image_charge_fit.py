r"""The analytic engine fitted to a_ij, as LSST's pipeline does.

.. math:: a_{ij} = \alpha\, m_{ij}(z_q, z_{sh}, z_{sv}, a, b) + \beta

with the relative area changes m of charge rectangles between conducting planes
(:mod:`bfsensor.simulate.image_charge`), a strength :math:`\alpha` that takes up the drift field,
and an offset :math:`\beta` common to all lags.  Both :math:`z_{sh}` and :math:`z_{sv}` stay above
:math:`z_q`.

The field of a charge close to its plane is that of a dipole, :math:`\alpha z_q`, and in the next
order :math:`a^2 - b^2` and :math:`z_q^2 - (a^2 + b^2)/2` count: the dipole, the sealed heights and
these two are told by data, while z_q, alpha, a and b one by one hardly are.  Hence the fit is made at
one height of the charge after another, and what that costs in chi2 stands in the result.  Errors
follow from the curvature at the minimum and hold where they are small beside their values.  An offset
is no physics: it absorbs what the model lacks at long range.
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


@dataclass(frozen=True, eq=False)
class ImageChargeFit:
    """Parameters of the analytic engine, from a_ij.

    Attributes
    ----------
    model : ImageCharge
        With the fitted heights and half sides.
    strength, offset : float
        alpha, and beta [1/e-].
    depth : float
        Conversion depth [um above the gates].
    names : tuple of str
        Free parameters, in the order of ``covariance``.
    covariance : ndarray, shape (p, p)
        From the errors as given; um, 1 and 1/e-.
    a, errors, predicted : ndarray, shape (n, n)
        Given, and by the model, ``[j, i]`` [1/e-].
    used : ndarray of bool, shape (n, n)
        Lags that were fitted.
    chi2 : float
    bounded : tuple of str
        Parameters that ended at a bound: the data do not determine them, they have no error,
        and the others theirs with these held.
    profile_heights, profile_chi2 : ndarray, shape (m,)
        Heights of the charge [um above the gates] and the least chi2 at each, up to where it is
        100 above the best: where it hardly changes, z_q, alpha, a and b are not known one by one.
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
        """Free parameters by name."""
        return {name: _value(self, name) for name in self.names}

    @property
    def parameter_errors(self) -> dict[str, float]:
        """Their errors, from the errors of the a_ij as given; nan at a bound.

        Where something ended at a bound, those of the height and the strength are too small:
        the profile says what is known of them.
        """
        return dict(
            zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True)
        )

    @property
    def dipole(self) -> tuple[float, float]:
        """Strength times height of the charge above the plane, and its error [um]."""
        height = self.model.charge_height - self.model.plane_height
        slope = np.array([
            {"charge_height": self.strength, "strength": height}.get(n, 0.0) for n in self.names
        ])  # fmt: skip
        known = np.nan_to_num(self.covariance)  # what is held at a bound adds nothing
        return self.strength * height, float(np.sqrt(slope @ known @ slope))

    @property
    def degrees_of_freedom(self) -> int:
        """Fitted lags less free parameters."""
        return int(self.used.sum()) - len(self.names)

    @property
    def error_scale(self) -> float:
        """Factor on all errors that would make chi2 what it should be."""
        return float(np.sqrt(self.chi2 / self.degrees_of_freedom))

    @property
    def residuals(self) -> FloatArray:
        """Given less predicted, by lag [1/e-]."""
        return self.a - self.predicted

    @property
    def ratio(self) -> FloatArray:
        """Predicted over given, by lag."""
        return self.predicted / self.a

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write an ECSV file: a row for each lag, parameters in the header.

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
        """Read what :meth:`write` wrote.

        Raises
        ------
        MeasurementError
            Not such a file, or damaged; names it.
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
    """Fit heights, half sides, strength and offset by least squares.

    Parameters
    ----------
    a, errors : array_like, shape (n, n)
        Relative area changes per electron and their standard errors [1/e-], ``[j, i]`` from lag
        (0, 0); nan where not measured.  LSST's pipeline fits lags up to 8.
    base : ImageCharge
        Thickness, pitch, permittivity, plane and drift field; a uniform field of any strength
        where ``strength`` is free.  Its heights and half sides count for nothing.
    depth : float, optional
        Conversion depth [um above the gates]; by default the back surface.
    used : array_like of bool, shape (n, n), optional
        Lags to fit; by default all that are finite.  An a_00 that was computed from the sum of
        the others is no measurement.
    free : sequence of str
        Which of :data:`SCALES` are free; a strength that is not is 1, an offset 0.

    Returns
    -------
    ImageChargeFit
        The best of the fits from :data:`bfsensor.fit.image_charge_problem.STARTS`.

    Raises
    ------
    MeasurementError
        Arrays that are no squares of one shape, errors that are not above 0, fewer lags than
        parameters, unknown names.

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
    # What ended at a bound is held there: it has no error, and the others theirs without it.
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
    """Lags to fit and names of what is free."""
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
            f"{int(lags.sum())} lags do not determine {len(names)} parameters; more lags, or "
            "less free"
        )
    return lags, names
