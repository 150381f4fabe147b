"""Scores of many campaigns: each goal's number with its trials and bounds, beside pass and moonshot.

Shares have Wilson's 95 % bounds (`astropy.stats.binom_conf_interval`), means 1.96 standard errors,
medians the order statistics that hold them at 95 %.  Bounds of coverage take parameters of one
campaign for independent, which they nearly are not.  A campaign whose projected SNR is not known
counts in every line that asks for one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.stats import binom_conf_interval
from scipy.stats import binom, fisher_exact, kstest

from validation.concealed.score import NAN, Held, Score

BINS = ((3.0, 4.0), (4.0, 6.25), (6.25, 10.0), (10.0, 1e9))
"""Projected SNRs of detection; the second and third stand for 5 and 8, their geometric means."""

GOALS: dict[str, tuple[str, str]] = {
    "false alarms on nulls, p < 0.01": ("<= 0.03", "<= 0.01"),
    "null p-values against even, KS p": ("", ">= 0.05"),
    "detected, SNR 4 to 6.25 (5)": (">= 0.85", ">= 0.95"),
    "detected, SNR 6.25 to 10 (8)": (">= 0.97", ">= 0.995"),
    "first named is true, SNR >= 8": (">= 0.75", ">= 0.9"),
    "truth in reported class, SNR >= 8": (">= 0.95", ">= 0.99"),
    "classes reported, SNR >= 8": ("<= 2.0", "<= 1.4"),
    "log-score of class [nat], SNR >= 8": ("<= 0.8", "<= 0.35"),
    "several effects, recall, SNR >= 12": (">= 0.8", ">= 0.92"),
    "several effects, precision, SNR >= 12": (">= 0.85", ">= 0.97"),
    "coverage of 68 % intervals": ("0.58 to 0.78", "0.63 to 0.73"),
    "coverage of 95 % intervals": ("0.89 to 0.99", "0.93 to 0.97"),
    "median relative parameter error, SNR >= 10": ("<= 0.15", "<= 0.08"),
    "outside the library: said so, SNR >= 10": (">= 0.75", ">= 0.95"),
    "outside the library: named of it, SNR >= 10": ("<= 0.1", "<= 0.02"),
    "open world claimed, truth in library": ("<= 0.08", "<= 0.02"),
    "held-out excess removed, library": (">= 0.85", ">= 0.97"),
    "held-out excess removed, free-form": (">= 0.6", ">= 0.85"),
    "held-out chi2/dof after the fit": ("", "0.95 to 1.05"),
    "location: lags exact": (">= 0.85", ">= 0.97"),
    "location: flux, overlap": (">= 0.6", ">= 0.8"),
    "location: x, overlap": (">= 0.5", ">= 0.75"),
    "location: exposures off by": ("<= 5", "<= 1"),
    "advised recording breaks the tie": (">= 0.7", ">= 0.9"),
    "longest time of a campaign of size S [s]": ("<= 120", "<= 45"),
    "longest time of a campaign of size M [s]": ("<= 600", "<= 300"),
}
"""What is asked (pass, moonshot), fixed before any campaign was scored."""


def wilson(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Return Wilson's bounds of a share; nan without trials.

    Examples
    --------
    >>> [round(b, 4) for b in wilson(0, 125)], [round(b, 4) for b in wilson(1, 130)]
    ([0.0, 0.0298], [0.0014, 0.0423])
    """
    if not trials:
        return NAN, NAN
    low, high = binom_conf_interval(hits, trials, level, interval="wilson")
    # round-off leaves -3e-18 at no hits
    return max(float(low), 0.0), min(float(high), 1.0)


@dataclass(frozen=True)
class Line:
    """One quantity: what was reached, from how many trials.

    Attributes
    ----------
    quantity : str
        One of :data:`GOALS`, if anything is asked of it.
    value, low, high : float
        Estimate and its 95 % bounds; nan without trials.
    trials : int
    hits : int
        Of shares; -1 otherwise.
    percent : bool
        Whether the value is printed in per cent.
    """

    quantity: str
    value: float
    low: float
    high: float
    trials: int
    hits: int = -1
    percent: bool = False

    @property
    def passed(self) -> str:
        """What is asked: "<= 0.03", ">= 0.85", "0.58 to 0.78"; "" where nothing is."""
        return GOALS.get(self.quantity, ("", ""))[0]

    @property
    def moonshot(self) -> str:
        """What is aimed at."""
        return GOALS.get(self.quantity, ("", ""))[1]

    def reached(self) -> str:
        """Return 'moonshot', 'pass', 'no', or '' without trials or a goal; by the value itself."""
        if not self.trials or not np.isfinite(self.value):
            return ""
        if self.moonshot and meets(self.value, self.moonshot):
            return "moonshot"
        if self.passed:
            return "pass" if meets(self.value, self.passed) else "no"
        return "no" if self.moonshot else ""


