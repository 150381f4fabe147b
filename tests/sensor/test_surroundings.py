"""Charge beyond the image: none, the same everywhere, or that of the image mirrored at its sides."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, SiliconSensor, draw_flat
from bfsensor._kernels import surroundings
from bfsensor._kernels.compile_options import from_python
from bfsensor._kernels.shifts import Charges
from bfsensor.errors import SensorError
from tests.kernels.plain_edges import charge_planes

KINDS = pytest.mark.parametrize("kind", [SiliconSensor, BrighterFatterSensor])
LEVEL = 2e4


def make(kind, surroundings, **options):
    return kind(rng=galsim.BaseDeviate(6121), surroundings=surroundings, **options)


def areas(kind, surroundings, pixels, **options):
    sensor = make(kind, surroundings, **options)
    return sensor.calculate_pixel_areas(galsim.ImageD(np.array(pixels, float))).array


def uniform_light(count, side, seed):
    x, y = np.random.default_rng(seed).uniform(0.5, side + 0.5, (2, count))
    return galsim.PhotonArray(count, x, y, np.ones(count))


@KINDS
@pytest.mark.parametrize("shape", [(30, 41), (3, 2), (1, 1), (600, 520)])
@pytest.mark.parametrize("surroundings", ["mirrored", LEVEL])
def test_a_uniform_image_has_pixels_of_one_area(kind, shape, surroundings):
    found = areas(kind, surroundings, np.full(shape, LEVEL))
    assert np.abs(found - 1).max() < 1e-6


@KINDS
def test_without_surroundings_the_frame_is_small(kind):
    found = areas(kind, "none", np.full((30, 30), LEVEL))
    assert found[0].mean() < 0.994 and abs(found[12:18, 12:18] - 1).max() < 1e-3
    # By definition the same as no charge, whatever it is called.
    assert (found == areas(kind, 0.0, np.full((30, 30), LEVEL))).all()
    assert (
        found == kind().calculate_pixel_areas(galsim.ImageD(30, 30, init_value=LEVEL)).array
    ).all()


@KINDS
@pytest.mark.parametrize("shape", [(16, 20), (9, 8)])
def test_mirrored_charge_is_that_of_an_image_with_its_mirror_images(kind, shape):
    """The middle of three by three copies, every second one mirrored, has the same areas."""
    pixels = np.random.default_rng(3).uniform(0, 9e4, shape)
    ny, nx = shape
    whole = np.pad(pixels, ((ny, ny), (nx, nx)), mode="symmetric")
    found = areas(kind, "mirrored", pixels)
    # The copies end 8 pixels away; charge acts up to 5 pixels from a corner, its background to 6.
    expected = areas(kind, "none", whole)[ny : 2 * ny, nx : 2 * nx]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@KINDS
def test_uniform_charge_is_that_of_a_frame(kind):
    pixels = np.random.default_rng(4).uniform(0, 9e4, (14, 12))
    found = areas(kind, LEVEL, pixels)
    framed = areas(kind, "none", np.pad(pixels, 24, constant_values=LEVEL))[24:-24, 24:-24]
    # Next to the image a frame's pixels know its charge, those of a given level do not: their
    # response to charge depends on that of their neighbours a little.
    assert np.abs(found - framed).max() < (1e-7 if kind is SiliconSensor else 1e-3)
    assert np.abs(found - areas(kind, "none", pixels)).max() > 5e-3


@KINDS
@pytest.mark.parametrize("dense", [False, True])
def test_photons_meet_the_mirror_image_as_it_is_at_each_renewal(kind, dense):
    """In blocks, resumed or not, the padding mirrors the effective charge after every block."""
    sensor = make(kind, "mirrored", nrecalc=2000.0)
    image = galsim.ImageD(19, 23)
    sensor.accumulate(uniform_light(500, 1, 7), image)
    if dense:
        # Every pixel changes: the whole image is taken again.
        sensor._exposure.ledger.counters[2] = 1
    sensor.accumulate(uniform_light(30_000, 18, 8), image, resume=True)
    charges = sensor._exposure.charges
    pad, shape = charges.pad, (charges.ny + 2 * charges.pad, charges.stride)
    seen = 0
    for array in charge_planes(charges):
        grid = array[: shape[0] * shape[1]].reshape(shape)[:, : charges.nx + 2 * pad]
        inner = grid[pad:-pad, pad:-pad]
        np.testing.assert_array_equal(grid, np.pad(inner, pad, mode="symmetric"))
        seen += int(inner.max() > 10)
    assert seen >= 1


@KINDS
def test_bright_light_at_the_side_lands_as_in_a_larger_image(kind):
    """A star on a side and its mirror image beyond it leave that side where it was."""
    count = 60_000
    rng = np.random.default_rng(51)
    x, y = rng.normal(0.0, 1.0, (2, count)) + np.array([[0.5], [8.0]])
    x = 0.5 + np.abs(x - 0.5)
    half = galsim.ImageD(galsim.BoundsI(1, 12, 1, 15))
    options = {"diffusion_factor": 0.0, "nrecalc": 1000.0}
    make(kind, "mirrored", **options).accumulate(
        galsim.PhotonArray(count, x, y, np.ones(count)), half
    )
    whole = galsim.ImageD(galsim.BoundsI(-11, 12, 1, 15))
    both = np.empty((2, 2 * count))
    both[:, ::2] = x, y
    both[:, 1::2] = 1.0 - x, y
    options["nrecalc"] = 2000.0
    make(kind, "none", **options).accumulate(
        galsim.PhotonArray(2 * count, *both, np.ones(2 * count)), whole
    )
    # The same photons and renewals; a table is mirror-symmetric to 1e-3 of its shifts.
    right = whole.array[:, 12:]
    assert np.abs(half.array - right).max() < 0.004 * right.max()
    alone = galsim.ImageD(galsim.BoundsI(1, 12, 1, 15))
    options["nrecalc"] = 1000.0
    make(kind, "none", **options).accumulate(
        galsim.PhotonArray(count, x, y, np.ones(count)), alone
    )
    # Without the mirror image other electrons cross the boundaries.
    wrong, right = (abs(image.array - right).sum() for image in (alone, half))
    assert right < 0.2 * wrong and wrong > 50, (right, wrong)


@KINDS
def test_threads_and_chunks_change_nothing(kind):
    images = []
    for cuts in ((), (4000, 9000)):
        sensor = make(kind, "mirrored", nrecalc=1500.0)
        image = galsim.ImageF(20, 20)
        light = uniform_light(12_000, 20, 33)
        ends = [0, *cuts, 12_000]
        for n in range(len(ends) - 1):
            part = slice(ends[n], ends[n + 1])
            photons = galsim.PhotonArray(
                ends[n + 1] - ends[n], light.x[part], light.y[part], light.flux[part]
            )
            sensor.accumulate(photons, image, resume=n > 0)
        images.append(image.array)
    assert (images[0] == images[1]).all()


@KINDS
def test_flats_need_no_frame_that_is_drawn_and_cut_off(kind):
    level, shape = 4e4, (40, 40)
    mirrored = make(kind, "mirrored")
    flats = [
        draw_flat(mirrored, shape, level, rng=galsim.BaseDeviate(n)).array
        for n in range(12)
    ]
    sides = np.mean([np.concatenate([f[0], f[-1], f[:, 0], f[:, -1]]) for f in flats])
    # 1920 pixels of 200 e- scatter: 5 e-; without charge outside the frame is 1 % low, 400 e-.
    assert abs(sides - level) < 25
    bare = draw_flat(make(kind, "none"), shape, level, rng=galsim.BaseDeviate(0), border=0)
    assert bare.array[0].mean() < 0.995 * level
    # Without surroundings a frame is drawn, as ever.
    options = {"rng": galsim.BaseDeviate(5)}
    by_default = draw_flat(make(kind, "none"), (9, 9), level, **options).array
    options = {"rng": galsim.BaseDeviate(5), "border": 8}
    assert (
        by_default == draw_flat(make(kind, "none"), (9, 9), level, **options).array
    ).all()


@pytest.mark.parametrize("each", [1, 3])
@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (7, 3), (30, 12)])
def test_single_pixels_are_mirrored_as_the_whole_image(shape, each):
    ny, nx = shape
    pad, stride = 7, nx + 14 + 16
    none = np.zeros(0, np.float32)
    charges = Charges(none, none, stride, pad, nx, ny, none, none, np.zeros(0, np.int64))
    whole = np.zeros(each * ((ny + 2 * pad) * stride + 16), np.float32)
    size = each * (ny + 2 * pad) * stride
    grid = whole[:size].reshape(-1, stride, each)[:, : nx + 2 * pad]
    pixels = np.random.default_rng(1).uniform(1, 2, (*shape, each)).astype(np.float32)
    grid[pad : pad + ny, pad : pad + nx] = pixels
    one = whole.copy()
    mirror_all, mirror_pixel = map(
        from_python, (surroundings.mirror_all, surroundings.mirror_pixel)
    )
    mirror_all(charges, whole, each)
    around = (pad, pad), (pad, pad), (0, 0)
    np.testing.assert_array_equal(grid, np.pad(pixels, around, mode="symmetric"))
    for j in range(ny):
        for i in range(nx):
            mirror_pixel(charges, one, each, j, i)
    np.testing.assert_array_equal(one, whole)


@KINDS
@pytest.mark.parametrize("value", ["sky", -1.0, float("nan"), float("inf"), None])
def test_other_surroundings_are_refused(kind, value):
    with pytest.raises(SensorError, match=r"surroundings = .*mirrored"):
        make(kind, value)


@KINDS
def test_surroundings_are_written_compared_and_given_as_text(kind):
    import pickle

    import bfsensor

    sensor = make(kind, "2e4")
    assert sensor.surroundings == LEVEL and sensor != make(kind, "none")
    assert sensor == pickle.loads(pickle.dumps(sensor))
    again = eval(repr(sensor), {"bfsensor": bfsensor, "galsim": galsim, "inf": np.inf})
    image = galsim.ImageD(5, 5, init_value=LEVEL)
    assert abs(again.calculate_pixel_areas(image).array - 1).max() < 1e-6
