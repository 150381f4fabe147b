"""Effects that a simulation may leave out, one class each, and the library of all of them.

Each class states its parameters with unit and plausible range, its source, and what it changes in
images and in measured channels.
"""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.effects.adc_bits import AdcBits
    from bfsensor.effects.amp_crosstalk import AmpCrosstalk
    from bfsensor.effects.bf_anisotropy import BrighterFatterAnisotropy
    from bfsensor.effects.bf_chromatic import BrighterFatterChromatic
    from bfsensor.effects.bf_long_range import BrighterFatterLongRange
    from bfsensor.effects.bf_nonlinear import BrighterFatterNonlinear, EdgesNonlinear
    from bfsensor.effects.bias_instability import BiasByFrame, BiasByRow
    from bfsensor.effects.charge_loss import ChargeLoss
    from bfsensor.effects.correlated_noise import CommonNoise, NoiseInTime, Pickup
    from bfsensor.effects.cosmic_rays import CosmicRays
    from bfsensor.effects.cti_parallel import CtiParallel
    from bfsensor.effects.cti_serial import CtiSerial
    from bfsensor.effects.dark_hot import DarkCurrent, HotColumns
    from bfsensor.effects.device_parameter import DeviceParameter
    from bfsensor.effects.edge_rolloff import EdgeRolloff
    from bfsensor.effects.effect import Effect, Law, Layout, Parameter, Segment, Shot
    from bfsensor.effects.electronic_memory import ElectronicMemory
    from bfsensor.effects.fringing import Fringing
    from bfsensor.effects.gain_drift import GainDrift
    from bfsensor.effects.gain_nonlinearity import GainNonlinearity
    from bfsensor.effects.illumination_turbulence import IlluminationTurbulence
    from bfsensor.effects.interpixel_coupling import InterpixelCoupling
    from bfsensor.effects.lateral_diffusion import LateralDiffusion
    from bfsensor.effects.library import LIBRARY, make_effect
    from bfsensor.effects.mask_stitch import MaskStitch, WavyMask
    from bfsensor.effects.persistence import Persistence
    from bfsensor.effects.psf_wings import PsfWings
    from bfsensor.effects.saturation import Saturation
    from bfsensor.effects.shutter_timing import FlatShutter, ShutterTiming
    from bfsensor.effects.tearing import DivisaderoTearing, Tearing
    from bfsensor.effects.trap_serial import TrapSerial
    from bfsensor.effects.tree_rings import RadialTreeRings, TreeRings, UnevenTreeRings
    from bfsensor.effects.voltage_dependence import VoltageDependence
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "adc_bits": ["AdcBits"],
            "amp_crosstalk": ["AmpCrosstalk"],
            "bf_anisotropy": ["BrighterFatterAnisotropy"],
            "bf_chromatic": ["BrighterFatterChromatic"],
            "bf_long_range": ["BrighterFatterLongRange"],
            "bf_nonlinear": ["BrighterFatterNonlinear", "EdgesNonlinear"],
            "bias_instability": ["BiasByFrame", "BiasByRow"],
            "charge_loss": ["ChargeLoss"],
            "correlated_noise": ["CommonNoise", "NoiseInTime", "Pickup"],
            "cosmic_rays": ["CosmicRays"],
            "cti_parallel": ["CtiParallel"],
            "cti_serial": ["CtiSerial"],
            "dark_hot": ["DarkCurrent", "HotColumns"],
            "device_parameter": ["DeviceParameter"],
            "edge_rolloff": ["EdgeRolloff"],
            "effect": ["Effect", "Law", "Layout", "Parameter", "Segment", "Shot"],
            "electronic_memory": ["ElectronicMemory"],
            "fringing": ["Fringing"],
            "gain_drift": ["GainDrift"],
            "gain_nonlinearity": ["GainNonlinearity"],
            "illumination_turbulence": ["IlluminationTurbulence"],
            "interpixel_coupling": ["InterpixelCoupling"],
            "lateral_diffusion": ["LateralDiffusion"],
            "library": ["LIBRARY", "make_effect"],
            "mask_stitch": ["MaskStitch", "WavyMask"],
            "persistence": ["Persistence"],
            "psf_wings": ["PsfWings"],
            "saturation": ["Saturation"],
            "shutter_timing": ["FlatShutter", "ShutterTiming"],
            "tearing": ["DivisaderoTearing", "Tearing"],
            "trap_serial": ["TrapSerial"],
            "tree_rings": ["RadialTreeRings", "TreeRings", "UnevenTreeRings"],
            "voltage_dependence": ["VoltageDependence"],
        },
    )

__all__ = [
    "LIBRARY",
    "AdcBits",
    "AmpCrosstalk",
    "BiasByFrame",
    "BiasByRow",
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
    "EdgeRolloff",
    "EdgesNonlinear",
    "Effect",
    "ElectronicMemory",
    "FlatShutter",
    "Fringing",
    "GainDrift",
    "GainNonlinearity",
    "HotColumns",
    "IlluminationTurbulence",
    "InterpixelCoupling",
    "LateralDiffusion",
    "Law",
    "Layout",
    "MaskStitch",
    "NoiseInTime",
    "Parameter",
    "Persistence",
    "Pickup",
    "PsfWings",
    "RadialTreeRings",
    "Saturation",
    "Segment",
    "Shot",
    "ShutterTiming",
    "Tearing",
    "TrapSerial",
    "TreeRings",
    "UnevenTreeRings",
    "VoltageDependence",
    "WavyMask",
    "make_effect",
]
