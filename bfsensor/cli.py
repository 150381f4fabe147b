"""The command line: ``bfsensor COMMAND``."""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import click

from bfsensor.cli_common import load_device, parse_settings
from bfsensor.cli_measure import measure
from bfsensor.cli_spots import spots
from bfsensor.errors import BFSensorError


class _Group(click.Group):
    """Turns the package's errors into one line on stderr and exit status 1."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except BFSensorError as error:
            click.echo(f"bfsensor: {error}", err=True)
            ctx.exit(1)
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            click.echo(f"bfsensor: {where}{error.strerror or error}", err=True)
            ctx.exit(1)
        except KeyboardInterrupt:
            click.echo(
                "bfsensor: interrupted; what is finished is kept, run again to go on",
                err=True,
            )
            ctx.exit(130)


@click.group(
    cls=_Group,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="bfsensor")
def main() -> None:
    """Device physics of thick CCDs: from a device file to distorted pixel boundaries."""


def _numbers(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    if value is None:
        return None
    try:
        return tuple(float(v) for v in value.split(","))
    except ValueError:
        raise click.BadParameter(
            f"{value!r} is not a list of numbers such as 0,25000,50000"
        ) from None


@main.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON for a program to read.")
def devices(as_json: bool) -> None:
    """List the built-in devices.

    \b
    Example:
      bfsensor devices
    """
    from bfsensor.device import Device, builtin_devices

    rows = []
    for name in builtin_devices():
        device = Device.load(name)
        point = device.operating_point
        rows.append(
            {
                "name": name,
                "pitch [um]": device.pixel.pitch_x,
                "thickness [um]": device.silicon.thickness,
                "gates low/high [V]": f"{point.gate_low:g}/{point.gate_high:g}",
                "back bias [V]": point.back_bias,
                "temperature [K]": point.temperature,
            }
        )
    if as_json:
        click.echo(json.dumps(rows, indent=1))
        return
    _print_table(rows)


def _print_table(rows: Sequence[dict[str, Any]]) -> None:
    names = list(rows[0])
    cells = [
        [f"{row[n]:g}" if isinstance(row[n], float) else str(row[n]) for n in names]
        for row in rows
    ]
    widths = [max(len(n), *(len(c[i]) for c in cells)) for i, n in enumerate(names)]
    click.echo("  ".join(n.ljust(w) for n, w in zip(names, widths, strict=True)).rstrip())
    for row in cells:
        click.echo("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip())


@main.command()
@click.argument("device")
@click.option("--set", "settings", multiple=True, callback=parse_settings, metavar="KEY=VALUE",
              help="Change a quantity: --set back_bias=-60V (repeatable).")  # fmt: skip
@click.option(
    "--charges", callback=_numbers, metavar="Q,Q,...", help="Source charges [e-]."
)
@click.option("--backgrounds", callback=_numbers, metavar="B,B,...",
              help="Uniform charges of all other pixels [e-].")  # fmt: skip
@click.option("--depths", callback=_numbers, metavar="Z,Z,...",
              help="Conversion depths [um above the gates].")  # fmt: skip
@click.option(
    "--vertices", default=32, show_default=True, help="Vertices a side between corners."
)
@click.option(
    "--pixels", default=9, show_default=True, help="Width of the table [pixel], odd."
)
@click.option("--accuracy", default=0.01, show_default=True,
              help="Mesh accuracy aimed at (measured errors go to the header).")  # fmt: skip
@click.option("--workers", type=click.IntRange(min=1), default=2, show_default=True,
              help="Processes.")  # fmt: skip
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Table to write [DEVICE.fits]."
)
@click.option("--galsim", type=click.Path(path_type=Path), metavar="STEM",
              help="Write STEM.cfg and STEM.dat for galsim.SiliconSensor instead: one "
              "charge, no background, one depth.")  # fmt: skip
@click.option(
    "--assess/--no-assess",
    default=None,
    help="Measure mesh, tracing and superposition errors for the header [whole tables].",
)
@click.option(
    "--figure/--no-figure", default=True, help="Draw the table beside it (needs [plots])."
)
@click.option("--overwrite", is_flag=True, help="Replace an existing output.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def table(
    device: str,
    settings: list[tuple[str, str]],
    charges: tuple[float, ...] | None,
    backgrounds: tuple[float, ...] | None,
    depths: tuple[float, ...] | None,
    vertices: int,
    pixels: int,
    accuracy: float,
    workers: int,
    output: Path | None,
    galsim: Path | None,
    assess: bool | None,
    figure: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Solve a DEVICE (name or .toml) and write its distortion table.

    The table holds the displacement of every vertex of the pixel boundaries against the
    charge of a source pixel, the uniform charge of all others, and the conversion depth.
    An interrupted run goes on where it was when the same command is given again.

    \b
    Examples:
      bfsensor table itl_sta3800c -o itl.fits
      bfsensor table e2v_ccd250 --set back_bias=-70V --galsim sensors/e2v_70
    """
    from tqdm import tqdm

    from bfsensor.build import build_table, peak_memory, plan_table
    from bfsensor.errors import TableError
    from bfsensor.galsim_format import write_galsim

    began, cpu_began = time.perf_counter(), _cpu_seconds()
    loaded = load_device(device, settings)
    if galsim is not None:
        charges = charges or (100000.0,)
        backgrounds = (0.0,)
        depths = depths or (95.0 / 100.0 * loaded.silicon.thickness,)
        if len(charges) != 1 or len(depths) != 1:
            raise TableError(
                f"a GalSim table holds one charge and one depth, not {len(charges)} and "
                f"{len(depths)}"
            )
        targets = [galsim.with_name(galsim.name + ending) for ending in (".cfg", ".dat")]
    else:
        targets = [output or Path(f"{loaded.name}.fits")]
    for target in targets:
        if target.exists() and not overwrite:
            raise TableError(f"{target} exists; give --overwrite to replace it")
        if not target.parent.is_dir():
            raise TableError(f"{target.parent} is not a folder")
    plan = plan_table(
        loaded, charges=charges, backgrounds=backgrounds, depths=depths, vertices=vertices,
        pixels=pixels, accuracy=accuracy,
    )  # fmt: skip
    click.echo(
        f"{loaded.name}: full well {plan.full_well:,.0f} e-, {len(plan.charges)} charges x "
        f"{len(plan.backgrounds)} backgrounds x {len(plan.depths)} depths, {plan.cells} "
        "cells a pixel",
        err=True,
    )
    checkpoint = targets[0].with_name(targets[0].name + ".levels")
    bar = tqdm(
        total=len(plan.charges) * len(plan.backgrounds), unit="level", file=sys.stderr
    )

    def progress(done: int, total: int) -> None:
        bar.n = done
        bar.refresh()

    provenance = {"command": " ".join(["bfsensor", *sys.argv[1:]])}
    executor = ProcessPoolExecutor(workers) if workers > 1 else None
    try:
        errors = None
        if assess if assess is not None else galsim is None:
            errors = _start_assessment(plan, executor, checkpoint)
        result = build_table(
            plan, executor=executor, checkpoint=checkpoint, progress=progress,
            errors=errors, provenance=provenance,
        )  # fmt: skip
    finally:
        bar.close()  # ends its line, before any message
        if executor is not None:
            executor.shutdown(cancel_futures=True)
    if galsim is not None:
        write_galsim(
            result,
            galsim,
            charge=plan.charges[0],
            depth=plan.depths[0],
            overwrite=overwrite,
        )
    else:
        result.write(targets[0], overwrite=overwrite)
    shutil.rmtree(checkpoint)
    written = [str(t) for t in targets]
    if figure:
        drawn = _draw(result, targets[0].with_suffix(".png"))
        written += [drawn] if drawn else []
    summary = {
        "written": written,
        "full_well_e": plan.full_well,
        "cells_a_pixel": plan.cells,
        "nodes": result.provenance.get("nodes"),
        "newton_steps": int(result.provenance["newton steps"]),
        "linear_iterations": int(result.provenance["linear iterations"]),
        "errors": dict(result.errors),
        "cpu_s": round(_cpu_seconds() - cpu_began, 1),
        "wall_s": round(time.perf_counter() - began, 1),
        "memory_GB": round(peak_memory(), 3),
    }
    if as_json:
        click.echo(json.dumps(summary, indent=1, default=str))
    else:
        for key, value in summary.items():
            click.echo(f"{key:18} {_plain(value)}")


