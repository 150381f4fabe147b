"""The full covariance model fitted to a curve: a, b, noise and gain with their errors."""

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
    """What a covariance curve says about a sensor and its readout.

    Attributes
    ----------
    a, c, noise : ndarray, shape (lags + 1, lags + 1)
        a_ij [1/e-], c_ij = a_ij b_ij [1/e-^2] and n_ij [e-^2], indexed [j, i].
    gain : float
        [e-/unit]; of a curve in electrons, what the assumed gain is to be multiplied by.
    matrix : ndarray, shape (3 n + 1, 3 n + 1)
        Covariance matrix of a, c, noise (n lags each, flattened as [j, i]) and gain; zero
        rows for what was held.
    held : tuple of str
        'c' and 'gain' where they were not free.
    chi2, dof : float, int
        Of the pairs used, each with its full error matrix.
    dropped : tuple of int
        Rows of the curve left out as outliers inside the range.
    level_range : tuple of float
        Lowest and highest level used [unit].
    range_reason : str
        'given', 'found', 'whole curve', or 'too few pairs to find it'.
    powers : int
        Highest power of the level in the model.
    unit, region : str
        As in the curve.
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
        """Errors of a [1/e-]."""
        return self._errors(0)

    @property
    def c_errors(self) -> FloatArray:
        """Errors of c [1/e-^2], zero where it was held."""
        return self._errors(1)

    @property
    def noise_errors(self) -> FloatArray:
        """Errors of the noise [e-^2]."""
        return self._errors(2)

    @property
    def gain_error(self) -> float:
        """Error of the gain [e-/unit], zero where it was held."""
        return float(np.sqrt(self.matrix[-1, -1]))

    @property
    def b(self) -> FloatArray:
        """Growth c / a of a with the level [1/e-]; means little where a is within its error of zero."""
        return np.asarray(
            np.divide(self.c, self.a, out=np.zeros_like(self.a), where=self.a != 0)
        )

    @property
    def sum_rule(self) -> tuple[float, float]:
        """Sum of a over the plane of the lags [1/e-] and its error.

        Charge is conserved, so the sum over all lags is zero; what lags beyond the largest
        hold is missing here, as is what a wrong gain does to a_00.
        """
        n = self.a.size
        weights = image_weights(self.a.shape[0] - 1).ravel()
        variance = weights @ self.matrix[:n, :n] @ weights
        return float(weights @ self.a.ravel()), float(np.sqrt(variance))

    @property
    def p_value(self) -> float:
        """Chance of a chi-square as large."""
        return float(chi2_distribution.sf(self.chi2, self.dof))

    def model(self, levels: ArrayLike) -> FloatArray:
        """Fitted covariances [unit^2] at levels [unit], shape (n, lags + 1, lags + 1)."""
        m = self.gain * np.atleast_1d(np.asarray(levels, float))
        return (expand(self.a, self.c, self.powers).at(m) + self.noise) / self.gain**2

    def write(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write as ECSV, a row for each lag (beside, then renamed)."""
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
        """Read what :meth:`write` wrote; names the file and what is missing in it."""
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

    The model is :func:`~bfsensor.measure.covariance_model.model_covariances`.  Every pair
    counts with the inverse of its full error matrix (Bartlett's, of the fitted
    covariances: weights from measured ones would favour pairs that came out low).  Start
    values come from a parabola for the variance and from C_ij against level squared.

    Parameters
    ----------
    curve : CovarianceCurve
        In electrons or ADU.
    lags : int, optional
        Largest lag fitted, that of the curve by default.  a beyond it is taken as zero.
    level_range : tuple of float, optional
        Lowest and highest level [unit].  By default the highest is found: from the lowest
        third on, pairs are added as long as a fit to those below predicts their nearest
        covariances, errors of that prediction included; three failures among five in a row
        end the range (:func:`~bfsensor.measure.covariance_solver.find_turnoff`).
    gain : float, optional
        Hold the gain at this value [e-/unit].
    constant_a : bool
        Hold b at zero: areas strictly proportional to charge.
    powers : int
        Highest power of the level in the model.  4 is the published equation: on 400 pairs
        of 1e6 pixels up to a_00 mu = -0.2 it moves b_00 by two standard deviations.
    outlier_chance : float
        Chance to lose any pair of a good curve: pairs whose chi-square exceeds that are
        dropped and listed.  Where the typical pair does not fit, the limit rises with it.

    Returns
    -------
    CovarianceFit

    Raises
    ------
    MeasurementError
        Too few pairs, more than a quarter of them outliers, or a fit that does not settle.

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
            f"{curve.unit} do not fix the model: at least {needed} levels are needed"
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
    """Fit, drop the pairs that do not belong, until none is left to drop."""
    n = (curve.lags + 1) ** 2
    limit = chi2_distribution.isf(chance / len(inside), n)
    typical = chi2_distribution.median(n)
    used = inside
    start = start_values(curve.select(inside), gain)
    # Gross outliers would bend the first fit towards themselves: it bounds their pull.
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
                "that the others follow: they are no outliers"
            )
        start = found
    raise MeasurementError("the set of outlier pairs does not settle in 10 rounds")
