r"""Brighter-fatter slopes: relative growth of spot widths with the charge in their peak."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2 as chi2_distribution

from bfsensor.errors import MeasurementError
from bfsensor.measure.ecsv import read_ecsv, same_fields, write_ecsv
from bfsensor.typing import FloatArray

UNIT_PEAK = 50_000.0
"""Electrons in the peak for which slopes are given [e-], as published by Lage et al. (2017)."""

SCHEMA = "bfsensor.BFSlope 1"
_UNITS = {"peak": "electron", "sigma": "pix", "error": "pix", "used": None}


@dataclass(frozen=True, eq=False)
class BFSlope:
    r"""The line :math:`\sigma = \sigma_0 (1 + s\, Q / 50\,000)` over its linear range.

    Parameters
    ----------
    slope, slope_error : float
        Slope s, in per cent of sigma_0 for 50,000 e- [%], and its standard error from the errors
        of the widths.
    range_error : float
        Error of the slope by the choice of the range [%]: rms change of the slope over shorter
        ranges, beyond the change that noise explains.
    sigma_0, sigma_0_error : float
        Width at a peak of 0 e- [pixel] and its standard error.
    rise, rise_error : float
        Growth for 50,000 e-, in per cent of a pixel [%], and its standard error.  Lage et al.
        (2017) print this number; their spots had 1 pixel before diffusion.
    chi2 : float
        Chi-square of the line within its range.
    dof : int
        Number of points within the range less 2.
    curvature : float
        Coefficient of a parabola in place of the line over its standard error; positive if it
        opens upwards; nan with fewer than four points.
    low, high : float
        Peaks of the first and last point in the range [e-].
    peak, sigma, error : ndarray, shape (n,)
        Peaks [e-], widths and errors of the widths [pixel] of all points, by rising peak.
    used : ndarray of bool, shape (n,)
        True for points in the range.

    Examples
    --------
    :func:`bf_slopes` makes one; its example shows slope and range.
    """

    slope: float
    slope_error: float
    range_error: float
    sigma_0: float
    sigma_0_error: float
    rise: float
    rise_error: float
    chi2: float
    dof: int
    curvature: float
    low: float
    high: float
    peak: FloatArray
    sigma: FloatArray
    error: FloatArray
    used: NDArray[np.bool_]

    @property
    def total_error(self) -> float:
        """Standard error of the slope with that of the range, added in quadrature [%]."""
        return float(np.hypot(self.slope_error, self.range_error))

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the slope as ECSV, a row for each point, the slope in the header.

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
        single = {
            one.name: getattr(self, one.name)
            for one in fields(self)
            if one.name not in _UNITS
        }
        write_ecsv(path, SCHEMA, columns, single, overwrite=overwrite)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> BFSlope:
        """Read a file that :meth:`write` made.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        slope : BFSlope
            Equal to the one that was written.

        Raises
        ------
        MeasurementError
            The file is missing, damaged or of another kind, or lacks a column.
        """
        header = [one.name for one in fields(cls) if one.name not in _UNITS]
        columns, single = read_ecsv(path, SCHEMA, tuple(_UNITS), header)
        return cls(**single, **columns)


class _SlopeLine(NamedTuple):
    """A fitted line: width at a peak of 0, growth per electron, covariance matrix, fit quality."""

    height: float
    growth: float
    covariance: FloatArray
    chi2: float
    curvature: float


def bf_slopes(
    peak: ArrayLike,
    sigma: ArrayLike,
    error: ArrayLike,
    *,
    peak_error: ArrayLike = 0.0,
    limits: tuple[float, float] | None = None,
    fewest: int = 5,
    probability: float = 0.01,
) -> BFSlope:
    r"""Fit the B-F slope of spot widths along one axis, over a linear range that is searched.

    Low peaks can be biased by residual offsets and noise, high ones by saturation.  The range is
    the run of neighbouring points, at least ``fewest``, that spans most electrons while two tests
    pass: (1) chi-square of a line is below the value that noise exceeds with the given
    probability; (2) a parabola is better than the line by no more than noise makes it with the
    same probability.  The second finds a gentle curvature that chi-square does not.  Where the
    range ends before the points do, one point more is left out, because curvature begins before a
    test finds it (in mocks this halves its bias of the slope, to a tenth of the error).

    Parameters
    ----------
    peak : array_like, shape (n,)
        Signal in the peak [e-], as :attr:`SpotFit.peak`: the fitted model, without background,
        in a pixel whose middle is the spot's centre.
    sigma : array_like, shape (n,)
        Rms widths along one axis [pixel].
    error : array_like, shape (n,) or (n, n)
        Standard errors of the widths [pixel], or their covariance matrix [pixel^2]: levels that
        share electrons, as in a simulation that adds charge step by step, are correlated.
    peak_error : array_like, shape (n,) or ()
        Standard errors of the peaks [e-], independent of one another.
    limits : tuple of float, optional
        Lowest and highest peak to use [e-]; the range is then given and not searched.
    fewest : int
        Smallest number of points of a range, 4 or more.
    probability : float
        Probability that noise alone fails one of the two tests, between 0 and 1.  A larger one
        finds gentler curvatures, and mistakes noise for curvature more often: at 0.05 one of 200
        linear series of ten points has no range at all.

    Returns
    -------
    found : BFSlope
        The slope with both errors, chi-square and range.

    Raises
    ------
    MeasurementError
        There are too few points, values are out of range, or no range is linear.

    Notes
    -----
    A curvature too small for the tests biases the slope, upwards if the widths rise faster at
    high peaks.  ``range_error`` estimates that: it is the root of the mean, over all runs that
    lack up to a third of the range's points, of the squared change of the slope less the part
    that noise explains, and 0 if that is negative.

    The slope is in per cent of sigma_0, not of a pixel.  The published simulation does not divide
    by sigma_0 and fits without weights; ``rise`` is in its unit.  If the abscissa were the mean
    signal of the central pixel of spots at random positions, it would be 8 % lower at a width of
    one pixel, and the slope 8 % larger.

    References
    ----------
    Lage, Bradshaw & Tyson 2017, section 2.1 and Fig. 2 (a).

    Examples
    --------
    >>> peak = np.linspace(10e3, 240e3, 24)
    >>> sigma = 1.02 * (1 + 0.0071 * peak / 50e3) + 0.004 * np.exp((peak - 220e3) / 10e3)
    >>> found = bf_slopes(peak, sigma, np.full(24, 1e-4))
    >>> print(f"{found.slope:.2f} {found.high / 1e3:.0f}")
    0.71 180
    """
    q, s, covariance, dq = _points(peak, sigma, error, peak_error)
    if fewest < 4:
        raise MeasurementError(f"fewest = {fewest} points must be 4 or more")
    if not 0 < probability < 1:
        raise MeasurementError(f"probability = {probability} must be between 0 and 1")
    if np.any(dq > 0):
        # An error of a peak acts through the growth, which the fit itself gives: the second
        # round corrects the first.
        for _ in range(2):
            line = _fit_line(q, s, covariance)
            whole = covariance + np.diag((line.growth * dq) ** 2)
        covariance = whole
    if limits is None:
        first, last = _find_range(q, s, covariance, fewest, probability)
    else:
        inside = np.nonzero((q >= limits[0]) & (q <= limits[1]))[0]
        if inside.size < fewest:
            raise MeasurementError(
                f"{inside.size} points from {limits[0]:g} to {limits[1]:g} e- are fewer "
                f"than fewest = {fewest}"
            )
        first, last = int(inside[0]), int(inside[-1]) + 1
    line = _fit_line(*_part(q, s, covariance, first, last))
    if not line.height > 0:
        raise MeasurementError(
            f"the line gives a width of {line.height:g} pixel at a peak of 0 e-, which must be "
            "above 0: give limits, or leave bad points out"
        )
    scale = 100 * UNIT_PEAK
    # Derivatives of growth / height by height and growth.
    by = np.array([-line.growth / line.height**2, 1 / line.height])
    used = np.zeros(len(q), bool)
    used[first:last] = True
    return BFSlope(
        slope=float(scale * line.growth / line.height),
        slope_error=float(scale * np.sqrt(by @ line.covariance @ by)),
        range_error=float(
            scale * _range_effect(q, s, covariance, first, last, fewest) / line.height
        ),
        sigma_0=line.height,
        sigma_0_error=float(np.sqrt(line.covariance[0, 0])),
        rise=float(scale * line.growth),
        rise_error=float(scale * np.sqrt(line.covariance[1, 1])),
        chi2=line.chi2,
        dof=last - first - 2,
        curvature=line.curvature,
        low=float(q[first]),
        high=float(q[last - 1]),
        peak=q,
        sigma=s,
        error=np.sqrt(np.diag(covariance)),
        used=used,
    )


def _points(
    peak: ArrayLike, sigma: ArrayLike, error: ArrayLike, peak_error: ArrayLike
) -> tuple[FloatArray, ...]:
    """Points by rising peak, with the covariance matrix of the widths and the peaks' errors."""
    q, s, e = (np.array(a, float) for a in (peak, sigma, error))
    if q.ndim != 1 or s.shape != q.shape or e.shape not in (q.shape, (q.size, q.size)):
        raise MeasurementError(
            f"peak, sigma and error have the shapes {q.shape}, {s.shape} and {e.shape}, "
            "not (n,), (n,) and (n,) or (n, n)"
        )
    dq = np.array(peak_error, float)
    if dq.shape not in ((), q.shape):
        raise MeasurementError(f"peak_error has the shape {dq.shape}, not {q.shape} or ()")
    dq = np.broadcast_to(dq, q.shape)
    for name, values in (("peak", q), ("sigma", s), ("error", e), ("peak_error", dq)):
        if not np.all(np.isfinite(values)):
            raise MeasurementError(f"{name} holds values that are not finite")
    if np.any(dq < 0):
        raise MeasurementError("peak_error must not be below 0 e-")
    order = np.argsort(q, kind="stable")
    q, s, dq = q[order], s[order], dq[order]
    if np.any(np.diff(q) <= 0):
        twice = q[1:][np.diff(q) <= 0][0]
        raise MeasurementError(f"two points have the same peak, {twice:g} e-")
    if e.ndim == 1:
        if not np.all(e > 0):
            raise MeasurementError(f"errors of the widths must be above 0, not {e.min():g}")
        return q, s, np.diag(e[order] ** 2), dq
    if not np.allclose(e, e.T, rtol=1e-6, atol=0) or np.linalg.eigvalsh(e)[0] <= 0:
        raise MeasurementError(
            "error, a covariance matrix, must be symmetric with eigenvalues above 0"
        )
    return q, s, e[np.ix_(order, order)], dq


