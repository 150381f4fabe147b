"""The device: what a sensor is made of and how it is operated.

A device file is TOML in which every quantity is a string with its unit, or an inline
table with ``value`` and what is known about it (``uncertainty``, ``origin``, ``source``).
Inside, all values are floats: um, V, K, electron/um^3, electron/um^2; doses and densities
of donors are positive, of acceptors negative.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from bfsensor.device.parts import (
    BuriedChannel,
    ChannelStop,
    ChannelStopDots,
    Edge,
    EdgeStrip,
    GateStack,
    Implant,
    Material,
    OperatingPoint,
    Pixel,
    Provenance,
    Ripple,
    Silicon,
    Well,
)
from bfsensor.device.shipped import did_you_mean, tables_dir
from bfsensor.device.summary import (
    device_rows,
    device_title,
    format_summary,
    summary_to_html,
)
from bfsensor.device.written_units import from_internal, to_internal
from bfsensor.errors import DeviceError
from bfsensor.files import written_whole

ORIGINS = ("measured", "published", "fitted", "guessed")


_CHOICES = {
    (Ripple, "kind"): ("plane", "radial"),
    (Implant, "shape"): ("gaussian", "box"),
    (EdgeStrip, "oxide"): ("none", "gate", "field"),
    (Edge, "side"): ("x", "y"),
}
_LISTS = {
    (Silicon, "ripples"): ("ripple", Ripple),
    (BuriedChannel, "implants"): ("implant", Implant),
    (ChannelStop, "implants"): ("implant", Implant),
    (ChannelStopDots, "implants"): ("implant", Implant),
    (EdgeStrip, "implants"): ("implant", Implant),
    (Edge, "strips"): ("strip", EdgeStrip),
}
_SECTIONS: dict[str, type] = {
    "pixel": Pixel,
    "material": Material,
    "silicon": Silicon,
    "gates": GateStack,
    "channel": BuriedChannel,
    "channel_stop": ChannelStop,
    "operating_point": OperatingPoint,
    "well": Well,
    "edge": Edge,
}
_OPTIONAL = ("material", "well", "edge")


@dataclass(frozen=True)
class Device:
    """A sensor and its operating point.

    Attributes
    ----------
    name : str
        Short name, used for files.
    pixel, material, silicon, gates, channel, channel_stop, operating_point, well, edge
        The sections of the device file.
    provenance : mapping of str to Provenance
        What is known about single values, by dotted key.

    Examples
    --------
    >>> device = Device.load("itl_sta3800c").with_value("back_bias", "-60 V")
    >>> device.operating_point.back_bias
    -60.0
    >>> device
    <Device itl_sta3800c, 100 um of silicon, back bias -60 V, gates -8/2 V>
    """

    name: str
    pixel: Pixel
    silicon: Silicon
    gates: GateStack
    channel: BuriedChannel
    channel_stop: ChannelStop
    operating_point: OperatingPoint
    material: Material = field(default_factory=Material)
    well: Well = field(default_factory=Well)
    edge: Edge | None = None
    provenance: Mapping[str, Provenance] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        _check(self)

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return _from_text, (self.to_toml(),)

    def __repr__(self) -> str:
        return f"<Device {device_title(self.name, self.silicon, self.operating_point)}>"

    def __str__(self) -> str:
        return format_summary(f"Device {self.name}", self._rows())

    def _repr_html_(self) -> str:
        return summary_to_html(f"Device {self.name}", self._rows())

    def _rows(self) -> list[tuple[str, str]]:
        parts = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del parts["name"]
        return device_rows(**parts)

    @property
    def is_mirror_symmetric(self) -> bool:
        """Whether a pixel's centre lines are mirror planes in x and in y."""
        dots = self.channel_stop.dots
        centred = dots is None or abs(dots.centre - self.pixel.pitch_y / 2) < 1e-9
        return self.edge is None and not self.silicon.ripples and centred

    @classmethod
    def load(cls, name: str | os.PathLike[str]) -> Device:
        """Read a built-in device by name, or a device file by path.

        Raises
        ------
        DeviceError
            Neither; names the built-in devices.
        """
        text = os.fspath(name)
        if text in builtin_devices():
            return cls.from_toml(tables_dir() / text / "device.toml")
        path = Path(text)
        if path.suffix == ".toml":
            return cls.from_toml(path)
        raise DeviceError(
            f"{text!r} is neither a built-in device ({', '.join(builtin_devices())}) "
            f"nor a .toml file{did_you_mean(text, builtin_devices())}"
        )

    @classmethod
    def from_toml(cls, source: str | os.PathLike[str]) -> Device:
        """Read a device file, given its path or its text.

        Raises
        ------
        DeviceError
            Names the file, section, key and limit.
        """
        if isinstance(source, str) and "\n" in source:
            label, text = "device", source
        else:
            path = Path(source)
            label = path.name
            try:
                text = path.read_text(encoding="utf-8")
            except (OSError, ValueError) as error:
                raise DeviceError(f"{path}: cannot be read: {error}") from None
        try:
            data = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise DeviceError(f"{label}: not TOML: {error}") from None
        try:
            return _parse(data)
        except DeviceError as error:
            raise DeviceError(f"{label}: {error}") from None

    def to_toml(self) -> str:
        """Write as the text of a device file, provenance included."""
        lines = [f"name = {_string(self.name)}"]
        for section in _SECTIONS:
            part = getattr(self, section)
            if part is not None:
                lines += ["", *_lines(part, section, section, self.provenance)]
        return "\n".join(lines) + "\n"

    @property
    def physics(self) -> str:
        """Text of all values without name and provenance: what solutions, and caches, depend on."""
        return dataclasses.replace(self, name="device", provenance={}).to_toml()

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a device file (beside, then renamed)."""
        with written_whole(path, DeviceError) as beside:
            beside.write_text(self.to_toml(), encoding="utf-8")

    def with_value(self, key: str, value: str) -> Device:
        """Give a copy with one quantity changed, without what was known about its old value.

        Caches go by :attr:`physics`, which that does not touch.

        Parameters
        ----------
        key : str
            Dotted (``'operating_point.back_bias'``) or short where that is unique.
        value : str
            Quantity with unit, as in a device file.
        """
        section, _, name = self._resolve(key).partition(".")
        part = getattr(self, section)
        spec = {f.name: f for f in dataclasses.fields(part)}[name]
        converted: float
        if not spec.metadata:
            try:
                converted = int(value)
            except ValueError:
                raise DeviceError(
                    f"{section}: {name} = {value!r} must be a whole number"
                ) from None
        else:
            try:
                converted = to_internal(value, spec.metadata["kind"])
            except DeviceError as error:
                raise DeviceError(f"{section}: {name}: {error}") from None
            _check_range(converted, spec.metadata, section, name, value)
        changed = dataclasses.replace(part, **{name: converted})
        kept = {k: v for k, v in self.provenance.items() if k != f"{section}.{name}"}
        return dataclasses.replace(self, **{section: changed}, provenance=kept)

    def with_operating_point(self, **values: str) -> Device:
        """Give a copy with voltages or temperature changed: ``back_bias='-60 V'``."""
        device = self
        for key, value in values.items():
            device = device.with_value(f"operating_point.{key}", value)
        return device

    @property
    def quantities(self) -> tuple[str, ...]:
        """Dotted names of all that :meth:`with_value` can change."""
        return tuple(
            f"{section}.{f.name}"
            for section, kind in _SECTIONS.items()
            if getattr(self, section) is not None
            for f in dataclasses.fields(kind)
            if f.metadata or f.type == "int"
        )

    def unit_of(self, key: str) -> tuple[str, str, str]:
        """Full name of a quantity, its kind and the unit it is written in.

        Parameters
        ----------
        key : str
            As in :meth:`with_value`.

        Returns
        -------
        name, kind, unit : str
            Dotted name; a key of :data:`bfsensor.device.written_units.INTERNAL` and its written
            unit, both empty for whole numbers.

        Raises
        ------
        DeviceError
            No such quantity.

        Examples
        --------
        >>> Device.load("itl_sta3800c").unit_of("back_bias")
        ('operating_point.back_bias', 'potential', 'V')
        """
        name = self._resolve(key)
        section, _, last = name.partition(".")
        spec = {f.name: f for f in dataclasses.fields(_SECTIONS[section])}[last]
        return name, spec.metadata.get("kind", ""), spec.metadata.get("unit", "")

    def _resolve(self, key: str) -> str:
        """Dotted name of a scalar quantity."""
        known = self.quantities
        if key in known:
            return key
        short = [k for k in known if k.split(".")[1] == key]
        if len(short) == 1:
            return short[0]
        hint = short or difflib.get_close_matches(
            key, [*known, *(k.split(".")[1] for k in known)], 3
        )
        means = f"; did you mean {' or '.join(hint)}?" if hint else ""
        raise DeviceError(f"no quantity {key!r} in a device{means}")


def _from_text(text: str) -> Device:
    return Device.from_toml(text)


def builtin_devices() -> tuple[str, ...]:
    """Names of the devices that come with the package.

    Returns
    -------
    names : tuple of str
        In alphabetical order, as :meth:`Device.load` takes them.

    Examples
    --------
    >>> "itl_sta3800c" in builtin_devices()
    True
    """
    return tuple(sorted(p.parent.name for p in tables_dir().glob("*/device.toml")))


# -- reading ---------------------------------------------------------------------------


def _unknown(given: str, allowed: list[str], where: str) -> DeviceError:
    close = difflib.get_close_matches(given, allowed, 1)
    hint = (
        f"; did you mean {close[0]!r}?" if close else f"; allowed are {', '.join(allowed)}"
    )
    return DeviceError(f"{where}unknown key {given!r}{hint}")


def _parse(data: dict[str, Any]) -> Device:
    provenance: dict[str, Provenance] = {}
    allowed = ["name", *_SECTIONS]
    for key in data:
        if key not in allowed:
            raise _unknown(key, allowed, "")
    if not isinstance(data.get("name"), str) or not data["name"]:
        raise DeviceError("name must be given as a string")
    parts: dict[str, Any] = {}
    for section, kind in _SECTIONS.items():
        if section not in data:
            if section not in _OPTIONAL:
                raise DeviceError(f"section [{section}] is missing")
            continue
        parts[section] = _parse_section(kind, data[section], section, provenance)
    return Device(name=data["name"], **parts, provenance=provenance)


def _parse_section(
    kind: type[Any], data: Any, where: str, provenance: dict[str, Provenance]
) -> Any:
    if not isinstance(data, dict):
        raise DeviceError(f"{where} must be a section")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    aliases: dict[str, str] = {
        entry: name for (owner, name), (entry, _) in _LISTS.items() if owner is kind
    }
    allowed = [n for n in fields if (kind, n) not in _LISTS] + list(aliases)
    values: dict[str, Any] = {}
    key: str
    for key, given in data.items():
        if key not in allowed:
            raise _unknown(key, allowed, f"{where}: ")
        name = aliases.get(key, key)
        spec = fields[name]
        path = f"{where}.{key}"
        if key in aliases:
            if not isinstance(given, list):
                raise DeviceError(f"{where}: {key} must be a list of sections, [[{path}]]")
            element = _LISTS[kind, name][1]
            values[name] = tuple(
                _parse_section(element, g, f"{path}[{i}]", provenance)
                for i, g in enumerate(given)
            )
        elif key == "dots":
            values[name] = _parse_section(ChannelStopDots, given, path, provenance)
        elif (kind, name) in _CHOICES:
            values[name] = given
        elif spec.metadata:
            values[name] = _parse_quantity(given, spec.metadata, where, key, provenance)
        else:
            if not isinstance(given, int) or isinstance(given, bool):
                raise DeviceError(f"{where}: {key} = {given!r} must be a whole number")
            values[name] = given
    for name, spec in fields.items():
        required = (
            spec.default is dataclasses.MISSING
            and spec.default_factory is dataclasses.MISSING
        )
        if required and name not in values:
            raise DeviceError(f"{where}: {name} is missing")
    return kind(**values)


def _parse_quantity(
    given: Any,
    metadata: Mapping[str, Any],
    where: str,
    key: str,
    provenance: dict[str, Provenance],
) -> float:
    text = given
    if isinstance(given, dict):
        for name in given:
            if name not in ("value", "uncertainty", "origin", "source"):
                raise _unknown(
                    name, ["value", "uncertainty", "origin", "source"], f"{where}: {key}: "
                )
        if "value" not in given:
            raise DeviceError(f"{where}: {key}: value is missing")
        text = given["value"]
        origin = given.get("origin")
        if origin is not None and origin not in ORIGINS:
            raise DeviceError(
                f"{where}: {key}: origin = {origin!r} must be one of {', '.join(ORIGINS)}"
            )
        source = given.get("source")
        if source is not None and not isinstance(source, str):
            raise DeviceError(f"{where}: {key}: source = {source!r} must be a string")
        try:
            uncertainty = (
                to_internal(str(given["uncertainty"]), metadata["kind"])
                if "uncertainty" in given
                else None
            )
        except DeviceError as error:
            raise DeviceError(f"{where}: {key}: uncertainty: {error}") from None
        if uncertainty is not None and not 0 <= uncertainty < np.inf:
            raise DeviceError(
                f"{where}: {key}: uncertainty = {given['uncertainty']!r} must be finite "
                "and at least 0"
            )
        provenance[f"{where}.{key}"] = Provenance(uncertainty, origin, source)
    if not isinstance(text, str):
        raise DeviceError(
            f"{where}: {key} = {text!r} must be a string with a unit, such as "
            f"'{text} {metadata['unit']}'"
        )
    try:
        value = to_internal(text, metadata["kind"])
    except DeviceError as error:
        raise DeviceError(f"{where}: {key}: {error}") from None
    _check_range(value, metadata, where, key, text)
    return value


def _check_range(
    value: float, metadata: Mapping[str, Any], where: str, key: str, given: str
) -> None:
    kind, unit = metadata["kind"], metadata["unit"]
    low, high = metadata["low"], metadata["high"]

    def limit(number: float) -> str:
        return from_internal(number, kind, unit)

    if not np.isfinite(value):
        raise DeviceError(f"{where}: {key} = {given!r} must be finite")
    if low is not None and (value < low or (metadata["above"] and value <= low)):
        bound = "above" if metadata["above"] else "at least"
        raise DeviceError(f"{where}: {key} = {given!r} must be {bound} {limit(low)}")
    if high is not None and value > high:
        raise DeviceError(f"{where}: {key} = {given!r} must be at most {limit(high)}")


# -- writing ---------------------------------------------------------------------------


def _string(text: str) -> str:
    """Write a TOML basic string; JSON's differ only in that they may hold DEL."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _lines(
    part: Any,
    header: str,
    path: str,
    provenance: Mapping[str, Provenance],
    *,
    element: bool = False,
) -> list[str]:
    out = [f"[[{header}]]" if element else f"[{header}]"]
    nested: list[str] = []
    for spec in dataclasses.fields(part):
        value = getattr(part, spec.name)
        if value is None or value == ():
            continue
        if (type(part), spec.name) in _LISTS:
            entry = _LISTS[type(part), spec.name][0]
            for i, item in enumerate(value):
                nested += [
                    "",
                    *_lines(
                        item,
                        f"{header}.{entry}",
                        f"{path}.{entry}[{i}]",
                        provenance,
                        element=True,
                    ),
                ]
        elif dataclasses.is_dataclass(value):
            nested += [
                "",
                *_lines(value, f"{header}.{spec.name}", f"{path}.{spec.name}", provenance),
            ]
        elif spec.metadata:
            kind, unit = spec.metadata["kind"], spec.metadata["unit"]
            text = from_internal(value, kind, unit)
            known = provenance.get(f"{path}.{spec.name}")
            if known is None:
                out.append(f'{spec.name} = "{text}"')
            else:
                entries = [f'value = "{text}"']
                if known.uncertainty is not None:
                    entries.append(
                        f'uncertainty = "{from_internal(known.uncertainty, kind, unit)}"'
                    )
                if known.origin is not None:
                    entries.append(f"origin = {_string(known.origin)}")
                if known.source is not None:
                    entries.append(f"source = {_string(known.source)}")
                out.append(f"{spec.name} = {{ {', '.join(entries)} }}")
        else:
            text = _string(value) if isinstance(value, str) else str(value)
            out.append(f"{spec.name} = {text}")
    return out + nested


