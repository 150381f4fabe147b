"""What a camera's a_ij allow: errors of the growth of stars."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from bfsensor.errors import MeasurementError
from bfsensor.fit.camera_areas import CameraAreas
from bfsensor.fit.camera_fit import fit_camera
from bfsensor.fit.correction_error import correction_error, star_growth
from bfsensor.sensor.table_correction import correct_table
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes
from bfsensor.table.build_image_charge import build_image_charge_table

TRUE = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0)
A = area_changes(TRUE, depth=100.0, reach=4)[4:, 4:]


def fitted(noise, model_error=0.0, a=A):
    areas = CameraAreas(a, np.full(A.shape, noise), np.isfinite(a), "simulated")
    return fit_camera(areas, base=TRUE, model_error=model_error)


@pytest.mark.slow
def test_errors_are_the_scatter_of_repeated_calibrations():
    noise = 2e-9
    rng = np.random.default_rng(97)
    stated = correction_error(fitted(noise))
    growths = [
        correction_error(fitted(noise, a=A + noise * rng.normal(size=A.shape))).growth
        for _ in range(12)
    ]
    true = star_growth(TRUE, depth=100.0, sigma=1.5)
    scatter = np.std(growths, axis=0, ddof=1) / true
    # Twelve give the scatter to 21 %; priors make the stated errors larger, not smaller.
    assert np.all(scatter < 1.6 * np.array(stated.error))
    assert np.all(scatter > 0.3 * np.array(stated.error))
    assert np.all(np.abs(np.mean(growths, axis=0) / true - 1) < 3 * np.array(stated.error))


def test_more_flats_take_the_noise_away():
    one, four = (correction_error(fitted(n)) for n in (2e-9, 1e-9))
    assert 1.5 < one.error[1] / four.error[1] < 2.2
    assert one.noise[1] == pytest.approx(one.error[1], rel=0.1)
    # Four times as many pairs, and a few more for what priors hold.
    assert 3.5 < one.pairs < 12
    own = correction_error(fitted(1e-11, model_error=0.05))
    assert own.pairs == np.inf and own.noise[0] < 0.1 * own.error[0]


def test_the_growth_is_what_the_table_of_the_model_takes_off():
    """Of a star that is nearly empty the correction is linear."""
    table = build_image_charge_table(TRUE)
    at = np.arange(-15, 16)
    line = np.exp(-0.5 * (at / 1.5) ** 2)
    star = 500.0 * np.outer(line, line)
    corrected = correct_table(star, table, temperature=173.0, surroundings=0.0)
    growth = star_growth(TRUE, depth=100.0, sigma=1.5)
    for n, axis in enumerate((0, 1)):
        moment = [a.sum(axis) @ at**2 / a.sum() for a in (star, corrected)]
        # Edges take light on a boundary for the mean of two pixels, which moves 5 % too much.
        assert 0.93 < (moment[0] / moment[1] - 1) * 100 / growth[n] < 0.97


def test_an_offset_is_in_no_star():
    areas = CameraAreas(A + 1e-9, np.full(A.shape, 1e-9), np.isfinite(A), "simulated")
    with_offset = correction_error(fit_camera(areas, base=TRUE, offset=True, model_error=0))
    plain = correction_error(fitted(1e-9))
    assert with_offset.growth[0] == pytest.approx(plain.growth[0], rel=0.05)
    assert with_offset.error[0] > plain.error[0]


def test_strength_and_field_are_one():
    found = dataclasses.replace(TRUE, drift_field=TRUE.drift_at(np.array([50.0]))[0] / 1.3)
    plain = dataclasses.replace(TRUE, drift_field=TRUE.drift_at(np.array([50.0]))[0])
    np.testing.assert_allclose(
        star_growth(found, depth=100.0, sigma=1.0),
        star_growth(plain, depth=100.0, sigma=1.0, strength=1.3), rtol=1e-6,
    )  # fmt: skip


def test_wide_and_narrow_stars_are_refused():
    with pytest.raises(MeasurementError, match=r"sigma = 0.1 must be from 0.5 to 5 pixels"):
        correction_error(fitted(1e-9), sigma=0.1)
