"""Effects of maps, light and time: predictions of all channels against pixels, by two engines."""

import numpy as np
import pytest

from bfsensor.diagnose.detect.candidate_screen import Screen
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.library import LIBRARY
from tests.validation.effects.parity import SMALL, disagreements
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.effects.effect_parity import (
    ENGINES,
    PLACES,
    SEED,
    effect_at,
    known_to_the_sensor,
    own_effect,
)
from validation.effects.effects_on_pixels import OnPixels, compare, null_campaign

WORDS = (
    "tree_rings", "edge_rolloff", "mask_stitch", "tearing", "fringing", "shutter_timing",
    "illumination_turbulence", "persistence", "dark_hot", "cosmic_rays",
)  # fmt: skip
# Rings of any profile need one that was measured in a map: tests/effects/test_sensor_laws.py.
KINDS = [k for k in LIBRARY if k.word in WORDS and k.variant != "radial"]
NAMES = [f"{k.word}:{k.variant}".rstrip(":") for k in KINDS]
# Fringes a few pixels apart lose contrast by the brighter-fatter effect, 16 % of their power for 9
# pixels: predictions hold that, pixels made here have the pattern of the light.
COMPARED = [k for k in KINDS if k.variant != "rough"]


def test_all_words_have_their_variants():
    assert len(NAMES) == 19 and {k.word for k in KINDS} == set(WORDS)


@pytest.mark.parametrize("kind", [
    pytest.param(k, id=k.word, marks=[pytest.mark.slow] * (k.word == "fringing"))
    for k in COMPARED
])  # fmt: skip
def test_predictions_agree_with_pixels_of_a_small_campaign(kind):
    engine = ENGINES[known_to_the_sensor(kind)]
    # Of fringes small campaigns, which have no red light, know nothing.
    size, width = ("S", 256) if kind.word == "fringing" else (SMALL, SMALL.pixels)
    # Columns of 1e4 standard deviations tell the gains better than flats do.
    place = 0.5 if "columns" in {p.name for p in kind.parameters} else 0.9
    assert disagreements(effect_at(kind, place, width), engine, size) == []


@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_an_effect_of_no_strength_changes_no_bit(kind):
    nothing = effect_at(kind, 0.9).scaled(0.0)
    assert nothing.is_neutral()
    null = VirtualSource(seed=SEED, size=SMALL)
    other = VirtualSource(seed=SEED, size=SMALL, effects=[OnPixels(nothing)])
    for exposure in null.exposures:
        pairs = zip(null.read(exposure), other.read(exposure), strict=True)
        assert all(np.array_equal(a.pixels, b.pixels) for a, b in pairs)
    measured, fit = null_campaign(SEED, SMALL)
    assert not Screen(Predictor(measured, virtual_baseline()), fit).change(nothing).any()


@pytest.mark.parametrize("word", ["edge_rolloff", "shutter_timing", "persistence"])
def test_a_wrong_amplitude_is_seen(word):
    plain = next(k for k in KINDS if k.word == word and not k.variant)
    right = effect_at(plain, 0.9, SMALL.pixels)
    found = compare(right.scaled(0.8), size=SMALL, own=own_effect(right))
    said, factor, _ = max(found.values())
    assert said > 10 and factor == pytest.approx(1.25, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    "kind", COMPARED, ids=lambda k: f"{k.word}:{k.variant}".rstrip(":")
)
def test_predictions_agree_with_pixels(kind, place, engine):
    if engine != ENGINES[0] and not known_to_the_sensor(kind):
        pytest.skip("the virtual sensor's rings are evenly spaced")
    assert disagreements(effect_at(kind, PLACES[place]), engine) == []
