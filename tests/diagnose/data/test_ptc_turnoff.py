"""Rough gains and histograms of codes with full pixels and the brighter-fatter effect."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.code_channels import CodeChannels
from bfsensor.diagnose.data.measure_channels import _rough_gains

GAIN, FULL = 2.2, 37_000.0


@pytest.mark.parametrize("full", [False, True])
def test_rough_gains_follow_a_quadratic_variance_that_collapses(full):
    """The effect lowers the variance by a fifth at the full well, where it then collapses."""
    level = np.array([900.0, 4e3, 1e4, 1.7e4, 2.6e4, 3.4e4, FULL, FULL])
    variance = level / GAIN * (1 - 0.2 * level / FULL) + 6.0
    variance[-2:] = 6.0 if full else variance[-2:]
    zero = np.zeros(len(level))
    channel = Channel(
        "flat_cov", variance, tuple(np.eye(1) for _ in level),
        {"amp": zero, "i": zero, "j": zero, "level": level}, "adu2",
    )  # fmt: skip
    gains: list[list[float]] = [[]]
    _rough_gains(channel, gains)
    assert gains[0][0] == pytest.approx(GAIN, rel=0.03)
    straight = 1 / np.polyfit(level[:5], variance[:5], 1)[0]
    assert straight > 1.1 * GAIN


@pytest.mark.parametrize(("full", "counted"), [(np.inf, True), (30_075.0, False)])
def test_flats_of_part_full_pixels_are_in_no_histogram(full, counted):
    rng = np.random.default_rng(5)
    light = 30_000 + 150 * rng.standard_normal((128, 128))
    codes = np.round(np.minimum(light, full) + 2.5 * rng.standard_normal(light.shape))
    channels = CodeChannels()
    channels.add([SimpleNamespace(image=codes)])
    assert bool(channels.channels()) == counted
    if counted:
        assert channels.notes == ()
    else:
        (note,) = channels.notes
        assert note.startswith("fit fold: ") and note.endswith(": 1 of amplifier 0")
