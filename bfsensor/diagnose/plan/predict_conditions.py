"""Predictions of an accepted model for exposures that were not taken: text or ECSV in, ECSV out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bfsensor.diagnose.data.exposure_info import condition_at, numbers_of
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.diagnose.plan.forecast import Forecaster, say_condition
from bfsensor.diagnose.plan.planned_exposures import Forecast, Planned
from bfsensor.errors import DiagnosisError
from bfsensor.measure.ecsv import write_ecsv
from bfsensor.text_files import UnreadableTextError, read_ecsv
from bfsensor.units import to_celsius, to_kelvin

SCHEMA = "bfsensor-predicted-1"
"""Name of the layout of predicted.ecsv, in its header."""

KEYS = (
    "level",
    "seconds",
    "flux",
    "wavelength",
    "back_bias",
    "temperature",
    "lamp",
    "count",
)
"""Names of a condition's quantities, in turn in e-, s, e-, nm, V, deg C, the lamp monitor's unit, and
number of exposures."""

SPOTS = ("sigma_x", "sigma_y", "flux")
"""Quantities of spots that are written."""

UNITS = {"sigma_x": "pixel", "sigma_y": "pixel", "flux": "electron"}
"""Their units."""

WRITTEN = ("flat_mean", "flat_cov", "spot")
"""Channels that are written."""


def read_conditions(texts: Sequence[str]) -> list[Planned]:
    """Read conditions of exposures, each a text such as ``level=40000,back_bias=-40`` or a file.

    A condition with ``flux`` (or ``kind=spot``) describes spots, any other a pair of flats; settings
    that are not given are the campaign's.

    Parameters
    ----------
    texts : sequence of str
        Texts of NAME=VALUE separated by commas, or paths of ECSV files with a row for each
        condition and the same names as columns.  Names: kind (flat or spot), level [e-], seconds
        [s], flux [e-], wavelength [nm], back_bias [V], temperature [deg C], lamp (the monitor's
        unit), count (exposures).

    Returns
    -------
    planned : list of Planned
        One for each condition, in order.

    Raises
    ------
    DiagnosisError
        A name or value is not allowed, or a file cannot be read; names the text and the fault.

    Examples
    --------
    >>> one, = read_conditions(["level=40000,wavelength=480"])
    >>> one.kind, one.count, one.level, one.wavelength
    ('flat', 2, 40000.0, 480.0)
    """
    out = []
    for text in texts:
        if text.endswith(".ecsv"):
            out += _of_file(text)
            continue
        given = {}
        for part in text.split(","):
            name, found, value = part.partition("=")
            if not found:
                raise DiagnosisError(f"condition {text!r}: {part!r} is not NAME=VALUE")
            given[name.strip()] = value.strip()
        out.append(_planned(given, f"condition {text!r}"))
    return out


def _of_file(path: str) -> list[Planned]:
    try:
        table = read_ecsv(path)
    except UnreadableTextError as error:
        raise DiagnosisError(f"{path}: not an ECSV table: {error}") from None
    return [
        _planned({n: row[n] for n in table.colnames if row[n] is not np.ma.masked},
                 f"{path}, row {k + 1}")
        for k, row in enumerate(table)
    ]  # fmt: skip


def _planned(given: Mapping[str, Any], where: str) -> Planned:
    values: dict[str, Any] = {}
    for name, value in given.items():
        if name == "kind":
            continue
        if name not in KEYS:
            raise DiagnosisError(f"{where}: {name} must be one of kind, {', '.join(KEYS)}")
        try:
            values[name] = float(value)
        except (TypeError, ValueError):
            values[name] = np.nan
        if not np.isfinite(values[name]):
            raise DiagnosisError(f"{where}: {name}={value} is not a finite number")
        if name in ("level", "seconds", "flux", "lamp", "count") and not values[name] > 0:
            raise DiagnosisError(f"{where}: {name}={value} must be above 0")
    kind = str(given.get("kind", "spot" if "flux" in values else "flat"))
    count = int(values.pop("count", 2 if kind == "flat" else 1))
    if kind not in ("flat", "spot"):
        raise DiagnosisError(f"{where}: kind={kind} must be flat or spot")
    needed = ("level", "seconds") if kind == "flat" else ("flux", "seconds")
    if not any(name in values for name in needed):
        raise DiagnosisError(f"{where}: {kind}s need {' or '.join(needed)}")
    if "temperature" in values:
        values["temperature"] = to_kelvin(values["temperature"])
    return replace(Planned(kind, count), **values)


def refuse_unheld(planned: Sequence[Planned], baseline: Baseline) -> None:
    """Refuse conditions for which a baseline has no boundary shifts.

    Parameters
    ----------
    planned : sequence of Planned
        Conditions to check.
    baseline : Baseline
        Baseline with the shifts.

    Raises
    ------
    DiagnosisError
        Names the condition, and those of the baseline.
    """
    for one in planned:
        condition = condition_at((one.wavelength, one.back_bias, one.temperature))
        if not baseline.at(condition)[1]:
            held = ", ".join(_told(*key) for key in baseline.edges)
            raise DiagnosisError(
                f"{say_condition(condition)}: the baseline {baseline.name} has no boundary shifts "
                f"there; it has them at {held}"
            )


def _told(wavelength: float, bias: float) -> str:
    parts = [f"{v:g} {u}" for v, u in ((wavelength, "nm"), (bias, "V")) if np.isfinite(v)]
    return " at ".join(parts) or "one condition for all"


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predictions of a model for exposures that were not taken.

    Attributes
    ----------
    forecasts : tuple of (int, Forecast)
        Number of the condition, from 1, and the forecast of one of its channels.
    fit : BaselineFit
        Fit of the model, with the covariance of its parameters.
    amplifiers : tuple of str
        Names of the amplifiers.
    notes : tuple of str
        Assumptions.

    Examples
    --------
    Predict a flat of 40,000 e- with the model of a diagnosis::

        result = diagnose(source, baseline)
        prediction = predict_conditions(*result.accepted, read_conditions(["level=40000"]))
        prediction.write("predicted.ecsv")
    """

    forecasts: tuple[tuple[int, Forecast], ...]
    fit: BaselineFit
    amplifiers: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def rows(self) -> list[dict[str, Any]]:
        """Make one row for each predicted value.

        'error' is the standard error by the fitted parameters, 'noise' the standard deviation by
        which such exposures scatter: compare a recording with both in quadrature.

        Returns
        -------
        list of dict
            Rows with the columns of the file that :meth:`write` writes.
        """
        out = []
        for number, one in self.forecasts:
            channel, x = one.channel, one.channel.axes
            errors = np.sqrt(np.clip(np.diag(one.covariance(self.fit)), 0.0, None))
            noise = channel.errors
            for k in range(len(channel)):
                what = str(x["what"][k]) if "what" in x else _WHAT[channel.word]
                if channel.word == "spot" and what not in SPOTS:
                    continue
                out.append({
                    "condition": number, "channel": channel.word, "what": what,
                    "amp": self.amplifiers[int(x["amp"][k])] if "amp" in x else "",
                    **{n: int(x[n][k]) if n in x else -1 for n in ("i", "j")},
                    **{n: float(x[n][k]) if n in x else np.nan
                       for n in ("wavelength", "back_bias", "time", "lamp", "level", "flux")},
                    "temperature": to_celsius(float(x["temperature"][k])),
                    "value": float(channel.values[k]), "error": float(errors[k]),
                    "noise": float(noise[k]), "unit": UNITS.get(what, channel.unit),
                })  # fmt: skip
        return out

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write all rows as an ECSV table; an existing file is replaced.

        Parameters
        ----------
        path : path-like
            File to write.

        Returns
        -------
        Path
            The same path.
        """
        rows = self.rows()
        columns = {
            name: ([r[name] for r in rows], unit, text)
            for name, (unit, text) in _COLUMNS.items()
        }
        gains = [
            float(v)
            for n, v in zip(self.fit.names, self.fit.values, strict=True)
            if n.startswith("gain ")
        ]
        meta = {"amplifiers": list(self.amplifiers), "gain_e_per_adu": gains,
                "notes": list(self.notes)}  # fmt: skip
        write_ecsv(path, SCHEMA, columns, meta, overwrite=True)
        return Path(path)


_WHAT = {"flat_mean": "mean", "flat_cov": "covariance"}
"""Quantity of each channel of flats."""

_COLUMNS: dict[str, tuple[str | None, str]] = {
    "condition": (None, "number of the condition asked for"),
    "channel": (None, "channel of the diagnosis"),
    "what": (None, "quantity"),
    "amp": (None, "amplifier"),
    "i": (None, "lag in x, -1: none"),
    "j": (None, "lag in y, -1: none"),
    "wavelength": ("nm", ""),
    "back_bias": ("V", ""),
    "temperature": ("deg_C", ""),
    "time": ("s", "exposure time"),
    "lamp": (None, "reading of the lamp monitor"),
    "level": (None, "mean of the flat [ADU] that covariances are for"),
    "flux": ("electron", "flux of a spot"),
    "value": (None, "prediction, in the unit of its row"),
    "error": (None, "standard error by the fitted parameters"),
    "noise": (None, "scatter of such exposures, standard deviation"),
    "unit": (None, "unit of value, error and noise"),
}
"""Unit and description of each column."""


def predict_conditions(
    predictor: Predictor, fit: BaselineFit, planned: Sequence[Planned]
) -> Prediction:
    """Predict means and covariances of flats, and widths and fluxes of spots, that were not taken.

    Errors are propagated from the full covariance of the fit's parameters to first order.

    Parameters
    ----------
    predictor : Predictor
        Accepted model, such as the first of ``Diagnosis.accepted``: baseline and effects found.
    fit : BaselineFit
        Its fit.
    planned : sequence of Planned
        Conditions, from :func:`read_conditions`.

    Returns
    -------
    Prediction
        Values with errors and noise.

    Raises
    ------
    DiagnosisError
        The baseline has no boundary shifts at a condition, or its light was not recorded.

    Examples
    --------
    Predict a spot of 5e5 e- with the model of a diagnosis::

        result = diagnose(source, baseline)
        prediction = predict_conditions(*result.accepted, read_conditions(["flux=5e5"]))
    """
    refuse_unheld(planned, predictor.baseline)
    forecaster = Forecaster(predictor, fit)
    notes: list[str] = []
    out: list[tuple[int, Forecast]] = []
    for number, one in enumerate(planned, 1):
        condition = forecaster.condition(one)
        wavelength, back_bias, temperature = numbers_of(condition)
        there = replace(
            one, wavelength=wavelength, back_bias=back_bias, temperature=temperature
        )
        refuse_unheld([there], predictor.baseline)
        found = [f for f in forecaster.forecasts([one]) if f.channel.word in WRITTEN]
        if not found:
            raise DiagnosisError(
                f"condition {number}: the campaign has no {one.kind}s that others could be predicted "
                "from"
            )
        for f in found:
            if any(n.startswith("light ") for n in f.free):
                notes.append(
                    f"condition {number}: the light at {wavelength:g} nm is taken from recordings at "
                    "other voltages or temperatures"
                )
        if one.kind == "flat" and not any(f.channel.word == "flat_mean" for f in found):
            notes.append(
                f"condition {number}: no flat at {wavelength:g} nm was recorded: covariances are for "
                "the level given, and no mean is predicted for an exposure time"
            )
        out += [(number, f) for f in found]
    return Prediction(
        tuple(out), fit, predictor.measured.amplifiers, tuple(dict.fromkeys(notes))
    )
