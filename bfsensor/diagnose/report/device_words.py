"""Fitted quantities of the device, the one first that recordings place farthest from its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from bfsensor.device.quantities import describe
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.unknown_level import NAME as LEVEL
from bfsensor.diagnose.report.class_words import said_number, said_p

SAID = 0.1
"""Probability, that any quantity is as far off by chance, below which the farthest one is stated in
words.  Chosen: one report in ten of a device within its file has the sentence; with 0.2, two."""

ALIKE = 4.0
"""Difference of the gains in chi-square of two quantities up to which recordings do not separate them.
Chosen: the better one is then at most 7.4 times as likely, exp(4 / 2); with 8, 55 times."""


@dataclass(frozen=True)
class FittedQuantity:
    """A quantity of the device as the recordings and its prior give it.

    Attributes
    ----------
    name : str
        Name of the parameter.
    value, error, nominal : float
        Fitted value, its standard error and the nominal value, in the unit of device files; nan for
        nominal values that are not known.
    unit : str
        The unit; '' where it is not known.
    pull, pull_error : float
        Fitted less nominal value, and its standard error, over the prior's width.
    gain : float
        Decrease of the chi-square if the prior of this quantity is left out:
        pull^2 / (1 - pull_error^2), which for a device within its file is a chi-square of one degree of
        freedom.
    p_value : float
        Probability that any of all quantities gains as much by chance (Bonferroni's bound).
    odds : float
        Odds that this quantity is anywhere within what it can be, against one within its
        uncertainty, all others within theirs; nan where its range is not bounded.
    """

    name: str
    value: float
    error: float
    nominal: float
    unit: str
    pull: float
    pull_error: float
    gain: float
    p_value: float
    odds: float

    def to_report(self) -> dict[str, Any]:
        """Make the entry of report.json; values that are not known are left out."""
        known = {
            k: v
            for k, v in vars(self).items()
            if not (isinstance(v, float) and np.isnan(v))
        }
        return known | {"name": self.name}


def fitted_quantities(fit: BaselineFit, baseline: Baseline) -> list[FittedQuantity]:
    """List the device's quantities by decreasing gain of leaving out their prior.

    Parameters
    ----------
    fit : BaselineFit
        Fit of the baseline.
    baseline : Baseline
        Its nominal values, spreads, ranges and units.

    Returns
    -------
    list of FittedQuantity
        Without parameters that are no quantities of the device: ``fit.unknown``, the flats' level.
    """
    errors = dict(zip(fit.names, fit.errors, strict=True))
    others = (*fit.unknown, LEVEL)
    pulls = {n: p for n, p in fit.pulls.items() if n not in others and n in baseline.spread}
    out = []
    for name, pull in pulls.items():
        width, error = baseline.spread[name], float(errors[f"device {name}"])
        nominal = baseline.nominal.get(name, np.nan)
        # A parameter that the recordings do not constrain has the error of its prior.
        free = max(1 - error**2, 1e-12)
        gain = pull**2 / free if error < 1 else 0.0
        low, high = baseline.bounds.get(name, (-np.inf, np.inf))
        range_ = (high - low) / width
        odds = np.sqrt(2 * np.pi / free) * np.exp(min(gain / 2, 500.0)) / range_
        q = FittedQuantity(
            name=name, value=nominal + pull * width, error=error * width, nominal=nominal,
            unit=baseline.units.get(name, ""), pull=pull, pull_error=error, gain=gain,
            p_value=min(1.0, len(pulls) * float(chi2.sf(gain, 1))),
            odds=float(odds) if np.isfinite(range_) else np.nan,
        )  # fmt: skip
        out.append(q)
    return sorted(out, key=lambda q: -q.gain)


def said_farthest(found: Sequence[FittedQuantity]) -> str:
    """State the quantity that is farthest from the device's file, if chance alone seldom does that.

    Parameters
    ----------
    found : sequence of FittedQuantity
        From :func:`fitted_quantities`.

    Returns
    -------
    str
        Sentences; '' where nothing is farther than :data:`SAID` allows.
    """
    if not found or found[0].p_value > SAID:
        return ""
    first = found[0]
    unit = f" {first.unit}" if first.unit else ""
    if np.isfinite(first.nominal):
        value = (
            f"{_named(first.name)} is {said_number(first.value)} +- "
            f"{said_number(first.error, 2)}{unit}, nominally {said_number(first.nominal)}{unit}, "
        )
    else:
        value = f"{first.name} is off by "
    text = (
        f"Farthest from the device's file: {value}{first.pull:+.1f} +- {first.pull_error:.1g} of its "
        f"uncertainties; that any of {len(found)} quantities is as far by chance has probability "
        f"{said_p(first.p_value)}."
    )
    if np.isfinite(first.odds) and first.odds > 1:
        text += (
            f" That it is anywhere within what it can be is {said_number(first.odds, 2)} times as "
            "likely as that all quantities are within their uncertainties."
        )
    alike = [q.name for q in found[1:] if q.p_value <= 1 and first.gain - q.gain < ALIKE]
    if alike:
        text += f" These recordings allow in its place: {', '.join(alike)}."
    return text


def _named(name: str) -> str:
    words = describe(name)
    return name if words == name else f"{words} ({name})"
