"""Device physics of thick CCDs: from a device file to the brighter-fatter effect."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "BFSensorError": "errors",
    "ConvergenceError": "errors",
    "DeviceError": "errors",
    "MeasurementError": "errors",
    "RecordingError": "errors",
    "SensorError": "errors",
    "TableError": "errors",
    "Device": "device.device",
    "builtin_devices": "device.device",
    "import_poisson_ccd": "device.poisson_ccd",
    "DistortionTable": "table.table",
    "build_table": "table.build",
    "plan_table": "table.table_plan",
    "BrighterFatterSensor": "sensor.brighter_fatter",
    "SiliconSensor": "sensor.silicon_sensor",
    "ShiftMap": "sensor.shift_maps",
}

__all__ = ["__version__", *sorted(_PUBLIC)]


def __getattr__(name: str) -> Any:
    """Import public names when they are first used: numba and astropy are slow to load."""
    if name in _PUBLIC:
        return getattr(import_module(f"bfsensor.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module 'bfsensor' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__


def _register() -> None:
    from bfsensor.galsim import register_when_loaded

    register_when_loaded()


_register()
