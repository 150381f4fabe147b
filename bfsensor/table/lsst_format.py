r"""Export of tables as LSST's calibration products: brighter-fatter kernels, distortion matrices.

The mean shifts of all edges by one electron (:mod:`bfsensor.table.quadrant_shifts`) become a
distortion matrix; their divergence, the a-matrix, becomes a kernel.  Arrays of lags are
[j, i] here and [i][j] in the files; :mod:`bfsensor.recording.tables.lsst_datasets` transposes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import dstn, idstn

from bfsensor.errors import TableError
from bfsensor.measure.bartlett import unfold
from bfsensor.recording.tables.lsst_datasets import BrighterFatterKernel, DistortionMatrix
from bfsensor.table.quadrant_shifts import QuadrantShifts
from bfsensor.typing import FloatArray

_POSITIVE = 0.025
"""Largest positive value of a valid kernel, relative to the size of its negative centre.

Published: the limit in LSST's cp_pipe.  It decides the column VALID only."""


def solve_kernel(areas: ArrayLike, *, zero_sum: bool = False) -> FloatArray:
    r"""Solve :math:`\nabla^2 K = -a` for the scalar kernel, zero at its border.

    The Laplacian is the five-point one, whose eigenvectors are sines: their transforms solve its system.

    Parameters
    ----------
    areas : array_like, shape (n, n)
        Relative area changes a_ij [1/e-] by lag [j, i] from (0, 0); to lowest order the
        covariances of flats without shot noise are :math:`C_{ij} = a_{ij} \mu^2`.
    zero_sum : bool
        First subtract from a_00 the sum over all lags of all four quadrants, so that no charge
        crosses the border.

    Returns
    -------
    kernel : ndarray, shape (2 n + 1, 2 n + 1)
        Kernel [pixel^2/e-], ``[j, i]``, lag (0, 0) in the middle.

    Raises
    ------
    TableError
        ``areas`` is not a square array of finite numbers.

    References
    ----------
    Coulton et al. 2018, AJ 155, 258, section 3.

    Examples
    --------
    >>> a = np.array([[-4e-7, 1e-7], [1e-7, 0.0]])
    >>> round(float(solve_kernel(a)[2, 2] * 1e7), 6)
    -1.0
    """
    a = np.array(areas, float)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or not np.all(np.isfinite(a)):
        raise TableError(f"areas of shape {a.shape} must be (n, n) and finite")
    whole = unfold(a)
    n = len(whole)
    if zero_sum:
        whole[n // 2, n // 2] -= whole.sum()
    second = -4 * np.sin(0.5 * np.pi * np.arange(1, n + 1) / (n + 1)) ** 2
    amplitudes = dstn(-whole, type=1) / (second[:, None] + second)
    return np.pad(idstn(amplitudes, type=1), 1)


def make_kernel(
    shifts: QuadrantShifts,
    gains: Mapping[str, float],
    *,
    noises: Mapping[str, float] | None = None,
    zero_sum: bool = False,
    meta: Mapping[str, Any] | None = None,
) -> BrighterFatterKernel:
    """Make LSST's BrighterFatterKernel, with the same kernel for every amplifier.

    Parameters
    ----------
    shifts : QuadrantShifts
        Shifts from :func:`bfsensor.table.quadrant_shifts.quadrant_shifts`.
    gains : mapping of str to float
        Gain [e-/ADU] by name of the amplifier, above 0.
    noises : mapping of str to float, optional
        Read noise [e-] by name of the amplifier; nan where not given.
    zero_sum : bool
        Whether the areas are made to add up to 0 first, as for :func:`solve_kernel`.
    meta : mapping, optional
        Further header keywords, such as ``INSTRUME`` and ``DETECTOR``.

    Returns
    -------
    BrighterFatterKernel
        Its column ``MEAN_XCORRS`` holds -a_ij within a rim of zeros.  No flats were measured: one
        masked pair of nan takes their place.  ``VALID`` is 1 if the kernel is lowest at its
        centre and nowhere above 0.025 times the size of that value.

    Raises
    ------
    TableError
        No amplifier, or a gain that is not above 0 and finite.

    Examples
    --------
    >>> shifts = QuadrantShifts(np.full((2, 2), -1e-7), np.full((2, 2), -1e-7))
    >>> make_kernel(shifts, {"C00": 1.6}).columns["KERNEL"].shape
    (1, 5, 5)
    """
    count = _check_gains(gains)
    areas = shifts.areas
    kernel = solve_kernel(areas, zero_sum=zero_sum)
    source = unfold(-areas)
    if zero_sum:
        source[len(areas) - 1, len(areas) - 1] -= source.sum()
    centre = kernel.min()
    middle = len(kernel) // 2
    valid = centre == kernel[middle, middle] and kernel.max() <= _POSITIVE * abs(centre)
    noise = [float((noises or {}).get(name, np.nan)) for name in gains]
    columns = {
        "AMPLIFIER": np.array(list(gains)),
        "EXP_ID_MASK": np.zeros((count, 1), bool),
        "RAW_MEANS": np.full((count, 1), np.nan),
        "RAW_VARIANCES": np.full((count, 1), np.nan),
        "RAW_XCORRS": np.full((count, 1, *areas.shape), np.nan),
        "GAIN": np.array(list(gains.values()), float),
        "NOISE": np.array(noise),
        "MEAN_XCORRS": np.repeat(np.pad(source, 1)[None], count, axis=0),
        "KERNEL": np.repeat(kernel[None], count, axis=0),
        "VALID": np.full(count, int(valid)),
    }
    return BrighterFatterKernel(columns, {"LEVEL": "AMP", **(meta or {})})


def make_distortion_matrix(
    shifts: QuadrantShifts,
    gains: Mapping[str, float],
    *,
    filters: Mapping[str, QuadrantShifts] | None = None,
    thickness: float = float("nan"),
    pitch: float = float("nan"),
    meta: Mapping[str, Any] | None = None,
) -> DistortionMatrix:
    """Make LSST's ElectrostaticBrighterFatterDistortionMatrix, one for the detector.

    Parameters
    ----------
    shifts : QuadrantShifts
        Shifts from :func:`bfsensor.table.quadrant_shifts.quadrant_shifts` for light that converts
        at the back surface.
    gains : mapping of str to float
        Gain [e-/ADU] by name of the amplifier, above 0.
    filters : mapping of str to QuadrantShifts, optional
        Shifts for the light of each physical filter, by the pipeline's name of the filter.
        Without filters the version is 1.0, which has no such columns.
    thickness, pitch : float
        Thickness and pixel pitch of the sensor [um], stored as fixed parameters; nan: not known.
    meta : mapping, optional
        Further header keywords.

    Returns
    -------
    DistortionMatrix
        Shifts of the table.  Because nothing was fitted, ``thickness`` and ``pixelsize`` are the
        only parameters, both fixed; errors and chi-squares are nan, and so are ``ATH`` and
        ``ATH_MINUS_BETA``, whose meaning the pipeline does not document.

    Raises
    ------
    TableError
        No amplifier, a gain that is not above 0 and finite, or shifts of different shapes.

    Examples
    --------
    >>> shifts = QuadrantShifts(np.full((2, 2), -1e-7), np.full((2, 2), -1e-7))
    >>> found = make_distortion_matrix(shifts, {"C00": 1.6}, filters={"y_10": shifts})
    >>> found.columns["A_N_BY_FILTER"].shape
    (1, 1, 2, 2)
    """
    _check_gains(gains)
    bands = dict(filters or {})
    for name, band in bands.items():
        if band.north.shape != shifts.north.shape:
            raise TableError(
                f"shifts of {name} have the shape {band.north.shape}, not "
                f"{shifts.north.shape}"
            )
    n = len(shifts.north)
    areas = shifts.areas
    nothing = np.full((1, n, n), np.nan)
    columns: dict[str, Any] = {
        "AMPNAMES": [list(gains)], "INPUT_RANGE": [n], "FIT_RANGE": [n], "BAD_AMPS": [[""]],
        "GAIN": [list(gains.values())], "A_MATRIX": areas[None],
        "A_MATRIX_SIGMA": nothing, "A_MATRIX_MODEL": areas[None],
        "A_MATRIX_SUM": [unfold(areas).sum()], "A_MATRIX_MODEL_SUM": [unfold(areas).sum()],
        "MODEL_NORMALIZATION": [[1.0, 0.0]], "USED_PIXELS": np.zeros((1, n, n), bool),
        "FIT_PARAM_NAMES": [["thickness", "pixelsize"]], "FREE_FIT_PARAM_NAMES": [[""]],
        "FIT_PARAMS": [[thickness, pitch]], "FIT_PARAM_ERRORS": [[np.nan, np.nan]],
        "FIT_CHI2": [np.nan], "FIT_REDUCED_CHI2": [np.nan],
        "FIT_PARAM_COV_MATRIX": [[np.nan]], "ATH": nothing, "ATH_MINUS_BETA": nothing,
    }  # fmt: skip
    sides = {"N": "north", "S": "south", "E": "east", "W": "west"}
    columns |= {f"A_{k}": getattr(shifts, side)[None] for k, side in sides.items()}
    if bands:
        count = len(bands)
        columns["AVAILABLE_FILTERS"] = [list(bands)]
        columns["A_MATRIX_MODEL_BY_FILTER"] = [[band.areas for band in bands.values()]]
        for name in ("ATH_BY_FILTER", "ATH_MINUS_BETA_BY_FILTER"):
            columns[name] = np.repeat(nothing[:, None], count, axis=1)
        for k, side in sides.items():
            columns[f"A_{k}_BY_FILTER"] = [[getattr(b, side) for b in bands.values()]]
    arrays = {name: np.array(column) for name, column in columns.items()}
    version = DistortionMatrix.VERSION if bands else 1.0
    cards = {f"{DistortionMatrix.OBSTYPE}_VERSION": version}
    cards |= {"INPUT_RANGE": n, "FIT_RANGE": n, **(meta or {})}
    return DistortionMatrix(arrays, cards)


def _check_gains(gains: Mapping[str, float]) -> int:
    """Number of amplifiers; refuses none, and gains that are not above 0."""
    if not gains:
        raise TableError("a dataset needs at least one amplifier with its gain")
    for name, gain in gains.items():
        if not 0 < gain < np.inf:
            raise TableError(f"gain of {name} = {gain} e-/ADU must be above 0 and finite")
    return len(gains)
