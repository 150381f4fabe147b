"""How often the silicon physics of concealed cases was named, as documents quote it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from astropy.table import Table, vstack

from validation.concealed.tally import wilson

Rows = Callable[[str], Table]
"""Gives the rows of a results file by its name."""
Hits = tuple[int, int]
"""Cases for which something holds, and cases of which it is asked."""

RESULTS = "silicon_cases"
NEWEST = tuple(f"proof{n}" for n in range(7, 18))
"""Sets made after the diagnosis at a2ddae1 (two), dffeb0b, 8d13aae (two), 9848899, 5b559fd (two),
3f43782 ('proof16') and e1ad63b ('proof15', 'proof17'); the last eight hold large changes alone,
'proof11' and 'proof14' of a second device, 'proof16' and 'proof17' of a third, 'proof15' by
Poisson_CCD."""
VISIBLE = 8.0
"""Projected SNR from which a change is visible.  Chosen: the goal's; at 16 half as many cases count."""


def of_sets(rows: Rows, sets: tuple[str, ...] = NEWEST) -> Table:
    """Rows of these sets."""
    table = rows(RESULTS)
    return vstack([table[table["set"] == name] for name in sets])


def count(table: Table) -> Mapping[str, Hits]:
    """Count what the goals ask of concealed cases.

    Examples
    --------
    >>> from astropy.table import Table
    >>> cases = Table({
    ...     "concealed": ["nothing", "memory"], "snr": [0.0, 9.0], "detected": [False, True],
    ...     "in_class": [False, True], "first": [False, True], "outside": [False, False],
    ...     "open_world": [False, False], "inside95": [0, 1], "intervals": [0, 1],
    ... })
    >>> count(cases)["alarms"], count(cases)["class"], count(cases)["values"]
    ((0, 1), (1, 1), (1, 1))
    """
    nulls = table[table["concealed"] == "nothing"]
    changed = table[table["concealed"] != "nothing"]
    seen = changed[changed["snr"] >= VISIBLE]
    # What no piece describes has no class but outside, and is asked that alone.
    known, strange = seen[~_true(seen, "outside")], seen[_true(seen, "outside")]
    said = known[_true(known, "detected")]
    right = int(np.sum(known["in_class"])) + int(np.sum(strange["open_world"]))
    return {
        "alarms": (int(np.sum(nulls["detected"])), len(nulls)),
        "detected": (int(np.sum(seen["detected"])), len(seen)),
        "class": (right, len(seen)),
        "first": (int(np.sum(known["first"])), len(known)),
        "outside": (int(np.sum(strange["open_world"])), len(strange)),
        "claimed": (int(np.sum(said["open_world"])), len(said)),
        "values": (int(np.sum(changed["inside95"])), int(np.sum(changed["intervals"]))),
    }


def _by_engine(table: Table, engine: str) -> Mapping[str, Hits]:
    return count(table[table["engine"] == engine])


def _true(table: Table, name: str) -> np.ndarray:
    return np.asarray(table[name], dtype=bool)


def said(hits: Hits) -> str:
    """Cases of all, and Wilson's 95 % bounds of the share.

    Examples
    --------
    >>> said((8, 10))
    '8 of 10 (49 to 94 %)'
    """
    low, high = wilson(*hits)
    return f"{hits[0]} of {hits[1]} ({100 * low:.0f} to {100 * high:.0f} %)"


SILICON_CASES: dict[str, Callable[[Rows], str]] = (
    {
        f"silicon {name}": lambda r, n=name: said(count(of_sets(r))[n])
        for name in ("alarms", "detected", "class", "first", "values")
    }
    | {
        f"silicon class {short}": lambda r, e=engine: said(
            _by_engine(of_sets(r), e)["class"]
        )
        for short, engine in (
            ("solver", "poisson"),
            ("images", "image charge"),
            ("program", "poisson_ccd"),
        )
    }
    | {
        "silicon seconds": lambda r: f"{np.median(of_sets(r)['cpu_s']):.0f}",
        "silicon slowest": lambda r: f"{np.max(of_sets(r)['cpu_s']):.0f}",
    }
)
"""Numbers by name, as functions of the results."""
