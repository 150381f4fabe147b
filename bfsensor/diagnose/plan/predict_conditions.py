"""What an accepted model predicts for exposures that were not taken: asked for in text, kept as ECSV."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from bfsensor.diagnose.data.exposure_info import condition_at, numbers_of
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.diagnose.plan.forecast import Forecaster, say_condition
from bfsensor.diagnose.plan.planned_exposures import Forecast, Planned
from bfsensor.errors import DiagnosisError
from bfsensor.measure.ecsv import write_ecsv
from bfsensor.units import to_celsius, to_kelvin

SCHEMA = "bfsensor-predicted-1"

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
"""Quantities a condition may give: [e-], [s], [e-], [nm], [V], [C], the monitor's unit, exposures."""

SPOTS = ("sigma_x", "sigma_y", "flux")
UNITS = {"sigma_x": "pixel", "sigma_y": "pixel", "flux": "electron"}
WRITTEN = ("flat_mean", "flat_cov", "spot")


def read_conditions(texts: Sequence[str]) -> list[Planned]:
    """Read conditions of exposures, each a text such as ``level=40000,back_bias=-40`` or a file.

    A condition with ``flux`` (or ``kind=spot``) is one of spots, any other of a pair of flats; what is
    not given is as in the campaign.

    Parameters
    ----------
    texts : sequence of str
        Texts, or paths of ECSV files with a row for each condition and the same names as columns.

    Returns
    -------
    planned : list of Planned

    Raises
    ------
    DiagnosisError
        Names the text and what is wrong in it.

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
        table = Table.read(path, format="ascii.ecsv")
    except (OSError, ValueError) as error:
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
            raise DiagnosisError(f"{where}: {name} is none of kind, {', '.join(KEYS)}")
        try:
            values[name] = float(value)
        except (TypeError, ValueError):
            raise DiagnosisError(f"{where}: {name}={value} is not a number") from None
        if name in ("level", "seconds", "flux", "lamp", "count") and not values[name] > 0:
            raise DiagnosisError(f"{where}: {name}={value} must be above 0")
    kind = str(given.get("kind", "spot" if "flux" in values else "flat"))
    count = int(values.pop("count", 2 if kind == "flat" else 1))
    if kind not in ("flat", "spot"):
        raise DiagnosisError(f"{where}: kind={kind}: flat or spot")
    needed = ("level", "seconds") if kind == "flat" else ("flux", "seconds")
    if not any(name in values for name in needed):
        raise DiagnosisError(f"{where}: {kind}s need {' or '.join(needed)}")
    if "temperature" in values:
        values["temperature"] = to_kelvin(values["temperature"])
    return replace(Planned(kind, count), **values)


def refuse_unheld(planned: Sequence[Planned], baseline: Baseline) -> None:
    """Refuse conditions that a baseline has no boundary shifts for.

    Raises
    ------
    DiagnosisError
        Names the condition and those that are held.
    """
    for one in planned:
        condition = condition_at((one.wavelength, one.back_bias, one.temperature))
        if not baseline.at(condition)[1]:
            held = ", ".join(_told(*key) for key in baseline.edges)
            raise DiagnosisError(
                f"{say_condition(condition)}: the baseline {baseline.name} holds no boundary shifts "
                f"there; it holds {held}"
            )


def _told(wavelength: float, bias: float) -> str:
    parts = [f"{v:g} {u}" for v, u in ((wavelength, "nm"), (bias, "V")) if np.isfinite(v)]
    return " at ".join(parts) or "one condition for all"


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a model predicts for exposures that were not taken.

    Attributes
    ----------
    forecasts : tuple of (int, Forecast)
        Number of the condition, from 1, and one of its channels.
    fit : BaselineFit
        That the parameters come from.
    amplifiers : tuple of str
        Names.
    notes : tuple of str
        What was assumed.
    """

    forecasts: tuple[tuple[int, Forecast], ...]
    fit: BaselineFit
    amplifiers: tuple[str, ...]
    notes: tuple[str, ...] = ()

    def rows(self) -> list[dict[str, Any]]:
        """Give a row for each value.

        'error' is what the fitted parameters leave open, 'noise' what the exposures themselves
        would scatter by: a recording is to be held against both.
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
        """Write all rows as ECSV; an existing file is replaced."""
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
    "flux": ("electron", "of a spot"),
    "value": (None, "prediction, in the unit of its row"),
    "error": (None, "what the fitted parameters leave open, standard deviation"),
    "noise": (None, "scatter of such exposures, standard deviation"),
    "unit": (None, "of value, error and noise"),
}


def predict_conditions(
    predictor: Predictor, fit: BaselineFit, planned: Sequence[Planned]
) -> Prediction:
    """Predict means and covariances of flats and sizes of spots that were not taken.

    Errors are linear in the fit's parameters, all of its covariance included.

    Parameters
    ----------
    predictor, fit
        The accepted model: baseline and effects found.
    planned : sequence of Planned
        From :func:`read_conditions`.

    Returns
    -------
    Prediction

    Raises
    ------
    DiagnosisError
        A condition that the baseline does not hold, or whose light was never recorded.
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
                f"condition {number}: the campaign has no {one.kind}s to predict others from"
            )
        for f in found:
            if any(n.startswith("light ") for n in f.free):
                notes.append(
                    f"condition {number}: the light of {wavelength:g} nm is taken from "
                    "other voltages or temperatures"
                )
        if one.kind == "flat" and not any(f.channel.word == "flat_mean" for f in found):
            notes.append(
                f"condition {number}: no flat of {wavelength:g} nm was recorded, so the "
                "mean is the level asked for, at no known exposure time"
            )
        out += [(number, f) for f in found]
    return Prediction(
        tuple(out), fit, predictor.measured.amplifiers, tuple(dict.fromkeys(notes))
    )
