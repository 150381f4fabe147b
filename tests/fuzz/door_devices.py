"""Doors of devices: TOML files, and configurations of Poisson_CCD."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from pathlib import Path
from typing import Any

import astropy.units as u
import galsim
import numpy as np

from bfsensor.device.device import ORIGINS, Device
from bfsensor.device.parts import CHOICES, LISTS, SECTIONS
from bfsensor.device.poisson_ccd import import_poisson_ccd
from bfsensor.device.shipped import tables_dir
from tests.fuzz.mutations import close, harmless, mutate_text, pick, short
from tests.fuzz.outcomes import Case, Door

SHIPPED = Path(galsim.meta_data.share_dir) / "sensors"

MORE = """
[edge]
side = "x"

[[edge.strip]]
width = "20 um"
voltage = "5 V"
oxide = "field"

[[edge.strip.implant]]
shape = "box"
dose = "1e12 cm-2"
depth = "1 um"

[channel_stop.dots]
centre = "5 um"
height = "3 um"

[[silicon.ripple]]
kind = "plane"
amplitude = "0.01"
period = "0.1 mm"
"""
"""Sections that shipped devices lack."""

QUANTITY = re.compile(
    r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*", re.DOTALL
)
INTERNAL = {
    "length": u.um, "potential": u.V, "temperature": u.K, "angle": u.rad, "field": u.V / u.um,
    "density": u.um**-3, "dose": u.um**-2, "number": u.dimensionless_unscaled,
}  # fmt: skip


class DeviceFile(Door):
    """A device file in TOML; every value is converted again and held against the part's range."""

    name = "device"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        own = [path.read_text() for path in sorted(tables_dir().glob("*/device.toml"))]
        rich = (tables_dir() / "itl_sta3800c" / "device.toml").read_text() + MORE
        self.texts = [*own, rich]
        for text in self.texts:
            assert judge_device(Device.from_toml(text), text.encode()) == ""

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate a shipped file, or one with every section."""
        way = harmless if rng.random() < 0.1 else mutate_text
        words, data, keeps = way(rng, pick(rng, self.texts))
        path = self.write("device.toml", data)
        return Case(
            words, lambda: Device.load(str(path)), lambda made: judge_device(made, data),
            ("device.toml",), keeps,
        )  # fmt: skip


def judge_device(made: Device, data: bytes) -> str:
    """Compare a device with the entries of its file."""
    try:
        entries = tomllib.loads(data.decode())
    except ValueError as error:
        return f"no TOML was accepted: {error}"
    if made.name != entries.pop("name", None):
        return f"its name is {made.name!r}"
    for section, given in entries.items():
        if section not in SECTIONS:
            return f"the unknown section {section} was ignored"
        if wrong := _judge_part(getattr(made, section), given, section, made.provenance):
            return wrong
    return ""


def _judge_part(part: Any, given: Any, where: str, provenance: Any) -> str:
    """Compare a part with its table, key by key, and what the table lacks with the defaults."""
    lists = {
        entry: name for (owner, name), (entry, _) in LISTS.items() if owner is type(part)
    }
    fields = {f.name: f for f in dataclasses.fields(part)}
    for key, value in given.items():
        name = lists.pop(key, key)
        spec = fields.pop(name, None)
        at, own = f"{where}.{key}", getattr(part, name, None)
        if spec is None:
            return f"the unknown key {at} was ignored"
        if isinstance(own, tuple):
            if len(own) != len(value):
                return f"{at} has {len(own)} entries for {len(value)}"
            wrongs = (
                _judge_part(a, b, f"{at}[{k}]", provenance)
                for k, (a, b) in enumerate(zip(own, value, strict=True))
            )
            wrong = next(filter(None, wrongs), "")
        elif dataclasses.is_dataclass(own):
            wrong = _judge_part(own, value, at, provenance)
        elif spec.metadata:
            wrong = _judge_quantity(own, value, at, spec.metadata, provenance)
        elif (type(part), name) in CHOICES:
            right = own == value and value in CHOICES[type(part), name]
            wrong = "" if right else f"{at} = {short(own)}"
        else:
            wrong = "" if type(value) is int and own == value else f"{at} = {short(own)}"
        if wrong:
            return wrong
    for name, spec in fields.items():
        if spec.default is not dataclasses.MISSING and getattr(part, name) != spec.default:
            return f"{where}.{name} is not its default although the file lacks it"
    return ""


def _judge_quantity(own: float, given: Any, at: str, metadata: Any, provenance: Any) -> str:
    """Compare a number with its text, its range, and its provenance."""
    text = given
    if isinstance(given, dict):
        text = given.get("value")
        known = provenance[at]
        if extra := set(given) - {"value", "uncertainty", "origin", "source"}:
            return f"{at}: the unknown keys {extra} were ignored"
        if (known.origin, known.source) != (given.get("origin"), given.get("source")):
            return f"{at}: origin or source changed"
        if known.origin is not None and known.origin not in ORIGINS:
            return f"{at}: origin {known.origin}"
        if "uncertainty" in given:
            if not 0 <= known.uncertainty < np.inf:
                return f"{at}: uncertainty {known.uncertainty}"
            if not close(
                known.uncertainty, convert(given["uncertainty"], metadata["kind"])
            ):
                return f"{at}: uncertainty {known.uncertainty} for {given['uncertainty']}"
    if not isinstance(text, str):
        return f"{at}: {short(text)} is no text with a unit"
    if not close(own, convert(text, metadata["kind"])):
        return f"{at} = {own} for {short(text)}"
    low, high = metadata["low"], metadata["high"]
    low, high = (-np.inf if low is None else low), (np.inf if high is None else high)
    if not (low <= own <= high and np.isfinite(own)) or (metadata["above"] and own == low):
        return f"{at} = {own} is outside {low} to {high}"
    return ""


def convert(text: str, kind: str) -> float:
    """Convert a number with a unit; nan where it is none."""
    found = QUANTITY.fullmatch(text) if isinstance(text, str) else None
    try:
        return float(found[1]) * u.Unit(found[2]).to(INTERNAL[kind]) if found else np.nan
    except (ValueError, u.UnitsError, OverflowError):
        return np.nan


CFG_KEYS = {
    "SensorThickness": ("silicon.thickness", 1.0), "PixelSizeX": ("pixel.pitch_x", 1.0),
    "PixelSizeY": ("pixel.pitch_y", 1.0), "GateOxide": ("gates.gate_oxide", 1.0),
    "BackgroundDoping": ("silicon.background_doping", 1e-12),
    "FieldOxide": ("gates.field_oxide", 1.0),
    "FieldOxideTaper": ("gates.field_oxide_taper", 1.0), "NumPhases": ("gates.phases", 1),
    "CollectingPhases": ("gates.collecting_phases", 1),
    "ChannelStopWidth": ("channel_stop.width", 1.0),
    "ChannelStopSideDiff": ("channel_stop.side_diffusion", 1.0),
    "ChannelSurfaceCharge": ("channel.surface_charge", 1e-8),
    "ChannelStopSurfaceCharge": ("channel_stop.surface_charge", 1e-8),
    "Vparallel_lo": ("operating_point.gate_low", 1.0),
    "Vparallel_hi": ("operating_point.gate_high", 1.0), "Vbb": ("operating_point.back_bias", 1.0),
    "CCDTemperature": ("operating_point.temperature", 1.0),
    "qfh": ("operating_point.hole_quasi_fermi_level", 1.0),
    **{
        f"{name}{what}_{i}": (f"{part}.implants.{i}.{attribute}", factor)
        for name, part in (("Channel", "channel"), ("ChannelStop", "channel_stop"))
        for i in range(2)
        for what, attribute, factor in (
            ("Dose", "dose", 1e-8), ("Peak", "peak", 1.0), ("Sigma", "sigma", 1.0)
        )
    },
}  # fmt: skip
"""Keys of a configuration, the attribute of a device, and the factor between them."""


class PoissonFile(Door):
    """A configuration of Poisson_CCD; each key is looked up in the device that it becomes."""

    name = "poisson_ccd"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.texts = [
            (SHIPPED / f"{stem}.cfg").read_text()
            for stem in ("lsst_itl_50_8", "lsst_e2v_50_8")
        ]
        path = self.folder / "camera.cfg"
        self.made = []
        for text in self.texts:
            path.write_text(text)
            self.made.append(import_poisson_ccd(path))
            assert judge_configuration(self.made[-1], text.encode(), text) == ""

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate one of GalSim's configurations."""
        way = harmless if rng.random() < 0.1 else mutate_text
        text = pick(rng, self.texts)
        words, data, keeps = way(rng, text)
        path = self.write("camera.cfg", data)
        return Case(
            words, lambda: import_poisson_ccd(path),
            lambda made: judge_configuration(made, data, text), ("camera.cfg",), keeps,
        )  # fmt: skip