# -- checking --------------------------------------------------------------------------


def _check(device: Device) -> None:
    """Refuse what cannot be built; every message names section, key and limit."""
    for section in _SECTIONS:
        part = getattr(device, section)
        if part is not None:
            _check_part(part, section)
    pixel, gates, stop = device.pixel, device.gates, device.channel_stop
    if not 2 <= gates.phases <= 8:
        raise DeviceError(f"gates: phases = {gates.phases} must be from 2 to 8")
    if not 1 <= gates.collecting_phases < gates.phases:
        raise DeviceError(
            f"gates: collecting_phases = {gates.collecting_phases} must be from 1 to "
            f"phases - 1 = {gates.phases - 1}"
        )
    if gates.field_oxide < gates.gate_oxide:
        raise DeviceError(
            f"gates: field_oxide = '{gates.field_oxide:g} um' must be at least "
            f"gate_oxide = '{gates.gate_oxide:g} um'"
        )
    room = pixel.pitch_x / 2
    for key, extra in (
        ("field_oxide_taper", gates.field_oxide_taper),
        ("side_diffusion", stop.side_diffusion),
    ):
        if stop.width / 2 + extra >= room:
            raise DeviceError(
                f"channel_stop: width / 2 + {key} = {stop.width / 2 + extra:g} um must be "
                f"below half the pixel, {room:g} um"
            )
    if device.operating_point.gate_high <= device.operating_point.gate_low:
        raise DeviceError(
            f"operating_point: gate_high = '{device.operating_point.gate_high:g} V' must "
            f"be above gate_low = '{device.operating_point.gate_low:g} V'"
        )
    depth = device.silicon.thickness - gates.field_oxide
    groups = {
        "channel.implant": device.channel.implants,
        "channel_stop.implant": stop.implants,
    }
    if stop.dots is not None:
        groups["channel_stop.dots.implant"] = stop.dots.implants
        if stop.dots.height >= pixel.pitch_y or stop.dots.centre > pixel.pitch_y:
            raise DeviceError(
                f"channel_stop.dots: centre = '{stop.dots.centre:g} um' and height = "
                f"'{stop.dots.height:g} um' must lie within the pixel, {pixel.pitch_y:g} um"
            )
    if device.edge is not None:
        for k, strip in enumerate(device.edge.strips):
            groups[f"edge.strip[{k}].implant"] = strip.implants
    for where, implants in groups.items():
        for i, implant in enumerate(implants):
            if implant.reach > depth:
                raise DeviceError(
                    f"{where}[{i}]: the implant ends {implant.reach:g} um below the "
                    f"surface, outside the silicon of {depth:g} um"
                )


