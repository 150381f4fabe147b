"""Rough fringes: their power by frequency is that of a sine of a random, strongly wrapped phase."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from bfsensor.effects import RoughFringes
from bfsensor.effects.effect import Layout, Shot

LAYOUT = Layout((256, 256), ())
RED, BLUE = (Shot("flat", 1, 5.0, wavelength=w, level=3e4) for w in (950.0, 620.0))


def rings(image: np.ndarray) -> np.ndarray:
    """Mean power of a mode in rings of 1/64 cycle per pixel, but for those along an axis."""
    power = np.abs(np.fft.fft2(image - image.mean())[1:, 1:]) ** 2 / image.size
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(256)[1:], np.fft.fftfreq(256)[1:]))
    bins = (k * 64).astype(int)
    return np.bincount(bins.ravel(), power.ravel())[:24] / np.bincount(bins.ravel())[:24]


def test_power_is_that_of_a_wrapped_random_phase() -> None:
    """Woodward: the power of a wave of wide phase modulation has the shape of its gradients'."""
    rng = np.random.default_rng(8681)
    found = []
    for _ in range(8):
        phase = gaussian_filter(rng.standard_normal((256, 256)), 12.0, mode="wrap")
        # The slope of the phase is 2 pi / 9 pixels per axis, its size some 8 turns.
        slope = np.diff(phase, axis=1).std()
        phase *= 2 * np.pi / 9.0 / np.sqrt(2) / slope
        found.append(rings(1e-3 * np.sqrt(2) * np.cos(phase)))
    wanted = np.mean(found, 0)
    made = rings(RoughFringes({"amp": 1e-3, "period": 9.0}).light_map(RED, LAYOUT))
    clear = slice(5, 14)
    # A ring of 300 modes or more scatters by 6 %, the mean of 8 by 2 %: 4 standard deviations.
    assert made[clear] == pytest.approx(wanted[clear], rel=0.25)
    assert made[:3].max() < 1e-12 * made[5]


def test_strength_is_the_rms_and_blue_light_has_none() -> None:
    effect = RoughFringes({"amp": 2e-3, "period": 4.0})
    assert effect.light_map(RED, LAYOUT).std() == pytest.approx(2e-3, rel=0.1)
    assert effect.light_map(BLUE, LAYOUT) is None
    assert RoughFringes({"amp": 0.0, "period": 4.0}).light_map(RED, LAYOUT) is None
