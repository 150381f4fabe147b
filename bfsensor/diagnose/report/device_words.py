"""Fitted quantities of the device, the one first that recordings place farthest from its file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2, norm

from bfsensor.device.quantities import describe
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.unknown_level import NAME as LEVEL
from bfsensor.diagnose.report.class_words import said_number, said_p
from bfsensor.effects.device_parameter import FARTHEST

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
    alone, alone_error : float
        Value by the recordings and the priors of all other quantities, within what it can be, and its
        standard error, in the unit of device files.
    at_end : bool
        Whether that value is an end of its range: the largest or smallest that the quantity can have,
        or FARTHEST uncertainties from the nominal one.
    gain : float
        Decrease of the chi-square at that value if the prior of this quantity is left out; for a
        device within its file at most a chi-square of one degree of freedom.
    p_value : float
        Probability that any of all quantities gains as much by chance (Bonferroni's bound).
    odds : float
        Odds that this quantity is anywhere within what it can be, at most
        :data:`~bfsensor.effects.device_parameter.FARTHEST` uncertainties off, against one within its
        uncertainty, all others within theirs.
    """

    name: str
    value: float
    error: float
    nominal: float
    unit: str
    pull: float
    pull_error: float
    alone: float
    alone_error: float
    at_end: bool
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
        # The prior is a datum with the residual ``pull`` and the leverage ``error**2``; a
        # parameter that the recordings do not constrain has the error of its prior.
        free = max(1 - error**2, 1e-9)
        middle, scatter = pull / free, error / np.sqrt(free)
        ends = np.array(baseline.bounds.get(name, (-np.inf, np.inf))) / width
        low, high = np.clip(ends, -FARTHEST, FARTHEST)
        alone = float(np.clip(middle, low, high))
        lost = ((alone - middle) / scatter) ** 2
        gain = max(pull**2 / free - lost, 0.0)
        inside = norm.cdf((high - middle) / scatter) - norm.cdf((low - middle) / scatter)
        within = norm.pdf(middle, scale=np.sqrt(1 + scatter**2))
        q = FittedQuantity(
            name=name, value=nominal + pull * width, error=error * width, nominal=nominal,
            unit=baseline.units.get(name, ""), pull=pull, pull_error=error,
            alone=_added(nominal, alone * width), alone_error=scatter * width,
            at_end=bool(alone != middle), gain=gain,
            p_value=min(1.0, len(pulls) * float(chi2.sf(gain, 1))),
            odds=float(inside / (high - low) / max(within, 1e-300)),
        )  # fmt: skip
        out.append(q)
    return sorted(out, key=lambda q: -q.gain)


def _added(nominal: float, change: float) -> float:
    """Changed value; 0, and not its round-off, where the change is all of it."""
    value = nominal + change
    return 0.0 if abs(value) < 1e-12 * abs(nominal) else value


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
        error = f" +- {said_number(first.alone_error, 2)}"
        value = (
            f"{_named(first.name)} is {said_number(first.alone)}"
            f"{'' if first.at_end else error}{unit} by the recordings"
            f"{', an end of what is taken as possible' if first.at_end else ''}, nominally "
            f"{said_number(first.nominal)}{unit}"
        )
    else:
        value = f"{first.name}, by {first.pull:+.1f} +- {first.pull_error:.1g} of its uncertainties"
    text = (
        f"Farthest from the device's file: {value}; that any of {len(found)} quantities is as far by "
        f"chance has probability {said_p(first.p_value)}."
    )
    if first.odds > 1:
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