def _start_assessment(
    plan: Any, executor: ProcessPoolExecutor | None, checkpoint: Path
) -> Callable[[], dict[str, float]]:
    """Begin to measure the errors of a table; the answer is kept like its levels."""
    from bfsensor.assess import assess
    from bfsensor.errors import TableError
    from bfsensor.files import written_whole

    kept = checkpoint / plan.key / "errors.json"
    if kept.exists():
        return lambda: dict(json.loads(kept.read_text()))
    pending = executor.submit(assess, plan) if executor is not None else None

    def finish() -> dict[str, float]:
        errors = pending.result() if pending is not None else assess(plan)
        with written_whole(kept, TableError) as beside:
            beside.write_text(json.dumps(errors))
        return errors

    return finish


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value))
    if isinstance(value, dict):
        return "; ".join(
            f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in value.items()
        )
    return f"{value:,.0f}" if isinstance(value, float) and value > 1000 else str(value)


def _draw(result: Any, path: Path) -> str | None:
    """Draw a table beside it; says so and goes on where matplotlib is missing."""
    from bfsensor import show

    try:
        figure = show.figure_for_table(result)
    except BFSensorError as error:
        click.echo(f"bfsensor: no figure: {error}", err=True)
        return None
    figure.savefig(path, dpi=120)
    return str(path)


