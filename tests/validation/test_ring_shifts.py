"""Rings of displaced charge, and of a varying sensitivity, are told apart by the transfer to shifts."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from validation.real.ring_shifts import BANDS, measure


def rings(seed, moved=True, offset=0.0):
    """Flats [percent] and shifts [pixel / 100] of random rings, with noise of the shifts."""
    rng = np.random.default_rng(seed)
    d = gaussian_filter1d(rng.standard_normal(2380 + 200), 4.0) * 2.0
    # A sensitivity moves spots of 1.5 pixels towards where it grows.
    g = -np.gradient(d)
    if not moved:
        d = 1.5**2 * np.gradient(g)
    at = np.arange(2380) + 100.0
    noise = 0.05 * d.std() * rng.standard_normal(len(at))
    return np.interp(at - offset, np.arange(len(g)), g), d[100:-100] + noise


@pytest.mark.parametrize("offset", [0.0, 4.5])
def test_displaced_charge_has_ratio_one_a_quarter_of_a_period_ahead(offset):
    found = measure(*rings(7, offset=offset))[0]
    n = len(BANDS)
    assert found[:n] == pytest.approx(np.ones(n), abs=0.03)
    assert found[n : 2 * n] == pytest.approx(np.full(n, 90.0), abs=3.0)
    assert found[2 * n : 3 * n].min() > 0.9
    assert found[-2:] == pytest.approx([-1.0, offset], abs=0.1)


def test_a_sensitivity_follows_the_wave_number_itself():
    assert measure(*rings(7, moved=False))[0][-2] == pytest.approx(1.0, abs=0.1)


def test_errors_are_those_of_repetition():
    """Jackknife errors of the ratio are as large as the scatter over draws with strong noise."""
    draws, spread = [], []
    for seed in range(48):
        g, d = rings(seed)
        d = d + 0.4 * d.std() * np.random.default_rng(seed + 100).standard_normal(len(d))
        found, error = measure(g, d)
        draws.append(found[:3])
        spread.append(error[:3])
    assert np.mean(spread, axis=0) == pytest.approx(np.std(draws, axis=0), rel=0.4)
