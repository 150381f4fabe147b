"""Codes of flats near the full well are not counted: what piles up is no converter's doing."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.code_channels import CodeChannels

WIDTH = 130.0


def counted(codes):
    channels = CodeChannels()
    channels.add([SimpleNamespace(image=np.asarray(codes, float))])
    return bool(channels.channels())


def flat(seed=8807, shape=(256, 128)):
    return np.rint(np.random.default_rng(seed).normal(43_000.0, WIDTH, shape))


@pytest.mark.parametrize("away", [0.0, 1.0, 2.4])
def test_a_flat_whose_bright_pixels_are_full_is_left_out(away):
    """At 2.4 widths 0.8 % of the pixels are: too few for a pile that stands out by itself."""
    read = np.rint(np.random.default_rng(8808).normal(0.0, 3.0, (256, 128)))
    assert not counted(np.minimum(flat(), 43_000 + np.rint(away * WIDTH)) + read)


def test_flats_below_the_full_well_are_counted():
    assert counted(flat())
    # Beyond 3.5 widths eight pixels are full, too few to matter.
    assert counted(np.minimum(flat(), 43_000 + np.rint(3.5 * WIDTH)))


def test_dark_corners_leave_a_flat_in():
    """Light that falls by 3 % towards a corner makes a long lower tail, and none of full pixels."""
    y, x = np.indices((256, 256)) / 256
    dim = np.rint(-43_000 * 0.03 * np.maximum(x**2 + y**2 - 0.6, 0.0) ** 2)
    even = flat(shape=(256, 256))
    assert counted(even + dim)
    # Where pixels of the bright half are full, the flat is left out.
    assert not counted(np.minimum(even + dim, 43_000 + np.rint(2.2 * WIDTH)))


def test_struck_and_dim_pixels_leave_a_flat_in():
    """Particles brighten some, dust dims some: one tail is longer, the other is there."""
    rng = np.random.default_rng(8809)
    for sign in (1, -1):
        codes = flat()
        struck = rng.random(codes.shape) < 2e-3
        codes[struck] += np.rint(sign * rng.exponential(3 * WIDTH, int(struck.sum())))
        assert counted(codes)


def test_codes_below_multiples_are_counted_for_each_bit():
    """A bit of high weight is seen at its own multiples, which are few among those of lower bits."""
    channels, rng = CodeChannels(), np.random.default_rng(8)
    for _ in range(4):
        codes = np.floor(16384 + 130 * rng.standard_normal((200, 200)))
        codes -= 2.0 * (codes % 16384 >= 8192)
        channels.add([SimpleNamespace(image=codes.astype(np.float32), repaired=None)])
    axes = channels.channels()[0].axes
    values = channels.channels()[0].values
    missing = (axes["code"] < 0) & (axes["bit"] == 14)
    assert missing.sum() == 2 and (values[missing] < -0.95).all()
    assert set(axes["bit"][axes["code"] < 0]) <= set(range(6, 16))
