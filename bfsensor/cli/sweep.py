"""``bfsensor sweep``: the response of a device over voltages, thickness, temperature, light."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import click

from bfsensor.cli.common import (
    check_targets,
    device_options,
    executor_options,
    load_device,
    overwrite_option,
    parse_settings,
    progress_bar,
    summary_option,
)
from bfsensor.errors import SweepError


@click.command()
@device_options
@click.option("--over", "over", multiple=True, required=True, callback=parse_settings,
              metavar="KEY=VALUES",
              help="Quantity and values: back_bias=-30V:-70V:5 (first, last, how many) or "
              "thickness=80um,100um; repeatable.")  # fmt: skip
@click.option("--paired", is_flag=True,
              help="First values together, then second ones, ...; not all with all.")  # fmt: skip
@click.option("--level", default=40_000.0, show_default=True,
              help="Charge of all pixels about which the response is taken [e-].")  # fmt: skip
@click.option("--full-pixel", default=0.0, metavar="Q",
              help="Area changes around one pixel of Q electrons among empty ones too.")  # fmt: skip
@click.option("--cells", type=int, help="Mesh cells a pixel [16].")
@click.option("--accuracy", type=float,
              help="Instead: mesh accuracy aimed at, as of bfsensor table.")  # fmt: skip
@executor_options
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="ECSV to write [DEVICE_sweep.ecsv].")  # fmt: skip
@click.option("--tables", type=click.Path(path_type=Path), metavar="FOLDER",
              help="Write the table of the response about the level at every point.")  # fmt: skip
@click.option("--plot", type=click.Path(path_type=Path), metavar="FIG",
              help="Draw a_ij against the quantity with most values (needs [plots]).")  # fmt: skip
@overwrite_option
@summary_option
@click.pass_context
def sweep(
    context: click.Context,
    device: str,
    over: list[tuple[str, str]],
    paired: bool,
    settings: list[tuple[str, str]],
    level: float,
    full_pixel: float,
    cells: int | None,
    accuracy: float | None,
    workers: int,
    executor: str,
    output: Path | None,
    tables: Path | None,
    plot: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Solve a DEVICE (name or .toml) anew for every value of swept quantities.

    One row a point: a_ij of the lags (0, 0) to (2, 2), the differential response about a
    level that flats see, with its numerical error; full well; cost.  A key is any quantity of
    the device file, or wavelength (without it light converts at the back surface).  Points
    that are done are kept in OUTPUT.points until all are: a run that was interrupted goes on
    when the same command is given again.

    A point that the device refuses (not depleted, a full well below the level, ...) or that
    does not converge is a row with a reason and no numbers; all others are solved, the file
    is written, and the exit status is 1.

    \b
    Examples:
      bfsensor sweep itl_sta3800c --over back_bias=-30V:-70V:5 --plot bias.png
      bfsensor sweep e2v_ccd250 --over thickness=80um,100um --over wavelength=400nm:1000nm:13
      bfsensor sweep itl_sta3800c --paired --over gate_low=-8V,-6V --over gate_high=2V,6V
    """
    from bfsensor.sweeps.axes import combine, parse_swept
    from bfsensor.sweeps.device_sweep import sweep_device
    from bfsensor.sweeps.executors import open_executor

    mesh = _cells(cells, accuracy)
    loaded = load_device(device, settings)
    swept = [parse_swept(key, text, loaded) for key, text in over]
    count = len(combine(swept, paired=paired))
    target = output or Path(f"{loaded.name}_sweep.ecsv")
    check_targets([target, *([plot] if plot else [])], overwrite, SweepError)
    work = target.with_name(target.name + ".points")
    with (
        progress_bar("point") as progress,
        open_executor(executor, min(workers, count + 2)) as pool,
    ):
        made = sweep_device(
            loaded, swept, paired=paired, level=level, full_pixel=full_pixel, cells=mesh,
            work=work, tables=tables, executor=pool, progress=progress,
            command=" ".join(["bfsensor", *sys.argv[1:]]),
        )  # fmt: skip
    made.write(target, overwrite=overwrite)
    shutil.rmtree(work)
    drawn = _draw(made, plot)
    summary = _summarise(made, [str(target), *drawn])
    if as_json:
        click.echo(json.dumps(summary, indent=1))
    else:
        _print(made)
        click.echo(f"written: {', '.join(summary['written'])}")
    if summary["refused"]:
        click.echo(
            f"bfsensor: {summary['refused']} of {len(made.rows)} points have no answer; see the column "
            f"'reason' of {target}",
            err=True,
        )
        context.exit(1)


def _summarise(made: Any, written: list[str]) -> dict[str, Any]:
    """What was made, and at what cost."""
    return {
        "written": written,
        "points": len(made.rows),
        "refused": int(made.refused.sum()),
        "reasons": sorted({str(r) for r in made.rows["reason"] if r}),
        "level_e": made.rows.meta["level"],
        "cells_a_pixel": made.rows.meta["cells"],
        "cpu_s": round(float(made.rows["cpu"].sum()), 1),
    }


def _cells(cells: int | None, accuracy: float | None) -> int:
    """Cells a pixel: as stated, or for an accuracy, as of tables."""
    from bfsensor.sweeps.points import CELLS
    from bfsensor.table.table_plan import ACCURACIES

    if cells is not None and accuracy is not None:
        raise click.UsageError("--cells and --accuracy: give one of them")
    if accuracy is None:
        return CELLS if cells is None else cells
    fitting = [n for limit, n in ACCURACIES.items() if limit <= accuracy * (1 + 1e-9)]
    if not fitting:
        raise SweepError(f"accuracy = {accuracy:g} must be at least {min(ACCURACIES):g}")
    return min(fitting)


def _print(made: Any) -> None:
    """Print the nearest lags of every point."""
    shown = ("a_00", "a_10", "a_01", "a_11")
    units = [made.rows[n].unit for n in made.swept]
    heads = [f"{n} [{u}]" if u else n for n, u in zip(made.swept, units, strict=True)]
    click.echo("  ".join([*heads, *(f"{n} [1e-6/e-]" for n in shown)]))
    for row in made.rows:
        values = [
            f"{row[n]:g}".rjust(len(h)) for n, h in zip(made.swept, heads, strict=True)
        ]
        if row["reason"]:
            click.echo("  ".join([*values, f"refused: {row['reason']}"]))
            continue
        click.echo("  ".join([*values, *(f"{1e6 * row[n]:.5f}".rjust(14) for n in shown)]))


def _draw(made: Any, path: Path | None) -> list[str]:
    if path is None:
        return []
    if made.refused.all():
        click.echo("bfsensor: no figure: no point has an answer", err=True)
        return []
    from bfsensor.plots.sweep import figure_for_sweep

    figure_for_sweep(made).savefig(path, dpi=120)
    return [str(path)]
