"""Reader of Poisson_CCD (and GalSim) sensor configurations as devices."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from bfsensor.device.device import Device
from bfsensor.device.parts import (
    BuriedChannel,
    ChannelStop,
    ChannelStopDots,
    GateStack,
    Implant,
    Material,
    OperatingPoint,
    Pixel,
    Silicon,
)
from bfsensor.errors import DeviceError
from bfsensor.text_files import nearly_equal

PUBLISHED_MATERIAL = Material(
    permittivity_silicon=11.7,
    permittivity_oxide=4.3,
    band_gap=1.1,
    density_of_states=2.5e7,
    thermal_voltage_300K=0.026,
)
"""Constants of silicon and oxide with which the published devices were tuned.

Published: they are compiled into Poisson_CCD (commit 036cbef)."""

_PER_CM2 = 1e-8
"""1 cm^-2 in um^-2, exact."""

_PER_CM3 = 1e-12
"""1 cm^-3 in um^-3, exact."""

_LINE = re.compile(r"^\s*([A-Za-z][A-Za-z0-9_]*)\s*=\s*(.*?)\s*$")
"""A line ``key = value``, comments cut off before."""


def read_configuration(path: str | os.PathLike[str]) -> dict[str, str]:
    """Read the ``key = value`` lines of a configuration; nothing is evaluated.

    Raises
    ------
    DeviceError
        Not a text file, or without any such line.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(f"{path}: cannot be read: {error}") from None
    out: dict[str, str] = {}
    for number, line in enumerate(text.split("\n"), 1):
        given = line.split("#", 1)[0]
        match = _LINE.match(given)
        if match is None and out and given.strip():
            raise DeviceError(
                f"{path}: line {number}: {given.strip()[:80]!r} is neither KEY = VALUE nor a comment (#)"
            )
        if match and out.setdefault(match[1], match[2]) != match[2]:
            raise DeviceError(
                f"{path}: line {number}: {match[1]} = {match[2][:40]!r} contradicts an earlier line, "
                f"{match[1]} = {out[match[1]][:40]!r}: leave out one of them"
            )
    if not out:
        raise DeviceError(
            f"{path}: not a Poisson_CCD configuration: no line of the form key = value"
        )
    return out


_DEVICE_KEYS = (
    "SensorThickness", "PixelSizeX", "PixelSizeY", "BackgroundDoping", "GateOxide", "FieldOxide",
    "FieldOxideTaper", "GateGap", "NumPhases", "CollectingPhases", "Vbb", "Vparallel_lo",
    "Vparallel_hi", "qfh", "CCDTemperature", "NumberofFixedRegions", "TreeRingAmplitude",
    "TreeRingPeriod", "TreeRingAngle", "ChannelStopWidth", "ChannelStopSideDiff",
    "ChannelStopDotCenter", "ChannelStopDotHeight",
    *(
        f"{region}{key}"
        for region in ("Channel", "ChannelStop", "ChannelStopDot")
        for key in ("Profile", "Doping", "Depth", "SurfaceCharge", "Dose_", "Peak_", "Sigma_")
    ),
)  # fmt: skip
"""Keys of a configuration that a device takes over; a number follows those that end in _."""

_NUMBERED = re.compile(r"(?<=_)\d+$")
"""Number of an implant at the end of its keys."""

_DEVICE_LIKE = re.compile(
    r"(Channel|Gate|Field|Background|Vbb|Vpar|qf|Top|TreeRing|CCDTemp)"
)
"""Beginnings of keys that describe a device; such a key that is not known is refused."""


def _refuse_unknown(data: dict[str, str]) -> None:
    """Refuse unknown keys that begin as keys of a device do, or are one but for a letter."""
    for key in data:
        name = _NUMBERED.sub("", key)
        if name in _DEVICE_KEYS:
            continue
        if key in ("GatePotential", "TopAbsorptionProb", "GateGapPotential"):
            continue  # they act on tracking, or on gaps that are refused themselves
        meant = next((one for one in _DEVICE_KEYS if nearly_equal(name, one)), "")
        if meant or _DEVICE_LIKE.match(key):
            hint = (
                f"did you mean {meant}?" if meant else "of another version of the program"
            )
            raise DeviceError(
                f"{key} is not a key that a device file can hold (misspelt, or {hint})"
            )


