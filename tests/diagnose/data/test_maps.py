"""Maps: sums over exposure times against maps held apart, and steps between amplifiers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.map_channels import LOW, MapChannels, block_side
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Segment
from tests.virtual import virtual_baseline

HERE, THERE = (
    Condition(wavelength=w, back_bias=-60.0, temperature=173.0) for w in (620.0, 870.0)
)
ROWS, COLUMNS = 120, 128
"""Size of a sensor of four amplifiers, whose border in y cuts blocks of 8 pixels."""

SEGMENTS = tuple(
    Segment(x, y, COLUMNS // 2, ROWS // 2, x > 0, y > 0, 8, 16, 8)
    for y in (0, ROWS // 2)
    for x in (0, COLUMNS // 2)
)
FLATS = {(HERE, 1.0): 2, (HERE, 3.0): 2, (HERE, 8.0): 3, (HERE, 16.0): 4, (THERE, 16.0): 2}
"""Pairs by condition and exposure time."""

ALONG_Y, ALONG_X = (np.linspace(-1, 1, n) for n in (ROWS, COLUMNS))
LIGHT = 1 + 0.02 * ALONG_X + 0.01 * ALONG_Y[:, None]


def make_flats(seed: int) -> dict[tuple[Condition, float], np.ndarray]:
    """Flats over their amplifiers' means, by condition and exposure time."""
    rng = np.random.default_rng(seed)
    response = LIGHT * (1 + 1e-3 * rng.standard_normal((ROWS, COLUMNS)))
    out = {}
    for (condition, time), pairs in FLATS.items():
        noise = 0.01 / np.sqrt(time) * rng.standard_normal((2 * pairs, ROWS, COLUMNS))
        flats = response + noise
        for s in SEGMENTS:
            part = flats[:, s.y : s.y + s.rows, s.x : s.x + s.columns]
            part /= part.mean((1, 2), keepdims=True)
        out[condition, time] = flats
    out[HERE, 8.0][1:, 5, 7] = np.nan
    return out


def measure(
    flats: dict[tuple[Condition, float], np.ndarray],
) -> tuple[MapChannels, Channel]:
    maps = MapChannels((ROWS, COLUMNS), {HERE: 16.0, THERE: 16.0})
    for (condition, time), images in flats.items():
        for first, second in zip(images[::2], images[1::2], strict=True):
            maps.add_pair(
                condition,
                time,
                (first - 1).astype(np.float32),
                (second - 1).astype(np.float32),
            )
    (channel,) = maps.channels()
    return maps, channel


