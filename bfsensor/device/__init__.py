"""Devices (geometry, doping, voltages), their quantities with priors, and laws of silicon."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.device.condition import Condition
    from bfsensor.device.device import Device, builtin_devices
    from bfsensor.device.parameters import (
        change_parameter,
        device_parameters,
        parameter_value,
    )
    from bfsensor.device.parts import (
        BuriedChannel,
        ChannelStop,
        ChannelStopDots,
        Edge,
        EdgeStrip,
        ElectronTransport,
        FittedCharge,
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
    from bfsensor.device.poisson_ccd import import_poisson_ccd
    from bfsensor.device.quantities import Prior, Quantity, choose_priors, with_priors
    from bfsensor.device.shipped import tables_dir
    from bfsensor.device.silicon import absorption_length, mobility
    from bfsensor.device.written_units import from_internal, to_internal
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "condition": ["Condition"],
            "device": ["Device", "builtin_devices"],
            "parameters": ["change_parameter", "device_parameters", "parameter_value"],
            "parts": [
                "BuriedChannel",
                "ChannelStop",
                "ChannelStopDots",
                "Edge",
                "EdgeStrip",
                "ElectronTransport",
                "FittedCharge",
                "GateStack",
                "Implant",
                "Material",
                "OperatingPoint",
                "Pixel",
                "Provenance",
                "Ripple",
                "Silicon",
                "Well",
            ],
            "poisson_ccd": ["import_poisson_ccd"],
            "quantities": ["Prior", "Quantity", "choose_priors", "with_priors"],
            "shipped": ["tables_dir"],
            "silicon": ["absorption_length", "mobility"],
            "written_units": ["from_internal", "to_internal"],
        },
    )

__all__ = [
    "BuriedChannel",
    "ChannelStop",
    "ChannelStopDots",
    "Condition",
    "Device",
    "Edge",
    "EdgeStrip",
    "ElectronTransport",
    "FittedCharge",
    "GateStack",
    "Implant",
    "Material",
    "OperatingPoint",
    "Pixel",
    "Prior",
    "Provenance",
    "Quantity",
    "Ripple",
    "Silicon",
    "Well",
    "absorption_length",
    "builtin_devices",
    "change_parameter",
    "choose_priors",
    "device_parameters",
    "from_internal",
    "import_poisson_ccd",
    "mobility",
    "parameter_value",
    "tables_dir",
    "to_internal",
    "with_priors",
]
