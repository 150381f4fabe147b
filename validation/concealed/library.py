"""All effects by class word, and how they are drawn."""

from __future__ import annotations

import numpy as np

from validation.concealed.effect import Effect
from validation.concealed.effects_light import LIGHT_EFFECTS
from validation.concealed.effects_readout import READOUT_EFFECTS
from validation.concealed.effects_silicon import SILICON_EFFECTS
from validation.concealed.outside import OutsideLibrary

EFFECTS: dict[str, type[Effect]] = {
    effect.word: effect
    for effect in (*READOUT_EFFECTS, *SILICON_EFFECTS, *LIGHT_EFFECTS, OutsideLibrary)
}
"""Class word to effect; 31 classes and the open world."""

KNOWN = tuple(word for word in EFFECTS if word != OutsideLibrary.word)


def make_effect(word: str, parameters: dict[str, float], variant: str = "") -> Effect:
    """Make an effect with given parameters.

    Raises
    ------
    ValueError
        No such class, variant or set of parameters.

    Examples
    --------
    >>> make_effect("cti_serial", {"cti": 1e-6}).truth()
    {'class': 'cti_serial', 'parameters': {'cti': 1e-06}}
    """
    return _find(word)(parameters, variant)


def draw_effect(
    word: str,
    rng: np.random.Generator,
    *,
    strength: float | None = None,
    variant: str | None = None,
) -> Effect:
    """Draw an effect of one class; ``strength`` 0 to 1 is the place in its amplitude range."""
    if strength is not None and not 0 <= strength <= 1:
        raise ValueError(f"strength = {strength:g}: 0 to 1")
    return _find(word).draw(rng, strength, variant)


def draw_effects(
    rng: np.random.Generator,
    *,
    null_fraction: float = 0.25,
    outside_fraction: float = 0.12,
    several_fraction: float = 0.16,
    strength: float | None = None,
) -> tuple[Effect, ...]:
    """Draw what one concealed campaign leaves out: nothing, something foreign, one or more.

    Several are two or (one time in three) three different classes of the library.
    """
    fractions = null_fraction, outside_fraction, several_fraction
    if min(fractions) < 0 or sum(fractions) > 1:
        raise ValueError(f"fractions {fractions}: none below 0, at most 1 in all")
    lot = rng.random()
    if lot < null_fraction:
        return ()
    if lot < null_fraction + outside_fraction:
        return (draw_effect(OutsideLibrary.word, rng, strength=strength),)
    number = 1
    if lot < sum(fractions):
        number = 3 if rng.random() < 1 / 3 else 2
    words = rng.choice(np.array(KNOWN), size=number, replace=False)
    return tuple(draw_effect(str(word), rng, strength=strength) for word in words)


def _find(word: str) -> type[Effect]:
    if word not in EFFECTS:
        raise ValueError(f"class = {word!r}: one of {', '.join(sorted(EFFECTS))}")
    return EFFECTS[word]
