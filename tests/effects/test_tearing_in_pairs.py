"""Covariances of torn flats against pairs drawn pixel by pixel, clipped as they are measured."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.effects import Tearing
from bfsensor.effects.effect import Layout, Segment
from bfsensor.measure.flat_pairs import flat_covariances

SIDE, LEVEL = 96, 60_000.0
LAYOUT = Layout((SIDE, SIDE), (Segment(0, 0, SIDE, SIDE),))
SHAPE = {"length": 1.5, "column": 0.5, "open": 0.4, "top": 0.0}


def white(level):
    """Covariances of photon noise alone, of one flat."""
    c = np.zeros((1, 32, 32))
    c[0, 0, 0] = level
    return c


def drawn(tear, pairs, relaxation, level=LEVEL):
    """Mean of measured covariances of pairs of torn flats, and its errors."""
    rng = np.random.default_rng(70)
    area = np.diff(tear._torn(SIDE)) * relaxation
    found = []
    for _ in range(pairs):
        flats = []
        for _ in range(2):
            torn = np.arange(SIDE) + 0.5 < SIDE * rng.uniform(tear["open"], 1.0)
            mean = level * (1 + torn[:, None] * area)
            flats.append(mean + np.sqrt(level) * rng.standard_normal((SIDE, SIDE)))
        found.append(flat_covariances(*flats, lags=3).covariances)
    return np.mean(found, 0), np.std(found, 0) / np.sqrt(pairs)


@pytest.mark.parametrize("amp", [0.01, 0.025, 0.04])
def test_pixels_beyond_the_clipping_limit_and_their_neighbours_are_excluded(amp):
    tear = Tearing({"amp": amp, **SHAPE})
    axes = {"amp": np.zeros(1), "level": np.array([LEVEL])}
    said = tear.covariances(white(LEVEL), axes, LAYOUT)[0, :4, :4]
    mean, error = drawn(tear, 300, 1.0)
    pull = (mean - said) / error
    assert np.abs(pull).max() < 4
    # Without the exclusion the prediction fails.
    none = tear.covariances(white(LEVEL), axes, LAYOUT.__class__(
        LAYOUT.shape, LAYOUT.segments, clip=np.inf
    ))[0, :4, :4]  # fmt: skip
    if amp > 0.03:
        assert np.abs((mean - none) / error).max() > 6


def test_tears_relax_as_the_noise_does():
    tear = Tearing({"amp": 0.01, **SHAPE})
    axes = {"amp": np.zeros(1), "level": np.array([LEVEL])}
    area = np.diff(tear._torn(SIDE))
    # A sensor whose charge widens neighbours in the row: a_00 = -2 a, a_10 = a.
    a = 2.0e-6
    k = 2 * np.pi * np.fft.rfftfreq(SIDE)
    strength = 2 * a * (np.cos(k) - 1) * LEVEL
    with np.errstate(invalid="ignore"):
        left = np.where(strength, np.expm1(strength) / strength, 1.0)
    wanted = np.fft.irfft(np.fft.rfft(area) * left, SIDE)
    c = np.zeros((1, 32, 32))
    q = 2 * np.pi * np.fft.fftfreq(32)
    twice = 4 * a * (np.cos(q) - 1) * LEVEL
    with np.errstate(invalid="ignore"):
        power = LEVEL * np.where(twice, np.expm1(twice) / twice, 1.0)
    c[0, 0] = np.fft.ifft(power).real
    said = tear.covariances(c, axes, LAYOUT)[0] - c[0]
    chance = np.diag(tear._chance(SIDE)).mean()
    for lag in (0, 1, 2):
        n = SIDE - lag
        expected = chance * LEVEL**2 * (wanted[:n] * wanted[lag:]).mean()
        plain = chance * LEVEL**2 * (area[:n] * area[lag:]).mean()
        assert said[0, lag] == pytest.approx(
            expected, abs=0.02 * chance * LEVEL**2 * (area @ area) / SIDE
        )
        if lag == 0:
            assert said[0, 0] < 0.9 * plain
