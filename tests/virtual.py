"""Campaigns of the virtual sensor for the package's tests: the only door to its maker.

The maker (``validation.concealed``) shares no code with the package.  What the package measures in a
campaign is kept outside the checkout by the content of the code that makes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bfsensor.diagnose.data.measure_channels import MeasuredChannels, measure_channels
from bfsensor.diagnose.fit.baseline_fit import BaselineFit, fit_bounded
from bfsensor.diagnose.model.predictor import Predictor
from tests.caching import keep
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.concealed.campaign import write_campaign
from validation.concealed.effect import Effect, Range
from validation.concealed.electrostatics import EdgeShifts
from validation.concealed.library import EFFECTS, KNOWN, make_effect
from validation.concealed.outside import OutsideLibrary
from validation.concealed.plan import Geometry, Size

__all__ = [
    "EFFECTS", "KNOWN", "SMALL", "EdgeShifts", "Effect", "Geometry", "OutsideLibrary", "Range",
    "Size", "VirtualSource", "fit_virtual", "make_effect", "measure_virtual", "virtual_baseline",
    "write_campaign",
]  # fmt: skip

SMALL = Size(128, 4, 1, dithers=1)
"""A campaign that is measured in two CPU seconds: 128 x 128 pixels."""

MAKERS = (
    "bfsensor.diagnose.data.measure_channels", "validation.common.virtual_source",
    "validation.concealed.library",
)  # fmt: skip
FITTERS = (*MAKERS, "bfsensor.diagnose.fit.baseline_fit")


def measure_virtual(
    *, seed: int, size: Any = SMALL, effects: Sequence[Any] = ()
) -> MeasuredChannels:
    """Channels of a campaign; see :class:`VirtualSource` for what it is made of."""

    def make() -> MeasuredChannels:
        return measure_channels(VirtualSource(seed=seed, size=size, effects=effects))

    key = _key(seed, size, effects)
    return make() if key is None else keep(key, make, made_by=MAKERS)


def fit_virtual(
    *, seed: int, size: Any = SMALL, effects: Sequence[Any] = ()
) -> tuple[MeasuredChannels, Predictor, BaselineFit]:
    """Channels of a campaign, and the nominal baseline fitted to them."""

    def make() -> tuple[MeasuredChannels, Predictor, BaselineFit]:
        measured = measure_virtual(seed=seed, size=size, effects=effects)
        return measured, *fit_bounded(measured, virtual_baseline())

    key = _key(seed, size, effects)
    return make() if key is None else keep(("fit", key), make, made_by=FITTERS)


def _key(seed: int, size: Any, effects: Sequence[Any]) -> object:
    """What tells a campaign; None where an effect that a test makes up has no name that does."""
    if not all(
        type(effect) is EFFECTS.get(getattr(effect, "word", "")) for effect in effects
    ):
        return None
    made: list[Effect] = list(effects)
    return (
        seed, size,
        [(one.word, sorted(dict(one.parameters).items()), one.variant) for one in made],
    )  # fmt: skip
