"""Light that changes from flat to flat: noise of maps that is correlated over many pixels."""

import numpy as np
import pytest

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.exposure_info import numbers_of
from bfsensor.diagnose.data.map_channels import MapChannels
from bfsensor.effects.effect import Layout, Shot
from bfsensor.effects.illumination_turbulence import IlluminationTurbulence

HERE = Condition(wavelength=620.0, back_bias=-60.0, temperature=173.0)
SIDE, PAIRS, NOISE = 256, 8, 5e-3
SHOT = Shot("flat", 0, 10.0, *numbers_of(HERE), 0.0, 5e4)


def map_of(seed, rms, corr=15.0):
    """Channel of flats with noise of pixels and light of their own."""
    rng = np.random.default_rng(seed)
    layout = Layout(shape=(SIDE, SIDE), segments=())
    light = IlluminationTurbulence({"rms": rms, "corr": corr})
    maps = MapChannels((SIDE, SIDE), {HERE: 10.0}, "held-out")
    for _ in range(PAIRS):
        flats = []
        for _ in range(2):
            flat = NOISE * rng.standard_normal((SIDE, SIDE))
            own = light.turbulence(SHOT, layout, rng)
            if own is not None:
                flat += own - own.mean()
            flats.append(flat.astype(np.float32))
        maps.add_pair(HERE, 10.0, *flats)
    (channel,) = maps.channels()
    return channel


def waves(channel):
    """Deviates of the longest waves along both axes, from columns and rows."""
    out = []
    for what, axis in (("column", "x"), ("row", "y")):
        own = channel.axes["what"] == what
        values = channel.values[own]
        # Of each the error is that of one number; lines share no noise.
        error = channel.errors[own][0]
        phase = 2 * np.pi * channel.axes[axis][own] / SIDE
        for n in range(1, 7):
            for part in (np.cos(n * phase), np.sin(n * phase)):
                out.append(values @ part / np.sqrt((part @ part) * error**2))
    return np.array(out)


@pytest.fixture(scope="module")
def turbulent():
    return [map_of(n, 6e-4) for n in range(12)]


def test_waves_of_the_light_are_within_their_errors(turbulent):
    found = np.concatenate([waves(c) for c in turbulent])
    # 288 of them; errors are those of waves of four blocks and longer, here of a fifth to all
    # of the sensor.
    assert 0.7 < np.sqrt(np.mean(found**2)) < 1.15
    assert np.abs(found).max() < 4.2


def test_without_it_they_are_not(monkeypatch):
    monkeypatch.setattr(MapChannels, "_long", lambda *_: 0.0)
    found = np.concatenate([waves(map_of(n, 6e-4)) for n in range(4)])
    assert np.sqrt(np.mean(found**2)) > 2.0


@pytest.mark.parametrize("rms", [0.0, 3e-5])
def test_of_what_is_lost_in_noise_errors_know_nothing(monkeypatch, rms):
    here = map_of(77, rms)
    monkeypatch.setattr(MapChannels, "_long", lambda *_: 0.0)
    np.testing.assert_array_equal(here.errors, map_of(77, rms).errors)
