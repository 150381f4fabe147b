"""Kernels of the correction with a table, against numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import correlate1d

from bfsensor._kernels import correction
from bfsensor._kernels.shifts import MODES, NEAR_MODES

pytestmark = pytest.mark.kernels

VALUES, SLOPES = np.array([0.6, -0.08, -0.02]), np.array([1.2, -0.1, 0.03])


def on_boundaries(light, right, sign):
    """Weighted sum of the pixels around lower boundaries; beyond three rows of the sides nonsense."""
    return correlate1d(light, np.concatenate([sign * right[::-1], right]), axis=0)


def test_light_on_boundaries_and_corners():
    light = np.random.default_rng(2).uniform(0, 9, (11, 13))
    on, across = np.zeros((2, 2, 11, 13))
    corners = np.zeros((11, 13))
    correction.light_on_boundaries(light, VALUES, SLOPES, on, across, corners)
    inner = np.s_[3:-3, 3:-3]
    lower, left = on_boundaries(light, VALUES, 1), on_boundaries(light.T, VALUES, 1).T
    np.testing.assert_allclose(on[1][inner], lower[inner], rtol=1e-12)
    np.testing.assert_allclose(on[0][inner], left[inner], rtol=1e-12)
    change, change_x = (
        on_boundaries(light, SLOPES, -1),
        on_boundaries(light.T, SLOPES, -1).T,
    )
    np.testing.assert_allclose(across[1][inner], change[inner], rtol=1e-11)
    np.testing.assert_allclose(across[0][inner], change_x[inner], rtol=1e-11)
    np.testing.assert_allclose(
        corners[inner], on_boundaries(left, VALUES, 1)[inner], rtol=1e-12
    )
    # At the sides two pixels.
    np.testing.assert_allclose(on[0][:, 1], light[:, :2].mean(1), rtol=1e-12)
    np.testing.assert_allclose(across[1][1], light[1] - light[0], rtol=1e-12)
    np.testing.assert_allclose(corners[1, 4], 0.5 * (on[0, 0, 4] + on[0, 1, 4]), rtol=1e-12)


def test_what_moved_is_given_back_without_loss():
    rng = np.random.default_rng(3)
    left, lower = rng.normal(size=(2, 8, 9))
    # No light crosses the borders of the image in the field.
    left[:, [2, 8]] = 0.0
    lower[[1, 7]] = 0.0
    image = rng.uniform(0, 100, (6, 6))
    out = np.zeros((6, 6))
    correction.give_back(image, left, lower, 1, 2, out)
    assert out.sum() == pytest.approx(image.sum(), rel=1e-14)
    expected = image[2, 3] + left[3, 5] - left[3, 6] + lower[3, 5] - lower[4, 5]
    assert out[2, 3] == pytest.approx(expected, rel=1e-14)
    # At the end of the fields nothing comes from beyond.
    whole = np.zeros((8, 9))
    correction.give_back(np.zeros((8, 9)), left, lower, 0, 0, whole)
    assert whole[7, 8] == pytest.approx(left[7, 8] + lower[7, 8])


def test_charges_of_a_linear_response():
    rng = np.random.default_rng(4)
    light, image = rng.uniform(0, 100, (2, 4, 5))
    out = np.zeros((MODES, 4, 5))
    empty = np.zeros((0, 0), np.float32)
    near = np.zeros((0, 0, NEAR_MODES), np.float32)
    times, weights = np.array([0.25, 0.75]), np.array([0.5, 0.5])
    correction.mean_charges(light, image, empty, near, 1.0, 1.0, times, weights, out)
    expected = 0.5 * light + 0.3125 * (image - light)
    np.testing.assert_allclose(out[0], expected, rtol=1e-12)
    assert not out[1:].any()
