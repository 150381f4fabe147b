"""Full wells just above the brightest flat, which is full in some of its pixels only."""

from bfsensor.diagnose.detect.candidate_screen import Screen
from bfsensor.effects.saturation import DrainedSaturation, Saturation
from tests.virtual import SMALL, fit_virtual, make_effect


def test_a_start_is_near_a_full_well_that_only_the_brightest_flats_reach():
    """Their variance falls by a part, and 1 % away from the full well a start changes nothing."""
    effect = make_effect("saturation", {"full_well": 1.21e5}, "")
    _, predictor, fit = fit_virtual(seed=5177, size=SMALL, effects=[effect])
    screen = Screen(predictor, fit)
    for kind in (Saturation, DrainedSaturation):
        # The excess of chi-square is 220; of the starts in even steps none gains any.
        assert screen.tried(kind)[0][0] > 50
