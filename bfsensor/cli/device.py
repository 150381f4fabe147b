"""``bfsensor device``: make, print and check device files."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bfsensor.cli.common import load_device, overwrite_option, settings_option
from bfsensor.errors import DeviceError

if TYPE_CHECKING:
    from bfsensor.device.device import Device


@click.group()
def device() -> None:
    """Make, print and check device files.

    A device file (.toml) states the geometry, doping and voltages of a sensor, with units.

    \b
    Example:
      bfsensor device new my_ccd.toml --from e2v_ccd250
      bfsensor device check my_ccd.toml
    """


@device.command("import", short_help="Convert a Poisson_CCD configuration.")
@click.argument("cfg", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path),
              help="Device file to write.  [default: CFG with the ending .toml]")  # fmt: skip
@overwrite_option
def import_(cfg: Path, output: Path | None, overwrite: bool) -> None:
    """Convert CFG, a configuration of Poisson_CCD or GalSim, to a device file.

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


@device.command("new", short_help="Write a copy of a device file.")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--from", "origin", metavar="DEVICE", required=True,
              help="Device to copy: a name of 'bfsensor devices', or a .toml file.")  # fmt: skip
@overwrite_option
def new(file: Path, origin: str, overwrite: bool) -> None:
    """Write a device FILE (.toml) as a copy of another device, comments included.

    The new device has the name of the file.  Edit its values, check them with 'bfsensor device
    check FILE', and compute its distortion table with 'bfsensor table FILE'.

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


@device.command("show", short_help="Print every value of a device.")
@click.argument("name", metavar="DEVICE")
@settings_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON for a program to read.")
def show(name: str, settings: list[tuple[str, str]], as_json: bool) -> None:
    """Print every value of a DEVICE with its unit, uncertainty and origin.

    DEVICE is a .toml file, or a name of 'bfsensor devices'.

    \b
    Examples:
      bfsensor device show e2v_ccd250
      bfsensor device show my_ccd.toml --set back_bias=-60V
    """
    _print(load_device(name, settings), {}, as_json)


@device.command("check", short_help="Print a device with warnings.")
@click.argument("file", metavar="DEVICE")
@settings_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON for a program to read.")
def check(file: str, settings: list[tuple[str, str]], as_json: bool) -> None:
    """Check the values of a DEVICE, and print them with its depletion and warnings.

    DEVICE is a .toml file, or a name of 'bfsensor devices'.  An unknown entry, a missing unit or
    a value out of range is an error (exit status 1) that names the entry and what is allowed.
    Warnings, of guessed values for example, leave the status at 0.  The full-depletion voltage
    [V] and the depleted thickness [um] are estimates; no field is solved.

    \b
    Example:
      bfsensor device check my_ccd.toml
    """
    loaded = load_device(file, settings)
    warnings = [line for warn in _WARNINGS for line in warn(loaded)]
    _print(loaded, _depletion(loaded), as_json, warnings)


def _depletion(device: Device) -> dict[str, str]:
    """Estimated full-depletion voltage and depleted thickness, as text with units."""
    from bfsensor.device.depletion import find_depletion

    found = find_depletion(device)
    return {
        "full_depletion_voltage": f"{found.full_depletion_voltage:.1f} V",
        "depleted_thickness": f"{found.depth:.1f} um",
        "depleted_from": f"{found.lowest:.1f} um",
        "depleted_to": f"{found.highest:.1f} um",
    }


def _print(
    device: Device,
    depletion: Mapping[str, str],
    as_json: bool,
    warnings: Sequence[str] = (),
) -> None:
    """Print a device, its depletion where given, and its warnings."""
    if as_json:
        found = {"device": tomllib.loads(device.to_toml()), "warnings": list(warnings)}
        click.echo(
            json.dumps(found | ({"depletion": depletion} if depletion else {}), indent=1)
        )
        return
    click.echo(device_text(device))
    if depletion:
        bias = f"{device.operating_point.back_bias:g} V"
        click.echo(
            f"\n[depletion]  estimated at back_bias = {bias}, heights above the gates"
        )
        for line in _block(depletion):
            click.echo(line)
    for line in warnings:
        click.echo(f"warning: {line}")


def device_text(device: Device) -> str:
    """Give a device as text: a block for each section, a line for each value.

    Unlike ``str(device)``, a summary, it has every value of the file, each with its origin.
    """
    entries = tomllib.loads(device.to_toml())
    lines = [str(entries.pop("name"))]
    for section, values in entries.items():
        lines += ["", f"[{section}]", *_block(values)]
    return "\n".join(lines)


def _block(values: Mapping[str, Any], indent: str = "  ") -> Iterator[str]:
    """Lines of a section and of the sections in it, names aligned."""
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
    """Warn of values whose stated origin is 'guessed'."""
    names = [key for key, known in device.provenance.items() if known.origin == "guessed"]
    if names:
        yield (
            f"guessed, not measured: {', '.join(sorted(names))}; 'bfsensor fit' fits these by default"
        )


def _unsourced(device: Device) -> Iterator[str]:
    """Warn of pixel, silicon and operating-point values whose origin the file does not state."""
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
    """Warn of the name of a built-in device on a device with other values."""
    from bfsensor.device.device import Device, builtin_devices

    if device.name in builtin_devices():
        shipped = Device.load(device.name)
        if shipped.physics != device.physics:
            yield (
                f"name = '{device.name}' is that of a built-in device with other values: change the "
                "name"
            )


def _undepleted(device: Device) -> Iterator[str]:
    """Warn of silicon that the back bias does not deplete, which every simulation refuses."""
    from bfsensor.device.depletion import check_depleted

    try:
        check_depleted(device)
    except DeviceError as error:
        yield str(error).removeprefix(f"{device.name}: ")


_WARNINGS = (_undepleted, _guessed, _unsourced, _taken_name)
"""Checks of 'device check', in the order of its lines: each takes a device and yields warnings."""