def _cpu_seconds() -> float:
    import resource

    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


@main.group()
def device() -> None:
    """Make and check device files."""


@device.command("import")
@click.argument("cfg", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Device file [FILE.toml]."
)
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def import_(cfg: Path, output: Path | None, overwrite: bool) -> None:
    """Turn a Poisson_CCD or GalSim configuration CFG into a device file.

    \b
    Example:
      bfsensor device import lsst_itl_50_8.cfg -o itl.toml
    """
    from bfsensor.device_import import import_poisson_ccd
    from bfsensor.errors import DeviceError

    result = import_poisson_ccd(cfg)
    target = output or cfg.with_suffix(".toml")
    if target.exists() and not overwrite:
        raise DeviceError(f"{target} exists; give --overwrite to replace it")
    result.write(target)
    click.echo(f"{target}: {result.name}")


@main.command()
@click.argument("source")
@click.option("--set", "settings", multiple=True, callback=parse_settings, metavar="KEY=VALUE",
              help="Change a device quantity (repeatable).")  # fmt: skip
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Figure [SOURCE.png]."
)
def show(source: str, settings: list[tuple[str, str]], output: Path | None) -> None:
    """Draw a table (.fits, GalSim stem) or a DEVICE (name or .toml).

    A table: distorted pixel boundaries with their areas, the response against charge,
    background and depth.  A device: potentials, carriers and electron paths of an empty and
    a filled pixel.

    \b
    Examples:
      bfsensor show itl.fits -o itl.png
      bfsensor show itl_sta3800c -o device.png
    """
    from bfsensor import show as figures
    from bfsensor.galsim_format import read_galsim
    from bfsensor.table import DistortionTable

    path = Path(source)
    is_stem = (
        path.with_name(path.name + ".dat").exists()
        and path.with_name(path.name + ".cfg").exists()
    )
    if path.suffix == ".fits" or is_stem:
        result = read_galsim(path) if is_stem else DistortionTable.read(path)
        drawn = {"": figures.figure_for_table(result)}
        target = output or path.with_suffix(".png")
    else:
        loaded = load_device(source, settings)
        drawn = figures.figure_for_device(loaded)
        target = output or Path(f"{loaded.name}.png")
    for name, figure in drawn.items():
        where = target.with_name(f"{target.stem}_{name}{target.suffix}") if name else target
        figure.savefig(where, dpi=120)
        click.echo(str(where))


main.add_command(spots)
main.add_command(measure)


if __name__ == "__main__":
    main()
