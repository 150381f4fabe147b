"""The command line: ``bfsensor COMMAND``."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from bfsensor.cli.check import check
from bfsensor.cli.common import LOG, load_device, parse_figure, settings_option, start_log
from bfsensor.cli.correct import correct
from bfsensor.cli.device import device
from bfsensor.cli.diagnose import diagnose
from bfsensor.cli.export import export
from bfsensor.cli.fit import fit
from bfsensor.cli.measure import measure
from bfsensor.cli.spots import spots
from bfsensor.cli.sweep import sweep
from bfsensor.cli.table import table
from bfsensor.cli.warm import warm
from bfsensor.errors import BFSensorError, in_one_line

_EPILOG = """\b
Results go to stdout and to files; messages and progress go to stderr, progress as a bar on a
terminal and elsewhere as at most one line every 30 s. Python programs get the messages from the
logger 'bfsensor'.

\b
Most commands take --json and then print the same results as JSON.

\b
Example, from a built-in device to its distortion table and a figure of it:
  bfsensor table itl_sta3800c -o itl.fits

\b
Exit status: 0 done, whatever the results are; 1 an error, described by one line on stderr; 2 a
wrong option or argument; 130 interrupted, 143 by SIGTERM.

\b
Shell completion: eval "$(_BFSENSOR_COMPLETE=bash_source bfsensor)" in ~/.bashrc; zsh_source for
zsh in ~/.zshrc; for fish: _BFSENSOR_COMPLETE=fish_source bfsensor | source
"""


class _Commands(click.Group):
    """Group of commands whose errors end as one line on stderr and an exit status.

    An error of the package or of a file: 1.  An interruption from the keyboard: 130, by SIGTERM:
    143.  A closed pipe, as of ``| head``: no line, and click's status 1.
    """

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with _terminated_as_interrupted():
                return super().invoke(ctx)
        except click.ClickException as error:
            # click declares the message final; it quotes what was given, of any length.
            vars(error)["message"] = in_one_line(error.message, 500)
            raise
        except BFSensorError as error:
            LOG.debug("where it happened:", exc_info=True)
            click.echo(f"bfsensor: {error}", err=True)
            ctx.exit(1)
        except BrokenPipeError:
            raise  # click ends quietly, without flushing to the reader that is gone
        except OSError as error:
            LOG.debug("where it happened:", exc_info=True)
            where = f"{error.filename}: " if error.filename else ""
            click.echo(in_one_line(f"bfsensor: {where}{error.strerror or error}"), err=True)
            ctx.exit(1)
        except KeyboardInterrupt as error:
            click.echo(
                "bfsensor: interrupted; what is finished is kept, run again to go on",
                err=True,
            )
            ctx.exit(143 if isinstance(error, _TerminatedError) else 130)


class _TerminatedError(KeyboardInterrupt):
    """The process was asked to end by SIGTERM, as by batch systems."""


@contextlib.contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM interrupt as Ctrl-C does; only the main thread may choose."""

    def end(number: int, frame: object) -> None:
        raise _TerminatedError

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog=_EPILOG,
)
@click.version_option(package_name="bfsensor")
@click.option("-v", "--verbose", is_flag=True,
              help="Print versions, seconds used and tracebacks of errors to stderr.")  # fmt: skip
@click.option("-q", "--quiet", is_flag=True, help="Print only errors to stderr.")
@click.pass_context
def main(context: click.Context, verbose: bool, quiet: bool) -> None:
    """Simulate the brighter-fatter effect of thick CCDs, and measure and diagnose it.

    A device file states a sensor's geometry, doping and voltages; from it the commands compute
    how stored charge moves pixel boundaries, and compare that with recordings.
    """
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
    """Name the versions that results depend on, without importing the packages."""
    from importlib.metadata import version

    from bfsensor import __version__

    own = [f"bfsensor {__version__}", f"python {sys.version.split()[0]}"]
    names = ("numpy", "scipy", "numba", "galsim", "astropy")
    return ", ".join([*own, *(f"{name} {version(name)}" for name in names)])


@main.command(short_help="List the built-in devices.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON for a program to read.")
def devices(as_json: bool) -> None:
    """List the built-in devices with pixel pitch, thickness, operating point and origin.

    The origin is that of the doping, or 'fitted to covariances': such a device has measured a_ij
    and their image-charge model, and its doping and voltages stand in from another one.

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
                "origin": loaded.origin,
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


@main.command(short_help="Draw a distortion table or a device.")
@click.argument("source")
@settings_option
@click.option("-o", "--output", type=click.Path(path_type=Path), callback=parse_figure,
              help="Figure to write, .png, .pdf or .svg.  [default: SOURCE.png]")  # fmt: skip
def show(source: str, settings: list[tuple[str, str]], output: Path | None) -> None:
    """Draw figures of SOURCE: a distortion table or a device.

    SOURCE is a table (.fits, or the stem of GalSim's .cfg and .dat) or a device (.toml, or a name
    of 'bfsensor devices').

    A table gives one figure: distorted pixel boundaries with their areas, and the response
    against charge, background and conversion depth.  A device is solved first and gives four,
    with a word before the suffix: potentials and carrier densities (profiles, sections), drift
    paths (paths), and electrons that drift, diffuse and are repelled by a full pixel (diffusion).

    \b
    Examples:
      bfsensor show itl.fits -o itl.png
      bfsensor show itl_sta3800c -o device.png
    """
    from bfsensor.plots import table as figures
    from bfsensor.plots.style import save_figure
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
        save_figure(figure, where)
        click.echo(str(where))


main.add_command(device)
main.add_command(table)
main.add_command(sweep)
main.add_command(spots)
main.add_command(measure)
main.add_command(check)
main.add_command(correct)
main.add_command(diagnose)
main.add_command(fit)
main.add_command(export)
main.add_command(warm)


if __name__ == "__main__":
    main()
