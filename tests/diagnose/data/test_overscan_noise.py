"""Errors of overscan profiles, and counts of pixels in the tails of the noise, with long pulses."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.dark_channels import count_tails
from bfsensor.diagnose.data.flat_channels import FlatChannels
from bfsensor.diagnose.kinds.flat_mean import FlatMeans

ROWS, COLUMNS, SERIAL, PARALLEL = 64, 128, 24, 16


def noisy(rng: np.random.Generator, shape: tuple[int, int], length: int) -> np.ndarray:
    """White noise of 5, and pulses of 15 that are some pixels long, along rows [ADU]."""
    out = 5.0 * rng.standard_normal(shape)
    if length:
        for row in out:
            for start in rng.integers(0, shape[1], rng.poisson(0.04 * shape[1] / length)):
                row[start : start + length] += 15.0
    return out.astype(np.float32)


def frame_of(rng: np.random.Generator, level: float, length: int) -> SimpleNamespace:
    image = rng.poisson(level, (ROWS, COLUMNS)) + noisy(rng, (ROWS, COLUMNS), length)
    return SimpleNamespace(
        name="amp", image=image.astype(np.float32), mask=np.zeros((ROWS, COLUMNS), bool),
        serial_overscan=noisy(rng, (ROWS, SERIAL), length), prescan=np.zeros((ROWS, 0)),
        parallel_overscan=noisy(rng, (PARALLEL, COLUMNS), length),
    )  # fmt: skip


def shots_of(number: int) -> list[SimpleNamespace]:
    """Headers of a pair of flats, of another level for each number."""
    return [
        SimpleNamespace(
            number=2 * number + k, exposure_time=1.0 + number, lamp=1.0, wavelength=None,
            back_bias=None, temperature=None, mjd=None, kind="flat",
        )
        for k in (0, 1)
    ]  # fmt: skip


@pytest.mark.parametrize("length", [0, 6])
def test_profiles_scatter_as_their_errors_say(length: int) -> None:
    """A row's mean has the noise of fewer pixels where pulses are several pixels long."""
    rng = np.random.default_rng(8650 + length)
    pulses = np.array([1.0, 1.0, 0.5]) if length else None
    flats = FlatChannels({}, {"amp": 5.0}, lamp_error=1e-3, pulses=pulses)
    for number in range(24):
        shots = shots_of(number)
        pair = [(s, [frame_of(rng, 1000.0, length)]) for s in shots]
        flats.add_pair(*pair, fold="fit")
    (channel,) = (c for c in flats.channels() if c.word == "parallel_overscan")
    square = float(np.square(channel.whiten(channel.values)).sum())
    # 192 values; without the pulses' length the second would be 1.9 times as large.
    assert abs(square / len(channel) - 1) < 4 * np.sqrt(2 / len(channel))


def test_tails_of_biases_and_of_darks_are_counted_alike() -> None:
    """Long bright pulses are tracks in a dark: without the same in biases darks would have too few."""
    rng = np.random.default_rng(8656)
    biases = [frame_of(rng, 0.0, 0) for _ in range(20)]
    for frame in biases:
        for _ in range(6):
            y, x = rng.integers(0, ROWS), rng.integers(0, COLUMNS - 5)
            frame.image[y, x : x + 5] += 60.0
    mean = {"amp": np.mean([f.image for f in biases], axis=0)}
    tails = [count_tails([f], mean, {"amp": 5.0}, len(biases)) for f in biases]
    assert np.mean(tails) < 6.0


def test_means_of_flats_without_overscan_have_a_zero_of_their_own() -> None:
    """The bias level of flats is another than that of biases; darks show by how much it drifts."""
    flats = FlatChannels({}, {"amp": 5.0}, lamp_error=1e-3)
    flats.zero_drift = np.array([[9.0]])
    rng = np.random.default_rng(8657)
    for number in range(8):
        shots = shots_of(number)
        frames = [frame_of(rng, 1000.0 * (1 + number), 0) for _ in shots]
        for frame in frames:
            frame.serial_overscan = frame.parallel_overscan = np.zeros(
                (ROWS, 0), np.float32
            )
        flats.add_pair(*((s, [f]) for s, f in zip(shots, frames, strict=True)), fold="fit")
    (channel,) = (c for c in flats.channels() if c.word == "flat_mean")
    assert (channel.errors >= 3.0).all()
    columns = FlatMeans().columns(channel, {}, SimpleNamespace(channels=(channel,)))
    assert (columns["zero 0"] == 1.0).all()
    # Light is known to 1e-3 and the mean of a flat of 1000 ADU to 0.4 ADU.
    assert channel.errors.min() < 3.3
    flats.zero_drift = None
    (channel,) = (c for c in flats.channels() if c.word == "flat_mean")
    assert channel.errors.min() > 5.0
    assert "zero 0" not in FlatMeans().columns(
        channel, {}, SimpleNamespace(channels=(channel,))
    )


def test_flats_with_an_overscan_know_their_zero_whatever_darks_lack() -> None:
    flats = FlatChannels({}, {"amp": 5.0}, lamp_error=1e-3)
    flats.zero_drift = np.array([[9.0]])
    rng = np.random.default_rng(8658)
    flats.add_pair(*((s, [frame_of(rng, 1000.0, 0)]) for s in shots_of(0)), fold="fit")
    (channel,) = (c for c in flats.channels() if c.word == "flat_mean")
    assert channel.errors.max() < 2.0
    assert "zero 0" not in FlatMeans().columns(
        channel, {}, SimpleNamespace(channels=(channel,))
    )
