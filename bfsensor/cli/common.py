"""What several commands share."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import click
from tqdm import tqdm


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


def load_device(name: str, settings: Sequence[tuple[str, str]]) -> Any:
    """Load a device and change its values."""
    from bfsensor.device.device import Device

    device = Device.load(name)
    for key, value in settings:
        device = device.with_value(key, value)
    return device


class Bar:
    """A bar on stderr that the readers may call with what is done and what there is."""

    def __init__(self, word: str) -> None:
        self._word = word
        self._bar: Any = None

    def __call__(self, done: int, of: int) -> None:
        """Move to what is done."""
        if self._bar is None:
            self._bar = tqdm(
                total=of, desc=self._word, leave=False, disable=not sys.stderr.isatty()
            )
        self._bar.update(done - self._bar.n)
        if done >= of:
            self._bar.close()
