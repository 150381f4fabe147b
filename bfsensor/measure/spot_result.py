"""Result of the forward model of a region's spots: widths, fluxes and centres, kept as ECSV."""

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
"""Reasons for which a spot is dropped; the first that holds is its status."""

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
        Correlation of x and y in the spot; 0 for axes along the pixels.
    covariance : ndarray, shape (3, 3)
        Covariance matrix of (sigma_x, sigma_y, correlation) from the noise of the pixels,
        valid for Gaussian spots; 0 for a correlation that was fixed.
    scatter_covariance : ndarray, shape (3, 3)
        The same matrix from the spots' scatter about the common shape, valid also for spots that
        are not Gaussian and for wrong variances; its relative error is
        :math:`1/\sqrt{2 n}`, nan with one spot.
    bias_x, bias_y : float
        Mean amount by which noise of the centres lowers the widths [pixel], already added to
        ``sigma_x`` and ``sigma_y``; 0 if ``correct_bias`` was False.
    chi2 : float
        Chi-square of the used spots by the variances of their pixels, for any weights, at the
        minimum over each spot's own parameters.
    dof : int
        Number of used pixels less free parameters.
    read_noise : float
        Read noise that the fit assumed [e-]; nan where variances were given.
    weights : str
        Weights of the pixels, ``noise`` or ``equal``.
    x, y : ndarray of int, shape (n,)
        Column and row of the stamps' central pixels.
    centre_x, centre_y, centre_x_error, centre_y_error : ndarray, shape (n,)
        Centres from the middle of the central pixel and their standard errors [pixel].
    flux, flux_error, background, background_error : ndarray, shape (n,)
        Electrons of the whole Gaussian [e-] and background per pixel [e-], with standard errors
        at the fitted shape; the error of a fixed background is 0.
    spot_chi2 : ndarray, shape (n,)
        Chi-square of each spot.
    spot_dof : ndarray of int, shape (n,)
        Number of used pixels less the spot's own free parameters.
    status : ndarray of str, shape (n,)
        ``used``, or the reason for which the spot was dropped, a key of `REASONS`.

    Examples
    --------
    :func:`fit_spots` makes one; its example shows widths and their error.
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
        """Standard error of sigma_x from the noise of the pixels [pixel]."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def sigma_y_error(self) -> float:
        """Standard error of sigma_y from the noise of the pixels [pixel]."""
        return float(np.sqrt(self.covariance[1, 1]))

    @property
    def used(self) -> NDArray[np.bool_]:
        """Mask of the spots to which the shape is fitted, shape (n,)."""
        return np.asarray(self.status == "used")

    @property
    def dropped(self) -> dict[str, int]:
        """Number of dropped spots by reason."""
        return {reason: int(np.sum(self.status == reason)) for reason in REASONS}

    @property
    def shape(self) -> Shape:
        """Common shape of the spots: widths [pixel] and correlation."""
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
        """Signal of each spot's model in a pixel whose middle is the spot's centre [e-].

        The shape is (n,), and the background is not included.  The signal does not depend on the
        spot's position in its pixel.  It is the abscissa of the slopes that Lage et al. (2017)
        simulate: their amplitude integrated over the central pixel of a centred spot.
        """
        return self.flux * float(integrate_gaussian([0.0], [0.0], self.shape, 1)[0, 0, 0])

    @property
    def peak(self) -> float:
        """Mean of `peaks` of the used spots [e-], the abscissa of B-F slopes."""
        return float(np.mean(self.peaks[self.used]))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the fit as ECSV, a row for each spot, the common shape in the header.

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
        shared = {
            one.name: getattr(self, one.name)
            for one in fields(self)
            if one.name not in _UNITS
        }
        write_ecsv(path, SCHEMA, columns, shared, overwrite=overwrite)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> SpotFit:
        """Read a file that :meth:`write` made.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        fit : SpotFit
            Equal to the one that was written.

        Raises
        ------
        MeasurementError
            The file is missing, damaged or of another kind, or lacks a column.
        """
        header = [one.name for one in fields(cls) if one.name not in _UNITS]
        columns, shared = read_ecsv(path, SCHEMA, tuple(_UNITS), header)
        try:
            for name in ("covariance", "scatter_covariance"):
                shared[name] = np.array(shared[name], float).reshape(3, 3)
            return cls(**shared, **columns)
        except (TypeError, ValueError) as error:
            raise MeasurementError(f"{path}: its header is damaged: {error}") from None
