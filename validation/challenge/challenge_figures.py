"""Figures of the concealed challenge: detection by projected SNR, probabilities, intervals, names.

All take scores (:func:`validation.concealed.opening.from_row` of rows of
``validation/results/challenge_trials.ecsv``).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from bfsensor.diagnose.data.channels import WORDS
from bfsensor.diagnose.detect.scans import DEVICE
from validation.concealed.score import Score
from validation.concealed.tally import wilson

EDGES = (3.0, 4.0, 5.0, 6.25, 8.0, 10.0, 14.0, 30.5)
"""Projected SNRs between which detection is counted."""

CHANCES = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.97, 1.0)
"""Probabilities between which classes are counted."""

ALARMS = Path(__file__).parents[1] / "results" / "challenge_alarms.ecsv"


def informed(snr: ArrayLike, shapes: int, alarm: float = 0.01) -> NDArray[np.float64]:
    """Share that an observer detects who knows the true effect's shape to be one of several.

    Deviates along the shapes, of Gaussian noise, two-sided, Bonferroni's charge: what is lost
    against it, an effect's unknown shape has cost, or one that nobody has drawn.

    Parameters
    ----------
    snr : array_like
        Projected SNR.
    shapes : int
        How many shapes are asked.
    alarm : float
        Share of nulls that are allowed to look like one of them.

    Examples
    --------
    >>> informed([3.0, 5.0, 8.0], 1).round(3), informed(5.0, 48).round(3)
    (array([0.664, 0.992, 1.   ]), np.float64(0.902))
    """
    return np.asarray(norm.sf(norm.isf(0.5 * alarm / shapes) - np.asarray(snr)))


def alarms(path: Path = ALARMS) -> dict[str, float]:
    """Deviates from which families alarm: ``python -m validation.challenge.concealed_trials alarms``."""
    table = Table.read(path, format="ascii.ecsv")
    return {str(r["family"]): float(r["alarm"]) for r in table}


def knowing_place(snr: ArrayLike, told: dict[str, float]) -> NDArray[np.float64]:
    """Share that is detected of effects whose shape is one of those sought, mean of the effects.

    Shapes of other places of an effect, and all other statistics, have their part of the false
    alarms as they do in diagnoses; what is lost against it, shapes between the places have cost.

    Parameters
    ----------
    snr : array_like
        Projected SNR.
    told : dict of str to float
        From :func:`alarms`; families that are words of channels are no effects.
    """
    own = np.array([v for k, v in told.items() if k not in (*WORDS, DEVICE, "chi-square")])
    return np.asarray(norm.sf(own - np.asarray(snr, float)[..., None]).mean(-1))


def reliability(
    reports: Sequence[tuple[tuple[str, ...], dict[str, float]]],
) -> list[tuple[float, float, float, float, int]]:
    """Of the classes that reports give a probability: how often they are true, by that.

    Parameters
    ----------
    reports : sequence of (true classes, probability by class)

    Returns
    -------
    list of (mean probability, share true, low, high, count)
    """
    chance = np.array([p for _, told in reports for p in told.values()])
    true = np.array([w in words for words, told in reports for w in told])
    out = []
    for low, high in itertools.pairwise(CHANCES):
        here = (chance > low) & (chance <= high)
        if here.any():
            n, k = int(here.sum()), int(true[here].sum())
            out.append((float(chance[here].mean()), k / n, *wilson(k, n), n))
    return out


def tempered(told: dict[str, float], temperature: float) -> dict[str, float]:
    """Probabilities at another temperature: their powers, of the same sum.

    Examples
    --------
    >>> {k: round(v, 2) for k, v in tempered({"a": 0.8, "b": 0.2}, 2.0).items()}
    {'a': 0.67, 'b': 0.33}
    """
    total = sum(told.values())
    powers = {w: p ** (1 / temperature) for w, p in told.items() if p > 0}
    scale = total / sum(powers.values()) if powers else 0.0
    return {w: scale * p for w, p in powers.items()}


def best_temperature(
    reports: Sequence[tuple[tuple[str, ...], dict[str, float]]], floor: float = 1e-3
) -> float:
    """Temperature at which the mean log-score of single effects is least."""

    def score(logarithm: float) -> float:
        t = float(np.exp(logarithm))
        return float(np.mean([
            -np.log(max(tempered(told, t).get(words[0], 0.0), floor)) for words, told in reports
        ]))  # fmt: skip

    found = minimize_scalar(score, bounds=(np.log(0.3), np.log(10.0)), method="bounded")
    return float(np.exp(found.x))


def draw_detection(scores: Sequence[Score], ax: Any) -> None:
    """Share of lone effects that were detected, by projected SNR."""
    lone = [s for s in scores if s.kind in ("single", "outside") and len(s.classes) == 1]
    for low, high in itertools.pairwise(EDGES):
        own = [s.detected for s in lone if low <= s.snr[0] < high]
        if own:
            k, n = sum(own), len(own)
            bounds = np.array(wilson(k, n))
            x = np.sqrt(low * min(high, 30.0))
            ax.errorbar(
                x,
                k / n,
                yerr=np.abs(bounds - k / n)[:, None],
                fmt="o",
                color="C0",
                capsize=2,
            )
            ax.annotate(f"{k}/{n}", (x, 0.03), ha="center", fontsize=7)
    for snr, share, word in (
        (5, 0.85, "pass"),
        (8, 0.97, ""),
        (5, 0.95, "aim"),
        (8, 0.995, ""),
    ):
        ax.plot(
            snr,
            share,
            "_",
            ms=14,
            color="C1" if share in (0.85, 0.97) else "C2",
            label=word,
        )
    fine = np.geomspace(EDGES[0], 30.0, 200)
    told = alarms()
    count = len(told)
    ax.plot(fine, informed(fine, count), color="0.6", label=f"knows {count} shapes exactly")
    ax.plot(fine, knowing_place(fine, told), "--", color="0.6",
            label="knows each effect's places")  # fmt: skip
    ax.set(xscale="log", xlabel="projected SNR", ylabel="detected", ylim=(0, 1.05))
    ax.set_xticks([3, 5, 8, 12, 20, 30], labels=["3", "5", "8", "12", "20", "30"])
    ax.minorticks_off()


def draw_reliability(
    reports: Sequence[tuple[tuple[str, ...], dict[str, float]]], ax: Any, **line: Any
) -> None:
    """How often classes of a probability are true."""
    points = np.array([p[:4] for p in reliability(reports)])
    if not len(points):
        return
    x, y, low, high = points.T
    ax.errorbar(x, y, yerr=np.abs(np.array([low, high]) - y), fmt="o-", capsize=2, **line)
    ax.plot([0, 1], [0, 1], color="0.7", lw=1)
    ax.set(xlabel="probability of a class in the report", ylabel="share that is true")


def draw_pulls(scores: Sequence[Score], ax: Any) -> None:
    """Deviations of parameters over the half widths of their 68 % intervals."""
    held = [p for s in scores for p in s.parameters if p.in68 is not None]
    pulls = np.array([
        (p.value - p.truth) / max((p.hi68 - p.value if p.truth > p.value else p.value - p.lo68), 1e-300)
        for p in held
    ])  # fmt: skip
    edges = np.linspace(-5, 5, 26)
    ax.hist(np.clip(pulls, -4.99, 4.99), edges, color="C0", alpha=0.7)
    x = np.linspace(-5, 5, 200)
    ax.plot(x, len(pulls) * 0.4 * np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color="k", lw=1)
    ax.set(xlabel="(fitted - true) / 68 % interval's half width", ylabel="parameters")


def draw_names(scores: Sequence[Score], ax: Any, least: float = 8.0) -> None:
    """By class: single effects of some strength, and what was put first."""
    strong = [s for s in scores if s.kind == "single" and s.at_least(least)]
    count = Counter(s.classes[0] for s in strong)
    words = sorted(count, key=lambda w: -count[w])
    right = [sum(s.top1 for s in strong if s.classes[0] == w) for w in words]
    inside = [sum(s.in_class for s in strong if s.classes[0] == w) for w in words]
    y = np.arange(len(words))
    ax.barh(y, [count[w] for w in words], color="0.85", label="taken")
    ax.barh(y, inside, color="C0", alpha=0.4, label="in the reported class")
    ax.barh(y, right, height=0.4, color="C0", label="put first")
    ax.set_yticks(y, labels=[w.replace("_", " ") for w in words], fontsize=7)
    ax.invert_yaxis()
    ax.set(xlabel=f"single effects of SNR {least:g} and more")
    ax.legend(fontsize=7, frameon=False)
