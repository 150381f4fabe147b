"""Device, a sensor's geometry, doping and voltages: its construction, changed copies and TOML file.

A device file is TOML in which every quantity is a string with its unit, or an inline
table with ``value`` and its provenance (``uncertainty``, ``origin``, ``source``).
Inside, all values are floats: um, V, K, electron/um^3, electron/um^2; doses and densities
of donors are positive, of acceptors negative.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import logging
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from bfsensor.device.checks import check_parts, check_range
from bfsensor.device.parts import (
    CHOICES,
    LISTS,
    SECTIONS,
    BuriedChannel,
    ChannelStop,
    ChannelStopDots,
    Edge,
    ElectronTransport,
    FittedCharge,
    GateStack,
    Material,
    OperatingPoint,
    Pixel,
    Provenance,
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
"""Values that the key ``origin`` of a quantity may have in a device file."""

_OPTIONAL = ("material", "well", "transport", "edge", "image_charge")
"""Sections that a device file may lack: material, well and transport then have their defaults, and
there is no edge and no image-charge model."""


PARTS = 64
"""Largest number of parts of a dotted key in a device file.  Chosen: keys of devices have at most 3, and
50,000 parts take minutes to parse; with 128 nothing changes for a reader."""

# The search begins at the beginning of a word only: within one it would take a time in proportion
# to the square of the word's length.
_DOTTED = re.compile(rf"(?<![\w-])(?:[\w-]+[ \t]*\.[ \t]*){{{PARTS}}}")
_LOG = logging.getLogger("bfsensor")

_EINSTEIN: set[str] = set()
"""Names of the devices of which :attr:`Device.diffusion` has said that they state no width."""


@dataclass(frozen=True)
class Device:
    """A sensor and its operating point.

    Frozen: :meth:`with_value` and :meth:`with_operating_point` return changed copies.  Two
    devices are equal if names, values and provenance are; their hash leaves the provenance out.

    Attributes
    ----------
    name : str
        Short name, used for files; not empty.
    pixel : Pixel
        Pitch [um].
    silicon : Silicon
        Thickness [um], background doping [e/um^3], ripples.
    gates : GateStack
        Clock phases and oxides [um].
    channel : BuriedChannel
        Implants and surface charge [e/um^2] of the buried channel.
    channel_stop : ChannelStop
        Width [um], implants and surface charge of the channel stop.
    operating_point : OperatingPoint
        Voltages [V] and temperature [K].
    material : Material
        Permittivities and band structure of silicon and oxide.
    well : Well
        Barrier [V] at which a pixel spills.
    transport : ElectronTransport
        Width of the diffusion over that by Einstein's relation, where it is known.
    edge : Edge or None
        Guard ring beyond the last pixel; None for the periodic array.
    provenance : mapping of str to Provenance
        Uncertainty, origin and source of the values that state any, by dotted key of the file,
        such as ``'channel.implant[0].dose'``.
    image_charge : FittedCharge or None
        Image-charge model that was fitted to covariances; None for a device whose response is
        solved from its doping and voltages.

    Raises
    ------
    DeviceError
        A value outside its range, or parts that cannot be built together; the message names
        section, key and limit.

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
    transport: ElectronTransport = field(default_factory=ElectronTransport)
    edge: Edge | None = None
    provenance: Mapping[str, Provenance] = field(default_factory=dict, hash=False)
    image_charge: FittedCharge | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        check_parts({name: getattr(self, name) for name in SECTIONS})

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
        """Whether a pixel's centre lines are mirror planes in x and in y.

        False with an edge, with ripples of the doping, or with channel-stop dots off centre.
        """
        dots = self.channel_stop.dots
        centred = dots is None or abs(dots.centre - self.pixel.pitch_y / 2) < 1e-9
        return self.edge is None and not self.silicon.ripples and centred

    @property
    def origin(self) -> str:
        """Origin of the response: 'fitted to covariances', or that of the bulk's doping."""
        if self.image_charge is not None:
            return "fitted to covariances"
        known = self.provenance.get("silicon.background_doping")
        return (known.origin if known else None) or "not stated"

    @classmethod
    def load(cls, name: str | os.PathLike[str]) -> Device:
        """Read a built-in device by name, or a device file by path.

        Parameters
        ----------
        name : str or path-like
            A name of :func:`builtin_devices`, or a path that ends in ``.toml``.

        Returns
        -------
        Device

        Raises
        ------
        DeviceError
            The name is neither a built-in device nor a path to a .toml file (the message lists
            the built-in devices), or the file cannot be read as a device.

        Examples
        --------
        >>> Device.load("e2v_ccd250").silicon.thickness
        100.0
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

        Parameters
        ----------
        source : str or path-like
            Path of the file; a string with a line break is taken as the file's text.

        Returns
        -------
        Device

        Raises
        ------
        DeviceError
            The file cannot be read, is not TOML, or describes no device that can be built; the
            message names the file, section, key and limit.

        Examples
        --------
        >>> device = Device.load("itl_sta3800c")
        >>> Device.from_toml(device.to_toml()) == device
        True
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
        # The parser takes a time in proportion to the square of a dotted key's parts.
        if long := _DOTTED.search(text):
            raise DeviceError(
                f"{label}: not a device file: the key {long.group()[:30]}... has more than {PARTS} "
                "parts; a device's have at most 3"
            )
        try:
            data = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise DeviceError(f"{label}: not TOML: {error}") from None
        except RecursionError:
            raise DeviceError(
                f"{label}: not a device file: values are nested deeper than a device's, which are "
                "tables of tables of values"
            ) from None
        try:
            return _parse(data)
        except DeviceError as error:
            raise DeviceError(f"{label}: {error}") from None

    def to_toml(self) -> str:
        """Write as the text of a device file, provenance included.

        Returns
        -------
        text : str
            :meth:`from_toml` reads an equal device from it, all floats bit for bit.
        """
        lines = [f"name = {_string(self.name)}"]
        for section in SECTIONS:
            part = getattr(self, section)
            # A section in which nothing is known is left out: its only line would be its header.
            if part is not None and part != ElectronTransport():
                lines += ["", *_lines(part, section, section, self.provenance)]
        return "\n".join(lines) + "\n"

    @property
    def physics(self) -> str:
        """Text of the device file with the name 'device', without provenance and transport.

        Solutions depend on nothing else of a device, so caches use it as their key.
        """
        bare = dataclasses.replace(
            self, name="device", transport=ElectronTransport(), provenance={}
        )
        return bare.to_toml()

    @property
    def diffusion(self) -> float:
        """Width of the diffusion over that by Einstein's relation.

        It is 1 where the device states none, which the logger ``bfsensor`` says once a process.
        """
        if self.transport.diffusion is not None:
            return self.transport.diffusion
        if self.name not in _EINSTEIN:
            _EINSTEIN.add(self.name)
            _LOG.warning(
                "the device %s states no width of its diffusion: Einstein's relation is used, which "
                "X-ray clusters in LSST's sensors exceed by 1.9 (device file: [transport], diffusion)",
                self.name,
            )
        return 1.0

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a device file under a temporary name, then rename it: half a file never exists.

        Parameters
        ----------
        path : path-like
            Where to; an existing file is replaced.

        Raises
        ------
        DeviceError
            The file cannot be written.
        """
        with written_whole(path, DeviceError) as beside:
            beside.write_text(self.to_toml(), encoding="utf-8")

    def with_value(self, key: str, value: str) -> Device:
        """Return a copy with one quantity changed and without the provenance of its old value.

        Parameters
        ----------
        key : str
            Dotted name (``'operating_point.back_bias'``), one of :attr:`quantities`, or its last
            part where that is unique (``'back_bias'``).
        value : str
            Quantity with unit, as in a device file; a plain number for whole numbers.

        Returns
        -------
        Device

        Raises
        ------
        DeviceError
            No such quantity, not a quantity of that dimension, or a value outside the range.

        Examples
        --------
        >>> Device.load("itl_sta3800c").with_value("thickness", "0.2 mm").silicon.thickness
        200.0
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
            check_range(converted, spec.metadata, section, name, value)
        changed = dataclasses.replace(part, **{name: converted})
        kept = {k: v for k, v in self.provenance.items() if k != f"{section}.{name}"}
        return dataclasses.replace(self, **{section: changed}, provenance=kept)

    def with_operating_point(self, **values: str) -> Device:
        """Return a copy with voltages or temperature changed.

        Parameters
        ----------
        **values : str
            Quantities with units by their keys in the section ``operating_point``: ``gate_low``,
            ``gate_high``, ``back_bias``, ``temperature``, ``hole_quasi_fermi_level``.  They are
            changed in the order given, each as by :meth:`with_value`, and every step must be a
            device that can be built.

        Returns
        -------
        Device

        Raises
        ------
        DeviceError
            As :meth:`with_value`.

        Examples
        --------
        >>> Device.load("itl_sta3800c").with_operating_point(back_bias="-60 V", gate_low="-9 V")
        <Device itl_sta3800c, 100 um of silicon, back bias -60 V, gates -9/2 V>
        """
        device = self
        for key, value in values.items():
            device = device.with_value(f"operating_point.{key}", value)
        return device

    @property
    def quantities(self) -> tuple[str, ...]:
        """Dotted names of all quantities that :meth:`with_value` can change.

        Quantities of implants, ripples, dots and edge strips are not among them;
        :func:`bfsensor.device.parameters.change_parameter` changes those.
        """
        return tuple(
            f"{section}.{f.name}"
            for section, kind in SECTIONS.items()
            if getattr(self, section) is not None
            for f in dataclasses.fields(kind)
            if f.metadata or f.type == "int"
        )

    def unit_of(self, key: str) -> tuple[str, str, str]:
        """Return the full name of a quantity, its kind and the unit it is written in.

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
        spec = {f.name: f for f in dataclasses.fields(SECTIONS[section])}[last]
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
    """List the names of the devices that come with the package.

    Returns
    -------
    names : tuple of str
        Names in alphabetical order, as :meth:`Device.load` takes them.

    Examples
    --------
    >>> "itl_sta3800c" in builtin_devices()
    True
    """
    return tuple(sorted(p.parent.name for p in tables_dir().glob("*/device.toml")))


