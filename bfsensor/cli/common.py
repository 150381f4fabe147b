"""What several commands share."""

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
    """Split ``KEY=VALUE`` options."""
    out = []
    for value in values:
        key, sign, text = value.partition("=")
        if not sign or not key or not text:
            raise click.BadParameter(
                f"{value!r} is not of the form KEY=VALUE, such as back_bias=-60V"
            )
        out.append((key.strip(), text.strip()))
    return out


settings_option = click.option(
    "--set", "settings", multiple=True, callback=parse_settings, metavar="KEY=VALUE",
    help="Change a value of the device, such as back_bias=-60V; repeatable.",
)  # fmt: skip

overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace an existing output."
)

summary_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the summary as JSON."
)


def device_options(command: Command) -> Command:
    """Take a DEVICE, and values of it that are changed."""
    return click.argument("device")(settings_option(command))


def executor_options(command: Command) -> Command:
    """Take where independent points are worked on, and by how many processes."""
    workers = click.option("--workers", default=2, show_default=True,
                           type=click.IntRange(min=1), help="Processes.")  # fmt: skip
    executor = click.option("--executor", default="process", show_default=True,
                            type=click.Choice(["process", "dask", "parsl"]),
                            help="Where they run.")  # fmt: skip
    return workers(executor(command))


def check_targets(
    paths: Sequence[Path], overwrite: bool, error: type[BFSensorError]
) -> None:
    """Refuse files that exist or have no folder, before any work."""
    for path in paths:
        if path.exists() and not overwrite:
            raise error(f"{path} exists; give --overwrite to replace it")
        if not path.parent.is_dir():
            raise error(f"{path.parent} is not a folder")


def load_device(name: str, settings: Sequence[tuple[str, str]]) -> Any:
    """Load a device and change its values."""
    from bfsensor.device.device import Device

    device = Device.load(name)
    for key, value in settings:
        device = device.with_value(key, value)
    return device


LOG = logging.getLogger("bfsensor")


class _ToStderr(logging.Handler):
    """Writes messages as the errors of the commands are written."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one message on today's stderr."""
        click.echo(f"bfsensor: {self.format(record)}", err=True)


def start_log(verbose: bool, quiet: bool) -> None:
    """Let the package's messages reach stderr: all, those of progress, or errors only."""
    LOG.setLevel(logging.DEBUG if verbose else logging.ERROR if quiet else logging.INFO)
    if not any(isinstance(one, _ToStderr) for one in LOG.handlers):
        LOG.addHandler(_ToStderr())


EVERY = 30.0
"""Seconds between two lines of progress where stderr is no terminal: a log stays readable."""


class Bar:
    """Progress on stderr, called with what is done and what there is.

    A bar on a terminal; elsewhere a line at most each :data:`EVERY` seconds, so that a short
    command says nothing.  Silent with ``bfsensor -q``.
    """

    def __init__(self, word: str) -> None:
        self._word = word
        self._bar: Any = None
        self._began = self._said = time.monotonic()

    def __call__(self, done: int, of: int) -> None:
        """Move to what is done."""
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
        if self._bar is None:  # not before the request is found good
            self._bar = tqdm(total=of, desc=self._word, leave=False)
        self._bar.n = done
        self._bar.refresh()
        if done >= of:
            self.close()

    def close(self) -> None:
        """End the bar's line, before any message."""
        if self._bar is not None:
            self._bar.close()


@contextlib.contextmanager
def progress_bar(unit: str) -> Iterator[Callable[[int, int], None]]:
    """Give a :class:`Bar` whose line ends with the block."""
    bar = Bar(unit)
    try:
        yield bar
    finally:
        bar.close()
