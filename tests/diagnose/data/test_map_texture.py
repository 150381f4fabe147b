"""Texture of maps: its errors where a map has a pattern, and where it has none."""

import numpy as np
import pytest
from scipy.fft import rfft2
from scipy.ndimage import gaussian_filter

from bfsensor.diagnose.data.map_texture import (
    map_texture,
    slow_power,
    slow_texture,
    texture_noise,
)
from bfsensor.diagnose.data.map_waves import without_shape

SIDE, SIGMA, DRAWS = 128, 0.003, 400


def pattern():
    """Rings of 18 pixels about a place outside, as strong as the noise is."""
    y, x = np.indices((SIDE, SIDE))
    return SIGMA * np.sqrt(2) * np.sin(2 * np.pi * np.hypot(x + 40, y - 160) / 18)


def draw(rng, shape):
    return shape + rng.normal(0, SIGMA, (SIDE, SIDE))


def drawn(seed):
    """Textures of maps with the pattern, their values, and the covariance by one more map."""
    rng, shape = np.random.default_rng(seed), pattern()
    textures = [map_texture(draw(rng, shape)) for _ in range(DRAWS)]
    one = draw(rng, shape)
    covariance = texture_noise(one, map_texture(one), one.size)
    return textures, np.array([t.values for t in textures]), covariance


def white(covariance, residuals):
    return np.linalg.solve(np.linalg.cholesky(covariance), residuals)


def test_errors_of_a_pattern_are_as_measured():
    _, values, covariance = drawn(3)
    left = white(covariance, (values - values.mean(0)).T)
    # Modes of the pattern that do not stand out count as noise: errors are up to a tenth too large.
    square = float((left**2).sum(0).mean()) / len(left)
    assert 0.8 < square < 1.05
    # In no direction much more than it says: 111 numbers of 400 draws reach 2.3 by chance.
    largest = np.linalg.eigvalsh(np.cov(left)).max()
    assert largest < 3.5
    apart = (values - values.mean(0)) / np.sqrt(np.diag(covariance))
    assert np.linalg.eigvalsh(np.cov(apart.T)).max() > 15


def test_an_amplitude_scatters_as_its_error_says():
    """Fitted with products taken as independent, by more than twice as much."""
    textures, values, covariance = drawn(4)
    template = map_texture(pattern()).values

    def deviates(matrix):
        weights = np.linalg.solve(matrix, template)
        amps = values @ weights / (template @ weights)
        return amps.std() * np.sqrt(template @ weights)

    # Of 400 draws a standard deviation scatters by 0.035.
    assert deviates(covariance) == pytest.approx(1.0, abs=0.15)
    products = SIDE**2 * (1 - np.abs(textures[0].dx) / SIDE) * (1 - textures[0].dy / SIDE)
    assert deviates(np.diag((1e6 * SIGMA**2) ** 2 / products)) > 2.5


def test_without_a_pattern_products_are_independent():
    rng = np.random.default_rng(5)
    values, errors = [], []
    for _ in range(100):
        image = draw(rng, 0.0)
        values.append(map_texture(image).values)
        errors.append(texture_noise(image, map_texture(image), image.size))
    assert all(e.ndim == 1 for e in errors)
    deviates = np.array(values) / np.array(errors)
    assert deviates.std() == pytest.approx(1.0, abs=0.04)


def test_stronger_patterns_make_larger_errors():
    rng, shape = np.random.default_rng(6), pattern()
    noise = rng.normal(0, SIGMA, (SIDE, SIDE))
    traces = []
    for strength in (0.0, 0.3, 1.0, 3.0):
        image = strength * shape + noise
        found = texture_noise(image, map_texture(image), image.size)
        traces.append(float((np.diag(found) if found.ndim == 2 else found**2).sum()))
    assert traces == sorted(traces)
    # The cross terms grow with the square of the pattern.
    grown = (traces[3] - traces[0]) / (traces[2] - traces[0])
    assert grown == pytest.approx(9.0, rel=0.25)


def turbulent(rng, flats):
    """Flats whose light fluctuates over 12 pixels, by a third of the noise of a pixel."""
    margin, width = 40, 12 / np.sqrt(2)
    out = []
    for _ in range(flats):
        rough = rng.standard_normal((SIDE + 2 * margin,) * 2)
        smooth = gaussian_filter(rough, width)[margin:-margin, margin:-margin]
        light = SIGMA / 3 * np.sqrt(4 * np.pi) * width * smooth
        out.append(draw(rng, light))
    return np.array(out)


@pytest.mark.parametrize("pairs", [1, 4])
def test_light_that_fluctuates_is_no_texture(pairs):
    """What a mean of flats has of it is known from their differences, and so is its scatter."""
    rng = np.random.default_rng(7)
    before, after = [], []
    for _ in range(60):
        flats = turbulent(rng, 2 * pairs)
        noise = (flats[::2] - flats[1::2]) / np.sqrt(2.0)
        power = sum(slow_power(n, rfft2(n)) for n in noise) / (2 * pairs**2)
        image = without_shape(flats.mean(0))
        texture = map_texture(image)
        errors = texture_noise(image, texture, image.size)
        own = errors if errors.ndim == 2 else np.diag(errors**2)
        white_part = SIGMA**2 / (2 * pairs)
        mean, more = slow_texture(power, white_part, image.shape, texture, pairs)
        before.append(white(own, texture.values))
        after.append(white(own + more, texture.values - mean))
    before, after = np.array(before), np.array(after)
    assert np.linalg.eigvalsh(before.T @ before / len(before)).max() > 50
    # Without fluctuations the largest of 111 numbers in 60 draws is 5.6; the mean has the error 0.13.
    assert np.linalg.eigvalsh(after.T @ after / len(after)).max() < 9
    assert 0.8 < np.square(after).mean() < 1.2
    assert np.abs(after.mean(0)).max() < 0.6
