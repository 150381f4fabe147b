"""Columns of darks: errors from the pixels' noise, or from columns that are uneven by nature."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.bias_channels import DarkChannels

ROWS, COLUMNS, NOISE, BIASES, DARKS = 64, 128, 3.0, 10, 4


def pulls(rng: np.random.Generator, uneven: float = 0.0) -> np.ndarray:
    """Whitened columns of one campaign's darks."""
    pattern = uneven * rng.standard_normal(COLUMNS)
    bias = NOISE / np.sqrt(BIASES) * rng.standard_normal((ROWS, COLUMNS))
    darks = DarkChannels({"one": bias}, {"one": NOISE}, biases=BIASES)
    for number in range(DARKS):
        image = NOISE * rng.standard_normal((ROWS, COLUMNS)) + pattern
        over = NOISE * rng.standard_normal((ROWS, 24))
        frame = SimpleNamespace(name="one", image=image, serial_overscan=over)
        exposure = SimpleNamespace(
            number=number,
            exposure_time=60.0,
            wavelength=None,
            back_bias=None,
            temperature=None,
        )
        darks.add(exposure, [frame])
    channel = darks.channels()[0]
    return channel.whiten(channel.values)[channel.axes["what"] == "column"]


def test_chi_square_of_columns_scatters_as_it_should() -> None:
    rng = np.random.default_rng(2718)
    squares = np.array([((p := pulls(rng)) - p.mean()) @ (p - p.mean()) for _ in range(60)])
    deviates = (squares - (COLUMNS - 1)) / np.sqrt(2.0 * (COLUMNS - 1))
    # Errors from the columns' own scatter gave deviates of 1.6.
    assert deviates.mean() == pytest.approx(0.0, abs=4 / np.sqrt(60))
    assert deviates.std() == pytest.approx(1.0, abs=4 / np.sqrt(120))


def test_uneven_columns_are_held_against_their_own_scatter() -> None:
    rng = np.random.default_rng(2719)
    mean = np.mean([np.square(pulls(rng, uneven=2.0)).mean() for _ in range(20)])
    # Held against noise alone it would be 14; a scatter is known to 10 %.
    assert mean == pytest.approx(1.0, abs=0.2)
