"""Readout effects: predictions of all channels against pixels, by two engines."""

import pytest

from bfsensor.effects.library import LIBRARY
from tests.validation.effects.parity import SMALL, disagreements
from validation.concealed.library import make_effect
from validation.effects.effect_parity import ENGINES, PLACES, effect_at, known_to_the_sensor
from validation.effects.effects_on_pixels import compare

WORDS = (
    "cti_serial", "cti_parallel", "trap_serial", "electronic_memory", "amp_crosstalk",
    "correlated_noise", "bias_instability", "gain_nonlinearity", "adc_bits", "gain_drift",
)  # fmt: skip
KINDS = [k for k in LIBRARY if k.word in WORDS and known_to_the_sensor(k)]
NAMES = [f"{k.word}:{k.variant}".rstrip(":") for k in KINDS]


def test_all_words_have_their_variants():
    assert len(NAMES) == 13 and {k.word for k in KINDS} == set(WORDS)


@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_predictions_agree_with_pixels_of_a_small_campaign(kind):
    assert disagreements(effect_at(kind, 0.9), ENGINES[1], SMALL) == []


@pytest.mark.parametrize("word", ["cti_serial", "electronic_memory", "gain_nonlinearity"])
def test_a_wrong_amplitude_is_seen(word):
    right = effect_at(next(k for k in KINDS if k.word == word), 0.9)
    own = make_effect(word, dict(right.values))
    found = compare(right.scaled(0.8), size=SMALL, own=own)
    said, factor, _ = max(found.values())
    # A bent response is not quite in proportion to its coefficients.
    assert said > 10 and factor == pytest.approx(1.25, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_predictions_agree_with_pixels(kind, place, engine):
    assert disagreements(effect_at(kind, PLACES[place]), engine) == []
