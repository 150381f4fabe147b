"""Recordings far from the baseline: a fit that does not converge still locates the mismatch."""

import numpy as np
import pytest

from bfsensor.diagnose.data.ptc_turnoff import below, find_turn_off
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.fit import baseline_fit as mismatch
from bfsensor.diagnose.fit.baseline_fit import UNSETTLED
from tests.virtual import (
    SMALL,
    make_effect,
    measure_virtual,
    virtual_baseline,
)

FULL = 5e4


@pytest.fixture(scope="module")
def saturated():
    effect = make_effect("saturation", {"full_well": FULL}, "")
    return measure_virtual(seed=5177, size=SMALL, effects=[effect])


@pytest.mark.slow
def test_flats_beyond_the_full_well_are_saturated(saturated):
    """Faint flats constrain the baseline; saturated ones then constrain the full well alone."""
    found = diagnose_measured(saturated, virtual_baseline())
    assert any("the variance of flats collapses" in n for n in found.notes)
    assert found.mismatch.detected and found.mismatch.findings[0].word.startswith("flat_")
    (one,) = found.attribution.found
    assert one.effect.word == "saturation"
    assert one.effect["full_well"] == pytest.approx(FULL, abs=4 * one.errors["full_well"])
    assert one.errors["full_well"] < 0.02 * FULL
    # Spots at 950 nm are left out: only a saturated one is fitted, so their width is hardly known.
    for word in ("flat_cov", "flat_mean"):
        before, after, values = found.attribution.heldout[word]
        assert before > 1e3 * values and after < 1.3 * values
        assert word not in found.attribution.fails_in


def test_turn_off_is_where_pixels_are_full(saturated):
    off = find_turn_off(saturated.channels)
    assert off.electrons == pytest.approx(FULL, rel=0.1)
    faint = below(saturated.channels, off)
    for old, new in zip(saturated.channels, faint, strict=True):
        if old.word == "flat_cov":
            assert 0 < len(new) < len(old)
            assert new.axes["level"].max() < min(off.levels.values())
    assert find_turn_off(faint) is None


def test_a_baseline_that_does_not_converge_is_reported(saturated, monkeypatch):
    monkeypatch.setattr(mismatch, "find_turn_off", lambda channels: None)
    found = diagnose_measured(saturated, virtual_baseline(), explain=False)
    assert (UNSETTLED in found.notes) == (not found.fit.converged)
    assert found.mismatch.detected
    assert any(f.word.startswith("flat_") for f in found.mismatch.findings)
    assert np.isfinite(found.fit.values).all() and np.isfinite(found.fit.residuals).all()
