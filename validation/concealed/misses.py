"""What went wrong, campaign by campaign, in plain words."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from validation.concealed.conventions import OUTSIDE
from validation.concealed.score import Held, Score


def describe_misses(score: Score) -> list[str]:
    """Say what a report missed, invented or got wrong; nothing where all is right.

    An effect below SNR 5 that was not seen is said too: the goals do not ask for it.
    """
    if not score.answered:
        return ["no report"]
    if score.kind == "null":
        return _of_null(score)
    if not score.detected:
        return [f"{_told(score)}: not detected (p = {score.p_value:.2g})"]
    out = _of_open_world(score) if score.kind == "outside" else _of_names(score)
    for held in score.parameters:
        if held.in95 is False:
            out.append(_of_parameter(held))
    if score.location["lags"] is False:
        out.append("lags of the covariances are not those of the effect")
    if score.location["amps"] is False:
        out.append("not the effect's amplifiers")
    return [f"{_told(score)}: {text}" for text in out]


def _of_null(score: Score) -> list[str]:
    if not score.detected:
        return []
    named = ", ".join(score.named) or (
        "outside the library" if score.outside else "nothing"
    )
    return [f"nothing was left out: false alarm at p = {score.p_value:.2g}, named {named}"]


def _told(score: Score) -> str:
    return " and ".join(
        word + (f" (SNR {snr:.1f})" if np.isfinite(snr) else "")
        for word, snr in zip(score.classes, score.snr, strict=True)
    )


def _of_open_world(score: Score) -> list[str]:
    out = [] if score.outside else ["not said to be outside the library"]
    if score.library_named:
        names = ", ".join(w for w in score.named if w != OUTSIDE)
        out.append(f"explained by {names}")
    return out


def _of_names(score: Score) -> list[str]:
    out = []
    if score.outside:
        out.append("said to be outside the library")
    if len(score.classes) == 1:
        if not score.top1:
            rest = (
                "the truth is in the reported class"
                if score.in_class
                else f"the truth is not in the reported class ({', '.join(score.told_class) or 'none'})"
            )
            out.append(f"first named {score.top or 'nothing'}; {rest}")
        elif not score.in_class:
            out.append("named, but not in the reported class")
    else:
        lost = [w for w in score.classes if w not in score.named]
        if lost:
            out.append(f"not named: {', '.join(lost)}")
    invented = [w for w in score.named if w not in score.classes and w != OUTSIDE]
    if invented and (len(score.classes) > 1 or score.top1):
        out.append(f"invented: {', '.join(invented)}")
    return out


def _of_parameter(held: Held) -> str:
    return (
        f"{held.name} = {held.truth:.4g}, outside the 95 % interval "
        f"{held.lo95:.4g} to {held.hi95:.4g} (stated {held.value:.4g})"
    )


def print_misses(scores: Iterable[Score], echo=print) -> None:
    """Print all misses, one a line, under the name of their campaign."""
    any_miss = False
    for score in scores:
        for text in describe_misses(score):
            any_miss = True
            echo(f"  {score.campaign}: {text}")
    if not any_miss:
        echo("  none")
