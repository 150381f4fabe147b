"""``bfsensor sweep``: the response of a device over voltages, thickness, temperature, light."""

from __future__ import annotations

import json
import math
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
from bfsensor.files import held


@click.command(short_help="Compute a_ij over voltages and more.")
@device_options
@click.option("--over", "over", multiple=True, required=True, callback=parse_settings,
              metavar="KEY=VALUES",
              help="Quantity to sweep and its values, as first:last:number (back_bias=-30V:-70V:5) or "
              "as a list (thickness=80um,100um); repeatable.")  # fmt: skip
@click.option("--paired", is_flag=True,
              help="Combine the first values of all --over, then the second ones, and so on.  "
              "[default: every value with every other]")  # fmt: skip
@click.option("--level", default=40_000.0, show_default=True,
              help="Uniform charge of all pixels at which the response is computed [e-].")  # fmt: skip
@click.option("--full-pixel", default=0.0, metavar="Q",
              help="Also compute the area changes around one pixel of Q electrons among empty "
              "pixels [e-]; 0 switches it off.  [default: 0]")  # fmt: skip
@click.option("--cells", type=int, help="Mesh cells per pixel.  [default: 32]")
@click.option("--accuracy", type=float,
              help="Choose the mesh by the relative accuracy of area changes, as 'bfsensor table' "
              "does; not with --cells.")  # fmt: skip
@executor_options
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="ECSV file to write.  [default: DEVICE_sweep.ecsv]")  # fmt: skip
@click.option("--tables", type=click.Path(path_type=Path), metavar="FOLDER",
              help="Also write, for every point, a distortion table of the response at "
              "--level.")  # fmt: skip
@click.option("--plot", type=click.Path(path_type=Path), metavar="FIG",
              help="Draw a_ij against the quantity with most values; needs "
              "bfsensor[plots].")  # fmt: skip
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
    """Compute a_ij of a DEVICE for every combination of the values of swept quantities.

    DEVICE is a .toml file or a name of 'bfsensor devices'.  Each point is one row of OUTPUT: a_ij
    [1/e-] for lags (0, 0) to (2, 2) with their numerical error, the full well [e-] and the CPU
    time.  Any quantity of the device file can be swept, and wavelength (without it light converts
    at the back surface).  Finished points are kept in OUTPUT.points until all are done: repeat the
    command to continue an interrupted run.

    A point that the device cannot take (silicon not depleted, full well below --level, ...) or
    that does not converge is a row with a reason and no numbers.  The other points are still
    written, and the exit status is 1.

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
    context.with_resource(held(work, SweepError))
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
    """Count the points and refusals, and name the files, mesh and CPU seconds."""
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
    """Mesh cells per pixel: as given, or the fewest that reach the accuracy of tables."""
    from bfsensor.sweeps.points import CELLS
    from bfsensor.table.table_plan import ACCURACIES

    if cells is not None and accuracy is not None:
        raise click.UsageError("--cells and --accuracy: give one of them")
    if accuracy is None:
        return CELLS if cells is None else cells
    fitting = [n for limit, n in ACCURACIES.items() if limit <= accuracy * (1 + 1e-9)]
    if not fitting or not math.isfinite(accuracy):
        raise SweepError(
            f"accuracy = {accuracy:g} must be finite and at least {min(ACCURACIES):g}"
        )
    return min(fitting)


def _print(made: Any) -> None:
    """Print a_ij of the nearest lags, or the reason for a refusal, for every point."""
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
    from bfsensor.plots.style import save_figure
    from bfsensor.plots.sweep import figure_for_sweep

    save_figure(figure_for_sweep(made), path)
    return [str(path)]
