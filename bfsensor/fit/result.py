"""The result of a fit: parameters with errors, data before and after, what is tied."""

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
from bfsensor.device.quantities import DIFFUSION, Quantity, describe, quantities
from bfsensor.errors import FitError
from bfsensor.files import written_whole
from bfsensor.fit.degeneracies import name_combination
from bfsensor.inference.profile_bounds import LEVELS, profile_bounds
from bfsensor.typing import FloatArray

SCHEMA = "bfsensor device fit 1"

WELL_KNOWN = 0.5
"""Posterior over prior width below which a combination is told on the terminal."""


@dataclass(frozen=True, eq=False)
class FittedSet:
    """One data set beside the device before and after the fit.

    Attributes
    ----------
    name, kind, unit : str
        Of the data.
    fitted : bool
        False: only held against the fit.
    labels : tuple of str, length n
        What each number is.
    places : ndarray of int, shape (n, 2)
        Lags (i, j) of areas, axes of slopes.
    values, errors : ndarray, shape (n,)
        As measured, errors as stated.
    before, after : ndarray, shape (n,)
        At the means of the priors, which are the values of the device file unless others were
        stated, and as fitted.
    after_error : ndarray, shape (n,)
        What the parameters' posterior leaves open of the prediction.
    chi2, chi2_before : float
        With the errors as stated.
    scale, scale_error : float
        By which errors are multiplied; nan as an error where it was held.
    determined : float
        Parameters that the set determines.
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
        """Predicted less measured, in scaled errors.

        Of numbers that were not fitted with the prediction's error besides.
        """
        error = self.scale * self.errors
        if not self.fitted:
            error = np.hypot(error, self.after_error)
        return np.asarray((self.after - self.values) / error)


@dataclass(frozen=True, eq=False)
class FitResult:
    """A device fitted to measurements.

    Attributes
    ----------
    device, fitted_device : str
        Device files before and after.
    parameters : tuple of str, length p
        Dotted names of what was free.
    prior, spread : ndarray, shape (p,)
        Gaussian priors [internal units].
    value : ndarray, shape (p,)
        Where the posterior is largest [internal units].
    covariance : ndarray, shape (p, p)
        Posterior, second moments about the values.
    sets : tuple of FittedSet
        The data.
    remains : ndarray, shape (p,)
        Posterior over prior width of independent combinations, the best known first.
    weights : ndarray, shape (p, p)
        Of the parameters in each combination, in units of their priors; one a row.
    ties, silent : tuple of str
        What the data cannot tell apart, and on what they are silent.
    profiles : mapping of str to (ndarray, ndarray)
        FloatArray and rise of the minimum, for those asked for.
    notes : tuple of str
        Assumptions and limits.
    mesh : mapping
        Of a fit carried to a finer mesh: cells a pixel of both, ratios of their a_ij by condition
        ([j, i]) where the fit ends and at the priors, solutions made, version; else empty.
    posterior : mapping
        How the errors were found: errors of the tangent alone; devices drawn and solved, and rms of
        what predictions of each set miss there; where predictions bend, number, mean and central
        intervals of the draws, of the parameters and ('combinations') of the combinations above, these
        as far from ``value`` in units of their priors.
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
        """Posterior errors of the parameters, others free [internal units]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def pulls(self) -> FloatArray:
        """Shift of each parameter from its prior, in spreads of the prior."""
        return np.asarray((self.value - self.prior) / self.spread)

    @property
    def chi2(self) -> float:
        """Of all fitted numbers with the errors as stated."""
        return float(sum(one.chi2 for one in self.sets if one.fitted))

    @property
    def n(self) -> int:
        """How many numbers were fitted."""
        return sum(len(one.values) for one in self.sets if one.fitted)

    def bounds(self) -> dict[str, dict[str, list[float | None]]]:
        """68 and 95 % bounds of the profiles [internal units]; None where they do not rise."""
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
        """Plain lists and numbers, as they are written."""
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
        """Write as JSON; raises FitError if that cannot be."""
        text = json.dumps(self.to_dict(), indent=1)
        with written_whole(path, FitError) as beside:
            beside.write_text(text + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> FitResult:
        """Read what :meth:`write` wrote; raises FitError for anything else."""
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise FitError(f"{path}: not readable as a fit: {error}") from None
        found = data.get("schema") if isinstance(data, dict) else None
        if found != SCHEMA:
            raise FitError(f"{path}: its schema is {found!r}, not {SCHEMA!r}")
        try:
            # Fits written before they were carried to finer meshes, and drawn from.
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
            raise FitError(f"{path}: not a whole fit: {error!r}") from None

    def said(self) -> str:
        """Write the fit as a table for a terminal; the last line gives chi2/n."""
        return "\n".join([
            *self._parameter_lines(), *(line for one in self.sets for line in _lines(one)),
            *self._told(),
            f"chi2/n = {self.chi2:.1f}/{self.n} = {self.chi2 / self.n:.2f} with the stated errors",
        ])  # fmt: skip

    def _parameter_lines(self) -> list[str]:
        known = quantities(Device.from_toml(self.device))
        rows = [("parameter", "prior", "fitted", "pull")]
        for k, name in enumerate(self.parameters):
            unit = known.get(name, Quantity(1.0, "number", "", 0.0, np.inf))
            rows.append(
                (
                    describe(name) if name != DIFFUSION else "diffusion over Einstein's",
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
        """Bounds of each profile beside those of its error."""
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
                out.append(f"measured to {part:.2f} of its prior: {name}{ends}")
        out += self._profile_lines()
        out += [f"not told apart: {tie}" for tie in self.ties]
        if self.silent:
            out.append(
                f"the data are silent on: {', '.join(describe(n) for n in self.silent)}"
            )
        return out + [f"note: {note}" for note in self.notes]


def _with_error(quantity: Quantity, value: float, error: float) -> str:
    """Value and error with two digits of the error, in the unit of device files.

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
    """Lines of one data set: sim/meas and pull of each number."""
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
    """Fields as they were before they were written."""
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
