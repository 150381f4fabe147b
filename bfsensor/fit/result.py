"""Result of a fit: parameters with errors, data and predictions, degeneracies; its file fit.json."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.device import Device
from bfsensor.device.quantities import ABSORPTION, DIFFUSION, Quantity, describe, quantities
from bfsensor.errors import FitError
from bfsensor.files import written_whole
from bfsensor.fit.degeneracies import name_combination
from bfsensor.inference.profile_bounds import LEVELS, profile_bounds
from bfsensor.typing import FloatArray

SCHEMA = "bfsensor device fit 1"
"""Schema in fit.json; files of another one are refused."""

WELL_KNOWN = 0.5
"""Ratio of posterior to prior width below which a combination of parameters is printed.

Chosen: fit.json holds all combinations; twice as large, all of them are printed."""


_OFF_DEVICE = {
    DIFFUSION: "diffusion over Einstein's",
    ABSORPTION: "absorption length over silicon's",
}
"""Words for free parameters that are no quantity of a device file, as tables print them."""


@dataclass(frozen=True, eq=False)
class FittedSet:
    """One data set with its predictions before and after the fit.

    Parameters
    ----------
    name, kind, unit : str
        Name of the set, its kind, and the unit of its numbers.
    fitted : bool
        False: the set was only compared with the fit.
    labels : tuple of str, length n
        Label of each number: its lag, or its axis and condition.
    places : ndarray of int, shape (n, 2)
        Lags (i, j) of areas; axis (0: x, 1: y) of slopes in the first column.
    values, errors : ndarray, shape (n,)
        Measured numbers and their errors as stated.
    before, after : ndarray, shape (n,)
        Predictions at the means of the priors, which are the values of the device file unless
        others were given, and at the fitted values.
    after_error : ndarray, shape (n,)
        Posterior error of the prediction.
    chi2, chi2_before : float
        Chi-square after and before the fit, with the errors as stated.
    scale, scale_error : float
        Factor on the errors and its error, nan if the factor was not fitted.
    determined : float
        Number of parameters that the set determines.

    Examples
    --------
    >>> from bfsensor.device.shipped import tables_dir
    >>> one = FitResult.read(tables_dir() / "itl_sta3800c_2019" / "fit.json").sets[0]
    >>> one.kind, one.unit, one.pulls.shape == one.values.shape
    ('areas', '1 / electron', True)
    """

    name: str
    kind: str
    unit: str
    fitted: bool
    labels: tuple[str, ...]
    places: NDArray[np.int64]
    values: FloatArray
    errors: FloatArray
    before: FloatArray
    after: FloatArray
    after_error: FloatArray
    chi2: float
    chi2_before: float
    scale: float
    scale_error: float
    determined: float

    @property
    def pulls(self) -> FloatArray:
        """Predicted minus measured numbers over their scaled errors, shape (n,).

        For sets that were not fitted the errors include that of the prediction.
        """
        error = self.scale * self.errors
        if not self.fitted:
            error = np.hypot(error, self.after_error)
        return np.asarray((self.after - self.values) / error)


@dataclass(frozen=True, eq=False)
class FitResult:
    """Result of fitting a device to measurements; equal results hold the same numbers.

    Parameters
    ----------
    device, fitted_device : str
        Device files before and after the fit, as text.
    parameters : tuple of str, length p
        Dotted names of the free parameters.
    prior, spread : ndarray, shape (p,)
        Means and standard deviations of the Gaussian priors [internal units].
    value : ndarray, shape (p,)
        Fitted values, at the maximum of the posterior [internal units].
    covariance : ndarray, shape (p, p)
        Posterior second moments about the fitted values.
    sets : tuple of FittedSet
        Data sets with their predictions.
    remains : ndarray, shape (p,)
        Ratio of posterior to prior width of independent combinations of the parameters, the best
        constrained first.
    weights : ndarray, shape (p, p)
        Weights of the parameters in units of their prior widths, one combination a row.
    ties : tuple of str
        Groups of parameters whose effects on the data cannot be distinguished.
    silent : tuple of str
        Dotted names of parameters that the data do not constrain.
    profiles : mapping of str to (ndarray, ndarray)
        Values of a parameter [internal unit] and rise of the objective, for those asked for.
    notes : tuple of str
        Assumptions and limits.
    mesh : mapping
        For a fit with a finer mesh: cells per pixel of both meshes, ratios of their a_ij by condition
        (``[j, i]``) at the fit and at the priors, number of solutions, version; otherwise empty.
    posterior : mapping
        Origin of the errors: those of linear predictions alone; number of devices drawn and solved,
        and the rms error of predictions of each set there; if predictions are not linear, number,
        mean and central intervals of the draws, of the parameters [internal units] and, under
        'combinations', of the combinations above, relative to ``value`` in prior widths.

    Examples
    --------
    >>> from bfsensor.device.shipped import tables_dir
    >>> result = FitResult.read(tables_dir() / "itl_sta3800c_2019" / "fit.json")
    >>> len(result.parameters) == len(result.value) == len(result.error)
    True
    """

    device: str
    fitted_device: str
    parameters: tuple[str, ...]
    prior: FloatArray
    spread: FloatArray
    value: FloatArray
    covariance: FloatArray
    sets: tuple[FittedSet, ...]
    remains: FloatArray
    weights: FloatArray
    ties: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()
    profiles: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    mesh: Mapping[str, Any] = field(default_factory=dict)
    posterior: Mapping[str, Any] = field(default_factory=dict)

    @property
    def error(self) -> FloatArray:
        """Posterior errors of the parameters, all others being free [internal units], shape (p,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def pulls(self) -> FloatArray:
        """Difference of each fitted value from its prior mean, in prior widths, shape (p,)."""
        return np.asarray((self.value - self.prior) / self.spread)

    @property
    def chi2(self) -> float:
        """Chi-square of all fitted numbers with the errors as stated."""
        return float(sum(one.chi2 for one in self.sets if one.fitted))

    @property
    def n(self) -> int:
        """Number of fitted numbers."""
        return sum(len(one.values) for one in self.sets if one.fitted)

    def bounds(self) -> dict[str, dict[str, list[float | None]]]:
        """Give the 68 and 95 % bounds of the profiled parameters.

        Returns
        -------
        bounds : dict of str to dict
            By parameter and '68 %' or '95 %': lower and upper bound [internal units], None where
            the profile does not rise far enough.
        """
        return {
            name: {
                share: [end if np.isfinite(end) else None for end in found]
                for share, level in LEVELS.items()
                for found in [profile_bounds(values, rise, level)]
            }
            for name, (values, rise) in self.profiles.items()
        }

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, FitResult):
            return NotImplemented
        return json.dumps(self.to_dict()) == json.dumps(other.to_dict())

    __hash__ = None  # type: ignore[assignment]

    def to_dict(self) -> dict[str, Any]:
        """Give the result as lists, numbers and texts, as fit.json holds it.

        Returns
        -------
        fields : dict
            Fields by name, with 'schema', 'chi2', 'n' and 'profile_bounds'.
        """
        out: dict[str, Any] = {"schema": SCHEMA, "chi2": self.chi2, "n": self.n}
        for spec in dataclasses.fields(self):
            value = getattr(self, spec.name)
            if spec.name == "sets":
                value = [
                    {f.name: _plain(getattr(one, f.name)) for f in dataclasses.fields(one)}
                    for one in value
                ]
            elif spec.name == "profiles":
                out["profile_bounds"] = _plain(self.bounds())
                value = {k: [_plain(a) for a in both] for k, both in value.items()}
            out[spec.name] = _plain(value)
        return out

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the result as JSON, replacing an existing file.

        Parameters
        ----------
        path : str or path-like
            File to write.

        Raises
        ------
        FitError
            The file cannot be written.
        """
        text = json.dumps(self.to_dict(), indent=1)
        with written_whole(path, FitError) as beside:
            beside.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> FitResult:
        """Read a file of :meth:`write`.

        Parameters
        ----------
        path : str or path-like
            File to read.

        Returns
        -------
        result : FitResult
            Equal to the one that was written.

        Raises
        ------
        FitError
            The file is missing, damaged, or of another schema.
        """
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise FitError(f"{path}: cannot be read as JSON of a fit: {error}") from None
        found = data.get("schema") if isinstance(data, dict) else None
        if found != SCHEMA:
            raise FitError(f"{path}: its schema is {found!r}, not {SCHEMA!r}")
        try:
            # Files of earlier versions lack these fields.
            for later in ("mesh", "posterior"):
                data.setdefault(later, {})
            fields = {spec.name: data[spec.name] for spec in dataclasses.fields(cls)}
            fields["sets"] = tuple(FittedSet(**_arrays(one)) for one in fields["sets"])
            fields["profiles"] = {
                k: (np.array(v[0], float), np.array(v[1], float))
                for k, v in fields["profiles"].items()
            }
            return cls(**_arrays(fields))
        except (KeyError, TypeError, ValueError) as error:
            raise FitError(f"{path}: incomplete or damaged fit: {error!r}") from None

    def said(self) -> str:
        """Give the result as text for a terminal.

        Returns
        -------
        text : str
            Parameters, data sets, combinations and notes; the last line gives chi2/n.
        """
        return "\n".join([
            *self._parameter_lines(), *(line for one in self.sets for line in _lines(one)),
            *self._told(),
            f"chi2/n = {self.chi2:.1f}/{self.n} = {self.chi2 / self.n:.2f} with the stated errors",
        ])  # fmt: skip

    def _parameter_lines(self) -> list[str]:
        """Table of the parameters: prior, fitted value with error, pull."""
        known = quantities(Device.from_toml(self.device))
        rows = [("parameter", "prior", "fitted", "pull")]
        for k, name in enumerate(self.parameters):
            unit = known.get(name, Quantity(1.0, "number", "", 0.0, np.inf))
            rows.append(
                (
                    _OFF_DEVICE.get(name) or describe(name),
                    _with_error(unit, self.prior[k], self.spread[k]),
                    _with_error(unit, self.value[k], self.error[k]),
                    f"{self.pulls[k]:+.2f}",
                )
            )
        widths = [max(len(row[n]) for row in rows) for n in range(4)]
        return [
            "  ".join(text.ljust(w) for text, w in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]

    def _profile_lines(self) -> list[str]:
        """Bounds of each profile, followed by those of a Gaussian with the posterior error."""
        known, out = quantities(Device.from_toml(self.device)), []
        for name, both in self.bounds().items():
            k = self.parameters.index(name)
            unit = known.get(name, Quantity(1.0, "number", "", 0.0, np.inf))
            parts = []
            for share, ends in both.items():
                reach = np.sqrt(LEVELS[share]) * self.error[k]
                plain = [self.value[k] - reach, self.value[k] + reach]
                words = ["open" if end is None else unit.text(end) for end in ends]
                parts.append(
                    f"{share} {words[0]} to {words[1]} "
                    f"(+-: {unit.text(plain[0])} to {unit.text(plain[1])})"
                )
            out.append(f"profile of {describe(name)}: {'; '.join(parts)}")
        return out

    def _told(self) -> list[str]:
        """Well constrained combinations, profiles, degeneracies and notes."""
        drawn = self.posterior.get("combinations", {}).get("central_95")
        out = []
        for number, (part, weights) in enumerate(
            zip(self.remains, self.weights, strict=True)
        ):
            if part < WELL_KNOWN and len(self.parameters) > 1:
                name = name_combination(self.parameters, weights)
                ends = (
                    ""
                    if drawn is None
                    else "; 95 % of draws from {:+.2f} to {:+.2f}".format(*drawn[number])
                )
                out.append(f"measured to {part:.2f} of its prior width: {name}{ends}")
        out += self._profile_lines()
        out += [f"not distinguished by the data: {tie}" for tie in self.ties]
        if self.silent:
            out.append(
                f"not constrained by the data: {', '.join(describe(n) for n in self.silent)}"
            )
        return out + [f"note: {note}" for note in self.notes]


def _with_error(quantity: Quantity, value: float, error: float) -> str:
    """Format a value and its error, to two digits of the error, in the unit of device files.

    Examples
    --------
    >>> _with_error(Quantity(100.0, "length", "um", 5.0, 1e3), 101.234, 3.456)
    '101.2 +- 3.5 um'
    """
    number, uncertainty, unit = (
        quantity.number(value),
        quantity.number(error),
        quantity.unit,
    )
    power = int(np.floor(np.log10(abs(uncertainty)))) if uncertainty else 0
    large = max(abs(number), abs(uncertainty))
    scale = int(np.floor(np.log10(large))) if large else 0
    if -3 <= scale < 5:
        digits = max(1 - power, 0)
        return f"{number:.{digits}f} +- {uncertainty:.{digits}f} {unit}".rstrip()
    digits = max(scale - power + 1, 0)
    ten = 10.0**scale
    return f"({number / ten:.{digits}f} +- {uncertainty / ten:.{digits}f})e{scale} {unit}".rstrip()


def _lines(one: FittedSet) -> list[str]:
    """Lines of one data set: predicted over measured before and after, and pull of each number."""
    scale = f"errors scaled by {one.scale:.2f}"
    if np.isfinite(one.scale_error):
        scale += f" +- {one.scale_error:.2f}"
    head = (
        f"{one.name}: {len(one.values)} {one.kind}, chi2/n {one.chi2_before / len(one.values):.2f}"
        f" before, {one.chi2 / len(one.values):.2f} after, {scale}"
    )
    if not one.fitted:
        head += ", not fitted"
    width = max(8, *(len(label) for label in one.labels))
    out = [
        "",
        head,
        f"{'':{width}}  {'measured':>10} {'error':>9}  sim/meas before, after   pull",
    ]
    for n, label in enumerate(one.labels):
        out.append(
            f"{label:{width}}  {one.values[n]:10.4g} {one.errors[n]:9.2g}  "
            f"{one.before[n] / one.values[n]:15.3f} {one.after[n] / one.values[n]:7.3f} "
            f"{one.pulls[n]:+6.2f}"
        )
    return [*out, ""]


def _plain(value: Any) -> Any:
    """Lists and numbers for JSON."""
    if isinstance(value, np.ndarray):
        return [_plain(v) for v in value.tolist()]
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    # JSON has no nan.
    return None if isinstance(value, float) and not np.isfinite(value) else value


_TEXTS = ("labels", "parameters", "ties", "silent", "notes")
_FLOATS = (
    "values", "errors", "before", "after", "after_error", "prior", "spread", "value",
    "covariance", "remains", "weights",
)  # fmt: skip


def _arrays(fields: dict[str, Any]) -> dict[str, Any]:
    """Arrays and tuples of the fields of a file."""
    out = dict(fields)
    for name, value in fields.items():
        if name in _TEXTS:
            out[name] = tuple(str(v) for v in value)
        elif name in _FLOATS:
            out[name] = np.array(value, float)
        elif name == "places":
            out[name] = np.array(value, np.int64).reshape(-1, 2)
        elif value is None:
            out[name] = float("nan")
    return out
