"""``bfsensor device``: make, look at and check device files."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bfsensor.cli.common import load_device, overwrite_option, settings_option
from bfsensor.errors import DeviceError

if TYPE_CHECKING:
    from bfsensor.device.device import Device


@click.group()
def device() -> None:
    """Make, look at and check device files."""


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
    from bfsensor.device.poisson_ccd import import_poisson_ccd

    result = import_poisson_ccd(cfg)
    target = output or cfg.with_suffix(".toml")
    _refuse_existing(target, overwrite)
    result.write(target)
    click.echo(f"{target}: {result.name}")


def _refuse_existing(target: Path, overwrite: bool) -> None:
    if target.exists() and not overwrite:
        raise DeviceError(f"{target} exists; give --overwrite to replace it")


@device.command("new")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--from", "origin", metavar="DEVICE", required=True,
              help="Device to begin with: a name of 'bfsensor devices', or a .toml file.")  # fmt: skip
@overwrite_option
def new(file: Path, origin: str, overwrite: bool) -> None:
    """Write a device FILE (.toml) that begins as a copy of another, comments included.

    The device is named as the file.  Edit its values, 'bfsensor device check' them, and make
    its distortion table by 'bfsensor table FILE'.

    \b
    Example:
      bfsensor device new my_ccd.toml --from e2v_ccd250
    """
    from bfsensor.device.device import Device, builtin_devices
    from bfsensor.device.shipped import tables_dir
    from bfsensor.files import written_whole

    if file.suffix != ".toml":
        raise DeviceError(f"{file}: the name of a device file ends in .toml")
    _refuse_existing(file, overwrite)
    Device.load(origin)  # refuses what is no device
    shipped = origin in builtin_devices()
    source = tables_dir() / origin / "device.toml" if shipped else Path(origin)
    name = f"name = {json.dumps(file.stem)}"
    text = source.read_text(encoding="utf-8")
    copied = re.sub(r"^name *=.*$", lambda _: name, text, count=1, flags=re.MULTILINE)
    try:
        made = Device.from_toml(copied)
    except DeviceError as error:
        raise DeviceError(f"{source}: cannot be copied: {error}") from None
    if made.name != file.stem:
        raise DeviceError(f"{source}: no line 'name = ...' to be changed")
    with written_whole(file, DeviceError) as beside:
        beside.write_text(copied, encoding="utf-8")
    click.echo(f"{file}: a copy of {origin}; edit it, then: bfsensor device check {file}")


@device.command("show")
@click.argument("name", metavar="DEVICE")
@settings_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON for a program to read.")
def show(name: str, settings: list[tuple[str, str]], as_json: bool) -> None:
    """Print a DEVICE (name or .toml): every value with its unit, uncertainty and origin.

    \b
    Examples:
      bfsensor device show e2v_ccd250
      bfsensor device show my_ccd.toml --set back_bias=-60V
    """
    _print(load_device(name, settings), (), as_json)


@device.command("check")
@click.argument("file", metavar="DEVICE")
@settings_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON for a program to read.")
def check(file: str, settings: list[tuple[str, str]], as_json: bool) -> None:
    """Read a DEVICE (.toml or name), print it with units, and warn of what is doubtful.

    Unknown entries, missing units and values out of range are errors (status 1), each with
    its place and what is allowed.  Warnings leave the status at 0.  Nothing is solved.

    \b
    Example:
      bfsensor device check my_ccd.toml
    """
    loaded = load_device(file, settings)
    _print(loaded, [line for warn in _WARNINGS for line in warn(loaded)], as_json)


def _print(device: Device, warnings: Any, as_json: bool) -> None:
    """Print a device and its warnings."""
    if as_json:
        values = tomllib.loads(device.to_toml())
        click.echo(json.dumps({"device": values, "warnings": list(warnings)}, indent=1))
        return
    click.echo(device_text(device))
    for line in warnings:
        click.echo(f"warning: {line}")


def device_text(device: Device) -> str:
    """Give a device as text: a block for each section, a line for each value."""
    entries = tomllib.loads(device.to_toml())
    lines = [str(entries.pop("name"))]
    for section, values in entries.items():
        lines += ["", f"[{section}]", *_block(values)]
    return "\n".join(lines)


def _block(values: Mapping[str, Any], indent: str = "  ") -> Iterator[str]:
    """Lines of a section and of the sections in it."""
    width = max((len(key) for key in values), default=0)
    for key, value in values.items():
        if isinstance(value, list) or (isinstance(value, dict) and "value" not in value):
            for part in value if isinstance(value, list) else [value]:
                yield f"{indent}{key}:"
                yield from _block(part, indent + "  ")
        elif isinstance(value, dict):
            known = f"{value['value']:12}"
            known += f" +- {value['uncertainty']}" if "uncertainty" in value else ""
            words = [value[word] for word in ("origin", "source") if word in value]
            known += f"  ({', '.join(words)})" if words else ""
            yield f"{indent}{key:{width}}  {known}".rstrip()
        else:
            yield f"{indent}{key:{width}}  {value}"


def _guessed(device: Device) -> Iterator[str]:
    """Values that nobody measured, published or fitted."""
    names = [key for key, known in device.provenance.items() if known.origin == "guessed"]
    if names:
        yield (
            f"guessed, not measured: {', '.join(sorted(names))}; 'bfsensor fit' lets these move"
        )


def _unsourced(device: Device) -> Iterator[str]:
    """Values that decide the effect and of which the file does not say where they are from."""
    names = [
        key
        for key in device.quantities
        if key.split(".")[0] in ("pixel", "silicon", "operating_point")
        and (key not in device.provenance or device.provenance[key].origin is None)
    ]
    if names:
        yield (
            f"no origin: {', '.join(names)}; write {{ value = ..., uncertainty = ..., origin = "
            "'measured', 'published', 'fitted' or 'guessed' }"
        )


def _taken_name(device: Device) -> Iterator[str]:
    """A name that a built-in device with other values has."""
    from bfsensor.device.device import Device, builtin_devices

    if device.name in builtin_devices():
        shipped = Device.load(device.name)
        if shipped.physics != device.physics:
            yield (
                f"name = '{device.name}' is that of a built-in device with other values: give "
                "this one its own"
            )


_WARNINGS = (_guessed, _unsourced, _taken_name)
"""What 'device check' warns of, in the order of the lines: each takes a device, gives lines."""
