"""Spots that earlier ones left: how much wider they make those that follow."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr

from bfsensor.diagnose.data.spot_channels import SpotChannels
from bfsensor.diagnose.data.spot_places import PlacedSpots, widening
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.persistence import Persistence
from tests.virtual import Size, measure_virtual, virtual_baseline

PIXELS, PITCH, SHARE = 256, 40, 0.01
SIGMAS = (1.05, 1.12), (1.1, 1.15)
"""Widths of later and of earlier spots along x and y [pixel]."""


def draw(places, flux, sigma):
    """Spots of an exposure, integrated over pixels."""
    edges = np.arange(PIXELS + 1) - 0.5
    image = np.zeros((PIXELS, PIXELS))
    for x, y in places:
        lines = [np.diff(ndtr((edges - c) / s)) for c, s in zip((x, y), sigma, strict=True)]
        image += flux * np.outer(lines[1], lines[0])
    return image


def measure(images, ghost=0.0):
    """With noise of the images alone, always the same; a ghost on the last of them."""
    spots = SpotChannels(read_noise=5.0, lamp_error=1e-4)
    rng = np.random.default_rng(4)
    for number, image in enumerate(images):
        exposure = SimpleNamespace(
            number=number, kind="spot", exposure_time=10.0, wavelength=620.0, lamp=1.0,
            back_bias=-60.0, temperature=173.15, mjd=None,
        )  # fmt: skip
        image = image + np.sqrt(image + 25.0) * rng.standard_normal(image.shape)
        last = number == len(images) - 1
        assert spots.add(exposure, image + ghost if last else image) is None
    return spots


@pytest.fixture(scope="module")
def places():
    """Places of spots in two exposures: in the second each moved by up to .5, and all by .3."""
    grid = np.arange(30.0, PIXELS - 29, PITCH)
    first = np.array([(x, y) for y in grid for x in grid])
    moved = np.random.default_rng(3).uniform(-0.5, 0.5, first.shape)
    moved[:, 0] += 0.3
    return first, first + moved


def test_a_ghost_widens_a_spot_as_said(places):
    first, second = places
    bright, faint = draw(first, 1e6, SIGMAS[1]), draw(second, 2e5, SIGMAS[0])
    ghost = draw(first, SHARE * 2e5, SIGMAS[1])
    clean, ghosted = measure([bright, faint]), measure([bright, faint], ghost)
    said = SHARE * widening([clean.placed[1]], [clean.placed[0]])[:, 0, 0]
    seen = [
        b**2 - a**2
        for a, b in zip(clean.placed[1].sigma, ghosted.placed[1].sigma, strict=True)
    ]
    # Nothing moved in y but each pinhole by itself: 1/12 of a pixel^2, in x .09 more.
    assert said[0] > said[1] > 0.0007
    np.testing.assert_allclose(seen, said, rtol=0.05, atol=5e-5)


def test_places_are_those_that_were_drawn(places):
    second = measure([draw(p, 3e5, SIGMAS[0]) for p in places]).placed[1]
    away = np.abs(second.places[:, None] - places[1]).max(-1).min(1)
    assert len(second.places) == len(places[1]) and away.max() < 0.02
    assert second.number == 1 and second.flux == pytest.approx(3e5, rel=0.01)


def test_of_other_pinholes_nothing_is_said():
    one = PlacedSpots(1, 1e5, (1.0, 1.0), np.arange(20.0).reshape(10, 2) * 30)
    other = one._replace(places=one.places + 12.0)
    assert not widening([one], [other]).any()


def test_held_out_spots_leave_ghosts_too():
    """The fourth and the ninth of ten are held out; the fifth is a faint one after a bright one."""
    size = Size(192, 2, 0, dithers=5, flat_seconds=(5.0, 20.0), spot_seconds=(1.25, 30.0))
    measured = measure_virtual(seed=12, size=size)
    bare = Predictor(measured, virtual_baseline())
    effect = Persistence({"frac": 1e-3, "tau": 2.0})
    with_it = bare.with_effects((effect,))
    channel = next(c for c in measured.channels if c.word == "spot" and c.fold == "fit")
    change = with_it.predict(channel, with_it.start) - bare.predict(channel, bare.start)
    fifth = channel.axes["exposure"] == measured.placed[4].number
    assert measured.placed[3].number not in channel.axes["exposure"]
    what, earlier = channel.axes["what"], measured.placed[:4]
    parts = 1e-3 * np.exp(-np.arange(4, 0, -1) / 2.0)
    ghosts = parts * [s.flux for s in earlier]
    # In the mean bias there are the ghosts of all spots, in four frames of eight.
    flux = float(change[fifth & (what == "flux")][0])
    assert 0.8 * ghosts.sum() < flux < ghosts.sum()
    wider = float(change[fifth & (what == "sigma_x")][0])
    share = ghosts / measured.placed[4].flux
    gained = widening([measured.placed[4]], earlier)[0, 0]
    sigma = measured.placed[4].sigma[0]
    assert wider == pytest.approx(float(share @ gained) / (2 * sigma), rel=0.25)
    # Most of both is the held-out one's.
    assert ghosts[3] > 0.5 * ghosts.sum() and share[3] * gained[3] > 0
