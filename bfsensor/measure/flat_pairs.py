"""Covariances of one pair of flats, corrected for the biases of clipping and of local means."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation
from scipy.stats import norm

from bfsensor.errors import MeasurementError
from bfsensor.measure.arrays import to_floats
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.measure.ecsv import read_ecsv, same_fields, square_lags, write_ecsv
from bfsensor.measure.products import (
    box_edges,
    subtract_box_means,
    sum_products,
    undo_box_means,
    undo_clipping,
)
from bfsensor.typing import FloatArray

UNITS = ("electron", "adu")
SCHEMA = "bfsensor flat covariances"


@dataclass(frozen=True, eq=False)
class FlatCovariances:
    """Covariances of one pair of flats in one region.

    Attributes
    ----------
    covariances : ndarray, shape (lags + 1, lags + 1)
        ``covariances[j, i]``: C_ij of one flat [unit^2], lag i in x and j in y, the mean of
        the lags (i, j) and (i, -j).
    errors : ndarray, shape (lags + 1, lags + 1)
        Standard errors after Bartlett [unit^2]; :meth:`error_matrix` gives the correlations
        of the lags.
    pairs : ndarray of int, shape (lags + 1, lags + 1)
        Number of pairs of pixels at the lag (i, j), without those of (i, -j).
    level : float
        Mean level to which the covariances belong [unit], see :func:`flat_covariances`.
    means : tuple of float
        Mean of each flat [unit].
    pixels : int
        Number of pixels used.
    clipped : int
        Number of pixels left out as outliers, with the rings around them.
    unit : str
        'electron' or 'adu'.
    region : str
        Name of the amplifier or region.

    Examples
    --------
    >>> rng = np.random.default_rng(8231)
    >>> found = flat_covariances(*rng.poisson(1e4, size=(2, 200, 200)), lags=2)
    >>> found.covariances.shape, found.pixels
    ((3, 3), 40000)
    """

    covariances: FloatArray
    errors: FloatArray
    pairs: NDArray[np.int64]
    level: float
    means: tuple[float, float]
    pixels: int
    clipped: int = 0
    unit: str = "electron"
    region: str = ""

    def __post_init__(self) -> None:
        for name, kind in (("covariances", float), ("errors", float), ("pairs", np.int64)):
            array = np.array(getattr(self, name), dtype=kind)
            if array.ndim != 2 or array.shape[0] != array.shape[1]:
                raise MeasurementError(
                    f"{name} has the shape {array.shape}, not (lags + 1, lags + 1)"
                )
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not self.covariances.shape == self.errors.shape == self.pairs.shape:
            raise MeasurementError("covariances, errors and pairs differ in shape")
        if self.unit not in UNITS:
            raise MeasurementError(f"unit = {self.unit!r} is not one of {', '.join(UNITS)}")
        object.__setattr__(self, "means", (float(self.means[0]), float(self.means[1])))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]

    @property
    def lags(self) -> int:
        """Largest lag in x and in y [pixel]."""
        return self.covariances.shape[0] - 1

    @property
    def correlations(self) -> FloatArray:
        """C_ij / C_00, indexed [j, i] (Lage et al. 2017 call this the covariance)."""
        return np.asarray(self.covariances / self.covariances[0, 0])

    def error_matrix(self) -> FloatArray:
        """Compute the covariance matrix of the measured covariances.

        Returns
        -------
        matrix : ndarray, shape ((lags + 1)**2, (lags + 1)**2)
            Matrix after Bartlett (:func:`~bfsensor.measure.bartlett.bartlett_matrix`)
            [unit^4], with lags flattened as ``[j, i]``.
        """
        return bartlett_matrix(self.covariances, self.pairs)

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the covariances as ECSV, a row for each lag.

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
        j, i = np.indices(self.covariances.shape)
        columns = {
            "i": (i.ravel(), "pixel", "lag in x, serial"),
            "j": (j.ravel(), "pixel", "lag in y, parallel"),
            "covariance": (self.covariances.ravel(), f"{self.unit}2", "C_ij of one flat"),
            "error": (self.errors.ravel(), f"{self.unit}2", "1 sigma after Bartlett"),
            "pairs": (self.pairs.ravel(), None, "pairs of pixels at this lag"),
        }
        names = ("level", "means", "pixels", "clipped", "unit", "region")
        meta = {name: getattr(self, name) for name in names}
        write_ecsv(path, SCHEMA, columns, meta, overwrite=overwrite)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> FlatCovariances:
        """Read a file that :meth:`write` made.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        found : FlatCovariances
            Equal to the one that was written.

        Raises
        ------
        MeasurementError
            The file is missing, damaged or of another kind, or lacks a column.
        """
        columns, meta = read_ecsv(
            path, SCHEMA, ("i", "j", "covariance", "error", "pairs"),
            ("level", "means", "pixels", "clipped", "unit", "region"),
        )  # fmt: skip
        lags = square_lags(path, columns)
        return cls(lags["covariance"], lags["error"], lags["pairs"], **meta)


def flat_covariances(
    first: ArrayLike,
    second: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    lags: int = 8,
    clip: float = 5.0,
    grow: int = 1,
    box: int | None = 64,
    unit: str = "electron",
    region: str = "",
) -> FlatCovariances:
    r"""Measure the pixel covariances of a pair of flats.

    Each flat is divided by its mean before they are subtracted, so that a pattern that both share
    (illumination, pixel response) cancels also if the lamp drifted between them:

    .. math::
        d = w_1 F_1 - w_2 F_2, \quad w_k = 1 / m_k, \qquad
        C_{ij} = \langle d(x, y)\, d(x + i, y \pm j) \rangle / (w_1^2 + w_2^2).

    A covariance that is linear in the level is measured at the level
    :math:`\mu = (w_1^2 m_1 + w_2^2 m_2) / (w_1^2 + w_2^2)`, which is reported.

    Parameters
    ----------
    first, second : array_like, shape (ny, nx)
        Flats with bias subtracted [unit], axis 0 along y.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is bad in either flat.  Pixels that are not finite, or hidden in a
        masked array, are left out too.
    lags : int
        Largest lag in x and y [pixel], from 0 to below half the shorter side.
    clip : float
        Number of standard deviations of the difference beyond which a pixel is left out as an
        outlier; at least 3, or inf for no clipping.  The standard deviation is that of a
        Gaussian with the same median absolute deviation.  The part of a Gaussian that clipping
        removes is corrected for: 1.5e-5 of the variance at 5, 2.7e-2 at 3.
    grow : int
        Number of rings of pixels left out around an outlier, because a particle's track is
        wider than the part of it above the noise.
    box : int, optional
        Side of the boxes whose mean is subtracted from the difference [pixel], against changes
        of the illumination's shape, more than ``2 * lags``; None for one box, the whole
        region.  The mean of n pixels removes the n-th part of the sum of all covariances,
        2.4e-4 of it at 64, which is corrected for.
    unit : {'electron', 'adu'}
        Unit of the flats.
    region : str
        Name of the amplifier or region, for the result.

    Returns
    -------
    found : FlatCovariances
        Covariances with errors, level and numbers of pixels.

    Raises
    ------
    MeasurementError
        The flats differ in shape, have a mean that is not above 0, are too small for the lags,
        or are the same image; more than 5 % of the pixels differ by more than ``clip`` standard
        deviations, which is not Gaussian noise; or an argument is out of range.

    Notes
    -----
    The level varies across a region with the illumination; the covariances are those at
    the mean level up to a_00 mu (relative rms of the illumination)^2, 1e-4 for 3 % rms at
    a_00 mu = 0.1.  A Poisson variable's fourth cumulant adds 1 / (4 mu N) to the squared
    relative error of the variance: below 1e-3 of it above 500 e-.

    References
    ----------
    Antilogus et al. 2014, JINST 9, C03048; Astier et al. 2019, A&A 629, A36, section 4.

    Examples
    --------
    >>> rng = np.random.default_rng(8231)
    >>> flats = rng.poisson(1e4, size=(2, 400, 400))
    >>> found = flat_covariances(*flats, lags=2)
    >>> bool(abs(found.covariances[0, 0] / 1e4 - 1) < 0.02)
    True
    """
    a, b, good = _checked(first, second, mask, lags, clip, grow, box)
    before = int(good.sum())
    means = (float(a[good].mean()), float(b[good].mean()))
    for m in means:
        if not m > 0:
            raise MeasurementError(
                f"a flat has the mean {m:g} {unit}, which must be above 0: subtract the bias level "
                "only"
            )
    edges = box_edges(a.shape, box)
    # Outliers change the means and the scatter by which they are found: three rounds suffice.
    cut = np.inf
    for last in (False, False, False, True):
        difference = subtract_box_means(a / means[0] - b / means[1], good, edges)
        if last or not np.isfinite(clip):
            break
        # The median of |x| of a Gaussian that was cut at ``cut`` sigma in the round before.
        median = norm.ppf(0.5 + 0.25 * (2 * norm.cdf(cut) - 1))
        sigma = float(np.median(np.abs(difference[good]))) / median
        outliers = good & (np.abs(difference) > clip * sigma)
        if not outliers.any():
            break
        _check_outliers(int(outliers.sum()), before, clip)
        if grow:
            ring = np.ones((2 * grow + 1, 2 * grow + 1), bool)
            outliers = good & binary_dilation(outliers, ring)
        good, cut = good & ~outliers, clip
        means = (float(a[good].mean()), float(b[good].mean()))
    weights = means[0] ** -2, means[1] ** -2
    if not np.abs(difference).max() > 1e-12:
        raise MeasurementError("the flats do not differ: the same image twice, or no noise")
    products, pairs = sum_products(difference, good, lags)
    if pairs.min() < 100:
        raise MeasurementError(
            f"{int(good.sum())} good pixels of {a.shape} leave {int(pairs.min())} pairs at "
            f"a lag of {lags}; at least 100 are needed"
        )
    both = products[1] / np.maximum(pairs[1], 1)
    raw = 0.5 * (products[0] / pairs[0] + both) / sum(weights)
    covariances = undo_box_means(undo_clipping(raw, clip), int(good.sum()), edges)
    return FlatCovariances(
        covariances=covariances,
        errors=np.sqrt(np.diag(bartlett_matrix(covariances, pairs[0]))).reshape(raw.shape),
        pairs=pairs[0],
        level=(weights[0] * means[0] + weights[1] * means[1]) / sum(weights),
        means=means,
        pixels=int(good.sum()),
        clipped=before - int(good.sum()),
        unit=unit,
        region=region,
    )


def measure_regions(
    first: ArrayLike,
    second: ArrayLike,
    regions: Mapping[str, tuple[slice, slice]],
    *,
    mask: ArrayLike | None = None,
    **options: Any,
) -> dict[str, FlatCovariances]:
    """Measure the covariances of a pair of flats region by region, such as amplifiers.

    Parameters
    ----------
    first, second : array_like, shape (ny, nx)
        Flats, as :func:`flat_covariances` takes them.
    regions : mapping of str to (slice, slice)
        Rows and columns of each region, by its name.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel of the image is bad.
    **options
        Keyword arguments of :func:`flat_covariances`.

    Returns
    -------
    found : dict of str to FlatCovariances
        Covariances by the region's name.

    Raises
    ------
    MeasurementError
        A region leaves the image or cannot be measured; the message has its name.

    Examples
    --------
    >>> rng = np.random.default_rng(8232)
    >>> flats = rng.poisson(1e4, size=(2, 100, 200))
    >>> halves = {"left": np.s_[:, :100], "right": np.s_[:, 100:]}
    >>> sorted(measure_regions(*flats, halves, lags=1))
    ['left', 'right']
    """
    a, b = to_floats(first, "first flat"), to_floats(second, "second flat")
    bad = None if mask is None else np.asarray(mask)
    found = {}
    for name, at in regions.items():
        for part, size in zip(at, a.shape, strict=True):
            low, high, _ = part.indices(size)
            if not (low < high and (part.stop is None or part.stop <= size)):
                raise MeasurementError(
                    f"{name}: [{part.start}:{part.stop}] of {size} rows or columns leaves the "
                    "image or is empty"
                )
        try:
            found[name] = flat_covariances(
                a[at], b[at], mask=None if bad is None else bad[at], region=name, **options
            )
        except MeasurementError as error:
            raise MeasurementError(f"{name}: {error}") from None
    return found


def _check_outliers(outliers: int, pixels: int, clip: float) -> None:
    """Refuse to clip so many pixels that the clipping, not the noise, sets the variance."""
    if outliers > 0.05 * pixels:
        raise MeasurementError(
            f"{100 * outliers / pixels:.0f} % of the pixels differ by more than {clip:g} sigma, "
            "at most 5 % may: the flats are too coarsely quantised (noise below one step), or "
            "have structure that must be masked; clip=inf clips nothing"
        )


def _checked(
    first: ArrayLike, second: ArrayLike, mask: ArrayLike | None,
    lags: int, clip: float, grow: int, box: int | None,
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:  # fmt: skip
    """Check the arguments; flats as floats with bad pixels 0, and the good pixels."""
    a, b = to_floats(first, "first flat"), to_floats(second, "second flat")
    if a.ndim != 2 or a.shape != b.shape:
        raise MeasurementError(f"flats of shapes {a.shape} and {b.shape} are not a pair")
    if not (isinstance(lags, int | np.integer) and 0 <= lags < min(a.shape) / 2):
        raise MeasurementError(
            f"lags = {lags} must be from 0 to below half the shorter side of {a.shape}"
        )
    if not clip >= 3:
        raise MeasurementError(f"clip = {clip} must be at least 3 sigma, or inf for none")
    if grow < 0:
        raise MeasurementError(f"grow = {grow} must not be negative")
    if not isinstance(grow, int | np.integer):
        raise MeasurementError(f"grow = {grow} must be a whole number")
    if box is not None and not box > 2 * lags:
        raise MeasurementError(
            f"box = {box} pixels must be more than twice the largest lag, {lags}"
        )
    good = np.isfinite(a) & np.isfinite(b)
    if mask is not None:
        bad = np.asarray(mask)
        if bad.shape != a.shape or bad.dtype != bool:
            raise MeasurementError(
                f"mask of shape {bad.shape} and type {bad.dtype} must be bool, {a.shape}"
            )
        good &= ~bad
    if not good.any():
        raise MeasurementError("no pixel is finite in both flats and not masked")
    a[~good] = b[~good] = 0.0
    return a, b, good
