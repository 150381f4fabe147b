r"""Fit of the image-charge model to a camera's a_ij, with priors where the data say little.

.. math:: a_{ij} = \frac{1}{E}\, m_{ij}(z_q, z_{sh}, z_{sv}, a, b)

with the parameters of :mod:`bfsensor.fit.image_charge_fit` and the drift field E in place of its
strength.  The dipole z_q / E and the heights z_sh and z_sv follow from the data; z_q, E, a and b
hardly do separately, and their priors (:data:`PRIORS`, wide) keep them where silicon sensors are.
Errors follow from the curvature of chi-square plus priors at its minimum.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.special import expit
from scipy.stats import chi2 as chi2_distribution

from bfsensor.errors import MeasurementError
from bfsensor.fit.camera_areas import CameraAreas
from bfsensor.fit.image_charge_fit import ImageChargeFit
from bfsensor.fit.image_charge_problem import SHAPE
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes
from bfsensor.typing import FloatArray

PRIORS = {
    "charge_height": (np.log(0.5), np.log(2.0)),
    "row_height": (np.log(1.0), np.log(2.5)),
    "column_height": (np.log(2.0), np.log(2.5)),
    "half_width_x": (0.0, 1.2),
    "half_width_y": (0.0, 1.2),
}
"""Means and standard deviations of Gaussian priors.

Of the logarithms of the charge's height above the gates, and of the two boundaries' heights above the
charge [um]; of the logit of each half side over half the pitch, so that half of all sides lie between
0.31 and 0.69 of it.  Chosen: they hold the values fitted to both of LSST's
vendors (``validation/results/image_charge_fit.ecsv``) within about one standard deviation; with priors
twice as wide, what the data do not determine has errors twice as large."""

FIELD_KNOWN, FIELD_GUESSED = 0.1, 0.4
"""Standard deviation of the logarithm of the drift field where the back bias is given, and where not.

Chosen: the potential of the channel, some 5 to 15 V, adds to the bias and is not known; back biases of
cameras range over a factor of two about a field of 0.5 V/um."""

MODEL_ERROR = 0.05
"""Standard deviation of measured a_ij about the model, over a_ij, besides their own errors.

Measured: image charges fitted to the a_ij of tables that solve Poisson's equation, without an offset,
scatter about them by 4.8 % (ITL) and 4.6 % (E2V), the roots of chi2/n in the header of
``validation/results/image_charge_fit.ecsv`` times 5 %; the largest misfit is 9 %, at lag (1, 1).
Without it, precise data would force the parameters to where the model imitates what it does not
hold."""

UNLIKELY = 0.01
"""Probability of chi-square below which the errors of a_ij are multiplied by the root of chi2/n.

Chosen: by statistics alone it happens once in 100 fits; above it errors stay as stated."""

DATA, PRIOR = 0.5, 0.9
"""Error over that of the prior below which the data determine a parameter, above which the prior does.

Chosen: 0.5 means that the data are at least 1.7 times as precise as the prior, 0.9 that they are at
most half as precise."""

_ROUNDS = 3
"""Number of fits with the model's accuracy in proportion to the a_ij of the last one.

Chosen: the third moves parameters by less than a hundredth of their errors."""

_LEAST = 1e-3
"""Least half side over half the pitch; chosen: the closed form loses digits below it."""

_STEP = 1e-3
"""Step of numerical derivatives, in standard deviations of the priors.

Chosen: errors of central differences are 1e-6 of the slope, far above the round-off of the field."""

_STARTS = (
    (0.0, 0.0, 0.0, 0.0, 0.0),
    (0.7, 0.5, 0.5, -1.0, 1.0),
    (-0.7, -0.5, 0.3, 1.0, -1.0),
)
"""Starts, in standard deviations from the mean of each prior.

