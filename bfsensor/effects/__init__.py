"""Effects that a simulation may leave out, one class each, and the library of all of them.

Each class states its parameters with unit and plausible range, its source, and what it changes in
images and in measured channels.
"""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.effects.adc_bits import AdcBits, ShiftedCodes, WideCodes
    from bfsensor.effects.amp_crosstalk import AmpCrosstalk
    from bfsensor.effects.bf_anisotropy import BrighterFatterAnisotropy
    from bfsensor.effects.bf_chromatic import AbsorptionChromatic, BrighterFatterChromatic
    from bfsensor.effects.bf_long_range import BrighterFatterLongRange
    from bfsensor.effects.bf_nonlinear import BrighterFatterNonlinear, EdgesNonlinear
    from bfsensor.effects.bias_instability import (
        BiasByFrame,
        BiasByRow,
        BiasByRowWithMemory,
        SettlingByFrame,
    )
    from bfsensor.effects.charge_loss import ChargeLoss, FillingLoss, PowerLoss
    from bfsensor.effects.correlated_noise import (
        CommonNoise,
        FlickerNoise,
        NoiseInTime,
        Pickup,
    )
    from bfsensor.effects.cosmic_rays import CosmicRays
    from bfsensor.effects.cti_parallel import CtiParallel, ParallelTraps, TwoParallelTraps
    from bfsensor.effects.cti_serial import CtiSerial, SerialTraps, TwoSerialTraps
    from bfsensor.effects.dark_hot import DarkCurrent, Glow, HotColumns
    from bfsensor.effects.device_parameter import DeviceParameter
    from bfsensor.effects.edge_rolloff import EdgeRolloff
    from bfsensor.effects.effect import Effect, Law, Layout, Parameter, Segment, Shot
    from bfsensor.effects.electronic_memory import ElectronicMemory, OffsetDrift, Settling
    from bfsensor.effects.fringing import Fringing, RoughFringes
    from bfsensor.effects.gain_drift import GainCurve, GainCycle, GainDrift, GainWarming
    from bfsensor.effects.gain_nonlinearity import (
        GainKink,
        GainNonlinearity,
        LateStart,
        ResponseCurve,
    )
    from bfsensor.effects.illumination_turbulence import IlluminationTurbulence
    from bfsensor.effects.interpixel_coupling import InterpixelCoupling
    from bfsensor.effects.lateral_diffusion import LateralDiffusion
    from bfsensor.effects.library import LIBRARY, make_effect
    from bfsensor.effects.mask_stitch import MaskStitch, WavyMask
    from bfsensor.effects.persistence import (
        Persistence,
        PowerPersistence,
        TwoTimesPersistence,
    )
    from bfsensor.effects.psf_wings import AureoleWings, ExponentialWings, PsfWings
    from bfsensor.effects.saturation import DrainedSaturation, Saturation
    from bfsensor.effects.shutter_timing import FlatShutter, ShutterTiming
    from bfsensor.effects.tearing import DivisaderoTearing, Tearing
    from bfsensor.effects.trap_serial import GradualTrap, TrapSerial, TwoTimesTrap
    from bfsensor.effects.tree_rings import RadialTreeRings, TreeRings, UnevenTreeRings
    from bfsensor.effects.voltage_dependence import VoltageDependence
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "adc_bits": ["AdcBits", "ShiftedCodes", "WideCodes"],
            "amp_crosstalk": ["AmpCrosstalk"],
            "bf_anisotropy": ["BrighterFatterAnisotropy"],
            "bf_chromatic": ["AbsorptionChromatic", "BrighterFatterChromatic"],
            "bf_long_range": ["BrighterFatterLongRange"],
            "bf_nonlinear": ["BrighterFatterNonlinear", "EdgesNonlinear"],
            "bias_instability": [
                "BiasByFrame",
                "BiasByRow",
                "BiasByRowWithMemory",
                "SettlingByFrame",
            ],
            "charge_loss": ["ChargeLoss", "FillingLoss", "PowerLoss"],
            "correlated_noise": ["CommonNoise", "FlickerNoise", "NoiseInTime", "Pickup"],
            "cosmic_rays": ["CosmicRays"],
            "cti_parallel": ["CtiParallel", "ParallelTraps", "TwoParallelTraps"],
            "cti_serial": ["CtiSerial", "SerialTraps", "TwoSerialTraps"],
            "dark_hot": ["DarkCurrent", "Glow", "HotColumns"],
            "device_parameter": ["DeviceParameter"],
            "edge_rolloff": ["EdgeRolloff"],
            "effect": ["Effect", "Law", "Layout", "Parameter", "Segment", "Shot"],
            "electronic_memory": ["ElectronicMemory", "OffsetDrift", "Settling"],
            "fringing": ["Fringing", "RoughFringes"],
            "gain_drift": ["GainCurve", "GainCycle", "GainDrift", "GainWarming"],
            "gain_nonlinearity": [
                "GainKink",
                "GainNonlinearity",
                "LateStart",
                "ResponseCurve",
            ],
            "illumination_turbulence": ["IlluminationTurbulence"],
            "interpixel_coupling": ["InterpixelCoupling"],
            "lateral_diffusion": ["LateralDiffusion"],
            "library": ["LIBRARY", "make_effect"],
            "mask_stitch": ["MaskStitch", "WavyMask"],
            "persistence": ["Persistence", "PowerPersistence", "TwoTimesPersistence"],
            "psf_wings": ["AureoleWings", "ExponentialWings", "PsfWings"],
            "saturation": ["DrainedSaturation", "Saturation"],
            "shutter_timing": ["FlatShutter", "ShutterTiming"],
            "tearing": ["DivisaderoTearing", "Tearing"],
            "trap_serial": ["GradualTrap", "TrapSerial", "TwoTimesTrap"],
            "tree_rings": ["RadialTreeRings", "TreeRings", "UnevenTreeRings"],
            "voltage_dependence": ["VoltageDependence"],
        },
    )