def judge_configuration(made: Device, data: bytes, original: str) -> str:
    """Compare a device with the keys of its configuration, and these with the original's."""
    try:
        given = data.decode()
    except ValueError:
        return "no UTF-8 was accepted"
    found, before = _pairs(given), _pairs(original)
    for key, (path, factor) in CFG_KEYS.items():
        texts = found.get(key, [])
        own: Any = made
        for part in path.split("."):
            if part.isdigit():
                own = own[int(part)] if int(part) < len(own) else None
            else:
                own = getattr(own, part, None)
        if not texts:
            if key in before and key.startswith("Channel") and own is None:
                continue  # the number of implants is smaller
            # A key that is gone, not deleted: its line is there, but misspelt.
            changed = set(found) - set(before) or _loose(given) - _loose(original)
            if key in before and changed and own not in (0, 0.0) and key != "PixelSizeY":
                return f"{key} is gone, {sorted(changed)[:2]} were ignored"
            if key in before and changed and float(before[key][0]):
                return f"{key} is gone and taken as 0, {sorted(changed)[:2]} were ignored"
            continue
        if len(set(texts)) > 1:
            return f"{key} is given as {short(texts)}, of which one was taken"
        if own is None:
            continue
        try:
            value = float(texts[0]) * factor
        except ValueError:
            return f"{key} = {short(texts[0])} was accepted"
        if not (np.isfinite(value) and close(own, value)):
            return f"{key} = {own} for {short(texts[0])}"
    return ""


def _pairs(text: str) -> dict[str, list[str]]:
    """Values by key of the lines KEY = VALUE."""
    out: dict[str, list[str]] = {}
    for line in text.split("\n"):
        key, sign, value = line.split("#")[0].partition("=")
        if sign and key.strip():
            out.setdefault(key.strip(), []).append(value.strip())
    return out


def _loose(text: str) -> set[str]:
    """Lines that are neither KEY = VALUE nor empty."""
    lines = (line.split("#")[0].strip() for line in text.split("\n"))
    return {line[:40] for line in lines if line and "=" not in line}
