"""The least-squares problem behind :mod:`bfsensor.fit.image_charge_fit`."""

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
"""Always free: heights [um above the gates] and half sides [um]."""

SCALES = ("strength", "offset")
"""Free unless told otherwise: the factor, and what is added to every lag [1/e-]."""

STARTS = ((0.5, 1.0, 2.0, 1.0, 3.0), (0.5, 1.0, 2.0, 1.0, 1.0), (0.5, 0.8, 2.5, 2.5, 2.5))
"""Of z_q above the plane, z_sh and z_sv above z_q, a and b [um]; the second has LSST's ratios."""

_LOWEST, _HIGHEST = 0.02, 20.0  # um
_HEIGHTS = 10
_FAR = 50.0  # of half a chi2: heights beyond are not looked at
_STEP = 1e-4  # of logarithms and um
_TOLERANCE, _MOST = 1e-7, 20


@dataclass(frozen=True, eq=False)
class ImageChargeProblem:
    """Data and model.

    A vector holds the logarithm of the charge's height, the sealed heights, all above the plane,
    half sides, logarithm of the dipole, offset.
    """

    given: FloatArray
    sigma: FloatArray
    lags: NDArray[np.bool_]
    base: ImageCharge
    depth: float
    names: tuple[str, ...]

    @property
    def size(self) -> float:
        """Unit of the offset [1/e-]."""
        return float(np.abs(self.given[self.lags]).max())

    def unpack(self, vector: FloatArray) -> tuple[ImageCharge, float, float]:
        """Model, strength and offset."""
        height, plane = float(np.exp(vector[0])), self.base.plane_height
        model = dataclasses.replace(
            self.base, charge_height=plane + height, row_height=plane + vector[1],
            column_height=plane + vector[2], half_width_x=vector[3], half_width_y=vector[4],
        )  # fmt: skip
        scales = dict(zip(self.names[5:], vector[5:], strict=True))
        # The dipole is free, not the strength: it is what most lags tell.
        strength = np.exp(scales["strength"]) / height if "strength" in scales else 1.0
        return model, float(strength), self.size * scales.get("offset", 0.0)

    def predict(self, vector: FloatArray) -> FloatArray:
        """Model of all lags, (n, n) [1/e-]."""
        model, strength, offset = self.unpack(vector)
        reach = len(self.given) - 1
        a = area_changes(model, depth=self.depth, reach=reach)[reach:, reach:]
        return strength * a + offset

    def pulls(self, vector: FloatArray) -> FloatArray:
        """Predicted less given of the fitted lags, in errors."""
        return ((self.predict(vector) - self.given) / self.sigma)[self.lags]

    def slopes(self, vector: FloatArray, which: Sequence[int]) -> FloatArray:
        """Derivatives of the pulls by some entries of the vector."""
        columns = []
        for n in which:
            if n < 5:
                # Backwards: forwards a half side at its bound would leave the pixel.
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
        """Of all but the height of the charge."""
        sealed = height + np.array([_LOWEST, min(_HIGHEST, self.base.thickness / 3)])
        ends = {"strength": np.log([1e-4, 1e4]), "offset": np.array([-1.0, 1.0])}
        half = 0.499 * np.array([self.base.pitch_x, self.base.pitch_y])
        more = [ends[name] for name in self.names[5:]]
        return (
            np.array([sealed[0], sealed[0], _LOWEST, _LOWEST, *(m[0] for m in more)]),
            np.array([sealed[1], sealed[1], *half, *(m[1] for m in more)]),
        )

    def at(self, height: float, start: FloatArray) -> Any:
        """Fit all but the height of the charge [um above the plane]."""
        first = [np.log(height)]
        low, high = self.bounds(height)
        rest = list(range(1, len(self.names)))
        return least_squares(
            lambda v: self.pulls(np.array([*first, *v])), np.clip(start, low, high),
            lambda v: self.slopes(np.array([*first, *v]), rest), bounds=(low, high),
            x_scale="jac", ftol=_TOLERANCE, xtol=_TOLERANCE, gtol=None, max_nfev=_MOST,
        )  # fmt: skip

    def profile(self) -> tuple[FloatArray, list[Any]]:
        """Best fits over heights of the charge, from the middle outwards until none fits."""
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
        """Start at another height: what the next order after the dipole tells stays.

        z_q^2 - (a^2 + b^2) / 2 and a^2 - b^2 do.
        """
        out = rest.copy()
        out[2:4] = np.sqrt(np.maximum(rest[2:4] ** 2 + to**2 - height**2, _LOWEST**2))
        return out

    def _start(self, given: Sequence[float], height: float) -> FloatArray:
        """Rest of a vector, as strong as the data."""
        rest = np.array([*given[1:], *(0.0 for _ in self.names[5:])])
        rest[:2] += height
        if "strength" in self.names:
            whole = np.array([np.log(height), *rest])
            rest[4] += np.log(self.size / np.abs(self.predict(whole)[self.lags]).max())
        return rest


def parameter_slopes(
    vector: FloatArray, names: Sequence[str], strength: float, size: float
) -> FloatArray:
    """Derivatives of the parameters (rows) by the fit's vector."""
    slopes = np.eye(len(vector))
    slopes[0, 0] = np.exp(vector[0])
    for n, name in enumerate(names[5:], 5):
        slopes[n, n] = strength if name == "strength" else size
        if name == "strength":  # what is free is its product with the height
            slopes[n, 0] = -strength
    return slopes
