"""Least-squares problem of the image-charge model, solved at fixed heights of the charge."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes
from bfsensor.typing import FloatArray

SHAPE = ("charge_height", "row_height", "column_height", "half_width_x", "half_width_y")
"""Parameters that are always free: heights [um above the gates] and half sides [um]."""

SCALES = ("strength", "offset")
"""Parameters that are free by default: factor on the model, and offset of every lag [1/e-]."""

STARTS = ((0.5, 1.0, 2.0, 1.0, 3.0), (0.5, 1.0, 2.0, 1.0, 1.0), (0.5, 0.8, 2.5, 2.5, 2.5))
"""Starts of fits [um]: z_q above the plane, z_sh and z_sv above z_q, half sides a and b.

Chosen: typical sizes in three shapes of the rectangle, the second with the ratios of LSST's pipeline;
lengths twice as large still lie within the bounds."""

_LOWEST, _HIGHEST = 0.02, 20.0
"""Bounds of heights above the charge and least half side [um].

Chosen: both lie far from fitted values; fits that end there have no error for that parameter."""

_HEIGHTS = 10
"""Number of heights of the charge at which the fit is repeated, from 0.05 to at most 6 um.

Chosen: neighbours differ by a factor of 1.7; twice as many give a finer profile in twice the time."""

_FAR = 50.0
"""Rise of half of chi2 above the least one beyond which heights are not tried.

Chosen: chi2 is then 100 larger, ten standard deviations; twice as large, the profile goes to 14."""

_STEP = 1e-4
"""Step of numerical derivatives [um; logarithm of the height].

Chosen: the error of the one-sided difference is proportional to it and below 1e-3 of the slope."""

_TOLERANCE, _MOST = 1e-7, 20
"""Relative tolerance of the least squares in chi2 and parameters, and largest number of evaluations.

