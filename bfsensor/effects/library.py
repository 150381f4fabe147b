"""The library of all effects, and how to make one by its name in the taxonomy."""

from __future__ import annotations

from collections.abc import Mapping

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
from bfsensor.effects.correlated_noise import CommonNoise, FlickerNoise, NoiseInTime, Pickup
from bfsensor.effects.cosmic_rays import CosmicRays
from bfsensor.effects.cti_parallel import CtiParallel, ParallelTraps, TwoParallelTraps
from bfsensor.effects.cti_serial import CtiSerial, SerialTraps, TwoSerialTraps
from bfsensor.effects.dark_hot import DarkCurrent, Glow, HotColumns
from bfsensor.effects.edge_rolloff import EdgeRolloff
from bfsensor.effects.effect import Effect
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
from bfsensor.effects.mask_stitch import MaskStitch, WavyMask
from bfsensor.effects.persistence import Persistence, PowerPersistence, TwoTimesPersistence
from bfsensor.effects.psf_wings import AureoleWings, ExponentialWings, PsfWings
from bfsensor.effects.saturation import DrainedSaturation, Saturation
from bfsensor.effects.shutter_timing import FlatShutter, ShutterTiming
from bfsensor.effects.tearing import DivisaderoTearing, Tearing
from bfsensor.effects.trap_serial import GradualTrap, TrapSerial, TwoTimesTrap
from bfsensor.effects.tree_rings import RadialTreeRings, TreeRings, UnevenTreeRings
from bfsensor.effects.voltage_dependence import VoltageDependence
from bfsensor.errors import EffectError
from bfsensor.text_files import one_line

LIBRARY: tuple[type[Effect], ...] = (
    AdcBits,
    ShiftedCodes,
    WideCodes,
    AmpCrosstalk,
    BiasByFrame,
    BiasByRow,
    BiasByRowWithMemory,
    SettlingByFrame,
    BrighterFatterAnisotropy,
    BrighterFatterChromatic,
    AbsorptionChromatic,
    BrighterFatterLongRange,
    BrighterFatterNonlinear,
    ChargeLoss,
    FillingLoss,
    PowerLoss,
    CommonNoise,
    CosmicRays,
    CtiParallel,
    CtiSerial,
    SerialTraps,
    TwoSerialTraps,
    ParallelTraps,
    TwoParallelTraps,
    DarkCurrent,
    EdgeRolloff,
    ElectronicMemory,
    Settling,
    OffsetDrift,
    Fringing,
    RoughFringes,
    GainDrift,
    GainWarming,
    GainCycle,
    GainCurve,
    GainNonlinearity,
    GainKink,
    LateStart,
    ResponseCurve,
    HotColumns,
    Glow,
    IlluminationTurbulence,
    InterpixelCoupling,
    LateralDiffusion,
    MaskStitch,
    NoiseInTime,
    FlickerNoise,
    Persistence,
    PowerPersistence,
    TwoTimesPersistence,
    Pickup,
    PsfWings,
    ExponentialWings,
    AureoleWings,
    Saturation,
    DrainedSaturation,
    ShutterTiming,
    Tearing,
    TrapSerial,
    GradualTrap,
    TwoTimesTrap,
    TreeRings,
    UnevenTreeRings,
    VoltageDependence,
    DivisaderoTearing,
    EdgesNonlinear,
    FlatShutter,
    RadialTreeRings,
    WavyMask,
)
"""Classes of all effects, one for each variant.  Those of a device's parameters depend on the
baseline: :func:`bfsensor.effects.device_parameter.device_parameters` makes them."""


def make_effect(word: str, values: Mapping[str, float], variant: str = "") -> Effect:
    """Make an effect with given parameters.

    Parameters
    ----------
    word : str
        Name in the taxonomy.
    values : mapping of str to float
        Values of all of its parameters, by name and in their units.
    variant : str
        Variant, or '' where the name has only one.

    Returns
    -------
    effect : Effect
        The effect; it acts by the methods of :class:`bfsensor.effects.Effect`.

    Raises
    ------
    EffectError
        There is no such effect, or its parameters are others.

    Examples
    --------
    >>> make_effect("charge_loss", {"q": 1e-7}).law().loss
    1e-07
    """
    for kind in LIBRARY:
        if (kind.word, kind.variant) == (word, variant):
            return kind(values)
    known = sorted({f"{k.word}:{k.variant}".rstrip(":") for k in LIBRARY})
    own = [name for name in known if name.partition(":")[0] == word]
    given = one_line(f"{word}{':' * bool(variant)}{variant}", 60)
    raise EffectError(
        f"effect {given} is not in the library, which has "
        + (", ".join(own) if own else f"{len(known)} others: see bfsensor.effects.LIBRARY")
    )
