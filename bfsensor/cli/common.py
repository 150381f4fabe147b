"""Options, checks, messages and progress bars that several commands share."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click
from tqdm import tqdm

from bfsensor.errors import BFSensorError

Command = TypeVar("Command", bound=Callable[..., Any])


def parse_settings(
    ctx: click.Context, param: click.Parameter, values: Sequence[str]
) -> list[tuple[str, str]]:
    """Split options of the form ``KEY=VALUE`` into pairs; refuse any other form."""
    out = []
    for value in values:
        key, sign, text = value.partition("=")
        if not sign or not key or not text:
            raise click.BadParameter(
                f"{value!r} is not of the form KEY=VALUE, such as back_bias=-60V"
            )
        out.append((key.strip(), text.strip()))
    return out


FIGURES = (".png", ".pdf", ".svg")
"""Suffixes of figures that commands write."""


def parse_figure(
    ctx: click.Context, param: click.Parameter, value: Path | None
) -> Path | None:
    """Refuse a figure of another format before anything is solved."""
    if value is not None and value.suffix.lower() not in FIGURES:
        raise click.BadParameter(
            f"{value.name!r}: a figure's name ends in {', '.join(FIGURES[:-1])} or {FIGURES[-1]}"
        )
    return value


settings_option = click.option(
    "--set", "settings", multiple=True, callback=parse_settings, metavar="KEY=VALUE",
    help="Change one quantity of the device, with its unit: --set back_bias=-60V. Repeatable.",
)  # fmt: skip

overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace the output file if it exists."
)

summary_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the summary as JSON."
)


def device_options(command: Command) -> Command:
    """Add the argument DEVICE and the option --set to a command."""
    return click.argument("device")(settings_option(command))


MOST_WORKERS = 1000
"""Largest number of processes of a command.  Chosen: above the cores of one machine; each takes 200 MB,
and with 2000 nothing is faster."""


def executor_options(command: Command) -> Command:
    """Add the options --workers and --executor to a command with independent points."""
    workers = click.option("--workers", default=2, show_default=True,
                           type=click.IntRange(1, MOST_WORKERS),
                           help="Processes that work at the same time.")  # fmt: skip
    executor = click.option("--executor", default="process", show_default=True,
                            type=click.Choice(["process", "dask", "parsl"]),
                            help="Library that runs the processes on this machine; dask "
                            "and parsl must be installed.")  # fmt: skip
    return workers(executor(command))


def check_targets(
    paths: Sequence[Path], overwrite: bool, error: type[BFSensorError]
) -> None:
    """Refuse outputs that exist, unless overwritten, or whose folder does not; before any work."""
    for path in paths:
        if path.exists() and not overwrite:
            raise error(f"{path} exists; give --overwrite to replace it")
        if not path.parent.is_dir():
            raise error(f"{path.parent} is not a folder")


def load_device(name: str, settings: Sequence[tuple[str, str]]) -> Any:
    """Load a device by name or path, with the quantities of ``--set`` changed."""
    from bfsensor.device.device import Device

    device = Device.load(name)
    for key, value in settings:
        device = device.with_value(key, value)
    return device


LOG = logging.getLogger("bfsensor")


class _ToStderr(logging.Handler):
    """Log handler that prints a message like the commands' errors: ``bfsensor: ...`` on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one message on the present stderr, which tests replace."""
        click.echo(f"bfsensor: {self.format(record)}", err=True)


def start_log(verbose: bool, quiet: bool) -> None:
    """Send the package's messages to stderr: all (verbose), progress, or only errors (quiet)."""
    LOG.setLevel(logging.DEBUG if verbose else logging.ERROR if quiet else logging.INFO)
    if not any(isinstance(one, _ToStderr) for one in LOG.handlers):
        LOG.addHandler(_ToStderr())


EVERY = 30.0
"""Shortest time between two lines of progress where stderr is no terminal [s].

Chosen: twice as large, the log of an hour's run has 60 lines of progress instead of 120."""


class Bar:
    """Progress on stderr, called with the number of finished items and of all items.

    A bar on a terminal; elsewhere a line every :data:`EVERY` seconds at most, so that a command
    that ends sooner prints none.  Silent with ``bfsensor -q``.
    """

    def __init__(self, word: str) -> None:
        self._word = word
        self._bar: Any = None
        self._began = self._said = time.monotonic()

    def __call__(self, done: int, of: int) -> None:
        """Show that ``done`` of ``of`` items are finished."""
        if not LOG.isEnabledFor(logging.INFO):
            return
        if sys.stderr.isatty():
            self._draw(done, of)
            return
        now = time.monotonic()
        if now - self._said >= EVERY:
            self._said = now
            LOG.info("%s: %d of %d, %.0f s", self._word, done, of, now - self._began)

    def _draw(self, done: int, of: int) -> None:
        if self._bar is None:  # only now: a refused request shows no empty bar
            self._bar = tqdm(total=of, desc=self._word, leave=False)
        self._bar.n = done
        self._bar.refresh()
        if done >= of:
            self.close()

    def close(self) -> None:
        """Remove the bar, so that the next message begins on a line of its own."""
        if self._bar is not None:
            self._bar.close()


@contextlib.contextmanager
def progress_bar(unit: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a :class:`Bar` that is closed at the end of the block."""
    bar = Bar(unit)
    try:
        yield bar
    finally:
        bar.close()


def parse_conditions(
    ctx: click.Context, param: click.Parameter, values: Sequence[str]
) -> list[tuple[str, dict[str, str]]]:
    """Split options ``[FILE:]KEY=VALUE,...`` into the file, empty for all, and its settings."""
    out = []
    for text in values:
        file, colon, rest = text.rpartition(":")
        if colon and "=" in file:
            file, rest = "", text
        given = {}
        for part in rest.split(","):
            key, sign, value = part.partition("=")
            if not sign or not key.strip() or not value.strip():
                raise click.BadParameter(
                    f"{text!r} is not of the form [FILE:]KEY=VALUE,..., such as "
                    "itl.csv:back_bias=-60V,wavelength=620nm"
                )
            given[key.strip()] = value.strip()
        out.append((file, given))
    return out
