"""Matched filters beside the scans: faint effects that change many values, and campaigns of none."""

from dataclasses import replace

import numpy as np
import pytest

from bfsensor.diagnose.detect.candidate_screen import Screen
from bfsensor.diagnose.detect.locate import ALARM, FAMILY, locate_mismatch
from bfsensor.diagnose.detect.matched_filters import (
    LOOKED,
    known_shapes,
    locate_effects,
    trials_of,
)
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.effects.persistence import Persistence
from bfsensor.effects.tearing import Tearing
from bfsensor.effects.tree_rings import TreeRings
from tests.virtual import fit_virtual, virtual_baseline


@pytest.fixture(scope="module")
def null():
    return fit_virtual(seed=9137)


def with_change(null, effect, length):
    """Fit of the null's channels with an effect added, at a projected SNR of ``length``."""
    measured, predictor, fit = null
    screen = Screen(predictor, fit)
    bare = screen._change(effect)
    seen = screen.change(effect)
    factor = length / np.sqrt(seen @ seen)
    parts = {
        c: factor * bare[s : s + len(c)]
        for c, s in zip(fit.channels, fit.starts, strict=False)
    }
    channels = tuple(
        replace(c, values=c.values + c.unwhiten(parts[c]))
        if c in parts else c
        for c in measured.channels
    )  # fmt: skip
    changed = replace(measured, channels=channels)
    return fit_bounded(changed, virtual_baseline())


def test_nothing_is_suspected_of_a_null(null):
    _, predictor, fit = null
    before = locate_mismatch(fit)
    after = locate_effects(predictor, fit)
    assert not after.detected and not after.findings
    assert (after.p_scans, after.p_chi2) == (before.p_scans, before.p_chi2)
    # Held against the largest of more statistics than the scans' own.
    assert after.p_value >= min(before.p_value, 1 - ALARM) * 0.5


@pytest.mark.slow
def test_what_scans_hardly_see_is_found_by_its_own_shape(null):
    effect = Persistence({"frac": 1e-4, "tau": 2.0})
    predictor, fit = with_change(null, effect, 8.0)
    found = locate_effects(predictor, fit)
    assert found.p_value < 1e-2 * ALARM < found.p_scans
    first = found.findings[0]
    assert (first.family, first.where["effect"]) == (FAMILY, "persistence")
    assert abs(first.z - 8.0) < 3.0
    # What is there already is not suspected again, and nothing else is.
    model = Model(predictor, fit).with_effects((effect,))
    left = locate_effects(model.predictor, model.fit)
    assert not left.detected and not left.findings


def test_shapes_do_not_depend_on_the_data(null):
    kinds = [Persistence, Tearing, TreeRings]
    one, two = (
        known_shapes(Screen(predictor, fit, seen), kinds)
        for (predictor, fit), seen in (
            (null[1:], ()),
            (
                with_change(null, Persistence({"frac": 1e-4, "tau": 2.0}), 6.0),
                ({"word": "flat_map", "x": (20, 30), "what": "column", "z": 9.0},),
            ),
        )
    )
    assert [k.effect for k in one] == [k.effect for k in two]
    assert len(one) > 60
    overlap = [float(a.weights @ b.weights) for a, b in zip(one, two, strict=True)]
    assert min(overlap) > 0.99
    assert all(abs(float(k.weights @ k.weights) - 1) < 1e-4 for k in one)


def test_effects_that_begin_at_sightings_are_charged_with_all_waves(null):
    _, predictor, fit = null
    screen = Screen(predictor, fit)
    starts = len(TreeRings.starts(predictor.layout, screen.seen))
    assert trials_of(TreeRings, screen) == LOOKED * max(starts, 1)