def import_poisson_ccd(path: str | os.PathLike[str]) -> Device:
    """Read a Poisson_CCD configuration as a device.

    The device takes over pixel size, thickness, background doping, implants of channel,
    channel stop and dots, surface charges, oxides, phases, voltages, quasi-Fermi level of the
    holes, and temperature.  Keys that steer a run (mesh, filled wells, tracking, output) are
    ignored.

    Parameters
    ----------
    path : path-like
        A ``.cfg`` file, such as those under ``share/sensors`` of GalSim.

    Returns
    -------
    Device
        Named after the file, with the material constants of that program.

    Raises
    ------
    DeviceError
        A key is missing or not a number, or the device has a feature that a device file cannot
        hold (gaps between gates, fixed regions, tree rings, unknown keys).

    Examples
    --------
    >>> import galsim
    >>> folder = Path(galsim.meta_data.share_dir) / "sensors"
    >>> import_poisson_ccd(folder / "lsst_itl_50_8.cfg").operating_point.back_bias
    -50.0
    """
    path = Path(path)
    given = _Configuration(read_configuration(path))
    try:
        return _device(path.stem, given)
    except DeviceError as error:
        raise DeviceError(f"{path.name}: {error}") from None


@dataclass(frozen=True)
class _Configuration:
    """A configuration, its texts by key, with methods that convert them."""

    texts: dict[str, str]

    def number(self, key: str, default: float | None = None) -> float:
        """Return the number of a key, ``default`` where it is missing; None: it must be there."""
        if key not in self.texts:
            if default is None:
                raise DeviceError(f"{key} is missing")
            return default
        try:
            return float(self.texts[key])
        except ValueError:
            raise DeviceError(f"{key} = {self.texts[key]!r} is not a number") from None

    def whole(self, key: str, default: float | None = None) -> int:
        """Return the whole number of a key."""
        value = self.number(key, default)
        if not value.is_integer():
            raise DeviceError(f"{key} = {self.texts[key]!r} is not a whole number")
        return int(value)

    def surface_charge(self, prefix: str) -> float:
        """Charge of a surface [e-/um^2], 0 where none is stated."""
        return self.number(f"{prefix}SurfaceCharge", 0.0) * _PER_CM2

    def implants(self, prefix: str) -> tuple[Implant, ...]:
        """Return the Gaussian implants of a region, or its single uniform one (profile 0)."""
        count = self.whole(f"{prefix}Profile", 0.0)
        if count == 0:
            doping = self.number(f"{prefix}Doping", 0.0)
            depth = self.number(f"{prefix}Depth", 0.0)
            return (
                (Implant("box", doping * _PER_CM2, depth=depth),)
                if doping and depth
                else ()
            )
        return tuple(
            Implant(
                "gaussian",
                self.number(f"{prefix}Dose_{i}") * _PER_CM2,
                self.number(f"{prefix}Peak_{i}"),
                self.number(f"{prefix}Sigma_{i}"),
            )
            for i in range(count)
        )


def _refuse_unmodelled(given: _Configuration) -> None:
    """Refuse features that a device file states in another way, or cannot state."""
    for key, why in (
        ("TreeRingAmplitude", "its period lacks a factor 2 pi there; give the ripple in the "
         "device file instead"),
        ("GateGap", "gaps between gates are not modelled"),
        ("NumberofFixedRegions", "fixed regions are not taken over; describe a guard ring as "
         "[edge] in the device file"),
    ):  # fmt: skip
        if given.number(key, 0.0):
            raise DeviceError(f"{key} = {given.texts[key]}: {why}")


def _device(name: str, given: _Configuration) -> Device:
    """Build the device that a configuration describes."""
    number = given.number
    _refuse_unknown(given.texts)
    _refuse_unmodelled(given)
    dots = None
    if given.implants("ChannelStopDot"):
        dots = ChannelStopDots(
            number("ChannelStopDotCenter"),
            number("ChannelStopDotHeight"),
            given.surface_charge("ChannelStopDot"),
            given.implants("ChannelStopDot"),
        )
    return Device(
        name=name,
        pixel=Pixel(number("PixelSizeX"), number("PixelSizeY", number("PixelSizeX"))),
        material=PUBLISHED_MATERIAL,
        silicon=Silicon(number("SensorThickness"), number("BackgroundDoping") * _PER_CM3),
        gates=GateStack(
            given.whole("NumPhases"),
            given.whole("CollectingPhases"),
            number("GateOxide"),
            number("FieldOxide"),
            number("FieldOxideTaper", 0.0),
        ),
        channel=BuriedChannel(given.surface_charge("Channel"), given.implants("Channel")),
        channel_stop=ChannelStop(
            number("ChannelStopWidth"),
            number("ChannelStopSideDiff", 0.0),
            given.surface_charge("ChannelStop"),
            given.implants("ChannelStop"),
            dots,
        ),
        operating_point=OperatingPoint(
            gate_low=number("Vparallel_lo"),
            gate_high=number("Vparallel_hi"),
            back_bias=number("Vbb"),
            temperature=number("CCDTemperature"),
            hole_quasi_fermi_level=number("qfh", 0.0),
        ),
    )
