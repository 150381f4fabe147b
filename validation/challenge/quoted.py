"""Numbers on campaigns of raw frames that documents quote: fresh ones beside the frozen ones."""

from __future__ import annotations

from collections.abc import Callable

from astropy.table import Table

from validation.concealed.opening import trial_from_row
from validation.concealed.tally import tally, wilson

Rows = Callable[[str], Table]
"""Gives the rows of a results file by its name."""
FRESH = ("tt", "uu")
"""Sets of size S that were made after the diagnosis at 8d13aae and 5b559fd."""
FROZEN = "7325d18"
"""Commit of the frozen campaigns."""
QUANTITIES = {
    "alarms": "false alarms on nulls, p < 0.01",
    "named": "first named is true, SNR >= 8",
    "values": "coverage of 95 % intervals",
}
"""What is quoted, by its name in :data:`validation.concealed.tally.GOALS`."""


def _shares(table: Table) -> dict[str, str]:
    """Hits of trials and Wilson's 95 % bounds, by quantity, of campaigns of size S."""
    own = [
        dict(zip(table.colnames, row, strict=True)) for row in table if row["size"] == "S"
    ]
    lines = {line.quantity: line for line in tally([trial_from_row(r).score for r in own])}
    out = {}
    for name, quantity in QUANTITIES.items():
        hits, trials = lines[quantity].hits, lines[quantity].trials
        low, high = wilson(hits, trials)
        out[name] = f"{hits} of {trials} ({100 * low:.0f} to {100 * high:.0f} %)"
    return out


def fresh(rows: Rows) -> dict[str, str]:
    """Shares in the sets :data:`FRESH`, by name."""
    table = rows("challenge_pixels_again")
    return _shares(table[[str(s) in FRESH for s in table["set"]]])


def frozen(rows: Rows) -> dict[str, str]:
    """Shares in the campaigns of size S that were diagnosed at :data:`FROZEN`, by name."""
    table = rows("challenge_pixels")
    return _shares(table[[str(c) == FROZEN for c in table["commit"]]])


RAW_FRAMES: dict[str, Callable[[Rows], str]] = {
    f"{word} {name}": lambda r, n=name, f=found: f(r)[n]
    for name in QUANTITIES
    for word, found in (("fresh", fresh), ("frozen", frozen))
}
"""Numbers by name, as functions of the results."""
