"""The library's own shapes beside the scans: faint effects that show in many places, and nothing."""

from dataclasses import replace

import numpy as np
import pytest

from bfsensor.diagnose.channels import Channel
from bfsensor.diagnose.diagnosis import fit_bounded
from bfsensor.diagnose.extract import measure_channels
from bfsensor.diagnose.locate import ALARM, FAMILY, locate_mismatch
from bfsensor.diagnose.model import Model
from bfsensor.diagnose.screen import Screen
from bfsensor.diagnose.suspects import suspect_effects, trials_of
from bfsensor.effects.persistence import Persistence
from bfsensor.effects.tearing import Tearing
from validation.concealed.plan import Size
from validation.virtual_source import VirtualSource, virtual_baseline

SMALL = Size(128, 4, 1, dithers=1)


@pytest.fixture(scope="module")
def null():
    measured = measure_channels(VirtualSource(seed=9137, size=SMALL))
    return measured, *fit_bounded(measured, virtual_baseline())


def with_change(null, effect, length):
    """The null's channels with what an effect changes, of a length in standard deviations."""
    measured, predictor, fit = null
    screen = Screen(predictor, fit)
    bare = screen._change(effect)
    seen = screen.change(effect)
    factor = length / np.sqrt(seen @ seen)
    parts = {
        id(c): factor * bare[s : s + len(c)]
        for c, s in zip(fit.channels, fit.starts, strict=False)
    }
    channels = tuple(
        Channel(c.word, c.values + c.unwhiten(parts[id(c)]), c.blocks, c.axes, c.unit, c.fold)
        if id(c) in parts else c
        for c in measured.channels
    )  # fmt: skip
    changed = replace(measured, channels=channels)
    return fit_bounded(changed, virtual_baseline())


def test_nothing_is_suspected_of_a_null(null):
    _, predictor, fit = null
    before = locate_mismatch(fit)
    after = suspect_effects(predictor, fit, before)
    assert not after.detected and after.findings == before.findings
    # Two families: what the scans say counts twice.
    assert after.p_value >= before.p_value


def test_what_scans_hardly_see_is_found_by_its_own_shape(null):
    effect = Persistence({"frac": 1e-4, "tau": 2.0})
    predictor, fit = with_change(null, effect, 8.0)
    scans = locate_mismatch(fit)
    found = suspect_effects(predictor, fit, scans)
    assert found.p_value < 1e-4 * ALARM < scans.p_value
    first = found.findings[0]
    assert (first.family, first.where["effect"]) == (FAMILY, "persistence")
    assert abs(first.z - 8.0) < 3.0
    # What is there already is not suspected again, and nothing else is.
    model = Model(predictor, fit).with_effects((effect,))
    left = suspect_effects(model.predictor, model.fit, locate_mismatch(model.fit))
    assert not left.detected and not left.findings


def test_places_that_are_tried_are_charged(null):
    _, predictor, fit = null
    screen = Screen(predictor, fit)
    assert trials_of(Persistence, screen) == len(Persistence.starts(predictor.layout))
    assert trials_of(Tearing, screen) > 50
