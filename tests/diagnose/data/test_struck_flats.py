"""Particles in dim flats: their pixels have no part in maps, those of the sensor stay."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.diagnose.data.flat_channels import leave_out_struck


def pair_of_flats() -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """Two flats of 4400 e- with a response of 1 % that both share."""
    rng = np.random.default_rng(8671)
    response = 4400 * (1 + 0.01 * rng.standard_normal((256, 128)))
    first, second = (rng.poisson(response * part).astype(float) for part in (1.0, 1.003))
    return first, second, rng


def test_a_track_along_a_column_leaves_its_mean() -> None:
    """60 pixels of 900 e- in a column of 256 would shift its mean by 5 % of the light."""
    first, second, rng = pair_of_flats()
    struck = second.copy()
    struck[140:200, 54] += 900.0 * rng.exponential(1.0, 60).clip(0.8, 3.0)
    clean = np.nanmean(second[:, 54] / second.mean())
    leave_out_struck(first, struck)
    assert np.isfinite(first).all()
    assert np.isnan(struck[140:200, 54]).all()
    assert np.isnan(struck).sum() < 400
    found = np.nanmean(struck[:, 54] / np.nanmean(struck))
    assert abs(found - clean) < 4 * 0.015 / np.sqrt(196)


def test_noise_and_what_both_flats_have_stay() -> None:
    first, second, _ = pair_of_flats()
    for flat in (first, second):
        flat[:, 70] *= 0.7
        flat[20, 20] += 5e4
    leave_out_struck(first, second)
    assert np.isfinite(first).all() and np.isfinite(second).all()


def test_a_tear_in_one_flat_stays() -> None:
    """A boundary that is displaced by 0.15 pixel gives one column what the next one lacks."""
    first, second, _ = pair_of_flats()
    second[:, 54] *= 1.15
    second[:, 55] *= 0.85
    leave_out_struck(first, second)
    assert np.isfinite(first).mean() > 0.999 and np.isfinite(second).mean() > 0.999
    assert np.nanmean(second[:, 54] / first[:, 54]) == pytest.approx(
        1.15 * 1.003, rel=0.005
    )
