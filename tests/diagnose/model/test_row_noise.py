"""Levels of rows scatter a little in usual sensors: a parameter of the fit, near 0, takes that up."""

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.bias_channels import ROW_ERROR, BiasChannels
from bfsensor.diagnose.kinds import KINDS
from bfsensor.effects.bias_instability import BiasByRow

ROWS, COLUMNS, AMPLIFIERS = 64, 120, 2


@pytest.fixture(scope="module")
def channels():
    """'bias_cov' and 'bias_level' of eight biases of white noise of 2 ADU."""
    rng, biases = np.random.default_rng(31), BiasChannels()
    exposure = SimpleNamespace(wavelength=None, back_bias=None, temperature=None)
    for number in range(8):
        frames = []
        for amp in range(AMPLIFIERS):
            pixels = np.rint(1000 + 2 * rng.standard_normal((ROWS, COLUMNS))).astype(
                np.float32
            )
            parts = {"image": pixels[:, :-20], "serial_overscan": pixels[:, -20:]}
            frames.append(
                SimpleNamespace(
                    name=f"amp {amp}",
                    pixels=pixels,
                    mask=np.zeros((ROWS, COLUMNS - 20), bool),
                    prescan=np.zeros((ROWS, 0)),
                    parallel_overscan=np.zeros((0, COLUMNS - 20)),
                    **parts,
                )
            )
        biases.add(SimpleNamespace(number=number, **vars(exposure)), frames)
    return [c for c in biases.channels() if c.word in ("bias_cov", "bias_level")]


def changes(channels):
    """Whitened changes by the effect and by the parameter, for a variance of 1 ADU^2 of rows' levels."""
    width = SimpleNamespace(frame_width=lambda amp: np.full(len(amp), COLUMNS))
    effect, column = [], []
    for channel in channels:
        x, here = channel.axes, channel.axes["amp"] == 1
        told = getattr(BiasByRow({"rms": 1.0}), channel.word)(x, width)
        if channel.word == "bias_level":
            told = told / x["white"]
        effect.append(channel.whiten(np.where(here, told, 0.0)))
        column.append(
            channel.whiten(KINDS[channel.word].columns(channel, {}, None)["row noise 1"])
        )
    return np.concatenate(effect), np.concatenate(column)


def test_the_parameter_is_the_effect_beside_the_value_that_holds_it(channels):
    effect, column = changes(channels)
    held = np.flatnonzero(~np.isclose(effect, column))
    assert len(held) == 1 and effect[held] == 0
    assert column[held] == pytest.approx(ROW_ERROR**-2)


@pytest.mark.parametrize(("rms", "low", "high"), [(ROW_ERROR, 0.0, 1.0), (0.4, 5.0, 64.0)])
def test_usual_rows_are_no_finding_and_moving_ones_are(channels, rms, low, high):
    """The deviate is that of the variance left where the parameter is free within its error."""
    effect, column = changes(channels)
    left = effect - column * (column @ effect) / (column @ column)
    assert low <= rms**2 * np.sqrt(left @ left) <= high
