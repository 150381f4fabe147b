"""The goals of a diagnosis on campaigns of an independent bench, split by strength, law and layout.

Trials are campaigns whose laws, strengths and nuisances are not the fitter's
(:mod:`validation.foreign`).  Shares have Wilson's 95 % bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from validation.concealed.calibration import stated_of
from validation.concealed.conventions import OUTSIDE
from validation.concealed.same_laws import CYCLES, SAME_LAWS, expected_parameters
from validation.concealed.score import NAN, Held, Score, snr_of
from validation.concealed.tally import Line, mean, share
from validation.concealed.tally import evenness as evenness_of

ASKED = {
    "campaigns without a report": ("<= 0", "<= 0"),
    "false alarms on nulls, p < 0.01": ("<= 0.02", "<= 0.01"),
    "p-values of nulls against even, KS p": (">= 0.05", ">= 0.05"),
    "detected, SNR 4 to 6.25 (5)": (">= 0.85", ">= 0.95"),
    "detected, SNR 6.25 to 10 (8)": (">= 0.97", ">= 0.995"),
    "detected, SNR above 10": (">= 0.99", ">= 1"),
    "named first right, SNR >= 8, a law of the library": (">= 0.85", ">= 0.95"),
    "named first right, SNR >= 8, another published law": (">= 0.7", ">= 0.9"),
    "truth in the reported class, SNR >= 8": (">= 0.95", ">= 0.99"),
    "mean size of the reported class, SNR >= 8": ("<= 1.6", "<= 1.3"),
    "'outside the library' claimed, truth in it": ("<= 0.05", "<= 0.01"),
    "an effect named beside that is not there": ("<= 0.03", "<= 0.01"),
    "two or three effects: recall": (">= 0.8", ">= 0.92"),
    "two or three effects: precision": (">= 0.9", ">= 0.97"),
    "coverage of 68 % intervals, a law of the library": ("0.6 to 0.76", "0.65 to 0.72"),
    "coverage of 95 % intervals, a law of the library": ("0.91 to 0.98", "0.94 to 0.96"),
    "outside the library: said so": (">= 0.8", ">= 0.95"),
    "outside the library: given a library name": ("<= 0.1", "<= 0.02"),
    "log-score of class [nat]": ("<= 0.6", "<= 0.35"),
    "held-out chi2 of touched channels 0.9 to 1.1": (">= 0.9", ">= 0.98"),
    "median time S [s]": ("<= 30", "<= 10"),
    "longest time S [s]": ("<= 90", "<= 45"),
    "longest time M [s]": ("<= 120", "<= 45"),
    "longest time X [s]": ("<= 600", "<= 180"),
}
"""What is asked by quantity (pass, moonshot), fixed before any campaign of an independent bench was
made."""

QUOTED = {
    "alarms": "false alarms on nulls, p < 0.01",
    "detected": "detected, SNR above 10",
    "named": "named first right, SNR >= 8, a law of the library",
    "named other": "named first right, SNR >= 8, another published law",
    "in class": "truth in the reported class, SNR >= 8",
    "outside": "'outside the library' claimed, truth in it",
    "invented": "an effect named beside that is not there",
    "recall": "two or three effects: recall",
    "precision": "two or three effects: precision",
    "held 68": "coverage of 68 % intervals, a law of the library",
    "held 95": "coverage of 95 % intervals, a law of the library",
}
"""Goals of campaigns of an independent bench that pages quote, by short name."""

BANDS = {"below 10": (0.0, 10.0), "10 to 100": (10.0, 100.0), "above 100": (100.0, np.inf)}
"""Projected SNRs by which every rate is split."""


@dataclass(frozen=True)
class Trial:
    """One campaign: its score, and what its truth says of laws and layout.

    Attributes
    ----------
    score : Score
    laws : tuple of str
        Law of each effect.
    amplifiers : int
    spots, overscan : bool
        Whether spots and a serial overscan were recorded.
    nuisances : tuple of str
        What the bench did beside.
    held : tuple of Held
        Parameters of effects that were named right, by the truth's own law.
    touched : tuple of float
        Held-out chi-square over values, after, of each channel whose value changed.
    stated : tuple of (float, bool)
        Probability of each class, and whether it is true.
    """

    score: Score
    laws: tuple[str, ...]
    amplifiers: int
    spots: bool
    overscan: bool
    nuisances: tuple[str, ...]
    held: tuple[Held, ...]
    touched: tuple[float, ...]
    stated: tuple[tuple[float, bool], ...]

    @property
    def library_laws(self) -> bool:
        """Whether the library has the formula of every law (:mod:`validation.concealed.same_laws`)."""
        pairs = zip(self.score.classes, self.laws, strict=True)
        return all(pair in SAME_LAWS for pair in pairs)

    @property
    def strongest(self) -> float:
        """Largest projected SNR of the effects; nan of a null."""
        return max(self.score.snr, default=NAN)


def trial_of(
    truth: Mapping[str, Any], score: Score, report: Mapping[str, Any] | None
) -> Trial:
    """Trial of a campaign from its truth, its score and its report, if there is one."""
    layout = truth.get("layout") or {}
    nuisances = truth.get("nuisances") or ()
    channels = ((report or {}).get("heldout") or {}).get("channels") or {}
    return Trial(
        score,
        tuple(str(e.get("law", "")) for e in truth["effects"]),
        int(truth.get("amplifiers", 1)),
        bool(layout.get("spots", True)),
        bool(layout.get("serial_overscan", True)),
        tuple(n if isinstance(n, str) else str(n["kind"]) for n in nuisances),
        tuple(_held(truth, report or {})),
        tuple(
            float(c["after"])
            for c in channels.values()
            if c["after"] != c["before"] and np.isfinite(c["after"])
        ),
        stated_of(truth, report),
    )


def _held(truth: Mapping[str, Any], report: Mapping[str, Any]) -> Iterator[Held]:
    """Reported parameters beside the truth's, in the report's own definitions."""
    said = {e["class"]: e for e in reversed(report.get("effects") or ())}
    for effect in truth["effects"]:
        own = said.get(effect["class"])
        if own is None:
            continue
        expected = expected_parameters(effect, truth, law=own.get("law") or "")
        for name, true in expected.items():
            given = (own.get("parameters") or {}).get(name)
            # Whole numbers and values that the fit holds have no interval.
            if not isinstance(given, Mapping) or given.get("lo68") is None:
                continue
            value = float(given["value"])
            turns = 1.0 if (effect["class"], name) in CYCLES else np.inf
            true = value + math.remainder(true - value, turns)
            ends = *_ends(given, "68", true), *_ends(given, "95", true)
            error = abs(value - true) / abs(true) if true else NAN
            yield Held(effect["class"], name, true, value, *ends, error, snr_of(effect))


def _ends(given: Mapping[str, Any], level: str, true: float) -> tuple[float, float]:
    """Ends of an interval; an open one holds the truth, and one that is open twice says nothing."""
    is_open = set(given.get(f"open{level}") or ())
    if is_open >= {"lo", "hi"}:
        return NAN, NAN
    low, high = float(given[f"lo{level}"]), float(given[f"hi{level}"])
    return min(low, true) if "lo" in is_open else low, max(
        high, true
    ) if "hi" in is_open else high


class Goal(Line):
    """A line of the table of :data:`ASKED`."""

    @property
    def passed(self) -> str:
        """What is asked; "" where nothing is."""
        return ASKED.get(self.quantity, ("", ""))[0]

    @property
    def moonshot(self) -> str:
        """What is aimed at."""
        return ASKED.get(self.quantity, ("", ""))[1]


def quoted_goal(table: Iterable[Any], short: str) -> str:
    """Share of a goal of :data:`QUOTED` with its Wilson bounds [%] and its trials, of all campaigns."""
    (row,) = (r for r in table if (r["part"], r["quantity"]) == ("all", QUOTED[short]))
    low, high = 100 * row["low"], 100 * row["high"]
    return f"{100 * row['value']:.0f} % ({low:.0f} to {high:.0f}, of {row['trials']})"


def _goal(line: Line) -> Goal:
    return Goal(**{k: getattr(line, k) for k in Line.__dataclass_fields__})


def goals(trials: Sequence[Trial]) -> list[Goal]:
    """Lines of the table, in the order of :data:`ASKED`, of the given trials.

    Examples
    --------
    >>> [line.quantity for line in goals([])] == list(ASKED)
    True
    """
    scores = [t.score for t in trials]
    null = [s for s in scores if s.kind == "null"]
    lone = [s for s in scores if len(s.classes) == 1]
    single = [t for t in trials if t.score.kind == "single" and t.score.at_least(8)]
    library = [s for s in scores if s.kind in ("single", "several")]
    several = [s for s in scores if s.kind == "several"]
    outside = [s for s in scores if s.kind == "outside" and s.detected]
    own = [t for t in single if t.library_laws]
    other = [t for t in single if not t.library_laws]
    held = [p for t in trials for p in t.held]
    ks = evenness_of([s.p_value for s in null])

    def detected(low: float, high: float) -> list[bool]:
        return [s.detected for s in lone if low <= s.snr[0] < high]

    lines = [
        share("campaigns without a report", (not s.answered for s in scores)),
        share("false alarms on nulls, p < 0.01", (s.detected for s in null if s.answered)),
        Line("p-values of nulls against even, KS p", ks.value, NAN, NAN, ks.trials),
        share("detected, SNR 4 to 6.25 (5)", detected(4, 6.25)),
        share("detected, SNR 6.25 to 10 (8)", detected(6.25, 10)),
        share("detected, SNR above 10", detected(10, np.inf)),
        share(
            "named first right, SNR >= 8, a law of the library",
            (t.score.top1 for t in own),
        ),
        share(
            "named first right, SNR >= 8, another published law",
            (t.score.top1 for t in other),
        ),
        share("truth in the reported class, SNR >= 8", (t.score.in_class for t in single)),
        mean(
            "mean size of the reported class, SNR >= 8",
            (len(t.score.told_class) for t in single if t.score.told_class),
        ),
        share("'outside the library' claimed, truth in it", (s.outside for s in library)),
        share("an effect named beside that is not there", map(invented, library)),
        share(
            "two or three effects: recall",
            (w in s.named for s in several for w in s.classes),
        ),
        share(
            "two or three effects: precision",
            (w in s.classes for s in several for w in s.named),
        ),
        *_coverage(held),
        share("outside the library: said so", (s.outside for s in outside)),
        share(
            "outside the library: given a library name",
            (s.library_named for s in outside),
        ),
        mean("log-score of class [nat]", (t.score.nat for t in single)),
        share(
            "held-out chi2 of touched channels 0.9 to 1.1",
            (0.9 <= c <= 1.1 for t in trials if t.score.named for c in t.touched),
        ),
        *_times(scores),
    ]
    return [_goal(line) for line in lines]


def invented(score: Score) -> bool:
    """Whether a class of the library is named beside a true one, and is not there."""
    wrong = set(score.named) - set(score.classes) - {OUTSIDE}
    return bool(wrong) and bool(score.found)


def _coverage(held: Sequence[Held]) -> list[Line]:
    return [
        share(
            f"coverage of {level} % intervals, a law of the library",
            (v for p in held if (v := inside(p)) is not None),
        )
        for level, inside in (("68", lambda p: p.in68), ("95", lambda p: p.in95))
    ]


def _times(scores: Sequence[Score]) -> list[Line]:
    """Wall clock by size; campaigns without a report have none."""
    out = []
    for name, size, of in (
        ("median", "S", np.median), ("longest", "S", np.max), ("longest", "M", np.max),
        ("longest", "X", np.max),
    ):  # fmt: skip
        wall = [s.wall_s for s in scores if s.size == size and np.isfinite(s.wall_s)]
        value = float(of(wall)) if wall else NAN
        out.append(Line(f"{name} time {size} [s]", value, NAN, NAN, len(wall)))
    return out


def splits(trials: Sequence[Trial]) -> dict[str, list[Trial]]:
    """Parts of the trials by strength, law and layout; nulls are in those of layouts alone."""
    made: dict[str, Callable[[Trial], bool]] = {
        **{
            f"SNR {name}": lambda t, low=low, high=high: low <= t.strongest < high  # type: ignore[misc]
            for name, (low, high) in BANDS.items()
        },
        "laws of the library": lambda t: bool(t.laws) and t.library_laws,
        "other published laws": lambda t: bool(t.laws) and not t.library_laws,
        "1 or 2 amplifiers": lambda t: t.amplifiers <= 2,
        "4 to 16 amplifiers": lambda t: t.amplifiers > 2,
        "with spots": lambda t: t.spots,
        "without spots": lambda t: not t.spots,
        "with a serial overscan": lambda t: t.overscan,
        "without a serial overscan": lambda t: not t.overscan,
        "no nuisance": lambda t: not t.nuisances,
        "1 to 3 nuisances": lambda t: 1 <= len(t.nuisances) <= 3,
        "4 nuisances or more": lambda t: len(t.nuisances) > 3,
    }
    return {name: [t for t in trials if own(t)] for name, own in made.items()}


def causes(score: Score) -> str:
    """Word for what is wrong with a campaign's report; "" where nothing is.

    'no report', 'false alarm', 'not detected', 'not said to be outside', 'given a library name',
    'wrong name', 'outside claimed', 'invented beside' or 'one of several missed': the first of
    them that holds.
    """
    if not score.answered:
        return "no report"
    if score.kind == "null":
        return "false alarm" if score.detected else ""
    if not score.detected:
        return "not detected"
    if score.kind == "outside":
        if not score.outside:
            return "not said to be outside"
        return "given a library name" if score.library_named else ""
    if not score.top1:
        return "wrong name"
    if score.outside:
        return "outside claimed"
    if invented(score):
        return "invented beside"
    return "one of several missed" if set(score.classes) - set(score.named) else ""


def described(trial: Trial) -> str:
    """One line of a campaign: the truth with laws and SNRs, what was said, and the p-value."""
    score = trial.score
    truth = " and ".join(
        f"{word}/{law} at {snr:.0f}"
        for word, law, snr in zip(score.classes, trial.laws, score.snr, strict=True)
    )
    said = " and ".join(score.named) or ("outside_library" if score.outside else "nothing")
    if score.outside and OUTSIDE not in score.named and score.named:
        said += " and outside"
    return f"{score.campaign}: {truth or 'null'}: {said}, p = {score.p_value:.2g}"