def _part(
    q: FloatArray,
    s: FloatArray,
    covariance: FloatArray,
    first: int,
    last: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    return q[first:last], s[first:last], covariance[first:last, first:last]


def _fit_line(q: FloatArray, s: FloatArray, covariance: FloatArray) -> _SlopeLine:
    """Least-squares line with the covariance matrix, and the curvature of a parabola."""
    unit = UNIT_PEAK
    factor = cho_factor(covariance, lower=True)
    powers = np.vander(q / unit, 3, increasing=True)
    line = powers[:, :2]
    errors = np.linalg.inv(line.T @ cho_solve(factor, line))
    found = errors @ (line.T @ cho_solve(factor, s))
    rest = s - line @ found
    weighted = cho_solve(factor, rest)
    curvature = float("nan")
    if len(q) >= 4:
        # The part of the square that no line can describe.
        bent = powers[:, 2] - line @ (errors @ (line.T @ cho_solve(factor, powers[:, 2])))
        size = float(bent @ cho_solve(factor, bent))
        curvature = float(bent @ weighted) / np.sqrt(size)
    to_electrons = np.diag([1.0, 1 / unit])
    return _SlopeLine(
        float(found[0]),
        float(found[1] / unit),
        to_electrons @ errors @ to_electrons,
        float(rest @ weighted),
        curvature,
    )


def _find_range(
    q: FloatArray,
    s: FloatArray,
    covariance: FloatArray,
    fewest: int,
    probability: float,
) -> tuple[int, int]:
    """First and one past the last point of the widest range that passes both tests."""
    n = len(q)
    if n < fewest:
        raise MeasurementError(f"{n} points are fewer than fewest = {fewest}")
    runs = [(i, j) for i in range(n) for j in range(i + fewest, n + 1)]
    runs.sort(key=lambda run: q[run[0]] - q[run[1] - 1])
    bend = float(chi2_distribution.isf(probability, 1))
    for first, last in runs:
        line = _fit_line(*_part(q, s, covariance, first, last))
        highest = float(chi2_distribution.isf(probability, last - first - 2))
        if line.chi2 <= highest and line.curvature**2 <= bend:
            # Curvature begins before a test finds it: one point more is left out beside it.
            if last < n and last - first > fewest:
                last -= 1
            if first > 0 and last - first > fewest:
                first += 1
            return first, last
    raise MeasurementError(
        f"no {fewest} neighbouring points of {n} lie on a line within their errors "
        f"(probability {probability:g}); give limits, or leave a bad point out"
    )


def _range_effect(
    q: FloatArray,
    s: FloatArray,
    covariance: FloatArray,
    first: int,
    last: int,
    fewest: int,
) -> float:
    """Change of the growth [pixel/e-] over shorter ranges beyond what noise explains."""
    whole = _fit_line(*_part(q, s, covariance, first, last))
    least = max(fewest, int(np.ceil((last - first) * 2 / 3)))
    excess = []
    for i in range(first, last):
        for j in range(i + least, last + 1):
            if (i, j) != (first, last):
                part = _fit_line(*_part(q, s, covariance, i, j))
                # The estimate from a part less that from the whole has, for an efficient whole,
                # the difference of the two variances.
                noise = part.covariance[1, 1] - whole.covariance[1, 1]
                excess.append((part.growth - whole.growth) ** 2 - noise)
    return float(np.sqrt(max(np.mean(excess), 0.0))) if excess else 0.0
