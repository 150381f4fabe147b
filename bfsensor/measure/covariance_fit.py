"""Fit of the full covariance model to a curve: a, b, noise and gain with their errors."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2 as chi2_distribution

from bfsensor.errors import MeasurementError
from bfsensor.measure.bartlett import image_weights
from bfsensor.measure.covariance_model import expand
from bfsensor.measure.covariance_solver import (
    CovarianceSolution,
    find_turnoff,
    solve,
    start_values,
)
from bfsensor.measure.curve import CovarianceCurve
from bfsensor.measure.ecsv import read_ecsv, same_fields, square_lags, write_ecsv
from bfsensor.typing import FloatArray

SCHEMA = "bfsensor covariance fit"
_MATRICES = ("a", "c", "noise")
_NAMES = (
    "gain", "held", "chi2", "dof", "dropped", "level_range", "range_reason", "powers",
    "unit", "region",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CovarianceFit:
    """Fitted parameters of the covariance model, with their covariance matrix.

    Attributes
    ----------
    a, c, noise : ndarray, shape (lags + 1, lags + 1)
        a_ij [1/e-], c_ij = a_ij b_ij [1/e-^2] and n_ij [e-^2], indexed [j, i].
    gain : float
        Gain [e-/unit]; for a curve in electrons the factor by which the assumed gain is to be
        multiplied.
    matrix : ndarray, shape (3 n + 1, 3 n + 1)
        Covariance matrix of a, c, noise (n lags each, flattened as [j, i]) and gain; rows and
        columns of parameters that were held are 0.
    held : tuple of str
        Parameters that were not free, among 'c' and 'gain'.
    chi2, dof : float, int
        Chi-square of the used pairs, each with its full error matrix, and degrees of freedom.
    dropped : tuple of int
        Rows of the curve inside the range that were left out as outliers.
    level_range : tuple of float
        Lowest and highest level used [unit].
    range_reason : str
        How the range was chosen: 'given', 'found', 'whole curve', or 'too few pairs to find it'.
    powers : int
        Highest power of the level in the model.
    unit, region : str
        Unit and name of the curve.

    Examples
    --------
    :func:`fit_covariances` makes one; its example shows ``a`` and ``gain``.
    """

    a: FloatArray
    c: FloatArray
    noise: FloatArray
    gain: float
    matrix: FloatArray
    held: tuple[str, ...]
    chi2: float
    dof: int
    dropped: tuple[int, ...]
    level_range: tuple[float, float]
    range_reason: str
    powers: int = 8
    unit: str = "electron"
    region: str = ""

    def __eq__(self, other: object) -> bool:
        return same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]

    def _errors(self, which: int) -> FloatArray:
        n = self.a.size
        variance = np.diag(self.matrix)[which * n : (which + 1) * n]
        return np.asarray(np.sqrt(variance).reshape(self.a.shape))

    @property
    def a_errors(self) -> FloatArray:
        """Standard errors of a as [j, i] [1/e-]."""
        return self._errors(0)

    @property
    def c_errors(self) -> FloatArray:
        """Standard errors of c as [j, i] [1/e-^2]; 0 where it was held."""
        return self._errors(1)

    @property
    def noise_errors(self) -> FloatArray:
        """Standard errors of the noise as [j, i] [e-^2]."""
        return self._errors(2)

    @property
    def gain_error(self) -> float:
        """Standard error of the gain [e-/unit]; 0 where it was held."""
        return float(np.sqrt(self.matrix[-1, -1]))

    @property
    def b(self) -> FloatArray:
        """Growth c / a of a with the level [1/e-]; not constrained where a is within its error of 0."""
        return np.asarray(
            np.divide(self.c, self.a, out=np.zeros_like(self.a), where=self.a != 0)
        )

    @property
    def sum_rule(self) -> tuple[float, float]:
        """Sum of a over the plane of the lags and its standard error [1/e-].

        Charge is conserved, so that the sum over all lags is 0.  This sum differs from 0 by the
        lags beyond the largest, and by the error of a_00 that a wrong gain makes.
        """
        n = self.a.size
        weights = image_weights(self.a.shape[0] - 1).ravel()
        variance = weights @ self.matrix[:n, :n] @ weights
        return float(weights @ self.a.ravel()), float(np.sqrt(variance))

    @property
    def p_value(self) -> float:
        """Probability of a chi-square at least as large, if the model is true."""
        return float(chi2_distribution.sf(self.chi2, self.dof))

    def model(self, levels: ArrayLike) -> FloatArray:
        """Evaluate the fitted model.

        Parameters
        ----------
        levels : array_like, shape (n,)
            Mean levels [unit].

        Returns
        -------
        covariances : ndarray, shape (n, lags + 1, lags + 1)
            C_ij of one flat [unit^2], indexed [pair, j, i].
        """
        m = self.gain * np.atleast_1d(np.asarray(levels, float))
        return (expand(self.a, self.c, self.powers).at(m) + self.noise) / self.gain**2

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the fit as ECSV, a row for each lag.

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
        j, i = np.indices(self.a.shape)
        n, units = self.a.size, ("1 / electron", "1 / electron2", "electron2")
        columns: dict[str, tuple[Any, str | None, str]] = {
            "i": (i.ravel(), "pixel", "lag in x, serial"),
            "j": (j.ravel(), "pixel", "lag in y, parallel"),
        }
        errors = (self.a_errors, self.c_errors, self.noise_errors)
        for name, unit, error in zip(_MATRICES, units, errors, strict=True):
            columns[name] = (getattr(self, name).ravel(), unit, "")
            columns[f"{name}_error"] = (error.ravel(), unit, "1 sigma")
        rows = self.matrix[: 3 * n].reshape(3, n, -1).transpose(1, 0, 2)
        columns["matrix"] = (rows, None, "rows of the covariance matrix of a, c, noise")
        meta = {name: getattr(self, name) for name in _NAMES}
        meta["gain_error"] = self.gain_error
        meta["gain_variance"] = float(self.matrix[-1, -1])
        meta["sum_of_a"], meta["sum_of_a_error"] = self.sum_rule
        write_ecsv(path, SCHEMA, columns, meta, overwrite=overwrite)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> CovarianceFit:
        """Read a file that :meth:`write` made.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        fit : CovarianceFit
            Equal to the one that was written.

        Raises
        ------
        MeasurementError
            The file is missing, damaged or of another kind, or lacks a column.
        """
        columns, meta = read_ecsv(
            path, SCHEMA, ("i", "j", *_MATRICES, "matrix"), (*_NAMES, "gain_variance")
        )
        lags = square_lags(path, columns)
        n = lags["a"].size
        rows = lags.pop("matrix").reshape(n, 3, -1).transpose(1, 0, 2)
        matrix = np.empty((3 * n + 1, 3 * n + 1))
        matrix[: 3 * n] = rows.reshape(3 * n, -1)
        matrix[-1, :-1] = matrix[:-1, -1]
        matrix[-1, -1] = meta.pop("gain_variance")
        for name in ("held", "dropped", "level_range"):
            meta[name] = tuple(meta[name])
        return cls(**lags, matrix=matrix, **meta)


def fit_covariances(
    curve: CovarianceCurve,
    *,
    lags: int | None = None,
    level_range: tuple[float, float] | None = None,
    gain: float | None = None,
    constant_a: bool = False,
    powers: int = 8,
    outlier_chance: float = 1e-3,
) -> CovarianceFit:
    """Fit a, b, noise and gain to covariances against level.

    The model is :func:`~bfsensor.measure.covariance_model.model_covariances`.  Every pair is
    weighted by the inverse of its full error matrix.  That is Bartlett's of the fitted
    covariances, because weights from measured ones would favour pairs that fluctuated low.
    Start values come from a parabola for the variance and from C_ij against level squared.

    Parameters
    ----------
    curve : CovarianceCurve
        Covariances in electrons or ADU.
    lags : int, optional
        Largest lag fitted, by default that of the curve; a is taken as 0 beyond it.
    level_range : tuple of float, optional
        Lowest and highest level [unit].  By default the highest is found: from the lowest
        third on, pairs are added as long as a fit to those below predicts their nearest
        covariances, errors of that prediction included; three failures among five in a row
        end the range (:func:`~bfsensor.measure.covariance_solver.find_turnoff`).
    gain : float, optional
        Value at which the gain is held [e-/unit], above 0; by default it is fitted.
    constant_a : bool
        Hold b at 0: changes of area are strictly proportional to charge.
    powers : int
        Highest power of the level in the model, 1 to 12.  4 is the published equation: on 400
        pairs of 1e6 pixels up to a_00 mu = -0.2 it moves b_00 by two standard deviations.
    outlier_chance : float
        Probability that any pair of a sound curve is dropped, between 0 and 1; pairs of larger
        chi-square are dropped and listed.  Where the median pair does not fit, the limit rises
        in proportion to its chi-square.

    Returns
    -------
    fit : CovarianceFit
        Parameters with their covariance matrix, chi-square and range.

    Raises
    ------
    MeasurementError
        An argument is out of range, the levels are too few, more than a quarter of the pairs
        are outliers, or the set of outliers does not settle.
    ConvergenceError
        The fit found no minimum.

    References
    ----------
    Astier et al. 2019, A&A 629, A36, sections 3 and 5.

    Examples
    --------
    >>> from bfsensor.measure.covariance_model import model_covariances
    >>> levels, a = np.linspace(5e3, 8e4, 12), np.array([[-1e-6, 2e-7], [2e-7, 5e-8]])
    >>> c = model_covariances(levels, a, noise=np.diag([25.0, 0.0]))
    >>> curve = CovarianceCurve.from_arrays(levels, c, pixels=250_000)
    >>> fit = fit_covariances(curve)
    >>> bool(np.allclose(fit.a, a, atol=1e-12)), round(fit.gain, 6)
    (True, 1.0)
    """
    if lags is not None and not 0 <= lags <= curve.lags:
        raise MeasurementError(f"lags = {lags} must be from 0 to {curve.lags}, the curve's")
    if gain is not None and not gain > 0:
        raise MeasurementError(f"gain = {gain} e-/{curve.unit} must be above 0")
    if not 0 < outlier_chance < 1:
        raise MeasurementError(f"outlier_chance = {outlier_chance} must be between 0 and 1")
    fitted = curve.select(lags=lags)
    needed = 2 + (not constant_a) + (gain is None)
    reason = "given"
    if level_range is None:
        high, reason = find_turnoff(fitted, gain=gain, constant_a=constant_a, powers=powers)
        level_range = (float(fitted.levels[0]), high)
    inside = np.flatnonzero(
        (fitted.levels >= level_range[0]) & (fitted.levels <= level_range[1])
    )
    if len(np.unique(fitted.levels[inside])) < needed:
        raise MeasurementError(
            f"{len(inside)} pairs from {level_range[0]:g} to {level_range[1]:g} "
            f"{curve.unit} have fewer than the {needed} levels that the model needs"
        )
    used, found = _fit_without_outliers(
        fitted, inside, gain=gain, constant_a=constant_a, powers=powers,
        chance=outlier_chance,
    )  # fmt: skip
    n = (fitted.lags + 1) ** 2
    return CovarianceFit(
        a=found.a, c=found.c, noise=found.noise, gain=found.gain, matrix=found.matrix,
        held=tuple(
            name
            for name, is_held in (("c", constant_a), ("gain", gain is not None))
            if is_held
        ),
        chi2=float(found.chi2.sum()),
        dof=len(used) * n - (3 - constant_a) * n - (gain is None),
        dropped=tuple(int(k) for k in np.setdiff1d(inside, used)),
        level_range=(float(fitted.levels[used[0]]), float(fitted.levels[used[-1]])),
        range_reason=reason, powers=powers, unit=curve.unit, region=curve.region,
    )  # fmt: skip


def _fit_without_outliers(
    curve: CovarianceCurve, inside: NDArray[np.intp], *, gain: float | None,
    constant_a: bool, powers: int, chance: float,
) -> tuple[NDArray[np.intp], CovarianceSolution]:  # fmt: skip
    """Fit and drop outliers in turn until none is left."""
    n = (curve.lags + 1) ** 2
    limit = chi2_distribution.isf(chance / len(inside), n)
    typical = chi2_distribution.median(n)
    used = inside
    start = start_values(curve.select(inside), gain)
    # Gross outliers would pull the first fit towards themselves: their weight is bounded there.
    bound: float | None = limit
    for _ in range(10):
        found = solve(
            curve.select(used), start, free_gain=gain is None, free_c=not constant_a,
            powers=powers, bound=bound,
        )  # fmt: skip
        scale = max(1.0, float(np.median(found.chi2)) / typical)
        good = found.chi2 <= limit * scale
        if good.all() and bound is None:
            return used, found
        bound = None
        used = used[good]
        if len(used) < 0.75 * len(inside):
            raise MeasurementError(
                f"{len(inside) - len(used)} of {len(inside)} pairs do not fit the model "
                "that the others follow, too many for outliers: give a level_range below "
                "saturation, or look at their flats"
            )
        start = found
    raise MeasurementError(
        "the set of outlier pairs does not settle in 10 rounds: leave doubtful pairs out, or give "
        "a smaller outlier_chance"
    )
