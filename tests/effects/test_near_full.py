"""Flats within a few widths of the full well: closed forms without steps, and what they leave open."""

import numpy as np
import pytest

from bfsensor.effects.saturation import FAR, LAGS, UNEVEN, UNSURE, Saturation

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
    assert effect.modes("spot", axes(light), None) is None


def test_neutral_leaves_nothing_open():
    assert Saturation({"full_well": 2e5}).modes("flat_mean", axes(FULL), None) is None