Chosen: a narrow and a wide rectangle in either direction; more starts found no lower chi-square."""


@dataclass(frozen=True, eq=False)
class CameraFit:
    """Image-charge model of a camera, with errors and what determines each parameter.

    Attributes
    ----------
    fit : ImageChargeFit
        Model with base drift field, strength, covariance of the parameters, a_ij measured and
        predicted.  Its covariance holds data and priors, its errors of a_ij the model's accuracy.
    priors : mapping of str to (float, float)
        Mean of the prior of each parameter, and its standard deviation where the fit ends, in the
        fit's units.
    error_scale : float
        Factor on the errors of a_ij; 1 where chi-square is not improbable.
    areas : CameraAreas
        The measured a_ij.
    effective : float
        Number of parameters that the data determine: the trace of the derivatives of the fitted by
        the measured a_ij.  Chi-square has about the number of lags less this as its mean.
    """

    fit: ImageChargeFit
    priors: dict[str, tuple[float, float]]
    error_scale: float
    areas: CameraAreas
    effective: float

    @property
    def chi2(self) -> float:
        """Chi-square of the fitted lags with the errors as given."""
        return self.fit.chi2 * self.error_scale**2

    @property
    def degrees_of_freedom(self) -> float:
        """Number of fitted lags less that of the parameters that they determine."""
        return float(self.fit.used.sum()) - self.effective

    @property
    def model(self) -> ImageCharge:
        """Fitted model, with the fitted drift field."""
        base, strength = self.fit.model.drift_field, self.fit.strength
        field = (
            tuple((z, e / strength) for z, e in base)
            if isinstance(base, tuple)
            else base / strength
        )
        return dataclasses.replace(self.fit.model, drift_field=field)

    @property
    def field_error(self) -> float:
        """Relative error of the drift field."""
        return self.fit.parameter_errors["strength"] / self.fit.strength

    def shares(self) -> dict[str, float]:
        """Error of each parameter over that of its prior; near 1 the data say nothing."""
        errors = self.fit.parameter_errors
        return {name: errors[name] / self.priors[name][1] for name in self.fit.names}

    def determined_by(self, name: str) -> str:
        """Say whether the data or the prior determine a parameter."""
        share = self.shares()[name]
        return "data" if share < DATA else "prior" if share > PRIOR else "data and prior"


def fit_camera(
    areas: CameraAreas,
    *,
    base: ImageCharge,
    depth: float | None = None,
    field_spread: float = FIELD_GUESSED,
    offset: bool = False,
    model_error: float = MODEL_ERROR,
) -> CameraFit:
    """Fit heights, half sides and drift field of the image-charge model to a_ij.

    Parameters
    ----------
    areas : CameraAreas
        Measured a_ij.
    base : ImageCharge
        Model with thickness, pitch, permittivity, and the drift field that its prior is centred on;
        its heights and half sides are not used.
    depth : float, optional
        Conversion depth of the flats' light [um above the gates]; by default the back surface.
    field_spread : float
        Standard deviation of the logarithm of the drift field in its prior, above 0.
    offset : bool
        Also fit an offset common to all lags, which absorbs what reaches beyond the lags or is not
        electrostatic.  It enters no table.
    model_error : float
        Relative accuracy of the model, added in quadrature to the errors of a_ij, at least 0.

    Returns
    -------
    fit : CameraFit

    Raises
    ------
    MeasurementError
        Fewer than three lags can be fitted, or the fit does not converge.

    References
    ----------
    Astier & Regnault 2023, A&A 670, A118.

    Examples
    --------
    >>> true = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0)
    >>> a = area_changes(true, depth=100.0, reach=4)[4:, 4:]
    >>> areas = CameraAreas(a, 0.01 * abs(a), np.isfinite(a), "simulated")
    >>> found = fit_camera(areas, base=true)
    >>> found.determined_by("column_height"), bool(found.fit.chi2 < 1)
    ('data', True)
    """
    count = int(areas.used.sum())
    if count < 3:
        raise MeasurementError(
            f"{areas.source}: {count} lags can be fitted; at least 3 are needed, such as 1,0 0,1 1,1"
        )
    given = (areas, base, depth, field_spread, offset, model_error)
    problem = _Problem.of(*given)
    found = problem.solve(1.0)
    for _ in range(_ROUNDS):
        # With errors in proportion to measured a_ij, those that fluctuated low would weigh more.
        problem = _Problem.of(*given, problem.predict(found.x))
        found = problem.solve(1.0, found.x)
    free = count - problem.effective(found.x, 1.0)
    chi2 = problem.chi2(found.x)
    scale = 1.0
    if free > 0 and chi2_distribution.sf(chi2, free) < UNLIKELY:
        scale = float(np.sqrt(chi2 / free))
        found = problem.solve(scale, found.x)
    return problem.result(found, scale)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Residuals of the fit.

    The vector holds the logarithms of z_q and of the boundaries' heights above it [um], the logits of
    the half sides over half a pitch, the logarithm of the drift field over that of the base, and where
    free the offset [largest a_ij].
    """

    areas: CameraAreas
    base: ImageCharge
    depth: float
    weights: FloatArray
    errors: FloatArray
    mean: FloatArray
    spread: FloatArray

    @classmethod
    def of(
        cls,
        areas: CameraAreas,
        base: ImageCharge,
        depth: float | None,
        field_spread: float,
        offset: bool,
        model_error: float,
        predicted: FloatArray | None = None,
    ) -> _Problem:
        mean, spread = (np.array([PRIORS[name][k] for name in SHAPE]) for k in (0, 1))
        mean, spread = np.append(mean, 0.0), np.append(spread, field_spread)
        if offset:  # no prior: a hundred times the largest a_ij is no constraint
            mean, spread = np.append(mean, 0.0), np.append(spread, 100.0)
        used = areas.used.ravel()
        own = (model_error * (areas.a if predicted is None else predicted)) ** 2
        total = np.sqrt(areas.errors**2 + own)
        if areas.matrix is None:
            weights = np.diag(1 / total.ravel()[used])
        else:
            chosen = areas.matrix[np.ix_(used, used)] + np.diag(own.ravel()[used])
            try:
                weights = np.linalg.inv(np.linalg.cholesky(chosen))
            except np.linalg.LinAlgError:
                raise MeasurementError(
                    f"{areas.source}: the covariance matrix of a_ij is not positive definite"
                ) from None
        height = base.thickness if depth is None else float(depth)
        return cls(areas, base, height, weights, total, mean, spread)

    @property
    def half_pitch(self) -> FloatArray:
        """Half the pixel pitch in x and y [um]."""
        return 0.5 * np.array([self.base.pitch_x, self.base.pitch_y])

    @property
    def size(self) -> float:
        """Unit of the offset: the largest fitted a_ij [1/e-]."""
        return float(np.abs(self.areas.a[self.areas.used]).max())

    def model(self, vector: FloatArray) -> ImageCharge:
        """Heights and half sides of a vector, with the base's drift field."""
        # Far beyond the priors the model ends: heights stay in the silicon.
        height, row, column = np.exp(
            np.minimum(vector[:3], np.log(self.base.thickness / 4))
        )
        half = self.half_pitch * np.clip(expit(vector[3:5]), _LEAST, 1.0)
        return dataclasses.replace(
            self.base, charge_height=self.base.plane_height + height,
            row_height=self.base.plane_height + height + row,
            column_height=self.base.plane_height + height + column,
            half_width_x=half[0], half_width_y=half[1],
        )  # fmt: skip

    def predict(self, vector: FloatArray) -> FloatArray:
        """a_ij of all lags [1/e-]."""
        reach = len(self.areas.a) - 1
        a = area_changes(self.model(vector), depth=self.depth, reach=reach)[reach:, reach:]
        return np.exp(-vector[5]) * a + (self.size * vector[6] if len(vector) > 6 else 0.0)

    def pulls(self, vector: FloatArray) -> FloatArray:
        """Predicted minus measured a_ij, uncorrelated and in their errors."""
        return self.weights @ (self.predict(vector) - self.areas.a)[self.areas.used]

    def chi2(self, vector: FloatArray) -> float:
        """Chi-square of the data with the errors as given."""
        return float(np.sum(self.pulls(vector) ** 2))

    def starts(self) -> list[FloatArray]:
        """Vectors from which fits begin."""
        out = []
        for start in _STARTS:
            first = self.mean.copy()
            first[:5] += np.array(start) * self.spread[:5]
            # The strength that the largest a_ij asks for, so that no start is far away.
            largest = np.abs(self.predict(first)[self.areas.used]).max()
            limit = 3 * self.spread[5]
            first[5] = np.clip(np.log(largest / self.size), -limit, limit)
            out.append(first)
        return out

    def solve(self, scale: float, start: FloatArray | None = None) -> Any:
        """Find the least chi-square of data and priors, from one start or from all."""
        fits = []
        for first in self.starts() if start is None else [start]:
            fits.append(
                least_squares(
                    lambda v: np.concatenate(
                        [self.pulls(v) / scale, (v - self.mean) / self.spread]
                    ),
                    first, lambda v: self.jacobian(v, scale), x_scale=self.spread,
                    method="lm", xtol=1e-8, ftol=1e-8, max_nfev=200,
                )
            )  # fmt: skip
        best = min(fits, key=lambda one: float(one.cost))
        if not best.success:
            raise MeasurementError(
                f"{self.areas.source}: the fit does not converge: {best.message}"
            )
        return best

    def jacobian(self, vector: FloatArray, scale: float) -> FloatArray:
        """Derivatives of the residuals, by central differences."""
        columns = []
        for n, spread in enumerate(self.spread):
            step = np.zeros(len(vector))
            step[n] = _STEP * spread
            rise = self.pulls(vector + step) - self.pulls(vector - step)
            columns.append(rise / (2 * step[n] * scale))
        return np.concatenate([np.array(columns).T, np.diag(1 / self.spread)])

    def result(self, found: Any, scale: float) -> CameraFit:
        """Turn the minimum into parameters with errors and priors."""
        v = found.x
        jacobian, slopes = self.jacobian(v, scale), self.slopes(v)
        covariance = slopes @ np.linalg.inv(jacobian.T @ jacobian) @ slopes.T
        names = (*SHAPE, "strength", *(["offset"] if len(v) > 6 else []))
        spread = np.sqrt(np.diag(slopes @ np.diag(self.spread**2) @ slopes.T))
        centre = self.parameters(self.mean)
        offset = self.size * v[6] if len(v) > 6 else 0.0
        chi2 = self.chi2(v)
        fit = ImageChargeFit(
            self.model(v), float(np.exp(-v[5])), offset, self.depth, names, covariance,
            self.areas.a, scale * self.errors, self.predict(v), self.areas.used,
            chi2 / scale**2, (), np.array([]), np.array([]),
        )  # fmt: skip
        priors = {
            n: (float(m), float(s)) for n, m, s in zip(names, centre, spread, strict=True)
        }
        return CameraFit(fit, priors, scale, self.areas, self.effective(v, scale))

    def effective(self, vector: FloatArray, scale: float) -> float:
        """Number of parameters that the data determine."""
        jacobian = self.jacobian(vector, scale)
        data = jacobian[: len(self.weights)]
        return float(np.trace(data @ np.linalg.inv(jacobian.T @ jacobian) @ data.T))

    def parameters(self, vector: FloatArray) -> FloatArray:
        """Parameters in the fit's units: heights and half sides [um], strength, offset [1/e-]."""
        model = self.model(vector)
        out = [getattr(model, name) for name in SHAPE] + [np.exp(-vector[5])]
        return np.array(out + [self.size * one for one in vector[6:]])

    def slopes(self, vector: FloatArray) -> FloatArray:
        """Derivatives of the parameters (rows) by the vector's entries (columns)."""
        slopes = np.eye(len(vector))
        heights = np.exp(vector[:3])
        slopes[:3, 0] = heights[0]
        slopes[1, 1], slopes[2, 2] = heights[1:]
        share = expit(vector[3:5])
        slopes[3, 3], slopes[4, 4] = self.half_pitch * share * (1 - share)
        slopes[5, 5] = -np.exp(-vector[5])
        if len(vector) > 6:
            slopes[6, 6] = self.size
        return slopes


def misfits(fit: ImageChargeFit, limit: float = 3.0) -> Sequence[tuple[int, int, float]]:
    """List lags (i, j) whose measured a_ij differ from the fit by more than some errors, worst first."""
    pulls = fit.residuals / fit.errors
    found = [
        (i, j, float(pull))
        for (j, i), pull in np.ndenumerate(pulls)
        if np.isfinite(pull) and abs(pull) > limit
    ]
    return sorted(found, key=lambda one: -abs(one[2]))