def test_sums_are_the_weighted_means() -> None:
    """They equal weighted means of maps that are all held at once, in double precision."""
    flats = make_flats(8821)
    maps, channel = measure(flats)
    means, weights = {}, {}
    for key, images in flats.items():
        noise = (images[::2] - images[1::2]) / np.sqrt(2)
        n = len(noise)
        boxes = noise.reshape(n, ROWS // LOW, LOW, COLUMNS // LOW, LOW)
        boxes = np.nansum(boxes, (2, 4)) / np.sqrt(np.isfinite(boxes).sum((2, 4)))
        means[key] = np.nanmean(images, 0)
        weights[key] = n**2 / boxes.reshape(n, -1).var(1).sum()
    wanted = {
        "all": [k for k in flats if k[0] == HERE],
        "short": [(HERE, 1.0), (HERE, 3.0)],
        "long": [(HERE, 8.0), (HERE, 16.0)],
        "870/-60/-100.15": [(THERE, 16.0)],
    }
    average = {
        name: np.average(
            [means[k] for k in keys], axis=0, weights=[weights[k] for k in keys]
        )
        for name, keys in wanted.items()
    }
    average["short"] /= average.pop("long")
    average["870/-60/-100.15"] /= average["all"]
    assert set(channel.axes["map"]) == set(average)
    for name, image in average.items():
        own = channel.axes["map"] == name
        for what, axis in (("column", 0), ("row", 1)):
            rows = own & (channel.axes["what"] == what)
            # Single precision of departures of 0.03, averaged over 120 pixels.
            np.testing.assert_allclose(
                channel.values[rows], image.mean(axis) - 1, atol=1e-8
            )
    shares = {s.seconds: s.weight for s in maps.shares()["all"]}
    whole = sum(weights[k] for k in wanted["all"])
    assert shares == pytest.approx(
        {k[1]: weights[k] / whole for k in wanted["all"]}, rel=1e-5
    )


def test_levels_in_two_runs_are_one_mean() -> None:
    flats = make_flats(8822)
    maps, _ = measure(flats)
    order = [(HERE, 16.0), (HERE, 1.0), (HERE, 3.0), (HERE, 8.0), (THERE, 16.0)]
    split = MapChannels((ROWS, COLUMNS), {HERE: 16.0, THERE: 16.0})
    for key, part in [
        *((k, slice(0, 4)) for k in order),
        *((k, slice(4, 8)) for k in order),
    ]:
        images = (flats[key][part] - 1).astype(np.float32)
        for first, second in zip(images[::2], images[1::2], strict=True):
            split.add_pair(*key, first, second)
    one, other = maps.channels()[0], split.channels()[0]
    np.testing.assert_allclose(one.values, other.values, atol=3 * float(one.errors.max()))
    total = sum(s.weight for s in split.shares()["all"])
    assert total == pytest.approx(1.0)


def test_amplifiers_in_two_rows_leave_no_steps() -> None:
    """Light that falls off towards the top makes steps in y between amplifiers over their means."""
    flats = make_flats(8823)
    maps, channel = measure(flats)
    measured = MeasuredChannels(
        channels=(channel,), amplifiers=tuple("abcd"), gains=(1.0,) * 4, read_noise=(3.0,) * 4,
        phases=(), columns=(72,) * 4, flips=tuple((s.flip_x, s.flip_y) for s in SEGMENTS),
        origins=tuple((s.x, s.y) for s in SEGMENTS), shape=(ROWS, COLUMNS), segments=SEGMENTS,
        maps={("fit", k): v for k, v in maps.shares().items()},
    )  # fmt: skip
    columns = Predictor(measured, virtual_baseline()).linear(channel)

    def left(names: list[str]) -> float:
        design = np.array([channel.whiten(columns[n]) for n in names]).T
        white = channel.whiten(channel.values)
        best = np.linalg.lstsq(design, white, rcond=None)[0]
        chosen = (channel.axes["map"] == "all") & (channel.axes["what"] != "ring")
        return float(np.square(white - design @ best)[chosen].sum() / chosen.sum())

    assert block_side((ROWS, COLUMNS)) == 8
    assert left(list(columns)) < 1.15
    assert left([n for n in columns if " amp " not in n]) > 3


def test_columns_with_values_of_others_have_no_noise_of_their_own() -> None:
    """A tenth of the columns is filled in: the noise of all others is not smaller for it."""
    shape = (160, 160)
    rng = np.random.default_rng(8829)
    # Of rows, which are means of their own and no part of rings, bridges across columns follow.
    light = 1e-2 * rng.standard_normal((160, 1)) * np.ones(shape)
    response = light + 3e-3 * rng.standard_normal(shape)
    filled = np.zeros(shape, bool)
    for start in range(5, 160, 40):
        filled[: 160 if start < 80 else 80, start : start + 4] = True
    maps = {
        name: MapChannels(shape, {HERE: 16.0}) for name in ("told", "not told", "sound")
    }
    for time in (1.0, 16.0):
        flats = response + 2e-3 * rng.standard_normal((4, *shape))
        for name, each in maps.items():
            images = flats.copy()
            if name != "sound":
                images[:, filled] = light[filled]
            told = {"filled": filled} if name == "told" else {}
            for a, b in images.astype(np.float32).reshape(2, 2, *shape):
                each.add_pair(HERE, time, a, b, **told)
    found = {name: each.channels()[0] for name, each in maps.items()}
    error = {n: c.errors[c.axes["what"] == "row"] for n, c in found.items()}
    # Medians of 22,000 differences, and variances of 330 boxes: to some per cent.
    assert error["told"] == pytest.approx(error["sound"], rel=0.05)
    assert (error["not told"] < 0.97 * error["sound"]).all()
    # The response of single pixels is part of the rings' power.
    for what, below in (("ring", found["sound"].values), ("texture", 0.0)):
        rows = found["told"].axes["what"] == what
        away = ((found["told"].values - below) / found["told"].errors)[rows]
        assert np.square(away).mean() < 1 + 4 * np.sqrt(2 / len(away))


def test_steps_between_amplifiers_in_two_rows_are_no_rings() -> None:
    """Uneven light leaves steps in x and in y, each amplifier being over its own mean."""
    rng = np.random.default_rng(8830)
    side = 128
    y, x = np.indices((side, side)) / side
    light = 1 - 0.16 * ((x - 0.6) ** 2 + (y - 0.65) ** 2) ** 2
    amplifiers = [
        (slice(a, a + side // 2), slice(b, b + side // 2))
        for a in (0, side // 2)
        for b in (0, side // 2)
    ]
    found = []
    for shape in (light, np.ones_like(light)):
        maps = MapChannels((side, side), {HERE: 16.0}, amplifiers=amplifiers)
        for _ in range(4):
            flats = shape * (1 + 3e-3 * rng.standard_normal((2, side, side)))
            for part in amplifiers:
                flats[(slice(None), *part)] /= flats[(slice(None), *part)].mean()
            maps.add_pair(HERE, 16.0, *(flats - 1).astype(np.float32))
        (channel,) = maps.channels()
        rows = (channel.axes["what"] == "ring") & (channel.axes["k"] > 0)
        found.append((channel.values / channel.errors)[rows])
    uneven, even = found
    assert np.abs(even).max() < 4
    assert np.abs(uneven).max() < 4


def test_light_that_fluctuates_leaves_no_texture() -> None:
    """Its correlation is known from the flats of pairs, whose boxes hold it as much as white noise."""
    rng = np.random.default_rng(21)
    side, correlation, noise = 192, 14.0, 3e-3
    width, margin = correlation / np.sqrt(2.0), 40
    pulls = []
    for _ in range(6):
        maps = MapChannels((side, side), {HERE: 16.0})
        flats = noise * rng.standard_normal((4, side, side))
        for image in flats:
            rough = rng.standard_normal((side + 2 * margin,) * 2)
            smooth = gaussian_filter(rough, width)[margin:-margin, margin:-margin]
            image += noise / 3 * np.sqrt(4 * np.pi) * width * smooth
            image -= image.mean()
        for first, second in zip(flats[::2], flats[1::2], strict=True):
            maps.add_pair(HERE, 16.0, first.astype(np.float32), second.astype(np.float32))
        channel = maps.channels()[0]
        texture = channel.axes["what"] == "texture"
        only = np.where(texture, channel.values, 0.0)
        pulls.append(channel.whiten(only)[texture])
    assert np.square(pulls).mean() == pytest.approx(1.0, abs=0.4)
    # Without the flats' differences numbers of four pixels are 4 errors off; 6 means have 0.4.
    assert np.abs(np.mean(pulls, axis=0)).max() < 2.0
