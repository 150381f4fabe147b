"""Persistence of earlier spots is detected in biases and darks."""

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.spot_ghosts import describe_ghosts, find_ghosts

SIDE, PITCH, NOISE = 120, 20, 5.0
ORDER = ["bias"] * 6 + ["dark"] * 2 + ["spot"] * 2 + ["bias"] * 4 + ["dark"]


def _spots(peak: float) -> np.ndarray:
    away = (np.arange(SIDE) + PITCH // 2) % PITCH - PITCH // 2
    return peak * np.exp(-(away[:, None] ** 2 + away**2) / 2.4)


def _campaign(left, *, rows=0.0, columns=0.0, order=ORDER, seed=0):
    """Exposures in order; each frame after spots holds ``left`` of the peak's electrons."""
    rng = np.random.default_rng(seed)
    standing = columns * rng.standard_normal(SIDE)
    exposures, images = [], {}
    lit = 0
    for number, kind in enumerate(order):
        time = {"bias": 0.0, "dark": 60.0, "spot": 30.0 + number}[kind]
        exposures.append(SimpleNamespace(number=number, kind=kind, exposure_time=time))
        image = 1000 + standing + rows * rng.standard_normal((SIDE, 1))
        image = image + NOISE * rng.standard_normal((SIDE, SIDE)) + _spots(lit * left)
        if kind == "spot":
            lit = 1
            image += _spots(5e4)
        images[number] = [SimpleNamespace(image=image.astype(np.float32))]
    return exposures, lambda one: images[one.number]


def test_ghosts_are_found_in_what_follows_spots():
    exposures, read = _campaign(30.0)
    found = find_ghosts(exposures, read)
    assert set(found) == {10, 11, 12, 13, 14}
    (lit,) = found[10]
    assert lit[::PITCH, ::PITCH].all() and 0.02 < lit.mean() < 0.2
    said = describe_ghosts({10, 11, 12, 13, 14}, exposures)
    assert "bias 10, 11, 12, 13 (" in said and "dark 14 (" in said


@pytest.mark.parametrize("seed", range(8))
def test_neither_noise_nor_rows_nor_columns_are_ghosts(seed):
    assert not find_ghosts(*_campaign(0.0, rows=8.0, columns=8.0, seed=seed))


def test_rows_that_move_hide_no_ghost():
    assert find_ghosts(*_campaign(30.0, rows=8.0, columns=8.0)).keys() == {
        10,
        11,
        12,
        13,
        14,
    }


@pytest.mark.parametrize("order", [
    ["spot", "spot", "bias", "bias", "bias", "bias", "bias"],
    ["bias"] * 3 + ["spot"] + ["bias"] * 4,
    ["bias"] * 8 + ["dark"] * 2,
])  # fmt: skip
def test_all_are_used_where_too_few_would_be_left(order):
    assert not find_ghosts(*_campaign(30.0, order=order))
