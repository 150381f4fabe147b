"""The command line: ``bfsensor COMMAND``."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from bfsensor.cli.check import check
from bfsensor.cli.common import LOG, load_device, settings_option, start_log
from bfsensor.cli.device import device
from bfsensor.cli.diagnose import diagnose
from bfsensor.cli.export import export
from bfsensor.cli.fit import fit
from bfsensor.cli.measure import measure
from bfsensor.cli.spots import spots
from bfsensor.cli.sweep import sweep
from bfsensor.cli.table import table
from bfsensor.cli.warm import warm
from bfsensor.errors import BFSensorError

_EPILOG = """\b
Results go to stdout and files, messages and progress to stderr: a bar on a terminal, elsewhere
a line every 30 s at most. Python programs find the messages under logging's name 'bfsensor'.

\b
Most commands take --json and print the same results for a program to read.

\b
Status: 0 done, whatever was found; 1 an error, one line on stderr says which; 2 a wrong option or
argument; 130 interrupted.

\b
Shell completion: eval "$(_BFSENSOR_COMPLETE=bash_source bfsensor)" in ~/.bashrc; zsh_source for
zsh in ~/.zshrc; for fish: _BFSENSOR_COMPLETE=fish_source bfsensor | source
"""


class _Commands(click.Group):
    """Turns the package's errors into one line on stderr and exit status 1."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except BFSensorError as error:
            LOG.debug("where it happened:", exc_info=True)
            click.echo(f"bfsensor: {error}", err=True)
            ctx.exit(1)
        except OSError as error:
            LOG.debug("where it happened:", exc_info=True)
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
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog=_EPILOG,
)
@click.version_option(package_name="bfsensor")
@click.option("-v", "--verbose", is_flag=True,
              help="Say more on stderr: versions, seconds, where an error happened.")  # fmt: skip
@click.option("-q", "--quiet", is_flag=True, help="Say nothing on stderr but errors.")
@click.pass_context
def main(context: click.Context, verbose: bool, quiet: bool) -> None:
    """Device physics of thick CCDs: from a device file to distorted pixel boundaries."""
    if verbose and quiet:
        raise click.UsageError("--verbose and --quiet exclude one another")
    start_log(verbose, quiet)
    if verbose:
        began, cpu_began = time.perf_counter(), time.process_time()
        LOG.debug("%s", _versions())
        context.call_on_close(
            lambda: LOG.debug(
                "%.1f s, of them %.1f s of CPU in this process",
                time.perf_counter() - began,
                time.process_time() - cpu_began,
            )
        )


def _versions() -> str:
    """Name what results depend on, without importing it."""
    from importlib.metadata import version

    from bfsensor import __version__

    own = [f"bfsensor {__version__}", f"python {sys.version.split()[0]}"]
    names = ("numpy", "scipy", "numba", "galsim", "astropy")
    return ", ".join([*own, *(f"{name} {version(name)}" for name in names)])


@main.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON for a program to read.")
def devices(as_json: bool) -> None:
    """List the built-in devices.

    \b
    Example:
      bfsensor devices
    """
    from bfsensor.device.device import Device, builtin_devices

    rows = []
    for name in builtin_devices():
        loaded = Device.load(name)
        point = loaded.operating_point
        rows.append(
            {
                "name": name,
                "pitch [um]": loaded.pixel.pitch_x,
                "thickness [um]": loaded.silicon.thickness,
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
@click.argument("source")
@settings_option
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Figure [SOURCE.png]."
)
def show(source: str, settings: list[tuple[str, str]], output: Path | None) -> None:
    """Draw a table (.fits, GalSim stem) or a DEVICE (name or .toml).

    A table: distorted pixel boundaries with their areas, the response against charge,
    background and depth.  A device, four figures, each with its name before the suffix:
    potentials and carriers (profiles, sections), drift paths (paths), and electrons that
    drift, that diffuse, and that a full pixel repels (diffusion).

    \b
    Examples:
      bfsensor show itl.fits -o itl.png
      bfsensor show itl_sta3800c -o device.png
    """
    from bfsensor.plots import table as figures
    from bfsensor.table.galsim_format import read_galsim
    from bfsensor.table.table import DistortionTable

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


main.add_command(device)
main.add_command(table)
main.add_command(sweep)
main.add_command(spots)
main.add_command(measure)
main.add_command(check)
main.add_command(diagnose)
main.add_command(fit)
main.add_command(export)
main.add_command(warm)


if __name__ == "__main__":
    main()