# -- reading ---------------------------------------------------------------------------


def _unknown(given: str, allowed: list[str], where: str) -> DeviceError:
    """Error for an unknown key: the key most like it, or else all that are allowed."""
    close = difflib.get_close_matches(given, allowed, 1)
    hint = (
        f"; did you mean {close[0]!r}?" if close else f"; allowed are {', '.join(allowed)}"
    )
    return DeviceError(f"{where}unknown key {given!r}{hint}")


def _parse(data: dict[str, Any]) -> Device:
    """Build a device from parsed TOML."""
    provenance: dict[str, Provenance] = {}
    allowed = ["name", *SECTIONS]
    for key in data:
        if key not in allowed:
            raise _unknown(key, allowed, "")
    if not isinstance(data.get("name"), str) or not data["name"]:
        raise DeviceError("name must be given as a string")
    parts: dict[str, Any] = {}
    for section, kind in SECTIONS.items():
        if section not in data:
            if section not in _OPTIONAL:
                raise DeviceError(f"section [{section}] is missing")
            continue
        parts[section] = _parse_section(kind, data[section], section, provenance)
    return Device(name=data["name"], **parts, provenance=provenance)


def _parse_section(
    kind: type[Any], data: Any, where: str, provenance: dict[str, Provenance]
) -> Any:
    """Build a part of type ``kind`` from its section; adds to ``provenance`` in place."""
    if not isinstance(data, dict):
        raise DeviceError(f"{where} must be a section")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    aliases: dict[str, str] = {
        entry: name for (owner, name), (entry, _) in LISTS.items() if owner is kind
    }
    allowed = [n for n in fields if (kind, n) not in LISTS] + list(aliases)
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
            element = LISTS[kind, name][1]
            values[name] = tuple(
                _parse_section(element, g, f"{path}[{i}]", provenance)
                for i, g in enumerate(given)
            )
        elif key == "dots":
            values[name] = _parse_section(ChannelStopDots, given, path, provenance)
        elif (kind, name) in CHOICES:
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
    """Convert one quantity to internal units; adds to ``provenance`` in place."""
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
    check_range(value, metadata, where, key, text)
    return value


# -- writing ---------------------------------------------------------------------------


def _string(text: str) -> str:
    """Write a TOML basic string: a JSON string with DEL, which only JSON allows, escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _lines(
    part: Any,
    header: str,
    path: str,
    provenance: Mapping[str, Provenance],
    *,
    element: bool = False,
) -> list[str]:
    """Lines of a part and of the parts in it; ``element``: the part is one of a list."""
    out = [f"[[{header}]]" if element else f"[{header}]"]
    nested: list[str] = []
    for spec in dataclasses.fields(part):
        value = getattr(part, spec.name)
        if value is None or value == ():
            continue
        if (type(part), spec.name) in LISTS:
            entry = LISTS[type(part), spec.name][0]
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
