"""Nuisances of a bench are told from effects: fixed bias structure, pulses of the noise, drift."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
from scipy.signal import lfilter

from bfsensor.diagnose.data.bench_nuisances import bench_nuisances
from bfsensor.diagnose.data.bias_channels import SCATTERED, STANDS_OUT, BiasChannels
from bfsensor.diagnose.data.flat_defects import bad_columns, low_pixels
from bfsensor.diagnose.data.measure_channels import measure_channels
from bfsensor.diagnose.diagnosis import diagnose_measured
from tests.virtual import SMALL, Effect, Range, VirtualSource, virtual_baseline

ROWS, COLUMNS, OVERSCAN = 128, 96, 24


@dataclass
class Info:
    number: int
    kind: str = "bias"
    exposure_time: float = 0.0
    wavelength: float | None = None
    back_bias: float | None = None
    temperature: float | None = None
    lamp: float | None = None
    mjd: float | None = None
    pair: int | None = None


@dataclass
class Bias:
    """A bias frame with the image and overscan of ``pixels``."""

    pixels: np.ndarray
    name: str = "one"
    flip_x: bool = False
    flip_y: bool = False
    origin: tuple[int, int] = (0, 0)
    prescan: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    parallel_overscan: np.ndarray = field(
        default_factory=lambda: np.zeros((0, 0), np.float32)
    )

    @property
    def image(self):
        return self.pixels[:, :COLUMNS]

    @property
    def serial_overscan(self):
        return self.pixels[:, COLUMNS:]

    @property
    def mask(self):
        return np.zeros((ROWS, COLUMNS), bool)


def biases(make, count=12, amplifiers=1):
    """Channels of biases whose frames ``make(frame, amplifier)`` gives."""
    out = BiasChannels()
    frames = [
        [Bias(make(n, a).astype(np.float32), f"amp {a}") for a in range(amplifiers)]
        for n in range(count)
    ]
    for n, own in enumerate(frames):
        out.add(Info(n), own)
    mean = {f.name: out.mean(f.name)[:, :COLUMNS] for f in frames[0]}
    for own in frames:
        out.add_third(own, mean)
    return out


def telegraph(rng, size, part, length):
    """A signal that is 1 for ``length`` pixels on average, in a part of the time, and else 0."""
    on, off = (
        rng.geometric(1 / length, size),
        rng.geometric(part / length / (1 - part), size),
    )
    both = np.column_stack([off, on]).ravel()
    return np.repeat(np.arange(len(both)) % 2, both)[:size].astype(float)


SIZE = ROWS * (COLUMNS + OVERSCAN)


def test_pulses_are_found_with_their_length():
    """Their third cumulants scatter most at lags where they are largest, which must not count less."""
    ratios = []
    for seed in range(3):
        rng = np.random.default_rng(seed)

        def make(frame, amp, rng=rng):
            noise = 3.0 * rng.standard_normal(SIZE) + 6.0 * telegraph(rng, SIZE, 0.02, 4.0)
            return 1000 + noise.reshape(ROWS, -1)

        found, deviate = biases(make, 12, 2).pulses()
        assert deviate > 10
        assert found[0] == 0 and found[1] == 1
        ratios.append(found[2])
    # The covariance falls by 1 - 1/4 - 1/196 with each pixel.
    assert np.mean(ratios) == pytest.approx(0.745, abs=0.02)


def test_pulses_as_high_as_the_noise_are_found():
    rng = np.random.default_rng(8127)

    def make(frame, amp):
        noise = 3.0 * rng.standard_normal(SIZE) + 3.0 * telegraph(rng, SIZE, 0.02, 4.0)
        return 1000 + noise.reshape(ROWS, -1)

    found, deviate = biases(make, 4).pulses()
    # The covariances are 0.015 of the variance, the third cumulants as much: deviates of 3 to 5.
    assert SCATTERED < deviate < STANDS_OUT
    assert found[1] == 1


@pytest.mark.parametrize("noise", ["gaussian", "heavy tails", "skewed"])
def test_other_noise_has_no_pulses(noise):
    rng = np.random.default_rng(8124)

    def make(frame, amp):
        white = {
            "gaussian": lambda: rng.standard_normal(SIZE + 1),
            "heavy tails": lambda: rng.standard_t(4, SIZE + 1),
            "skewed": lambda: rng.gamma(2.0, 1.0, SIZE + 1),
        }[noise]()
        # Correlated from pixel to pixel only where Gaussian: an effect of the library.
        tied = 0.2 * white[:-1] if noise == "gaussian" else 0.0
        return 1000 + 3.0 * (white[1:] + tied).reshape(ROWS, -1)

    assert not biases(make).pulses()[0].any()


@pytest.mark.parametrize(("together", "seen"), [(True, False), (False, True)])
def test_levels_that_drift_together_do_not_jump(together, seen):
    rng = np.random.default_rng(8125)
    steps = rng.standard_normal((12, 3))
    if together:
        steps[:, 1:] = steps[:, :1] * [1.1, 0.8]

    def make(frame, amp):
        level = 1000 + 100 * amp + 2.0 * steps[frame, amp]
        return level + 3.0 * rng.standard_normal((ROWS, COLUMNS + OVERSCAN))

    (channel,) = [
        c for c in biases(make, amplifiers=3).channels() if c.word == "bias_level"
    ]
    frames = channel.axes["what"] == "frames"
    z = channel.values[frames] / channel.errors[frames]
    assert (z.max() > 5) == seen and (seen or np.abs(z).max() < 4)


@pytest.mark.parametrize("column", [0, 1, 40, 95])
def test_columns_are_found_at_borders_and_from_a_row_on(column):
    image = 3e-3 * np.random.default_rng(8126).standard_normal((ROWS, COLUMNS))
    image[50:, column] -= 0.03
    (found,) = bad_columns(image)
    assert list(found.columns) == [column]
    # A step of ten times the noise of a pixel is placed to a row.
    assert abs(found.rows.start - 50) <= 1 and found.rows.stop == ROWS
    assert found.change.min() == pytest.approx(-0.03, abs=2e-3)


def test_a_column_is_no_low_pixel():
    image = 3e-3 * np.random.default_rng(8127).standard_normal((ROWS, COLUMNS))
    image[:, 20] -= 0.03
    image[70, 60] -= 0.05
    assert np.argwhere(low_pixels(image)).tolist() == [[70, 60]]


class Structure(Effect):
    """Columns, rows and a settling of the bias, the same in all frames."""

    word = "structure"
    variants: ClassVar = {"": {"part": Range(0.0, 1.0, amplitude=True)}}

    def noise(self, frames, context):
        part, out = self.parameters["part"], []
        for n, frame in enumerate(frames):
            rng = np.random.default_rng(n)
            rows, columns = (rng.standard_normal(s) for s in frame.shape)
            settling = 4.0 * np.exp(-np.arange(frame.shape[1]) / 4.0)
            own = 0.4 * rows[:, None] + 0.4 * columns[None] + settling[None]
            out.append((frame + part * own).astype(frame.dtype))
        return out


@pytest.mark.slow
def test_structure_of_the_bias_is_listed_and_no_alarm():
    measured = measure_channels(
        VirtualSource(seed=8128, size=SMALL, effects=[Structure({"part": 1.0})])
    )
    listed = [c for c in measured.cosmetics if c.kind == "bias_structure"]
    assert len(listed) == 2 and all(c.z > 10 for c in listed)
    found = diagnose_measured(measured, virtual_baseline(), explain=False)
    assert not found.mismatch.detected


def test_two_lamps_of_one_level_are_no_flicker():
    flats = [
        Info(n, "flat", exposure_time=t, lamp=lamp * (1 + 2e-4 * (n % 3)))
        for n, (t, lamp) in enumerate([(10.0, 0.5), (6.0, 0.8)] * 6)
    ]
    steps = dict.fromkeys(range(12), 1.0)
    found = bench_nuisances(BiasChannels(), {}, [], flats, steps, (ROWS, COLUMNS))
    assert [c.kind for c in found] == ["lamp_flicker"]
    assert found[0].size == pytest.approx(2e-4 * np.sqrt(2 / 3), rel=1e-3)


def test_tracks_in_single_biases_are_not_in_their_mean_but_fixed_structure_is():
    """A track of 5000 ADU in one of 12 frames would be a dent of 400 ADU in every other exposure."""
    rng = np.random.default_rng(8131)
    channels = BiasChannels()
    for n in range(12):
        pixels = 1000 + 3.0 * rng.standard_normal((ROWS, COLUMNS + OVERSCAN))
        pixels[:, 7] += 400.0
        pixels[10 + 4 * (n % 3), 20:30] += 5000.0 * (n < 3)
        channels.add(Info(n), [Bias(pixels.astype(np.float32), "amp")])
    mean = channels.mean("amp")
    assert np.abs(np.delete(mean, 7, axis=1)).max() < 6 * 3.0 / 9**0.5
    np.testing.assert_allclose(mean[:, 7].mean(), 400.0, atol=1.0)


@pytest.mark.parametrize("seed", range(6))
def test_noise_that_remembers_the_pixel_before_has_no_pulses(seed):
    """Third cumulants of Gaussian noise are 0, but scatter by more where neighbours are alike."""
    rng = np.random.default_rng(8200 + seed)

    def make(frame, amp):
        noise = 4.0 * rng.standard_normal(SIZE)
        noise += 16.0 * lfilter([0.8], [1.0, -0.6], rng.standard_normal(SIZE))
        return 1000 + noise.reshape(ROWS, -1)

    assert not biases(make, 16, 2).pulses()[0].any()


def test_lags_of_white_noise_do_not_stand_out():
    """Of the covariances at all lags those within their scatter count as none."""
    rng = np.random.default_rng(8301)

    def make(frame, amp):
        return 1000 + 4.0 * rng.standard_normal((ROWS, COLUMNS + OVERSCAN))

    seen = biases(make, 8)._seen(0)
    assert seen[0] == pytest.approx(16.0, rel=0.1)
    # STANDS_OUT errors are passed by less than one in a thousand.
    assert np.count_nonzero(seen[1:]) <= 0.01 * len(seen)
