"""What GalSim and imSim ask of a sensor, held by both of ours."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise

import galsim
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import bfsensor
from bfsensor import BrighterFatterSensor, SensorError, SiliconSensor

BOTH = pytest.mark.parametrize("kind", [SiliconSensor, BrighterFatterSensor])


def make(kind, **options):
    return kind(rng=galsim.BaseDeviate(6007), **options)


def photons(count=30_000, seed=71, *, full=False, flux=1.0, width=2.0):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0, width, (2, count))
    extra = {}
    if full:
        extra = {
            "dxdz": rng.normal(0, 0.1, count), "dydz": rng.normal(0, 0.1, count),
            "wavelength": rng.uniform(400, 1000, count),
        }  # fmt: skip
    return galsim.PhotonArray(count, x, y, np.full(count, flux), **extra)


def blank(side=21, dtype=np.float32):
    image = galsim.Image(side, side, dtype=dtype)
    image.setCenter(0, 0)
    return image


def part(all_photons, lo, hi):
    some = galsim.PhotonArray(hi - lo)
    if hi == lo:
        return some
    some.copyFrom(all_photons, source_indices=slice(lo, hi))
    return some


@BOTH
def test_pickle_copy_compare_and_repr(kind):
    sensor = make(kind)
    galsim.utilities.check_pickle(sensor)
    assert sensor == kind(rng=galsim.BaseDeviate(6007))
    assert sensor != make(kind, strength=2.0)
    assert sensor != make(kind, nrecalc=7.0)
    assert sensor != kind(rng=galsim.BaseDeviate(6008))
    assert sensor != galsim.SiliconSensor(rng=galsim.BaseDeviate(6007))
    assert copy.deepcopy(sensor) == sensor
    assert isinstance(sensor, galsim.SiliconSensor)
    with pytest.raises(TypeError):
        hash(sensor)
    again = eval(repr(sensor), {"galsim": galsim, "bfsensor": bfsensor, "inf": np.inf})
    assert again._key() == sensor._key()  # generators do not come back from their repr
    image = blank()
    sensor.accumulate(photons(), image)
    assert pickle.loads(pickle.dumps(sensor))._last_image is None


@BOTH
def test_generator(kind):
    rng = galsim.BaseDeviate(88)
    sensor = kind(rng=rng)
    assert sensor.rng.raw() == galsim.BaseDeviate(88).raw()
    images = []
    for _ in range(2):
        sensor.updateRNG(galsim.BaseDeviate(1234))
        images.append(blank())
        sensor.accumulate(photons(), images[-1])
    np.testing.assert_array_equal(images[0].array, images[1].array)
    fresh = blank()
    sensor.accumulate(photons(), fresh)
    assert not np.array_equal(fresh.array, images[0].array)
    with pytest.raises(TypeError):
        sensor.updateRNG([3.5])


def spoiled(field, value):
    bad = photons(full=True)
    getattr(bad, field)[11] = value
    return bad


@BOTH
def test_refusals_leave_the_image_alone(kind):
    sensor = make(kind)
    image = blank()
    image.array[...] = 3.0
    good = photons()
    with pytest.raises(galsim.GalSimError, match="not without it before"):
        sensor.accumulate(good, image, resume=True)
    for field in ("x", "y", "flux", "dxdz", "dydz", "wavelength"):
        with pytest.raises(
            SensorError, match=f"photon 11: {field if field[0] != 'd' else 'slope_'}"
        ):
            sensor.accumulate(spoiled(field, np.nan), image)
        if field != "wavelength":
            with pytest.raises(SensorError, match="photon 11"):
                sensor.accumulate(spoiled(field, np.inf), image)
    with pytest.raises(galsim.GalSimUndefinedBoundsError):
        sensor.accumulate(good, galsim.Image(dtype=np.float32))
    with pytest.raises(TypeError, match="float32 or float64, not int32"):
        sensor.accumulate(good, galsim.ImageI(9, 9))
    with pytest.raises(galsim.GalSimImmutableError):
        sensor.accumulate(good, image.view(make_const=True))
    dirty = blank()
    dirty.array[3, 3] = np.nan
    with pytest.raises(SensorError, match="the image holds values that are not finite"):
        sensor.accumulate(good, dirty)
    assert np.all(image.array == 3.0)
    # And it works as if nothing had been.
    sensor.accumulate(good, image)
    other = blank()
    other.array[...] = 3.0
    make(kind).accumulate(good, other)
    np.testing.assert_array_equal(image.array, other.array)
    with pytest.raises(galsim.GalSimError, match="an image other than"):
        sensor.accumulate(good, other, resume=True)


@BOTH
@pytest.mark.parametrize("full", [False, True])
@settings(max_examples=8, deadline=None)
@given(cuts=st.lists(st.integers(0, 30_000), max_size=6))
def test_pieces_equal_one_call(kind, full, cuts):
    """Bit for bit, in single precision and with fractional flux too."""
    everything = photons(full=full, flux=0.73)
    whole = blank()
    total = make(kind, nrecalc=1500.0).accumulate(everything, whole)
    pieces = blank()
    sensor = make(kind, nrecalc=1500.0)
    at = [0, *sorted(cuts), len(everything)]
    parts = [
        sensor.accumulate(part(everything, lo, hi), pieces, resume=n > 0)
        for n, (lo, hi) in enumerate(pairwise(at))
    ]
    np.testing.assert_array_equal(whole.array, pieces.array)
    assert sum(parts) == pytest.approx(total, rel=1e-12)


@BOTH
def test_threads_do_not_matter(kind):
    everything = photons(300_000, full=True)
    images = []
    for threads in (1, 2):
        sensor = make(kind)
        sensor.threads = threads
        images.append(blank())
        sensor.accumulate(everything, images[-1])
    np.testing.assert_array_equal(images[0].array, images[1].array)


@BOTH
def test_views_and_types(kind):
    everything = photons()
    plain = blank(dtype=np.float64)
    make(kind).accumulate(everything, plain)
    for dtype in (np.float32, np.float64):
        big = np.zeros((42, 63), dtype)
        for view in (big[::2, ::3], big[::-2, ::-3], big[:21, :21]):
            view[...] = 0
            image = galsim.Image(view)
            image.setCenter(0, 0)
            make(kind).accumulate(everything, image)
            np.testing.assert_array_equal(view, plain.array)
    for shape in ((1, 1), (3, 1), (1, 40)):
        image = galsim.Image(*shape, dtype=np.float32)
        image.setCenter(0, 0)
        added = make(kind).accumulate(everything, image)
        assert 0 < added == image.array.sum() < len(everything)


@BOTH
def test_flux_of_any_sign_and_size(kind):
    mixed = photons(20_000)
    mixed.flux[::3] = -1.0
    mixed.flux[::7] = 0.0
    image = blank(dtype=np.float64)
    sensor = make(kind, nrecalc=500.0)
    added = sensor.accumulate(mixed, image)
    assert added == image.array.sum()
    off = sensor.diagnostics["off_image"]
    assert added + off == mixed.flux.sum()
    empty = blank()
    assert sensor.accumulate(galsim.PhotonArray(0), empty) == 0.0
    far = galsim.PhotonArray(3, np.array([1e9, -1e300, 50.0]), np.zeros(3), np.ones(3))
    assert sensor.accumulate(far, empty) == 0.0
    heavy = photons(2000, flux=500.0)
    sensor.accumulate(heavy, image)
    assert np.all(np.isfinite(image.array))


def test_nrecalc_by_hand_equals_automatic():
    everything = photons(40_000, full=True)
    automatic = blank()
    make(SiliconSensor, nrecalc=4000).accumulate(everything, automatic)
    by_hand = blank()
    sensor = make(SiliconSensor, nrecalc=0)
    for n in range(10):
        some = part(everything, 4000 * n, 4000 * (n + 1))
        sensor.accumulate(some, by_hand, resume=n > 0, recalc=True)
    np.testing.assert_array_equal(automatic.array, by_hand.array)


@BOTH
def test_transpose_exchanges_the_axes(kind):
    rng = np.random.default_rng(5)
    image = galsim.ImageD(rng.uniform(0, 9e4, (17, 17)))
    turned = galsim.ImageD(image.array.T.copy())
    areas = make(kind).calculate_pixel_areas(image).array
    other = make(kind, transpose=True).calculate_pixel_areas(turned).array
    # Single precision of the sums, added in another order.
    np.testing.assert_allclose(areas, other.T, atol=2e-7)
    assert np.abs(areas - make(kind).calculate_pixel_areas(turned).array.T).max() > 1e-3


@BOTH
@pytest.mark.parametrize("method", ["phot", "fft"])
def test_draw_image(kind, method):
    star = galsim.Gaussian(sigma=0.5, flux=3e5)
    image = star.drawImage(
        nx=33, ny=33, scale=0.3, method=method, sensor=make(kind),
        rng=galsim.BaseDeviate(41), **({"maxN": 10_000} if method == "phot" else {}),
    )  # fmt: skip
    assert image.added_flux == pytest.approx(image.array.sum(dtype=float), rel=1e-6)
    assert image.array.sum() == pytest.approx(3e5, rel=0.01)


def pool(sensor):
    """Draw batches of objects into one image, as photon pooling does."""
    image = galsim.ImageF(200, 200)
    for batch in range(3):
        for sub in range(2):
            some = photons(20_000, seed=100 + 10 * batch + sub, full=True, width=3.0)
            some.x += 60.0 + 30 * sub
            some.y += 100.0
            sensor.accumulate(
                some, image, resume=batch + sub > 0, recalc=sub == 0 and batch > 0
            )
    return image.array


@BOTH
def test_photon_pooling_in_processes(kind):
    """One sensor, nrecalc = 0, one float32 image, boundaries renewed once a batch."""
    sensor = make(kind, nrecalc=0)
    with ProcessPoolExecutor(1) as executor:
        away = executor.submit(pool, sensor).result()
    here = pool(make(kind, nrecalc=0))
    np.testing.assert_array_equal(away, here)
    assert here.sum() > 100_000
