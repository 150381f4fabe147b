"""Scores of one report against its truth, the same for files and for trials in memory.

A truth is a dict as in truth.json; each of its ``effects`` may carry ``snr``, its projected SNR
alone, and the truth ``where`` (see :mod:`validation.concealed.conventions`) and ``tie_broken``
(whether the advised recording, taken, told the classes apart).  A report is report.json by its
contract.  What a truth has no answer for is None or nan and counts in no score.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from validation.concealed.conventions import (
    OUTSIDE,
    expected_location,
    is_class,
    reading_of,
)

SCHEMA = "bfsensor-diagnosis-1"
FLOOR = 1e-3
"""Probabilities below count as this: 6.9 nat at most for one campaign."""
HELD_OUT_VALUES = 1000
"""Held-out values of a campaign whose report does not say (``heldout.values``; S has 1428)."""
NAN = float("nan")

Truth = Mapping[str, Any]
Report = Mapping[str, Any]

_NEEDED: dict[str, type | tuple[type, ...]] = {
    "campaign": str, "detected": bool, "p_value": (int, float), "effects": list,
    "class_probability": dict, "equivalence_class": list, "open_world": bool,
    "location": dict, "recommended_recordings": list, "heldout": dict,
}  # fmt: skip
SCORED = ("schema", *_NEEDED, "version", "said")
"""Keys of a report that scores are made from, and what it says in words."""


def check_report(report: Any, name: str) -> None:
    """Refuse what is not a report by the contract.

    Raises
    ------
    ValueError
        Names the campaign and the first key that is missing or not as it must be.
    """
    if not isinstance(report, Mapping) or report.get("schema") != SCHEMA:
        given = report.get("schema") if isinstance(report, Mapping) else type(report)
        raise ValueError(f"{name}: report.json: schema = {given!r}, must be {SCHEMA!r}")
    for key, kind in _NEEDED.items():
        if key not in report:
            raise ValueError(f"{name}: report.json: no {key!r}")
        if not isinstance(report[key], kind):
            raise ValueError(
                f"{name}: report.json: {key} = {report[key]!r} is a "
                f"{type(report[key]).__name__}"
            )
    if not 0 <= report["p_value"] <= 1:
        raise ValueError(f"{name}: report.json: p_value = {report['p_value']!r}: 0 to 1")
    words = [e.get("class") for e in report["effects"]]
    for word in [*words, *report["class_probability"], *report["equivalence_class"]]:
        if not isinstance(word, str) or not is_class(word):
            raise ValueError(f"{name}: report.json: class {word!r} is not in the taxonomy")


def kind_of(truth: Truth) -> str:
    """Return 'null', 'single', 'several', or 'outside' where any effect is foreign."""
    words = [e["class"] for e in truth["effects"]]
    if OUTSIDE in words:
        return "outside"
    return ("null", "single")[len(words)] if len(words) < 2 else "several"


def named(report: Report) -> tuple[str, ...]:
    """Return the classes that a report claims, first named first; none without a detection."""
    if not report["detected"]:
        return ()
    return tuple(dict.fromkeys(e["class"] for e in report["effects"]))


def said_outside(report: Report) -> bool:
    """Whether a report says that nothing in the library explains what it found."""
    return report["detected"] and (report["open_world"] or OUTSIDE in named(report))


def top_class(report: Report) -> str:
    """Return the one cause that a report puts first; "" if it names none.

    The first of its effects; without effects, 'outside_library' if it says so, else the class of
    the largest probability.
    """
    if not report["detected"]:
        return ""
    if names := named(report):
        return names[0]
    if said_outside(report):
        return OUTSIDE
    chances = report["class_probability"]
    return max(chances, key=lambda w: chances[w]) if chances else ""


def probability_of(report: Report, word: str) -> float:
    """Return the probability given to a class; probabilities beyond 1 in all are scaled to 1."""
    if not report["detected"]:
        return 0.0
    total = max(1.0, float(sum(report["class_probability"].values())))
    return float(report["class_probability"].get(word, 0.0)) / total


def log_score(report: Report, word: str) -> float:
    """Return -ln of the probability given to the true class [nat], at most -ln(FLOOR).

    Examples
    --------
    >>> report = {"detected": True, "class_probability": {"cti_serial": 0.5}}
    >>> round(log_score(report, "cti_serial"), 4), round(log_score(report, "tearing"), 4)
    (0.6931, 6.9078)
    """
    return float(-np.log(max(probability_of(report, word), FLOOR)))


def reported_class(report: Report) -> tuple[str, ...]:
    """Return the equivalence class; what is named first alone where none is given."""
    if not report["detected"]:
        return ()
    if report["equivalence_class"]:
        return tuple(dict.fromkeys(report["equivalence_class"]))
    return (top,) if (top := top_class(report)) else ()


@dataclass(frozen=True)
class Held:
    """A reported parameter beside the true one, in the truth's unit.

    ``error`` is relative to the truth's distance from the reading's origin.
    """

    word: str
    name: str
    truth: float
    value: float
    lo68: float
    hi68: float
    lo95: float
    hi95: float
    error: float
    snr: float

    @property
    def in68(self) -> bool | None:
        """Whether the 68 % interval holds the truth; None without an interval."""
        return _inside(self.truth, self.lo68, self.hi68)

    @property
    def in95(self) -> bool | None:
        """Whether the 95 % interval holds the truth."""
        return _inside(self.truth, self.lo95, self.hi95)


def _inside(value: float, low: float, high: float) -> bool | None:
    if not (np.isfinite(low) and np.isfinite(high)):
        return None
    # a told truth is rounded: an end that it lies on holds it
    slack = 1e-9 * max(abs(low), abs(high))
    return bool(low - slack <= value <= high + slack)


def held_parameters(truth: Truth, report: Report) -> list[Held]:
    """Return the parameters, of correctly named effects, that both sides give."""
    given = {e["class"]: e.get("parameters") or {} for e in reversed(report["effects"])}
    out = []
    for effect in truth["effects"]:
        word = effect["class"]
        if word == OUTSIDE or word not in named(report):
            continue
        for name, true in effect["parameters"].items():
            reading = reading_of(word, name)
            said = next(
                (given[word][n] for n in (name, *reading.aliases) if n in given[word]), None
            )
            if said is None or not reading.scored:
                continue
            if not isinstance(said, Mapping):
                said = {"value": said}
            numbers = [
                NAN if said.get(k) is None else float(said[k]) * reading.scale
                for k in ("value", "lo68", "hi68", "lo95", "hi95")
            ]
            away = abs(true - reading.origin)
            error = abs(numbers[0] - true) / away if away > 0 else NAN
            out.append(Held(word, name, float(true), *numbers, error, snr_of(effect)))
    return out


def snr_of(effect: Mapping[str, Any]) -> float:
    """Projected SNR of an effect, nan where it is not known."""
    return NAN if effect.get("snr") is None else float(effect["snr"])


def excess_removed(report: Report) -> tuple[float, float]:
    """Part of the held-out chi-square's excess that the model took away, and what is left.

    nan where there is no significant excess (3 standard deviations of chi-square) before, or
    the report does not tell.
    """
    held = report["heldout"]
    before, after = held.get("chi2dof_before"), held.get("chi2dof_after")
    if before is None or after is None or not report["detected"]:
        return NAN, NAN
    error = np.sqrt(2 / float(held.get("values") or HELD_OUT_VALUES))
    if not before - 1 > 3 * error:
        return NAN, float(after)
    return float(1 - (after - 1) / (before - 1)), float(after)


def overlap(one: Sequence[float], two: Sequence[float]) -> float:
    """Intersection over union of two intervals; 0 where either is empty.

    Examples
    --------
    >>> overlap([0, 2], [1, 4]), overlap([0, 1], [2, 3]), overlap([], [0, 1])
    (0.25, 0.0, 0.0)
    """
    if len(one) != 2 or len(two) != 2:
        return 0.0
    both = min(one[1], two[1]) - max(one[0], two[0])
    either = max(one[1], two[1]) - min(one[0], two[0])
    return float(max(both, 0.0) / either) if either > 0 else float(one[0] == two[0])


def location_scores(truth: Truth, report: Report) -> dict[str, Any]:
    """Hold a location against the truth's; None or nan where the truth has none, or none is told.

    ``lags``, ``amps``: exactly right, lags being a part of the class's own; ``flux``, ``x``, ``y``:
    intersection over union, of the channel whose flux fits best; ``exposures``: how far off the
    farther end is.
    """
    want, said = expected_location(truth), report["location"]
    out: dict[str, Any] = {
        "lags": None, "amps": None, "flux": NAN, "x": NAN, "y": NAN, "exposures": NAN,
    }  # fmt: skip
    if not report["detected"]:
        return out
    if "lags" in want:
        lags = {tuple(p) for p in said.get("lags", ())}
        out["lags"] = bool(lags) and lags <= {tuple(p) for p in want["lags"]}
    if "amps" in want:
        out["amps"] = sorted(said.get("amps", ())) == sorted(want["amps"])
    for axis in ("x", "y"):
        if axis in want:
            out[axis] = overlap(said.get(axis, ()), want[axis])
    # a place on the sensor has no flux: none told is none wrong
    if want.get("flux") and said.get("flux_e"):
        out["flux"] = max(overlap(said["flux_e"], f) for f in want["flux"].values())
    if "exposures" in want:
        ends = said.get("exposures", ())
        out["exposures"] = (
            float(max(abs(a - b) for a, b in zip(ends, want["exposures"], strict=True)))
            if len(ends) == 2 else float("inf")
        )  # fmt: skip
    return out


@dataclass(frozen=True)
class Score:
    """Everything that is counted of one campaign."""

    campaign: str
    size: str
    kind: str
    classes: tuple[str, ...]
    snr: tuple[float, ...]
    detected: bool
    p_value: float
    named: tuple[str, ...]
    top: str
    probability: float
    nat: float
    told_class: tuple[str, ...]
    outside: bool
    parameters: tuple[Held, ...]
    removed: float
    after: float
    location: Mapping[str, Any]
    advised: bool
    tie_broken: bool | None
    answered: bool = True
    wall_s: float = NAN
    cpu_s: float = NAN
    memory_gb: float = NAN

    @property
    def top1(self) -> bool:
        """Whether what is put first is true."""
        return self.top in self.classes

    @property
    def in_class(self) -> bool:
        """Whether the truth is in the reported class."""
        return bool(set(self.classes) & set(self.told_class))

    @property
    def found(self) -> tuple[str, ...]:
        """True classes that were named."""
        return tuple(w for w in self.classes if w in self.named)

    @property
    def library_named(self) -> bool:
        """Whether any class of the library is claimed."""
        return bool(set(self.named) - {OUTSIDE})

    def at_least(self, snr: float) -> bool:
        """Whether each effect has this projected SNR; where it is not known, it counts."""
        return all(not s < snr for s in self.snr)


def score_campaign(
    truth: Truth, report: Report | None, cost: Mapping[str, float] | None = None
) -> Score:
    """Hold one report against its truth.

    Parameters
    ----------
    truth : mapping
        See the module.
    report : mapping or None
        None where the command gave none: nothing detected, no p-value.
    cost : mapping, optional
        ``wall_s``, ``cpu_s``, ``memory_gb``.
    """
    name = str(truth["campaign"])
    answered = report is not None
    if report is None:
        report = empty_report(name)
    else:
        check_report(report, name)
    words = tuple(e["class"] for e in truth["effects"])
    removed, after = excess_removed(report)
    given = {k: float((cost or {}).get(k, NAN)) for k in ("wall_s", "cpu_s", "memory_gb")}
    return Score(
        campaign=name,
        size=str(truth.get("size", "S")),
        kind=kind_of(truth),
        classes=words,
        snr=tuple(snr_of(e) for e in truth["effects"]),
        detected=report["detected"],
        p_value=float(report["p_value"]),
        named=named(report),
        top=top_class(report),
        probability=probability_of(report, words[0]) if len(words) == 1 else NAN,
        nat=log_score(report, words[0]) if len(words) == 1 else NAN,
        told_class=reported_class(report),
        outside=said_outside(report),
        parameters=tuple(held_parameters(truth, report)),
        removed=removed,
        after=after,
        location=location_scores(truth, report),
        advised=report["detected"] and bool(report["recommended_recordings"]),
        tie_broken=truth.get("tie_broken"),
        answered=answered,
        **given,
    )


def empty_report(name: str) -> dict[str, Any]:
    """Return what stands for a report that the command did not give; its p-value is nan."""
    return {
        "schema": SCHEMA, "campaign": name, "detected": False, "p_value": NAN, "effects": [],
        "class_probability": {}, "equivalence_class": [], "open_world": False, "location": {},
        "recommended_recordings": [], "heldout": {},
    }  # fmt: skip
