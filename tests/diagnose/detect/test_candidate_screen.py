"""Amplitudes of candidates at their starting points."""

import numpy as np
import pytest

from bfsensor.diagnose.detect.candidate_screen import _best_factor
from bfsensor.effects.effect import Parameter
from bfsensor.effects.persistence import TwoTimesPersistence


@pytest.mark.parametrize("bend", [0.0, 1e-30, 1e-18, 1e-4, 0.5])
@pytest.mark.parametrize("amplitude", [-0.04, 0.05, 3.0])
def test_amplitude_of_a_template_that_is_straight_but_for_rounding(bend, amplitude):
    rng = np.random.default_rng(3)
    one = 400 * rng.standard_normal(300) / np.sqrt(300)
    two = bend * rng.standard_normal(300)
    left = amplitude * one + amplitude**2 * two
    found = _best_factor((one, two), left, signed=True)
    assert found == pytest.approx(amplitude, rel=1e-6)
    if bend < 0.1:
        only = _best_factor((one, two), left, signed=False)
        assert only == pytest.approx(max(amplitude, 0.0), rel=1e-6)


def test_no_fit_goes_beyond_what_physics_allows():
    slow = next(p for p in TwoTimesPersistence.parameters if p.name == "slow")
    assert slow.widest == (0.0, 1.0)
    assert slow._replace(ends=(-np.inf, np.inf)).widest == pytest.approx((-0.46, 1.46))
    assert Parameter("reach", "e-", 0.0, 10.0, law="flat", ends=(0.0, np.inf)).widest == (
        0.0,
        15.0,
    )