def meets(value: float, asked: str) -> bool:
    """Whether a value is as asked.

    Examples
    --------
    >>> meets(0.8, ">= 0.75"), meets(0.8, "<= 0.75"), meets(0.6, "0.58 to 0.78")
    (True, False, True)
    """
    numbers = [float(n) for n in re.findall(r"\d+\.?\d*", asked)]
    if " to " in asked:
        return numbers[0] <= value <= numbers[1]
    return value <= numbers[0] if asked.startswith("<=") else value >= numbers[0]


def share(quantity: str, hits: Iterable[bool]) -> Line:
    """Make the line of a share."""
    found = [bool(h) for h in hits]
    k, n = sum(found), len(found)
    return Line(quantity, k / n if n else NAN, *wilson(k, n), n, k, percent=True)


def mean(quantity: str, values: Iterable[float]) -> Line:
    """Make the line of a mean, with 1.96 standard errors to either side."""
    v = _finite(values)
    if not len(v):
        return Line(quantity, NAN, NAN, NAN, 0)
    error = float(v.std(ddof=1) / np.sqrt(len(v))) if len(v) > 1 else NAN
    middle = float(v.mean())
    return Line(quantity, middle, middle - 1.96 * error, middle + 1.96 * error, len(v))


def median(quantity: str, values: Iterable[float], *, percent: bool = False) -> Line:
    """Make the line of a median, between the order statistics that hold it at 95 %."""
    v = np.sort(_finite(values))
    n = len(v)
    if not n:
        return Line(quantity, NAN, NAN, NAN, 0, percent=percent)
    # the k-th value from either end: fewer than k below the median has a chance of 2.5 %
    k = int(binom.ppf(0.025, n, 0.5))
    low, high = (float(v[k - 1]), float(v[n - k])) if k > 0 else (NAN, NAN)
    return Line(quantity, float(np.median(v)), low, high, n, percent=percent)


def _finite(values: Iterable[float]) -> np.ndarray:
    """Values that are told; infinite ones (told nothing where something is) count."""
    v = np.array([float(x) for x in values])
    return v[~np.isnan(v)] if len(v) else v


def tally(scores: Sequence[Score]) -> list[Line]:
    """Return all lines, in the order of the goals."""
    null = [s for s in scores if s.kind == "null" and s.answered]
    single = [s for s in scores if s.kind == "single"]
    outside = [s for s in scores if s.kind == "outside"]
    library = [s for s in scores if s.kind in ("single", "several")]
    return [
        share("false alarms on nulls, p < 0.01", (s.detected for s in null)),
        evenness([s.p_value for s in null]),
        *_detections([s for s in (*single, *outside) if len(s.classes) == 1]),
        *_names([s for s in single if s.at_least(8)]),
        *_several([s for s in scores if s.kind == "several" and s.at_least(12)]),
        *_parameters([p for s in scores for p in s.parameters]),
        *_outside([s for s in outside if s.at_least(10)]),
        share("open world claimed, truth in library", (s.outside for s in library)),
        *_held_out(library, [s for s in outside if s.outside]),
        *_locations(single),
        share("advised recording breaks the tie",
              (s.tie_broken for s in scores if s.tie_broken is not None)),
        *_times(scores),
    ]  # fmt: skip


def evenness(p_values: Sequence[float]) -> Line:
    """Make the line of a Kolmogorov-Smirnov test of p-values against even ones."""
    p = _finite(p_values)
    value = float(kstest(p, "uniform").pvalue) if len(p) else NAN
    return Line("null p-values against even, KS p", value, NAN, NAN, len(p))


def _detections(lone: Sequence[Score]) -> list[Line]:
    """Detection of lone effects by projected SNR; apart where it is not known."""
    words = ("3 to 4", "4 to 6.25 (5)", "6.25 to 10 (8)", "10 and more")
    out = [
        share(f"detected, SNR {word}", (s.detected for s in lone if low <= s.snr[0] < high))
        for (low, high), word in zip(BINS, words, strict=True)
    ]
    unknown = [s.detected for s in lone if np.isnan(s.snr[0])]
    return [*out, share("detected, SNR not known", unknown)] if unknown else out


def _names(strong: Sequence[Score]) -> list[Line]:
    """Single effects: what is put first, the class, its probability."""
    sizes = (len(s.told_class) for s in strong if s.told_class)
    return [
        share("first named is true, SNR >= 8", (s.top1 for s in strong)),
        share("truth in reported class, SNR >= 8", (s.in_class for s in strong)),
        mean("classes reported, SNR >= 8", sizes),
        mean("log-score of class [nat], SNR >= 8", (s.nat for s in strong)),
    ]


