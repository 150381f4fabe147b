"""Crosstalk from spots: found where it is, and not where spots lie across amplifiers' border."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from bfsensor.diagnose.data.code_channels import CrosstalkChannels

NOISE, PITCH, SIZE = 4.0, 30, 240


def spots_over_a_border(crosstalk: float) -> CrosstalkChannels:
    """Two amplifiers that read away from one another, a column of spots on their border."""
    out = CrosstalkChannels()
    for seed in range(8641, 8645):
        rng = np.random.default_rng(seed)
        edge = np.arange(2 * SIZE + 1) - 0.5

        def along(places: np.ndarray, stop: int, edge=edge, rng=rng) -> np.ndarray:
            places = places + rng.uniform(-0.4, 0.4, len(places))
            return np.diff(ndtr((edge[: stop + 1] - places[:, None]) / 1.1), axis=1).sum(0)

        # From the border, the amplifiers' own columns are 17 + 30 n and 30 n pixels away.
        x = np.r_[12.4:SIZE - 20:PITCH, SIZE - 0.1, SIZE + 29.5:2 * SIZE:PITCH]  # fmt: skip
        image = 6e5 * np.outer(
            along(np.arange(15.0, SIZE, PITCH), SIZE), along(x, 2 * SIZE)
        )
        left, right = image[:, :SIZE][:, ::-1], image[:, SIZE:]
        frames = [left + crosstalk * right, right + crosstalk * left]
        out.add([f + NOISE * rng.standard_normal(f.shape) for f in frames], [NOISE, NOISE])
    return out


def test_spots_on_the_border_are_no_crosstalk() -> None:
    (channel,) = spots_over_a_border(0.0).channels()
    assert np.all(np.abs(channel.values) < 4 * channel.errors)


def test_crosstalk_is_found() -> None:
    (channel,) = spots_over_a_border(1e-4).channels()
    assert np.all(np.abs(channel.values - 1e-4) < 4 * channel.errors)
    assert np.all(channel.values > 6 * channel.errors)


def spots_beside_spots(crosstalk: float, apart: int) -> CrosstalkChannels:
    """Spots of one amplifier are some pixels from those of the other, but for a first column.

    Across the nearest spot of the other amplifier, the first column's spots lie at that distance
    from its next ones.
    """
    out = CrosstalkChannels()
    edge = np.arange(SIZE + 1) - 0.5
    rows, own = np.arange(15.0, SIZE - 8, PITCH), np.arange(15.0, SIZE - 16, PITCH)

    def light(places: np.ndarray) -> np.ndarray:
        return np.diff(ndtr((edge - places[:, None]) / 1.1), axis=1).sum(0)

    for seed in range(8651, 8655):
        rng = np.random.default_rng(seed)
        left = 6e5 * np.outer(light(rows), light(own + rng.uniform(-0.4, 0.4)))
        right = 6e5 * np.outer(light(rows), light(own[1:] + apart + rng.uniform(-0.4, 0.4)))
        frames = [left + crosstalk * right, right + crosstalk * left]
        out.add([f + NOISE * rng.standard_normal(f.shape) for f in frames], [NOISE, NOISE])
    return out


@pytest.mark.parametrize("crosstalk", [0.0, 1e-3])
@pytest.mark.parametrize("apart", [5, 9])
def test_other_spots_of_the_amplifier_are_no_crosstalk(crosstalk, apart) -> None:
    (channel,) = spots_beside_spots(crosstalk, apart).channels()
    assert np.all(np.abs(channel.values - crosstalk) < 4 * channel.errors)
    if apart > 7 and crosstalk:
        assert np.all(channel.values > 6 * channel.errors)


@pytest.mark.parametrize("width", [1.1, 1.9])
def test_the_far_side_of_a_wide_spot_is_no_crosstalk(width) -> None:
    """Spots of 1.9 pixel, 7.6 pixels from the other amplifier's: their halos differ by its 1e-3."""
    out = CrosstalkChannels()
    edge = np.arange(SIZE + 1) - 0.5
    places = np.arange(15.3, SIZE - 12, PITCH)

    def light(places: np.ndarray) -> np.ndarray:
        return np.diff(ndtr((edge - places[:, None]) / width), axis=1).sum(0)

    for seed in range(8661, 8669):
        rng = np.random.default_rng(seed)
        left, right = (
            6e5 * np.outer(light(places), light(p)) for p in (places, places + 7.6)
        )
        out.add(
            [f + NOISE * rng.standard_normal(f.shape) for f in (left, right)],
            [NOISE, NOISE],
        )
    for channel in out.channels():
        assert np.all(np.abs(channel.values) < 4 * channel.errors)
    assert bool(out.channels()) == (width < 1.5)


@pytest.mark.parametrize("biases", [0, 4])
def test_noise_of_the_mean_bias_counts_once_for_all_exposures(biases: int) -> None:
    """It is the same in all exposures, whose spots are in the same places."""
    edge = np.arange(SIZE + 1) - 0.5
    pulls = []
    for seed in range(24):
        rng = np.random.default_rng(8681 + seed)
        out = CrosstalkChannels(biases=biases)
        shared = NOISE / 2 * rng.standard_normal((2, SIZE, SIZE))

        def light(start: float, rng=rng) -> np.ndarray:
            places = np.arange(start, SIZE - 8, PITCH)
            places += rng.uniform(-0.4, 0.4, len(places))
            return np.diff(ndtr((edge - places[:, None]) / 1.1), axis=1).sum(0)

        frames = [6e4 * np.outer(light(15.0), light(x)) for x in (12.0, 22.0)]
        for _ in range(12):
            images = [
                f + s + NOISE * rng.standard_normal(f.shape)
                for f, s in zip(frames, shared, strict=True)
            ]
            out.add(images, [NOISE, NOISE])
        (channel,) = out.channels()
        pulls += (channel.values / channel.errors).tolist()
    # With 12 exposures and 4 biases the mean bias has three quarters of the variance: without its
    # error pulls scatter by 2.  The scatter of 48 pulls is known to 10 %.
    assert (np.std(pulls) < 1.3) == bool(biases)
    assert np.std(pulls) > 0.75