def _check_part(part: Any, where: str) -> None:
    for spec in dataclasses.fields(part):
        value = getattr(part, spec.name)
        if value is None:
            continue
        if (type(part), spec.name) in _CHOICES:
            choices = _CHOICES[type(part), spec.name]
            if value not in choices:
                raise DeviceError(
                    f"{where}: {spec.name} = {value!r} must be one of {', '.join(choices)}"
                )
        elif isinstance(value, tuple):
            entry = _LISTS[type(part), spec.name][0]
            for i, item in enumerate(value):
                _check_part(item, f"{where}.{entry}[{i}]")
        elif dataclasses.is_dataclass(value):
            _check_part(value, f"{where}.{spec.name}")
        elif spec.metadata:
            text = (
                from_internal(value, spec.metadata["kind"], spec.metadata["unit"])
                if np.isfinite(value)
                else str(value)
            )
            _check_range(value, spec.metadata, where, spec.name, text)
    if isinstance(part, Implant):
        needed = ("peak", "sigma") if part.shape == "gaussian" else ("depth",)
        for name in needed:
            if getattr(part, name) is None:
                raise DeviceError(f"{where}: {name} is missing for a {part.shape} implant")
        for name in sorted({"peak", "sigma", "depth"} - set(needed)):
            if getattr(part, name) is not None:
                raise DeviceError(
                    f"{where}: {name} does not belong to a {part.shape} implant"
                )