def _several(strong: Sequence[Score]) -> list[Line]:
    """Two or three effects: each effect, and each name, is a trial."""
    recall = (w in s.named for s in strong for w in s.classes)
    precision = (w in s.classes for s in strong for w in s.named)
    return [
        share("several effects, recall, SNR >= 12", recall),
        share("several effects, precision, SNR >= 12", precision),
    ]


def _parameters(held: Sequence[Held]) -> list[Line]:
    in68 = [p.in68 for p in held if p.in68 is not None]
    in95 = [p.in95 for p in held if p.in95 is not None]
    errors = [p.error for p in held if not p.snr < 10]
    return [
        share("coverage of 68 % intervals", in68),
        share("coverage of 95 % intervals", in95),
        median("median relative parameter error, SNR >= 10", errors, percent=True),
    ]


def _outside(far: Sequence[Score]) -> list[Line]:
    return [
        share("outside the library: said so, SNR >= 10", (s.outside for s in far)),
        share(
            "outside the library: named of it, SNR >= 10", (s.library_named for s in far)
        ),
    ]


def _held_out(library: Sequence[Score], free: Sequence[Score]) -> list[Line]:
    def removed(scores: Sequence[Score]) -> Iterable[float]:
        return (s.removed for s in scores)

    after = (s.after for s in (*library, *free))
    return [
        median("held-out excess removed, library", removed(library), percent=True),
        median("held-out excess removed, free-form", removed(free), percent=True),
        mean("held-out chi2/dof after the fit", after),
    ]


def _locations(single: Sequence[Score]) -> list[Line]:
    def told(name: str) -> list[Any]:
        return [v for s in single if (v := s.location[name]) is not None]

    return [
        share("location: lags exact", told("lags")),
        mean("location: flux, overlap", told("flux")),
        mean("location: x, overlap", told("x")),
        share("location: amplifiers exact", told("amps")),
        median("location: exposures off by", told("exposures")),
    ]


def _times(scores: Sequence[Score]) -> list[Line]:
    out = []
    for size in sorted({s.size for s in scores}, reverse=True):
        wall = _finite([s.wall_s for s in scores if s.size == size])
        if len(wall):
            name = f"longest time of a campaign of size {size} [s]"
            out.append(Line(name, float(wall.max()), NAN, NAN, len(wall)))
    return out


def print_lines(lines: Sequence[Line], echo: Callable[[str], Any] = print) -> None:
    """Print the table."""
    echo(f"{'quantity':48s}{'value':>8s}  {'95 % bounds':>16s}{'trials':>9s}"
         f"  {'pass':13s}{'moonshot':13s}reached")  # fmt: skip
    for line in lines:
        value, low, high = (
            _written(v, line.percent) for v in (line.value, line.low, line.high)
        )
        trials = f"{line.hits}/{line.trials}" if line.hits >= 0 else str(line.trials)
        bounds = f"{low} to {high}" if low != "-" else "-"
        asked = (_goal(line.passed, line.percent), _goal(line.moonshot, line.percent))
        echo(f"{line.quantity:48s}{value:>8s}  {bounds:>16s}{trials:>9s}  {asked[0]:13s}"
             f"{asked[1]:13s}{line.reached()}")  # fmt: skip


def print_beside(
    lines: Sequence[Line],
    others: Sequence[Line],
    names: tuple[str, str],
    echo: Callable[[str], Any] = print,
) -> dict[str, float]:
    """Print two sets' lines beside one another; return, of shares, the p that they are one.

    Fisher's exact test, two-sided; lines without trials in either are left out.
    """
    found: dict[str, float] = {}
    by = {line.quantity: line for line in others}
    echo(f"{'quantity':48s}{names[0]:>28s}{names[1]:>28s}  p of one share")
    for one in lines:
        other = by.get(one.quantity)
        if other is None or not one.trials or not other.trials:
            continue
        told = [
            f"{line.hits}/{line.trials} {_written(line.value, line.percent)}"
            if line.hits >= 0
            else f"{_written(line.value, line.percent)} ({line.trials})"
            for line in (one, other)
        ]
        end = ""
        if one.hits >= 0 and other.hits >= 0:
            table = [[line.hits, line.trials - line.hits] for line in (one, other)]
            found[one.quantity] = float(fisher_exact(table).pvalue)
            end = f"{found[one.quantity]:.2f}"
        echo(f"{one.quantity:48s}{told[0]:>28s}{told[1]:>28s}  {end}")
    return found


def _written(value: float, percent: bool) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{100 * value:.1f}%" if percent else f"{value:.3g}"


def _goal(asked: str, percent: bool) -> str:
    if not percent:
        return asked
    return re.sub(r"\d+\.?\d*", lambda m: f"{100 * float(m[0]):g}%", asked)
