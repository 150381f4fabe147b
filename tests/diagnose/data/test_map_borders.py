"""Lines at the rim that are unlike others are found, and left out of maps."""

import numpy as np
import pytest

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.map_borders import find_borders
from bfsensor.diagnose.data.map_channels import MapChannels

SHAPE = 96, 160


def noise(seed, shape=SHAPE):
    return np.random.default_rng(seed).normal(0, 0.003, shape)


def test_no_line_of_noise_is_found():
    assert [b for seed in range(200) for b in find_borders(noise(seed))] == []


@pytest.mark.parametrize("line", [0, SHAPE[1] - 1])
def test_a_column_that_scatters_is(line):
    image = noise(1)
    image[:, line] += 0.012 * np.random.default_rng(2).standard_normal(SHAPE[0])
    (found,) = find_borders(image)
    assert (found.axis, found.line) == (1, line)
    assert found.ratio == pytest.approx(np.hypot(1, 4), rel=0.3)
    found.cut(image)
    assert np.isnan(image[:, line]).all()
    assert np.isfinite(np.delete(image, line, axis=1)).all()


def test_neither_light_nor_single_pixels_nor_means_matter():
    image = noise(3) + 0.05 * np.linspace(-1, 1, SHAPE[1]) ** 2
    image += 0.05 * np.linspace(-1, 1, SHAPE[0])[:, None]
    image[10:20, 0] = 0.5  # dead or hot ones
    image[0] += 0.02
    assert find_borders(image) == []


def test_pixels_that_are_not_read_do_not_matter():
    image = noise(4)
    image[:, :40] = np.nan
    image[:, -1] += 0.02 * np.random.default_rng(5).standard_normal(SHAPE[0])
    assert [(b.axis, b.line) for b in find_borders(image)] == [(1, SHAPE[1] - 1)]


def maps_of(rim):
    """Maps of six flats, the first row with scatter of its own."""
    condition = Condition(wavelength=620.0, back_bias=-60.0, temperature=173.15)
    maps = MapChannels((64, 64), {condition: 10.0})
    fixed = noise(6, (64, 64))
    fixed[0] += rim * np.sin(np.arange(64))
    for n in range(3):
        pair = (fixed + 0.1 * noise(10 + 2 * n + k, (64, 64)) for k in (0, 1))
        maps.add_pair(condition, 10.0, *(p.astype(np.float32) for p in pair), level=1.0)
    (channel,) = maps.channels()
    return maps, channel


def test_maps_leave_it_out_and_say_so():
    usual, plain = maps_of(0.0)
    cut, channel = maps_of(0.05)
    assert usual.notes == []
    assert len(cut.notes) == 1 and "row 0," in cut.notes[0]
    row = (channel.axes["what"] == "row") & (channel.axes["y"] == 0)
    block = (channel.axes["what"] == "block") & (channel.axes["y"] < 4)
    assert channel.values[row] == 0.0
    assert channel.errors[row] > 5 * plain.errors[row]
    # Blocks of the first rows are those of the other rows.
    np.testing.assert_allclose(channel.values[block], plain.values[block], atol=0.002)
