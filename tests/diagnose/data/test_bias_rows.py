"""Rows of biases: the variance of their means beyond the covariances of near pixels."""

import numpy as np
import pytest

from bfsensor.diagnose.data.bias_channels import (
    _autocovariance,
    _errors_in_order,
    _lags,
    _row_excess,
)
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


def test_lags_of_rows_tell_rows_with_memory_from_rows_without(white):
    """Autocovariances at multiples of a row, with the errors that are said."""
    lags = _lags(ROWS, COLUMNS)
    assert lags[: READOUT_LAGS + 1].tolist() == list(range(READOUT_LAGS + 1))
    assert lags[READOUT_LAGS + 1 :].tolist() == [COLUMNS, 2 * COLUMNS, 3 * COLUMNS]
    assert _lags(8, 100).max() < 200
    few = white[:200]
    plain = np.array([_autocovariance(f)[lags] for f in few])
    size = ROWS * COLUMNS
    said = np.sqrt(
        np.diag(_errors_in_order(np.array([16.0, *np.zeros(size // 4 - 1)]), lags)) / size
    )
    # The scatter of 200 frames is known to 5 %.
    np.testing.assert_allclose(plain.std(0), said, rtol=0.2)
    rng = np.random.default_rng(5)
    levels = np.zeros((200, ROWS, 1))
    for row in range(ROWS):
        before = levels[:, row - 1] if row else 0.0
        levels[:, row] = 0.7 * before + 0.8 * rng.standard_normal((200, 1))
    moved = np.array(
        [_autocovariance(f + v)[lags] for f, v in zip(few, levels, strict=True)]
    )
    found = moved.mean(0)[-3:]
    variance = 0.64 / (1 - 0.49)
    # The subtracted mean of a frame takes a twentieth of levels with such a memory.
    np.testing.assert_allclose(
        found, variance * 0.7 ** np.arange(1, 4), atol=0.1 * variance
    )
