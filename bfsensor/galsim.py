"""Registration of bfsensor's sensor types with GalSim's configuration, without importing GalSim.

``modules: [bfsensor]`` in a configuration only imports bfsensor.  Where GalSim's
configuration is loaded already the types are registered at once.  Where it is not, a finder
in ``sys.meta_path`` registers them as soon as it is: GalSim executes ``import bfsensor``,
which does nothing when bfsensor was imported before GalSim, and importing GalSim here would
make ``import bfsensor`` twenty times as slow.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import sys
from collections.abc import Sequence
from importlib import import_module
from types import ModuleType
from typing import Any

_WATCHED = "galsim.config.sensor"


class _Builder:
    """Builder of a sensor type; the class of the sensor is imported when it is first needed."""

    def __init__(self, name: str) -> None:
        self.name = name

    def buildSensor(self, config: Any, base: Any, logger: Any) -> Any:  # noqa: N802
        """Build the sensor that a configuration describes."""
        import bfsensor

        options = import_module("bfsensor.sensor.config")
        builder = options.EffectSensorBuilder(getattr(bfsensor, self.name))
        return builder.buildSensor(config, base, logger)


def register(*, silicon: bool = False) -> None:
    """Register BrighterFatter and BfsensorSilicon, and with ``silicon`` replace Silicon."""
    from galsim.config.sensor import RegisterSensorType

    RegisterSensorType("BrighterFatter", _Builder("BrighterFatterSensor"))
    RegisterSensorType("BfsensorSilicon", _Builder("SiliconSensor"))
    if silicon:
        RegisterSensorType("Silicon", _Builder("SiliconSensor"))


class _Loader(importlib.abc.Loader):
    """Loader that executes GalSim's module and then registers the sensor types."""

    def __init__(self, loader: Any) -> None:
        self.loader = loader

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType | None:
        return self.loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        self.loader.exec_module(module)
        register()


class _Watch(importlib.abc.MetaPathFinder):
    """Finder that hooks the first import of GalSim's registry of sensors, and then removes itself."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != _WATCHED:
            return None
        sys.meta_path.remove(self)
        spec = importlib.machinery.PathFinder.find_spec(name, path)
        if spec is not None and spec.loader is not None:
            spec.loader = _Loader(spec.loader)
        return spec


def register_when_loaded() -> None:
    """Register now if GalSim's registry is loaded, else as soon as it is imported."""
    if _WATCHED in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _Watch())
