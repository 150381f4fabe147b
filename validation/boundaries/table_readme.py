"""What the pages of shipped tables say of them, made from the tables.

``python -m validation.boundaries.table_readme [NAME...]`` rewrites in ``tables/NAME/README.md`` lines
that begin with :data:`MADE` and :data:`CHANGES`, and the table of estimated errors; nothing is solved.
"""

from __future__ import annotations

import re
from pathlib import Path

import click

from bfsensor.table.table import DistortionTable

TABLES = Path(__file__).parents[2] / "tables"
MADE = "`table.fits`, made by "
CHANGES = "For 100,000 e- on an empty background"
ERRORS = "| estimated error (in the header) | |"
CHARGE, HEIGHT = 1e5, 95.0
LAGS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (3, 3))


def written(text: str, table: DistortionTable) -> str:
    """Text of a page with what the table gives."""
    reach = table.reach
    about = table.provenance
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
    errors = "\n".join(
        f"| {name} | {value:.3g} |" for name, value in sorted(table.errors.items())
    )
    lines = []
    for line in text.splitlines():
        start = next((new for new in (made, changes) if line.startswith(new[:20])), None)
        lines.append(line if start is None else start)
    text = "\n".join(lines) + "\n"
    block = re.escape(ERRORS) + r"\n\|---\|---\|\n(\|.*\|\n)+"
    return re.sub(block, lambda _: f"{ERRORS}\n|---|---|\n{errors}\n", text)


@click.command()
@click.argument("names", nargs=-1)
def main(names: tuple[str, ...]) -> None:
    """Rewrite the pages of shipped tables NAMES, by default of all that a device made."""
    for page in sorted(TABLES.glob("*/README.md")):
        text = page.read_text()
        if (names and page.parent.name not in names) or ERRORS not in text:
            continue
        page.write_text(written(text, DistortionTable.read(page.parent / "table.fits")))
        click.echo(page.parent.name)


if __name__ == "__main__":
    main()
