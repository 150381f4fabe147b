"""Flats within a few widths of the full well: closed forms without steps, and what they leave open."""

import numpy as np
import pytest

from bfsensor.diagnose.model.spot_predictions import spill
from bfsensor.effects.saturation import (
    BRIGHTEST,
    FAR,
    LAGS,
    SKEWED,
    UNEVEN,
    UNSURE,
    DrainedSaturation,
    Saturation,
)

FULL = 9.7e4
WIDTH = np.sqrt(FULL)


def axes(light, **more):
    light = np.atleast_1d(np.asarray(light, float))
    return {"level": light, "light": light, **more}


def test_means_have_no_steps_where_the_unevenness_passes_a_tenth():
    """Rounded unevenness made steps of 0.8 e- where means are known to 2."""
    light = np.linspace(0.955 / UNEVEN, 0.945 / UNEVEN, 41) ** 2
    wells = light + 0.5 * np.sqrt(light)
    lost = np.array([
        float(Saturation({"full_well": w}).flat_mean(axes(n), None)[0])
        for n, w in zip(light, wells, strict=True)
    ])  # fmt: skip
    steps = np.diff(lost)
    assert np.ptp(lost) > 0.05
    assert np.abs(steps).max() < 3 * np.abs(np.median(steps))


def test_flats_of_full_pixels_are_not_compared():
    """Where all pixels are full, spilled charge may stay, leave or move on."""
    light = FULL + 2 * FAR * WIDTH
    effect = Saturation({"full_well": FULL})
    mean = effect.modes("flat_mean", axes(light), None)
    assert mean[0, 0] == pytest.approx(light - FULL)
    lags = np.arange(LAGS + 2)
    for i in (0, 1):
        both = axes(np.full(len(lags), light), i=np.full(len(lags), i), j=lags)
        modes = effect.modes("flat_cov", both, None)
        np.testing.assert_allclose(modes, np.eye(len(lags)) * light / 12**0.5)
    assert not effect.covariances(np.ones((1, 8, 8)), axes(light), None).any()


@pytest.mark.parametrize(("away", "open_"), [(1.0, True), (-1.0, True), (3 * FAR, False)])
def test_only_flats_near_the_full_well_are_left_open(away, open_):
    effect = Saturation({"full_well": FULL})
    light = FULL - away * WIDTH
    mean = effect.modes("flat_mean", axes(light), None)
    assert mean.shape == (1, 1 if open_ else 0)
    lost = effect.flat_mean(axes(light), None)[0] - min(FULL - light, 0.0)
    if open_:
        assert abs(mean[0, 0]) == pytest.approx(UNSURE * abs(lost), rel=1e-6)
    lags = np.arange(LAGS + 2)
    both = axes(np.full(len(lags), light), i=np.zeros(len(lags), int), j=lags)
    modes = effect.modes("flat_cov", both, None)
    assert modes.shape == (len(lags), LAGS + 1 if open_ else 0)
    # Each lag on its own; none beyond those that spilling is followed to.
    # Interpolation between levels leaves rounding errors.
    known = np.count_nonzero(np.abs(modes) > 1e-6 * light, axis=1)
    assert known[-1] == 0 and (known <= 1).all()
    # Where all pixels are full no variance is left to be unsure of.
    assert (known[: LAGS + 1] > 0).all() == (away > 0 and open_)
    aside = axes(light, i=np.array([1]), j=np.array([0]))
    assert effect.modes("flat_cov", aside, None).shape == (1, 0)
    assert effect.modes("serial_overscan", axes(light), None) is None


def test_skewness_of_spots_whose_brightest_pixels_are_full_is_left_open():
    """It jumps where the next pixel fills; fainter spots and widths are predicted."""
    effect = Saturation({"full_well": FULL})
    bright, faint = 1.1 * FULL / BRIGHTEST, 0.9 * FULL / BRIGHTEST
    spots = {
        "what": np.array(["sigma_x", "skew_x", "skew_y", "skew_x"]),
        "flux": np.array([bright, bright, bright, faint]),
    }
    modes = effect.modes("spot", spots, None)
    np.testing.assert_array_equal(modes, SKEWED * np.eye(4)[:, 1:3])


def test_neutral_leaves_nothing_open():
    assert Saturation({"full_well": 2e5}).modes("flat_mean", axes(FULL), None) is None


@pytest.mark.parametrize("away", [-1.5, 0.0, 1.5])
@pytest.mark.parametrize("drain", [0.0, 0.5, 1.0])
def test_charge_that_is_drained_in_part(drain, away):
    """Flats near the full well, pixel by pixel: what spills loses a part at each step."""
    effect = DrainedSaturation({"full_well": FULL, "drain": drain})
    light = FULL - away * WIDTH
    rng = np.random.default_rng(11)
    uneven = UNEVEN * light * rng.standard_normal((400, 200))
    pair = []
    for _ in range(2):
        charge = light + uneven + np.sqrt(light) * rng.standard_normal((400, 200))
        for _ in range(200):
            over = np.maximum(charge - FULL, 0.0)
            charge -= over
            charge[1:] += 0.5 * (1 - drain) * over[:-1]
            charge[:-1] += 0.5 * (1 - drain) * over[1:]
        pair.append(np.minimum(charge, FULL))
    seen = np.mean(pair) - light
    said = effect.flat_mean(axes(light), None)[0]
    c = np.zeros((1, 16, 16))
    c[0, 0, 0] = light
    left = effect.covariances(c, axes(light), None)[0, :2, 0]
    difference = np.subtract(*pair) / 2**0.5
    var, near = difference.var(), np.mean(difference[1:] * difference[:-1])
    # Between both ends of the drain the prediction is a straight line, an estimate.
    few = 0.02 if drain in (0.0, 1.0) else 0.1
    assert said == pytest.approx(seen, abs=(0.02 + few) * WIDTH)
    np.testing.assert_allclose(left, [var, near], atol=(0.01 + few) * light)
    if drain == 1.0 and away > 0:
        assert var < 0.9 * light and abs(near) < 0.01 * light


def test_spots_lose_what_is_drained():
    charge = np.zeros((1, 9, 3))
    charge[0, 4, 1] = 3.0
    np.testing.assert_allclose(spill(charge, 1.0, drain=1.0).sum(), 1.0)
    np.testing.assert_allclose(spill(charge, 1.0).sum(), 3.0)
    half = spill(charge, 1.0, drain=0.5)
    assert half[0, 3:6, 1].tolist() == [0.5, 1.0, 0.5]
    assert DrainedSaturation({"full_well": 1e5, "drain": 0.3}).law().drain == 0.3
    assert DrainedSaturation({"full_well": 2e5, "drain": 0.3}).law().drain == 0.0
