"""Whether stated probabilities and intervals hold: by tenths of probability, and by class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from validation.concealed.score import Held
from validation.concealed.tally import Line, share

TENTHS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Ends of the intervals of probability.  Chosen: deciles, as reliability diagrams have."""


def stated_of(
    truth: Mapping[str, Any], report: Mapping[str, Any] | None
) -> tuple[tuple[float, bool], ...]:
    """Each class's probability in a report that detects something, and whether the class is true.

    Parameters
    ----------
    truth, report : mapping
        Of one campaign; a campaign without a report states nothing.

    Returns
    -------
    tuple of (float, bool)
        Of the classes that the report lists, and of true ones that it does not list at 0.

    Examples
    --------
    >>> truth = {"effects": [{"class": "tearing"}]}
    >>> report = {"detected": True, "class_probability": {"tearing": 0.9, "cti_serial": 0.1}}
    >>> stated_of(truth, report)
    ((0.9, True), (0.1, False))
    """
    if not report or not report["detected"]:
        return ()
    true = [e["class"] for e in truth["effects"]]
    words = dict.fromkeys([*report["class_probability"], *true])
    return tuple((float(report["class_probability"].get(w, 0.0)), w in true) for w in words)


def reliability(stated: Sequence[tuple[float, bool]]) -> list[Line]:
    """Share of true classes among those that were given a probability, by tenths of it.

    Examples
    --------
    >>> for line in reliability([(0.95, True), (0.97, False), (0.05, False)]):
    ...     print(line.quantity, line.hits, "of", line.trials)
    given 0.0 to 0.1 (mean 0.050): true 0 of 1
    given 0.9 to 1.0 (mean 0.960): true 1 of 2
    """
    out = []
    for low, high in pairwise(TENTHS):
        own = [(p, t) for p, t in stated if low <= p < high or p == high == TENTHS[-1]]
        if own:
            mean = sum(p for p, _ in own) / len(own)
            name = f"given {low:.1f} to {high:.1f} (mean {mean:.3f}): true"
            out.append(share(name, [t for _, t in own]))
    return out


def coverage_by_class(held: Sequence[Held]) -> list[Line]:
    """Share of the intervals of each parameter of each class that hold the truth.

    Parameters
    ----------
    held : sequence of Held
        Parameters with intervals, of effects that were named right and by the truth's own law.

    Returns
    -------
    list of Line
        Two lines for each class and parameter, of 68 % and of 95 % intervals.
    """
    out = []
    for word, name in sorted({(h.word, h.name) for h in held}):
        own = [h for h in held if (h.word, h.name) == (word, name)]
        for level, inside in (("68", [h.in68 for h in own]), ("95", [h.in95 for h in own])):
            line = share(f"{word} {name}, {level} %", [v for v in inside if v is not None])
            if line.trials:
                out.append(line)
    return out
