"""Fluxes of spots: their errors hold what differs between spots."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr

from bfsensor.diagnose.data.spot_channels import (
    STAMP,
    WING,
    WINGS_ALIKE,
    SpotChannels,
    stamp_moments,
)

SIDE, PITCH, WIDTH, FLUX = 192, 30, 1.1, 2e5


def exposure_of(rng: np.random.Generator, scatter: float, part: float = 1.0) -> np.ndarray:
    """Gaussian spots on a grid, each of its own brightness [e-]."""
    image = np.zeros((SIDE, SIDE))
    y, x = np.indices(image.shape)
    for cy in range(20, SIDE - 15, PITCH):
        for cx in range(20, SIDE - 15, PITCH):
            dx, dy = rng.uniform(-0.5, 0.5, 2)
            r2 = (x - cx - dx) ** 2 + (y - cy - dy) ** 2
            peak = FLUX * (1 + scatter * rng.standard_normal()) / (2 * np.pi * WIDTH**2)
            image += peak * np.exp(-r2 / (2 * WIDTH**2))
    return rng.poisson(part * image) + rng.normal(0.0, 4.0, image.shape)


@pytest.mark.parametrize("scatter", [0.0, 0.02])
def test_fluxes_scatter_between_exposures_as_their_errors_say(scatter: float) -> None:
    rng = np.random.default_rng(1618)
    channels = SpotChannels(read_noise=4.0, lamp_error=2e-4)
    for number in range(24):
        shot = SimpleNamespace(
            number=number, exposure_time=5.0, lamp=1.0, wavelength=None, back_bias=None,
            temperature=None, mjd=None,
        )  # fmt: skip
        assert channels.add(shot, exposure_of(rng, scatter)) is None
    channel = channels.channels()[0]
    flux = channel.axes["what"] == "flux"
    pulls = ((channel.values - channel.values[flux].mean()) / channel.errors)[flux]
    # Of 24 the scatter is known to 15 %; without scatter the assumed 1e-3 is more than there is.
    assert pulls.std(ddof=1) < 1.5
    if scatter:
        assert pulls.std(ddof=1) > 0.55


def shot_of(number: int) -> SimpleNamespace:
    return SimpleNamespace(
        number=number, exposure_time=5.0, lamp=1.0, wavelength=None, back_bias=None,
        temperature=None, mjd=None,
    )  # fmt: skip


@pytest.mark.parametrize("part", [0.0, 0.02])
def test_fluxes_know_the_error_of_their_zero(part: float) -> None:
    """Telegraph noise counts in a flux and not in its background, which is clipped."""
    rng = np.random.default_rng(1618)
    channels = SpotChannels(read_noise=4.0, lamp_error=2e-4)
    for number in range(12):
        image = exposure_of(rng, 0.0) / 40
        image += 30.0 * (rng.random(image.shape) < part)
        assert channels.add(shot_of(number), image) is None
    channel = channels.channels()[0]
    flux = channel.axes["what"] == "flux"
    light = FLUX / 40
    excess = channel.values[flux].mean() - light
    error = channel.errors[flux].mean()
    # An excess of a hundred electrons, of five thousand, is no light; without noise of that kind
    # the error is that of the lamp and of counting 36 times 5,000 electrons.
    assert (excess > 60.0) == bool(part) and (error > 0.3 * excess or not part)
    assert 10.0 < error < 15.0 or part


def test_errors_of_faint_spots_are_those_of_counting():
    """The scatter between exposures of much light says little of those of a fortieth of it."""
    rng = np.random.default_rng(1619)
    channels = SpotChannels(read_noise=4.0, lamp_error=1e-6)
    for number in range(36):
        shot, part = shot_of(number), 1.0 if number < 24 else 1 / 40
        shot.exposure_time *= part
        assert channels.add(shot, exposure_of(rng, 0.0, part)) is None
    channel = channels.channels()[0]
    flux = channel.axes["what"] == "flux"
    for wanted, own in (
        (FLUX, channel.axes["time"] > 1),
        (FLUX / 40, channel.axes["time"] < 1),
    ):
        pulls = ((channel.values - wanted) / channel.errors)[flux & own]
        assert 0.6 < pulls.std(ddof=1) < 1.5


@pytest.mark.parametrize("width", [1.1, 1.75])
def test_skewness_does_not_depend_on_the_place_in_the_pixel(width: float) -> None:
    edges = np.arange(22) - 10.5
    places = np.array([[0.0, 0.0], [0.4, -0.3], [-0.45, 0.2]])
    lines = np.diff(ndtr((edges - places[..., None]) / width), axis=-1)
    wide = 1e5 * lines[:, 1, :, None] * lines[:, 0, None, :]
    found = stamp_moments(wide, *places.T)
    assert np.abs([found["skew_x"], found["skew_y"]]).max() < 2e-4


def test_wings_do_not_depend_on_places_within_pixels():
    """A square with sharp ends holds 0.04 % less of a spot on the border of two pixels."""
    edges = np.arange(22) - 10.5
    places = np.random.default_rng(3).uniform(-0.5, 0.5, (40, 2))
    along = [np.diff(ndtr((edges - v[:, None]) / 1.5), axis=1) for v in places.T]
    wings = stamp_moments(1e6 * along[1][:, :, None] * along[0][:, None], *places.T)[
        "wings"
    ]
    assert np.ptp(wings) < 1e-5
    assert wings.mean() == pytest.approx(1.6e-3, rel=0.02)


@pytest.mark.parametrize(("light", "tail"), [(40.0, 2e-3), (0.05, 2e-3), (40.0, 0.0)])
def test_wings_are_known_to_a_part_of_the_background_and_of_their_tail(light, tail):
    """Pixels of wings hold 0.05 e- more or less than those beside; a tail is known to a tenth of it."""
    image = exposure_of(np.random.default_rng(4), 0.0) * light
    y, x = np.indices(image.shape)
    for cy in range(20, SIDE - 15, PITCH):
        for cx in range(20, SIDE - 15, PITCH):
            ring = np.abs(np.hypot(x - cx, y - cy) - 7.5) < 0.6
            image += tail * light * FLUX / 40 * ring
    channels = SpotChannels(read_noise=4.0, lamp_error=1e-6)
    assert channels.add(shot_of(0), image) is None
    channel = channels.channels()[0]
    (wings,) = np.flatnonzero(channel.axes["what"] == "wings")
    floor = 0.05 * (WING**2 - STAMP**2) / channel.axes["flux"][wings]
    tenth = 0.1 * abs(channel.values[wings])
    assert channel.errors[wings] > np.hypot(floor, tenth)
    # Beside them there is only the scatter between 36 spots.
    assert channel.errors[wings] ** 2 < 2 * (floor**2 + tenth**2) or light < 1 or not tail


def test_many_exposures_do_not_make_wings_of_spots_at_the_same_places_surer():
    """Whatever lies beside the spots lies there in all exposures: 40 know it no better than 10."""
    rng = np.random.default_rng(5)
    channels = SpotChannels(read_noise=4.0, lamp_error=1e-6)
    for number in range(12):
        assert channels.add(shot_of(number), exposure_of(rng, 0.0) * 40) is None
    channel = channels.channels()[0]
    wings = channel.axes["what"] == "wings"
    alike = channel.whiten(wings.astype(float))
    # The error of a departure that all have alike.
    assert alike @ alike < WINGS_ALIKE**-2
    assert (np.diff(np.flatnonzero(wings)) == 1).all() and wings.sum() == 12


def test_widths_have_the_covariance_of_their_scatter():
    """Light beside spots widens them along x and along y; few spots tell their scatter badly."""
    rng = np.random.default_rng(1620)
    channels = SpotChannels(read_noise=4.0, lamp_error=1e-3)
    y, x = np.indices((SIDE, SIDE))
    for number in range(60):
        image = exposure_of(rng, 0.0)
        # In each exposure half of the spots have a faint neighbour on a diagonal.
        for cy in range(20, SIDE - 15, PITCH):
            for cx in range(20, SIDE - 15, PITCH):
                far = (x - cx - 3) ** 2 + (y - cy - 3) ** 2
                image += rng.integers(2) * 400.0 * np.exp(-far / 2)
        assert channels.add(shot_of(number), image) is None
    (channel,) = channels.channels()
    kinds = channel.axes["what"]
    sizes = [channel.values[kinds == w] for w in ("sigma_x", "sigma_y")]
    told = np.mean([b for b in channel.blocks if len(b) == 2], axis=0)
    seen = np.cov(sizes)
    assert told[0, 1] / told[0, 0] == pytest.approx(seen[0, 1] / seen[0, 0], abs=0.2)
    np.testing.assert_allclose(np.diag(told), np.diag(seen), rtol=0.5)


def test_an_exposure_that_scatters_more_has_errors_of_its_own():
    rng = np.random.default_rng(1621)
    channels = SpotChannels(read_noise=4.0, lamp_error=1e-3)
    for number in range(6):
        image = exposure_of(rng, 0.0)
        if number == 3:
            struck = image[20::PITCH, 22::PITCH]
            struck += 6000.0 * rng.random(struck.shape)
        assert channels.add(shot_of(number), image) is None
    (channel,) = channels.channels()
    errors = channel.errors[channel.axes["what"] == "skew_x"]
    others = np.delete(errors, 3)
    assert errors[3] > 3 * others.max()
    np.testing.assert_allclose(others, others[0], rtol=0.05)
