"""``python -m validation.foreign make``: concealed campaigns by an engine and laws of their own."""

from __future__ import annotations

from pathlib import Path

import click
from astropy.table import Table
from tqdm import tqdm

from validation.common.run_header import run_header
from validation.foreign.accuracy import accuracy_rows, faults_of
from validation.foreign.campaign import Wish, make_set
from validation.foreign.departures import make_departures
from validation.foreign.laws import CLASSES, LAWS
from validation.foreign.nuisances import NUISANCES

RESULTS = Path(__file__).parents[1] / "results" / "foreign_accuracy.ecsv"


@click.group()
def main() -> None:
    """Concealed campaigns for scoring; `validation.concealed run` and `open` take the folders.

    \b
    Example:
      python -m validation.foreign make campaigns --count 200 --set scored --truth-folder sealed
    """


@main.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--count", default=1, show_default=True, help="Number of campaigns in the set."
)
@click.option("--set", "name", type=click.Choice(["dev", "scored"]), default="dev", show_default=True,
              help="Development seeds, or scored ones with a secret master salt.")  # fmt: skip
@click.option("--size", type=click.Choice(["S", "M", "X", "T"]), default="S", show_default=True,
              help="256, 512, 1024 (or, for tests, 128) pixels a side.")  # fmt: skip
@click.option(
    "--class", "word", type=click.Choice(CLASSES), default=None, help="One class for all."
)
@click.option("--law", default="", help="One law for all; `laws` lists them.")
@click.option("--null", is_flag=True, help="Nothing is left out.")
@click.option("--nuisances", default="some", show_default=True,
              help="all, none, some, or words with commas between.")  # fmt: skip
@click.option(
    "--seed", default=0, show_default=True, help="Counts from the set's first seed."
)
@click.option(
    "--snr", type=float, default=None, help="Projected SNR [3 to 5000, log-uniform]."
)
@click.option("--truth-folder", type=click.Path(path_type=Path), default=None,
              help="Where truths are sealed [OUT_sealed, beside OUT].")  # fmt: skip
def make(
    out: Path,
    count: int,
    name: str,
    size: str,
    word: str | None,
    law: str,
    null: bool,
    nuisances: str,
    seed: int,
    snr: float | None,
    truth_folder: Path | None,
) -> None:
    """Make a set of campaigns in OUT; the same command goes on with an interrupted one.

    \b
    Example:
      python -m validation.foreign make nulls --count 20 --null --nuisances all
      python -m validation.foreign make rings --class tree_rings --law growing_sum --snr 50
    """
    sealed = truth_folder or out.with_name(out.resolve().name + "_sealed")
    if null and (word or law):
        raise click.UsageError(
            "--null leaves nothing out: give no --class or --law with it"
        )
    try:
        wish = Wish(name, size, word or "", law, null, nuisances, seed, snr)
        made = make_set(
            out, sealed, wish, count, progress=lambda e, n: tqdm(e, desc=n, disable=None)
        )
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    click.echo(
        f"{out}: {len(made)} campaigns made, {count - len(made)} were there; truths in {sealed}"
    )


@main.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--truth-folder", type=click.Path(path_type=Path), default=None,
              help="Where truths are sealed [OUT_sealed, beside OUT].")  # fmt: skip
def departures(out: Path, truth_folder: Path | None) -> None:
    """Make the six campaigns of :mod:`validation.foreign.departures` in OUT.

    \b
    Example:
      python -m validation.foreign departures departures
    """
    sealed = truth_folder or out.with_name(out.resolve().name + "_sealed")
    made = make_departures(out, sealed)
    click.echo(f"{out}: {len(made)} campaigns made; truths in {sealed}")


@main.command()
def laws() -> None:
    """List the laws by class, with their sources, and the nuisances."""
    for (word, name), law in sorted(LAWS.items()):
        click.echo(f"{word:24s} {name:20s} {law.source}")
    for word, nuisance in NUISANCES.items():
        click.echo(f"{'nuisance':24s} {word:20s} {nuisance.source}")


@main.command()
@click.option("-o", "--output", type=click.Path(path_type=Path), default=RESULTS, show_default=True,
              help="ECSV that the rows are written to.")  # fmt: skip
def accuracy(output: Path) -> None:
    """Hold the covariances of the collection's scheme against the closed form.

    \b
    Example:
      python -m validation.foreign accuracy
    """
    rows = accuracy_rows()
    table = Table(rows=rows)
    table.meta.update(run_header("python -m validation.foreign accuracy"))
    beside = output.with_name(output.name + ".part")
    table.write(beside, format="ascii.ecsv", overwrite=True)
    beside.replace(output)
    click.echo(f"{output}: {len(rows)} rows")
    if faults := faults_of(rows):
        raise click.ClickException("; ".join(faults))


if __name__ == "__main__":
    main()
