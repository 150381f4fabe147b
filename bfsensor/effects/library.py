"""All effects: found by class word, and by variant where a class has several."""

from __future__ import annotations

from collections.abc import Mapping

from bfsensor.effects.charge_loss import ChargeLoss
from bfsensor.effects.cosmic_rays import CosmicRays
from bfsensor.effects.dark_hot import DarkCurrent, HotColumns
from bfsensor.effects.edge_rolloff import EdgeRolloff
from bfsensor.effects.effect import Effect
from bfsensor.effects.fringing import Fringing
from bfsensor.effects.gain_nonlinearity import GainNonlinearity
from bfsensor.effects.illumination_turbulence import IlluminationTurbulence
from bfsensor.effects.interpixel_coupling import InterpixelCoupling
from bfsensor.effects.mask_stitch import MaskStitch
from bfsensor.effects.persistence import Persistence
from bfsensor.effects.shutter_timing import ShutterTiming
from bfsensor.effects.tearing import Tearing
from bfsensor.effects.trap_serial import TrapSerial
from bfsensor.effects.tree_rings import TreeRings
from bfsensor.errors import EffectError

LIBRARY: tuple[type[Effect], ...] = (
    ChargeLoss,
    CosmicRays,
    DarkCurrent,
    EdgeRolloff,
    Fringing,
    GainNonlinearity,
    HotColumns,
    IlluminationTurbulence,
    InterpixelCoupling,
    MaskStitch,
    Persistence,
    ShutterTiming,
    Tearing,
    TrapSerial,
    TreeRings,
)
"""Every candidate, one for each variant of a class."""


def make_effect(word: str, values: Mapping[str, float], variant: str = "") -> Effect:
    """Make an effect with given parameters.

    Parameters
    ----------
    word, variant : str
        Class, and which kind of it.
    values : mapping of str to float
        All parameters.

    Raises
    ------
    EffectError
        No such class or variant, or not its parameters.

    Examples
    --------
    >>> make_effect("charge_loss", {"q": 1e-7}).law().loss
    1e-07
    """
    for kind in LIBRARY:
        if (kind.word, kind.variant) == (word, variant):
            return kind(values)
    known = ", ".join(sorted({f"{k.word}:{k.variant}".rstrip(":") for k in LIBRARY}))
    raise EffectError(f"effect {word}{':' * bool(variant)}{variant}: one of {known}")
