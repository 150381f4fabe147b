"""What the pages of shipped tables say of them, made from the tables.

``python -m validation.table_readme [NAME...]`` rewrites in ``tables/NAME/README.md`` lines
that begin with :data:`MADE` and :data:`CHANGES`, the table of estimated errors, and of fitted devices
those of lags and parameters, from ``fit.json``; nothing is solved.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import click

from bfsensor.device.device import Device
from bfsensor.device.quantities import describe, quantities
from bfsensor.fit.result import FitResult
from bfsensor.table.table import DistortionTable

TABLES = Path(__file__).parents[1] / "tables"
MADE = "`table.fits`, made by "
CHANGES = "For 100,000 e- on an empty background"
ERRORS = "| estimated error (in the header) | |"
FITTED_LAGS = (
    "| lag | measured [1/e-] | stated error | before / measured | fitted / measured | "
    "pull, scaled errors |"
)
PARAMETERS = "| parameter | prior | fitted | pull from the prior |"
CHARGE, HEIGHT = 1e5, 95.0
LAGS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (3, 3))

NEAREST = 10
"""Square of the distance up to which fitted lags are listed [pixel^2].  Chosen: farther ones are below
1e-8 per electron; with 20, the page has 22 of the 24."""


def with_table(text: str, table: DistortionTable) -> str:
    """Text of a page with what the table gives."""
    reach, about = table.reach, table.provenance
    made = (
        f"{MADE}`{about['command']}`: {len(table.charges)} source charges (0 to "
        f"{table.charges.max():,.0f} e-), {len(table.backgrounds)} backgrounds (0 to "
        f"{table.backgrounds.max():,.0f} e-), {len(table.depths)} conversion depths "
        f"({table.depths[0]:.2g} to {table.depths[-1]:.4g} um above the gates), {2 * reach + 1} x "
        f"{2 * reach + 1} pixels, {table.vertices} vertices a side, {about['cells']} cells a pixel. "
        f"Full well {table.full_well:,.0f} e-."
    )
    areas = table.area_changes(charge=CHARGE, background=0.0, depth=HEIGHT)
    listed = ", ".join(f"({i},{j}) {areas[reach + j, reach + i]:.4g}" for i, j in LAGS)
    changes = (
        f"{CHANGES} and conversion at {HEIGHT:g} um the area changes [um^2] are {listed}."
    )
    new = {MADE: made, CHANGES: changes}
    lines = [
        next((new[start] for start in new if line.startswith(start)), line)
        for line in text.splitlines()
    ]
    errors = [f"| {name} | {value:.3g} |" for name, value in sorted(table.errors.items())]
    return _with_rows("\n".join(lines) + "\n", ERRORS, errors)


def with_fit(text: str, fit: FitResult) -> str:
    """Text of the page of a fitted device with lags and parameters of its fit."""
    (one,) = fit.sets
    order = sorted((i * i + j * j, -i, n) for n, (i, j) in enumerate(one.places.tolist()))
    lags = [
        f"| ({-minus},{int(one.places[n][1])}) | {one.values[n]:.3e} | {one.errors[n]:.1e} | "
        f"{one.before[n] / one.values[n]:.3f} | {one.after[n] / one.values[n]:.3f} +- "
        f"{one.after_error[n] / abs(one.values[n]):.3f} | {one.pulls[n]:+.2f} |"
        for square, minus, n in order
        if square <= NEAREST
    ]
    known = quantities(Device.from_toml(fit.device))
    parameters = []
    for k, name in enumerate(fit.parameters):
        unit = known[name]
        prior, spread, value, error = (
            unit.number(v[k]) for v in (fit.prior, fit.spread, fit.value, fit.error)
        )
        parameters.append(
            f"| {describe(name)} [{unit.unit}] | {prior:.4g} +- {spread:.2g} | {value:.4g} +- "
            f"{error:.2g} | {fit.pulls[k]:+.2f} |"
        )
    return _with_rows(_with_rows(text, FITTED_LAGS, lags), PARAMETERS, parameters)


def _with_rows(text: str, head: str, rows: Sequence[str]) -> str:
    """Text with other rows below the head of a table."""
    block = re.escape(head) + r"\n(\|[-|]+\|)\n(\|.*\|\n)+"
    return re.sub(block, lambda found: "\n".join([head, found[1], *rows]) + "\n", text)


def renewed(page: Path) -> str:
    """Text of a page as its table, and the fit of its device, give it."""
    text = with_table(page.read_text(), DistortionTable.read(page.parent / "table.fits"))
    fit = page.parent / "fit.json"
    return with_fit(text, FitResult.read(fit)) if fit.exists() else text


@click.command()
@click.argument("names", nargs=-1)
def main(names: tuple[str, ...]) -> None:
    """Rewrite the pages of shipped tables NAMES, by default of all that a device made."""
    for page in sorted(TABLES.glob("*/README.md")):
        if (names and page.parent.name not in names) or ERRORS not in page.read_text():
            continue
        page.write_text(renewed(page))
        click.echo(page.parent.name)


if __name__ == "__main__":
    main()