Chosen: at the best height further steps would change chi2 by less than 1e-7 of itself."""


@dataclass(frozen=True, eq=False)
class ImageChargeProblem:
    """Measured a_ij, errors, fitted lags, and the model with its free parameters.

    The vector of the fit holds the logarithm of the charge's height, the heights of the boundaries
    between rows and columns, all above the plane [um], the half sides [um], and where free the
    logarithm of the dipole and the offset in units of the largest a_ij.
    """

    given: FloatArray
    sigma: FloatArray
    lags: NDArray[np.bool_]
    base: ImageCharge
    depth: float
    names: tuple[str, ...]

    @property
    def size(self) -> float:
        """Unit of the offset: the largest fitted a_ij [1/e-]."""
        return float(np.abs(self.given[self.lags]).max())

    def unpack(self, vector: FloatArray) -> tuple[ImageCharge, float, float]:
        """Give the model, the strength and the offset [1/e-] of a vector."""
        height, plane = float(np.exp(vector[0])), self.base.plane_height
        model = dataclasses.replace(
            self.base, charge_height=plane + height, row_height=plane + vector[1],
            column_height=plane + vector[2], half_width_x=vector[3], half_width_y=vector[4],
        )  # fmt: skip
        scales = dict(zip(self.names[5:], vector[5:], strict=True))
        # Free is the dipole instead of the strength: most lags constrain it, whatever the height.
        strength = np.exp(scales["strength"]) / height if "strength" in scales else 1.0
        return model, float(strength), self.size * scales.get("offset", 0.0)

    def predict(self, vector: FloatArray) -> FloatArray:
        """Predict a_ij of all lags [1/e-], shape (n, n)."""
        model, strength, offset = self.unpack(vector)
        reach = len(self.given) - 1
        a = area_changes(model, depth=self.depth, reach=reach)[reach:, reach:]
        return strength * a + offset

    def pulls(self, vector: FloatArray) -> FloatArray:
        """Predicted minus measured a_ij of the fitted lags, in units of their errors."""
        return ((self.predict(vector) - self.given) / self.sigma)[self.lags]

    def slopes(self, vector: FloatArray, which: Sequence[int]) -> FloatArray:
        """Derivatives of the pulls by some entries of the vector, a column for each."""
        columns = []
        for n in which:
            if n < 5:
                # Backward differences: at its bound a half side must not grow beyond the pixel.
                step = np.zeros(len(vector))
                step[n] = _STEP
                columns.append((self.pulls(vector) - self.pulls(vector - step)) / _STEP)
            elif self.names[n] == "strength":
                offset = self.unpack(vector)[2]
                columns.append(((self.predict(vector) - offset) / self.sigma)[self.lags])
            else:
                columns.append((self.size / self.sigma)[self.lags])
        return np.array(columns).T

    def bounds(self, height: float) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of all entries but the height of the charge."""
        sealed = height + np.array([_LOWEST, min(_HIGHEST, self.base.thickness / 3)])
        ends = {"strength": np.log([1e-4, 1e4]), "offset": np.array([-1.0, 1.0])}
        half = 0.499 * np.array([self.base.pitch_x, self.base.pitch_y])
        more = [ends[name] for name in self.names[5:]]
        return (
            np.array([sealed[0], sealed[0], _LOWEST, _LOWEST, *(m[0] for m in more)]),
            np.array([sealed[1], sealed[1], *half, *(m[1] for m in more)]),
        )

    def at(self, height: float, start: FloatArray) -> Any:
        """Fit all entries at a fixed height of the charge [um above the plane]."""
        first = [np.log(height)]
        low, high = self.bounds(height)
        rest = list(range(1, len(self.names)))
        return least_squares(
            lambda v: self.pulls(np.array([*first, *v])), np.clip(start, low, high),
            lambda v: self.slopes(np.array([*first, *v]), rest), bounds=(low, high),
            x_scale="jac", ftol=_TOLERANCE, xtol=_TOLERANCE, gtol=None, max_nfev=_MOST,
        )  # fmt: skip

    def profile(self) -> tuple[FloatArray, list[Any]]:
        """Fit at several heights of the charge, from the middle outwards until chi2 is too large."""
        heights = np.geomspace(0.05, min(6.0, self.base.thickness / 6), _HEIGHTS)
        middle = int(np.argmin(np.abs(heights - STARTS[0][0])))
        tries = [
            self.at(heights[middle], self._start(start, heights[middle]))
            for start in STARTS
        ]
        fits = {middle: min(tries, key=lambda fit: float(fit.cost))}
        least = float(fits[middle].cost)
        for way in (1, -1):
            n = middle + way
            while 0 <= n < len(heights) and fits[n - way].cost < least + _FAR:
                fits[n] = self.at(
                    heights[n], self._carry(fits[n - way].x, *heights[[n - way, n]])
                )
                least = min(least, float(fits[n].cost))
                n += way
        done = sorted(fits)
        return heights[done], [fits[n] for n in done]

    def _carry(self, rest: FloatArray, height: float, to: float) -> FloatArray:
        """Start at another height: keep the two combinations that data constrain after the dipole.

        They are z_q^2 - (a^2 + b^2) / 2 and a^2 - b^2.
        """
        out = rest.copy()
        out[2:4] = np.sqrt(np.maximum(rest[2:4] ** 2 + to**2 - height**2, _LOWEST**2))
        return out

    def _start(self, given: Sequence[float], height: float) -> FloatArray:
        """Entries after the height of a start, with the dipole scaled to the largest a_ij."""
        rest = np.array([*given[1:], *(0.0 for _ in self.names[5:])])
        rest[:2] += height
        if "strength" in self.names:
            whole = np.array([np.log(height), *rest])
            rest[4] += np.log(self.size / np.abs(self.predict(whole)[self.lags]).max())
        return rest


def parameter_slopes(
    vector: FloatArray, names: Sequence[str], strength: float, size: float
) -> FloatArray:
    """Derivatives of the parameters (rows) by the entries of the fit's vector (columns)."""
    slopes = np.eye(len(vector))
    slopes[0, 0] = np.exp(vector[0])
    for n, name in enumerate(names[5:], 5):
        slopes[n, n] = strength if name == "strength" else size
        if name == "strength":  # free is its product with the height
            slopes[n, 0] = -strength
    return slopes
