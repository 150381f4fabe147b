"""Numbers on pieces of silicon physics that docs/concepts/silicon_pieces.md quotes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from astropy.table import Table

Rows = Callable[[str], Table]
"""Gives the rows of a results file by its name."""

RESULTS = "silicon_pieces"
PIECES = (
    "free_holes", "stop_diffusion", "oxide_charge", "fewer_gates", "more_gates", "back_bias",
    "gate_high", "gate_low", "charge_diffusion",
)  # fmt: skip
"""Pieces with changes of a_ij and of spots."""


def select(rows: Rows, piece: str, what: str, **values: object) -> Table:
    """Rows of a piece and quantity that have these values."""
    table = rows(RESULTS)
    keep = (table["piece"] == piece) & (table["what"] == what)
    for name, value in values.items():
        keep &= np.asarray(table[name] == value)
    return table[keep]


def value(rows: Rows, piece: str, what: str, form: str = ".2g", **values: object) -> str:
    """Value of the only row."""
    (row,) = select(rows, piece, what, **values)
    return f"{row['value']:{form}}"


def with_error(
    rows: Rows, piece: str, what: str, form: str = ".2f", **values: object
) -> str:
    """Value of the only row and its error."""
    (row,) = select(rows, piece, what, **values)
    return f"{row['value']:{form}} +- {row['error']:{form}}"


def signed_areas(rows: Rows, piece: str) -> str:
    """Changes of a_00, a_10, a_01 and a_11 [%] at the usual condition."""
    found = {
        (r["i"], r["j"]): float(r["value"])
        for r in select(rows, piece, "a_ij", at="620 nm, -50 V")
    }
    return ", ".join(f"{found[lag]:+.2g}" for lag in ((0, 0), (1, 0), (0, 1), (1, 1)))


def spots(rows: Rows, piece: str) -> str:
    """Changes of the growth of spots in x and y [%]."""
    return ", ".join(value(rows, piece, f"spot_{axis}", "+.2g") for axis in "xy")


def best(rows: Rows, piece: str) -> str:
    """Condition with the largest change over all a_ij, and that change [%]."""
    table = select(rows, piece, "length")
    row = table[int(np.argmax(table["value"]))]
    return f"{row['at']} ({row['value']:.2g} %)"


def span(rows: Rows, what: str, form: str) -> str:
    """Least and largest expected growth of the variance over devices and voltages."""
    found = select(rows, "charge_diffusion", what)["value"]
    return f"{min(found):{form}} to {max(found):{form}}"


def found(rows: Rows, case: str, form: str, factor: float = 1.0) -> str:
    """Value and 68 % error of a concealed case, and whether it stood out."""
    table = rows("silicon_pieces_found")
    (row,) = table[table["case"] == case]
    error = 0.5 * (row["high68"] - row["low68"])
    return f"{factor * row['value']:{form}} +- {factor * error:{form}}"


def _numbers() -> dict[str, Callable[[Rows], str]]:
    diffusion = "charge_diffusion"
    out: dict[str, Callable[[Rows], str]] = {}
    for piece in PIECES:
        short = piece.replace("_", " ")
        out[f"{short} areas"] = lambda r, p=piece: signed_areas(r, p)
        out[f"{short} spots"] = lambda r, p=piece: spots(r, p)
        out[f"{short} best"] = lambda r, p=piece: best(r, p)
    out |= {
        "expected alone": lambda r: span(r, "expected, charged pixel", ".1f"),
        "expected centre": lambda r: span(
            r, "expected, centre of the charged pixel", ".1f"
        ),
        "expected spots": lambda r: span(r, "expected, spots of 10 um", ".1f"),
        "expected flat": lambda r: span(r, "expected, all pixels", ".1f"),
        "expected flat itl": lambda r: value(
            r, diffusion, "expected, all pixels", ".2f", device="itl_sta3800c", at="-50 V"
        ),
        "diffusion width": lambda r: value(
            r, diffusion, "width", ".1f", device="itl_sta3800c", at="-50 V"
        ),
        "traced flat": lambda r: with_error(r, diffusion, "traced, all pixels"),
        "diffused first 20": lambda r: with_error(
            r, diffusion, "area lost, diffused first over in the field", at="20000 e-"
        ),
        "diffused first 80": lambda r: with_error(
            r, diffusion, "area lost, diffused first over in the field", at="80000 e-"
        ),
        "spots by 1 %": lambda r: value(r, diffusion, "growth of spots of 10 um by 1 %"),
        "expected share": expected_share,
        "found 5": lambda r: found(r, "diffusion, 5 %", ".2f"),
        "found half": lambda r: found(r, "diffusion, 0.5 %", ".2f"),
        "found two electrons": lambda r: found(r, "two electrons", ".2f", 100.0),
        **{
            f"gap {level}": partial(
                with_error,
                piece=diffusion,
                what="direct over sensor, less 1",
                form=".1f",
                at=f"{level}000 e-",
            )
            for level in (20, 80, 150)
        },
        "growth for gap 150": lambda r: with_error(
            r, diffusion, "growth that would explain it", ".1f", at="150000 e-"
        ),
        "extra 350": lambda r: value(r, "quantum_yield", "extra", at="350 nm"),
        "extra 400": lambda r: value(r, "quantum_yield", "extra", at="400 nm"),
        "yield variance 400": lambda r: value(r, "quantum_yield", "variance", at="400 nm"),
        "yield neighbour 400": lambda r: value(
            r, "quantum_yield", "covariance", at="400 nm", i=1, j=0
        ),
        "yield sum 400": lambda r: value(r, "quantum_yield", "all lags", at="400 nm"),
        "columns 10": lambda r: columns(r, "largest change of a covariance over C_10", 10),
        "columns 20": lambda r: columns(r, "largest change of a covariance over C_10", 20),
        "columns apart": lambda r: columns(r, "C_10 of even columns less that of odd", 10),
        "columns pattern": lambda r: value(
            r, "columns", "pattern of widths at 1e5 e- over that at 0", ".0f"
        ),
        "drift time": lambda r: value(r, "clouds", "drift time", ".1f"),
        "in flight 1e5": lambda r: value(
            r, "clouds", "electrons in flight", ".1g", at="100000 e-/s"
        ),
        "in flight 1e9": lambda r: value(
            r, "clouds", "electrons in flight", ".1f", at="1e+09 e-/s"
        ),
        "push": lambda r: value(r, "clouds", "push", ".1g"),
        "dead layer light": lambda r: value(r, "dead_layer", "light lost", ".0f"),
        "dead layer areas": dead_areas,
    }
    return out


def columns(rows: Rows, what: str, part: int) -> str:
    """Row of columns whose edges move alternately more and less by ``part`` %."""
    return value(rows, "columns", what, at=f"edges {part} % more and less")


def expected_share(rows: Rows) -> str:
    """Growth of spots of 10 um by the expected diffusion [%], ITL at -50 V."""
    diffusion = "charge_diffusion"
    (one,) = select(rows, diffusion, "growth of spots of 10 um by 1 %")
    at = {"device": "itl_sta3800c", "at": "-50 V"}
    (growth,) = select(rows, diffusion, "expected, spots of 10 um", **at)
    return f"{one['value'] * growth['value']:.1f}"


def dead_areas(rows: Rows) -> str:
    """Largest change of the nearest a_ij by a dead layer [%]."""
    return f"{max(abs(select(rows, 'dead_layer', 'a_ij')['value'])):.2g}"


SILICON_PIECES = {f"piece {name}": number for name, number in _numbers().items()}
"""Numbers by name, as functions of the results."""
