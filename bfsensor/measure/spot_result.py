"""What the forward model of a region's spots gives, in memory and as ECSV."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import MeasurementError
from bfsensor.measure.ecsv import read_ecsv, same_fields, write_ecsv
from bfsensor.measure.spot_model import Shape, integrate_gaussian
from bfsensor.typing import FloatArray

REASONS: Mapping[str, str] = {
    "masked": "too few good pixels, or a bad one in the 3 x 3 about the centre",
    "faint": "flux below 5 times its error",
    "centre": "centre too far from the brightest pixel",
    "chi2": "residuals far above those of the region's other spots",
    "width": "own widths far from those of the region's other spots",
    "diverged": "centre did not settle",
}
"""Why a spot was dropped, in the order in which the reasons are asked."""

SCHEMA = "bfsensor.SpotFit 1"
_UNITS = {
    "x": "pix",
    "y": "pix",
    "centre_x": "pix",
    "centre_y": "pix",
    "centre_x_error": "pix",
    "centre_y_error": "pix",
    "flux": "electron",
    "flux_error": "electron",
    "background": "electron",
    "background_error": "electron",
    "spot_chi2": None,
    "spot_dof": None,
    "status": None,
}


@dataclass(frozen=True, eq=False)
class SpotFit:
    r"""Sizes of the spots of one region, and each spot's own flux, centre and background.

    Parameters
    ----------
    sigma_x, sigma_y : float
        Rms widths of the Gaussian before its integration over pixels [pixel].
    correlation : float
        Of x and y in the spot; 0 for axes along the pixels.
    covariance : ndarray, shape (3, 3)
        Of (sigma_x, sigma_y, correlation), from the noise of the pixels if the spots are
        Gaussian; 0 where the correlation was fixed.
    scatter_covariance : ndarray, shape (3, 3)
        The same from the spots' scatter about the common shape: it holds for spots that
        are not Gaussian and for wrong variances; good to :math:`1/\sqrt{2 n}` of itself, nan
        with one spot.
    bias_x, bias_y : float
        What the noise of the centres takes from the widths on average, already added to
        ``sigma_x`` and ``sigma_y`` [pixel]; 0 if that was not wanted.
    chi2 : float
        Of the used spots by the variances of their pixels, whatever the weights, each spot's
        own parameters at their best.
    dof : int
        Used pixels less free parameters.
    read_noise : float
        As assumed [e-]; nan where variances were given.
    weights : str
        Of the pixels, ``noise`` or ``equal``.
    x, y : ndarray of int, shape (n,)
        Central pixels of the stamps.
    centre_x, centre_y, centre_x_error, centre_y_error : ndarray, shape (n,)
        From the middle of the central pixel [pixel].
    flux, flux_error, background, background_error : ndarray, shape (n,)
        All electrons of the Gaussian [e-]; background per pixel [e-], error 0 where fixed.
        Errors of single spots are those at the fitted shape.
    spot_chi2 : ndarray, shape (n,)
        Of each spot.
    spot_dof : ndarray of int, shape (n,)
        Used pixels less the spot's own free parameters.
    status : ndarray of str, shape (n,)
        ``used``, or why the spot was dropped: a key of `REASONS`.
    """

    sigma_x: float
    sigma_y: float
    correlation: float
    covariance: FloatArray
    scatter_covariance: FloatArray
    bias_x: float
    bias_y: float
    chi2: float
    dof: int
    read_noise: float
    weights: str
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    centre_x: FloatArray
    centre_y: FloatArray
    centre_x_error: FloatArray
    centre_y_error: FloatArray
    flux: FloatArray
    flux_error: FloatArray
    background: FloatArray
    background_error: FloatArray
    spot_chi2: FloatArray
    spot_dof: NDArray[np.int64]
    status: NDArray[np.str_]

    @property
    def sigma_x_error(self) -> float:
        """Error of sigma_x [pixel] from the noise of the pixels."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def sigma_y_error(self) -> float:
        """Error of sigma_y [pixel] from the noise of the pixels."""
        return float(np.sqrt(self.covariance[1, 1]))

    @property
    def used(self) -> NDArray[np.bool_]:
        """Which spots the shape is fitted to."""
        return np.asarray(self.status == "used")

    @property
    def dropped(self) -> dict[str, int]:
        """Number of dropped spots by reason."""
        return {reason: int(np.sum(self.status == reason)) for reason in REASONS}

    @property
    def shape(self) -> Shape:
        """The common shape."""
        return Shape(self.sigma_x, self.sigma_y, self.correlation)

    @property
    def tilt(self) -> float:
        """Angle of the long axis from x towards y [degree], -90 to 90; nan for a circle."""
        xx, yy = self.sigma_x**2, self.sigma_y**2
        xy = self.correlation * self.sigma_x * self.sigma_y
        if xx == yy and xy == 0:
            return float("nan")
        return float(np.degrees(0.5 * np.arctan2(2 * xy, xx - yy)))

    @cached_property
    def peaks(self) -> FloatArray:
        """Signal of each spot's model in a pixel at whose middle the spot stands [e-].

        Without background, shape (n,).  It does not depend on where in the pixel the spot
        fell, and is the abscissa of the slopes that Lage et al. (2017) simulate: their
        amplitude integrated over the central pixel of a centred spot.
        """
        return self.flux * float(integrate_gaussian([0.0], [0.0], self.shape, 1)[0, 0, 0])

    @property
    def peak(self) -> float:
        """Mean of `peaks` of the used spots [e-]: the abscissa of B-F slopes."""
        return float(np.mean(self.peaks[self.used]))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write as ECSV: one row a spot, what they share in the header.

        Raises
        ------
        MeasurementError
            The file exists and ``overwrite`` is not set, or it cannot be written.
        """
        columns = {name: (getattr(self, name), unit, "") for name, unit in _UNITS.items()}
        shared = {
            one.name: getattr(self, one.name)
            for one in fields(self)
            if one.name not in _UNITS
        }
        write_ecsv(path, SCHEMA, columns, shared, overwrite=overwrite)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> SpotFit:
        """Read what :meth:`write` wrote.

        Raises
        ------
        MeasurementError
            The file is missing, damaged or of another schema; names it.
        """
        header = [one.name for one in fields(cls) if one.name not in _UNITS]
        columns, shared = read_ecsv(path, SCHEMA, tuple(_UNITS), header)
        try:
            for name in ("covariance", "scatter_covariance"):
                shared[name] = np.array(shared[name], float).reshape(3, 3)
            return cls(**shared, **columns)
        except (TypeError, ValueError) as error:
            raise MeasurementError(f"{path}: damaged: {error}") from None
