"""Rows of biases: the variance of their means beyond the covariances of near pixels."""

import numpy as np
import pytest

from bfsensor.diagnose.data.bias_channels import _row_excess
from bfsensor.effects.read_noise import READOUT_LAGS

ROWS, COLUMNS, FRAMES = 128, 100, 600


@pytest.fixture(scope="module")
def white():
    return 4.0 * np.random.default_rng(3).standard_normal((FRAMES, ROWS, COLUMNS))


def test_excess_of_white_noise_is_none_and_scatters_as_said(white):
    found = np.array([_row_excess(f) for f in white])
    error = found[:, 1].mean()
    assert abs(found[:, 0].mean()) < 4 * error / FRAMES**0.5
    # The scatter of so many is known to 3 %.
    assert found[:, 0].std() == pytest.approx(error, rel=0.12)
    assert found[:, 2].mean() == pytest.approx(16.0 / COLUMNS, rel=0.01)


def test_excess_is_independent_of_covariances_of_near_pixels(white):
    near = np.array([
        sum((f[:, k:] * f[:, :-k]).mean() for k in range(1, READOUT_LAGS + 1)) for f in white
    ])  # fmt: skip
    excess = np.array([_row_excess(f)[0] for f in white])
    whole = np.array([f.mean(1).var(ddof=1) for f in white])
    assert abs(np.corrcoef(near, excess)[0, 1]) < 4 / FRAMES**0.5
    # The variance of the means itself is correlated with them, and would count them twice.
    assert np.corrcoef(near, whole)[0, 1] > 0.4


def test_rows_that_move_are_seen_with_the_strength_that_is_said(white):
    rng = np.random.default_rng(4)
    moved = np.array([_row_excess(f + 0.8 * rng.standard_normal((ROWS, 1))) for f in white])
    lag = np.arange(READOUT_LAGS + 1, COLUMNS)
    said = 2.0 / COLUMNS * float((1 - lag / COLUMNS).sum()) * 0.64
    assert moved[:, 0].mean() == pytest.approx(said / moved[:, 2].mean(), rel=0.05)
