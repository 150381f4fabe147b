"""Turn a Poisson_CCD (or GalSim) configuration into a device."""

from __future__ import annotations

import os
import re
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

PUBLISHED_MATERIAL = Material(
    permittivity_silicon=11.7,
    permittivity_oxide=4.3,
    band_gap=1.1,
    density_of_states=2.5e7,
    thermal_voltage_300K=0.026,
)
"""Constants compiled into Poisson_CCD (commit 036cbef), with which devices were tuned."""

_PER_CM2 = 1e-8
_PER_CM3 = 1e-12
_LINE = re.compile(r"^\s*([A-Za-z][A-Za-z0-9_]*)\s*=\s*(.*?)\s*$")


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
    out = {}
    for line in text.splitlines():
        match = _LINE.match(line.split("#", 1)[0])
        if match:
            out[match[1]] = match[2]
    if not out:
        raise DeviceError(
            f"{path}: not a Poisson_CCD configuration: no line of the form key = value"
        )
    return out


_DEVICE_KEYS = re.compile(
    r"(SensorThickness|PixelSize[XY]|BackgroundDoping|GateOxide|FieldOxide(Taper)?|GateGap|NumPhases"
    r"|CollectingPhases|Vbb|Vparallel_(lo|hi)|qfh|CCDTemperature|NumberofFixedRegions"
    r"|TreeRing(Amplitude|Period|Angle)"
    r"|Channel(Stop|StopDot)?(Profile|Doping|Depth|SurfaceCharge|(Dose|Peak|Sigma)_\d+)"
    r"|ChannelStop(Width|SideDiff|DotCenter|DotHeight))"
)
_DEVICE_LIKE = re.compile(
    r"(Channel|Gate|Field|Background|Vbb|Vpar|qf|Top|TreeRing|CCDTemp)"
)


def _refuse_unknown(data: dict[str, str]) -> None:
    """Refuse keys that look like part of the device and are not known."""
    for key in data:
        if _DEVICE_LIKE.match(key) and not _DEVICE_KEYS.fullmatch(key):
            if key in ("GatePotential", "TopAbsorptionProb", "GateGapPotential"):
                continue  # they act on tracking, or on gaps that are refused themselves
            raise DeviceError(
                f"{key} is not a key that a device file can hold (misspelt, or of another "
                "version of the program)"
            )


def import_poisson_ccd(path: str | os.PathLike[str]) -> Device:
    """Read a Poisson_CCD configuration as a device.

    Taken over: pixel size, thickness, background doping, channel, channel-stop and dot
    implants, surface charges, oxides, phases, voltages, hole level, temperature.  What
    steers a run (mesh, filled wells, tracking, output) is not part of a device.

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
        A key is missing or not a number, or the device cannot be represented.
    """
    path = Path(path)
    data = read_configuration(path)
    try:
        return _device(path.stem, data)
    except DeviceError as error:
        raise DeviceError(f"{path.name}: {error}") from None


def _device(name: str, data: dict[str, str]) -> Device:
    """Build the device that a configuration describes."""

    def number(key: str, default: float | None = None) -> float:
        if key not in data:
            if default is None:
                raise DeviceError(f"{key} is missing")
            return default
        try:
            return float(data[key])
        except ValueError:
            raise DeviceError(f"{key} = {data[key]!r} is not a number") from None

    def whole(key: str, default: float | None = None) -> int:
        value = number(key, default)
        if not value.is_integer():
            raise DeviceError(f"{key} = {data[key]!r} is not a whole number")
        return int(value)

    def implants(prefix: str) -> tuple[Implant, ...]:
        count = whole(f"{prefix}Profile", 0.0)
        if count == 0:
            doping, depth = number(f"{prefix}Doping", 0.0), number(f"{prefix}Depth", 0.0)
            return (
                (Implant("box", doping * _PER_CM2, depth=depth),)
                if doping and depth
                else ()
            )
        return tuple(
            Implant(
                "gaussian",
                number(f"{prefix}Dose_{i}") * _PER_CM2,
                number(f"{prefix}Peak_{i}"),
                number(f"{prefix}Sigma_{i}"),
            )
            for i in range(count)
        )

    _refuse_unknown(data)
    if number("TreeRingAmplitude", 0.0):
        raise DeviceError(
            f"TreeRingAmplitude = {data['TreeRingAmplitude']}: its period lacks a factor "
            "2 pi there; give the ripple in the device file instead"
        )
    if number("GateGap", 0.0):
        raise DeviceError(
            f"GateGap = {data['GateGap']}: gaps between gates are not modelled"
        )
    if number("NumberofFixedRegions", 0.0):
        raise DeviceError(
            f"NumberofFixedRegions = {data['NumberofFixedRegions']}: fixed regions are not "
            "taken over; describe a guard ring as [edge] in the device file"
        )
    dots = None
    if implants("ChannelStopDot"):
        dots = ChannelStopDots(
            number("ChannelStopDotCenter"),
            number("ChannelStopDotHeight"),
            number("ChannelStopDotSurfaceCharge", 0.0) * _PER_CM2,
            implants("ChannelStopDot"),
        )
    return Device(
        name=name,
        pixel=Pixel(number("PixelSizeX"), number("PixelSizeY", number("PixelSizeX"))),
        material=PUBLISHED_MATERIAL,
        silicon=Silicon(number("SensorThickness"), number("BackgroundDoping") * _PER_CM3),
        gates=GateStack(
            whole("NumPhases"),
            whole("CollectingPhases"),
            number("GateOxide"),
            number("FieldOxide"),
            number("FieldOxideTaper", 0.0),
        ),
        channel=BuriedChannel(
            number("ChannelSurfaceCharge", 0.0) * _PER_CM2, implants("Channel")
        ),
        channel_stop=ChannelStop(
            number("ChannelStopWidth"),
            number("ChannelStopSideDiff", 0.0),
            number("ChannelStopSurfaceCharge", 0.0) * _PER_CM2,
            implants("ChannelStop"),
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