__all__ = [
    "LIBRARY",
    "AbsorptionChromatic",
    "AdcBits",
    "AmpCrosstalk",
    "AureoleWings",
    "BiasByFrame",
    "BiasByRow",
    "BiasByRowWithMemory",
    "BrighterFatterAnisotropy",
    "BrighterFatterChromatic",
    "BrighterFatterLongRange",
    "BrighterFatterNonlinear",
    "ChargeLoss",
    "CommonNoise",
    "CosmicRays",
    "CtiParallel",
    "CtiSerial",
    "DarkCurrent",
    "DeviceParameter",
    "DivisaderoTearing",
    "DrainedSaturation",
    "EdgeRolloff",
    "EdgesNonlinear",
    "Effect",
    "ElectronicMemory",
    "ExponentialWings",
    "FillingLoss",
    "FlatShutter",
    "FlickerNoise",
    "Fringing",
    "GainCurve",
    "GainCycle",
    "GainDrift",
    "GainKink",
    "GainNonlinearity",
    "GainWarming",
    "Glow",
    "GradualTrap",
    "HotColumns",
    "IlluminationTurbulence",
    "InterpixelCoupling",
    "LateStart",
    "LateralDiffusion",
    "Law",
    "Layout",
    "MaskStitch",
    "NoiseInTime",
    "OffsetDrift",
    "ParallelTraps",
    "Parameter",
    "Persistence",
    "Pickup",
    "PowerLoss",
    "PowerPersistence",
    "PsfWings",
    "RadialTreeRings",
    "ResponseCurve",
    "RoughFringes",
    "Saturation",
    "Segment",
    "SerialTraps",
    "Settling",
    "SettlingByFrame",
    "ShiftedCodes",
    "Shot",
    "ShutterTiming",
    "Tearing",
    "TrapSerial",
    "TreeRings",
    "TwoParallelTraps",
    "TwoSerialTraps",
    "TwoTimesPersistence",
    "TwoTimesTrap",
    "UnevenTreeRings",
    "VoltageDependence",
    "WavyMask",
    "WideCodes",
    "make_effect",
]
