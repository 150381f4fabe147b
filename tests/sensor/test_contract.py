"""What GalSim and imSim ask of a sensor, held by both of ours."""

from __future__ import annotations

import copy
import inspect
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
RINGS = galsim.SiliconSensor.simple_treerings(0.3, 40.0, r_max=200.0)


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


def draw(sensor, all_photons=None, **options):
    """Pixels of one exposure."""
    image = blank(**options)
    sensor.accumulate(photons() if all_photons is None else all_photons, image)
    return image.array


# -- objects -------------------------------------------------------------------------------


def test_silicon_sensor_has_the_signature_of_galsim():
    """BrighterFatterSensor begins with it; its name is of another table, qdist all of it."""
    theirs = inspect.signature(galsim.SiliconSensor).parameters
    ours = inspect.signature(SiliconSensor).parameters
    assert {k: p.default for k, p in ours.items()} == {
        k: p.default for k, p in theirs.items()
    }
    assert list(inspect.signature(BrighterFatterSensor).parameters)[: len(theirs)] == list(
        theirs
    )
    for method in ("accumulate", "calculate_pixel_areas"):
        theirs = inspect.signature(getattr(galsim.SiliconSensor, method)).parameters
        for kind in (SiliconSensor, BrighterFatterSensor):
            ours = inspect.signature(getattr(kind, method)).parameters
            assert [(k, p.default) for k, p in ours.items()] == [
                (k, p.default) for k, p in theirs.items()
            ]


@BOTH
def test_pickle_copy_and_repr(kind):
    for options in (
        {},
        {"treering_func": RINGS, "treering_center": galsim.PositionD(3, 4)},
    ):
        sensor = make(kind, **options)
        galsim.utilities.check_pickle(sensor)
        # Drawing with a copy gives the same pixels.
        galsim.utilities.check_pickle(
            sensor, lambda s: draw(copy.deepcopy(s), photons(2000)).tolist()
        )
        assert copy.copy(sensor) == sensor == copy.deepcopy(sensor)
        assert copy.copy(sensor).rng is sensor.rng
        space = {"galsim": galsim, "bfsensor": bfsensor, "inf": np.inf, "array": np.array}
        again = eval(repr(sensor), space)
        assert again._key() == sensor._key()  # generators do not come back from their repr
        assert isinstance(str(sensor), str)
    assert isinstance(sensor, galsim.SiliconSensor)
    with pytest.raises(TypeError, match="unhashable"):
        hash(sensor)


@BOTH
def test_copies_begin_a_new_exposure(kind):
    sensor, image = make(kind), blank()
    sensor.accumulate(photons(), image)
    for other in (
        pickle.loads(pickle.dumps(sensor)),
        copy.copy(sensor),
        copy.deepcopy(sensor),
    ):
        assert other == sensor
        with pytest.raises(galsim.GalSimError, match="not without it before"):
            other.accumulate(photons(), image, resume=True)
    # The exposure of the sensor itself goes on.
    sensor.accumulate(photons(), image, resume=True)


DIFFERENT = {
    "name": "lsst_e2v_50_8", "strength": 2.0, "diffusion_factor": 0.5, "qdist": 2,
    "nrecalc": 7.0, "treering_func": RINGS, "treering_center": galsim.PositionD(1.0, 2.0),
    "transpose": True,
}  # fmt: skip


@BOTH
@pytest.mark.parametrize("key", DIFFERENT)
def test_sensors_differ_by_every_option(kind, key):
    value = DIFFERENT[key]
    if key == "name" and kind is BrighterFatterSensor:
        value = "e2v_ccd250"
    sensor = make(kind, **{key: value})
    assert getattr(sensor, key) == value
    assert sensor == make(kind, **{key: value})
    assert sensor != make(kind)


@BOTH
def test_sensors_differ_by_kind_and_generator(kind):
    galsim.utilities.check_all_diff(
        [
            make(SiliconSensor), make(BrighterFatterSensor),
            kind(rng=galsim.BaseDeviate(6008)), galsim.SiliconSensor(rng=galsim.BaseDeviate(6007)),
            galsim.Sensor(), "sensor",
        ],
        check_hash=False,
    )  # fmt: skip


@BOTH
def test_rings_must_be_tables_and_positions(kind):
    for wrong in (lambda r: r, 0.3, np.zeros(4), "rings.txt"):
        with pytest.raises(TypeError, match=r"treering_func must be a galsim.LookupTable"):
            kind(treering_func=wrong)
    for wrong in ((3.0, 4.0), None, galsim.PositionI(3, 4), "here"):
        with pytest.raises(TypeError, match=r"treering_center must be a galsim.PositionD"):
            kind(treering_func=RINGS, treering_center=wrong)


# -- random numbers ------------------------------------------------------------------------


@BOTH
def test_generator_is_shared(kind):
    rng = galsim.BaseDeviate(88)
    sensor = kind(rng=rng)
    assert sensor.rng.raw() == galsim.BaseDeviate(88).raw()
    # One generator: what either takes is gone for both.
    rng.discard(5)
    twin = galsim.BaseDeviate(88)
    twin.discard(6)
    assert sensor.rng == galsim.UniformDeviate(twin)
    draw(sensor)
    assert rng != twin
    # Two sensors that share one draw other electrons; two alike draw the same.
    first, second = (draw(kind(rng=rng)) for _ in range(2))
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(draw(make(kind)), draw(make(kind)))
    # A copy has its own.
    alone = copy.deepcopy(sensor)
    before = sensor.rng.serialize()
    draw(alone)
    assert sensor.rng.serialize() == before != alone.rng.serialize()


@BOTH
def test_update_rng_restarts_and_shares(kind):
    sensor = kind(rng=galsim.BaseDeviate(88))
    images = []
    for _ in range(2):
        rng = galsim.BaseDeviate(1234)
        sensor.updateRNG(rng)
        images.append(draw(sensor))
        assert sensor.rng == galsim.UniformDeviate(rng)  # it has gone on as well
    np.testing.assert_array_equal(*images)
    np.testing.assert_array_equal(images[0], draw(kind(rng=galsim.BaseDeviate(1234))))
    assert not np.array_equal(draw(sensor), images[0])
    for wrong in ([3.5], {}, galsim.Sensor()):
        with pytest.raises(TypeError):
            sensor.updateRNG(wrong)


@BOTH
def test_an_exposure_keeps_its_random_numbers(kind):
    """GalSim updates the generator before every stamp; a resumed exposure goes on as it was."""
    everything, image = photons(), blank()
    sensor = make(kind)
    for n in range(3):
        sensor.accumulate(
            part(everything, 10_000 * n, 10_000 * (n + 1)), image, resume=n > 0
        )
        sensor.updateRNG(galsim.BaseDeviate(500 + n))
    np.testing.assert_array_equal(image.array, draw(make(kind)))


# -- refusals ------------------------------------------------------------------------------


def spoiled(field, value):
    bad = photons(full=True)
    getattr(bad, field)[11] = value
    return bad


def bad_photons():
    """Photons that no sensor takes, and how the message begins."""
    for field in ("x", "y", "flux", "dxdz", "dydz", "wavelength"):
        name = {"dxdz": "slope_x", "dydz": "slope_y"}.get(field, field)
        # Light of infinite wavelength is not absorbed: that is no error.
        for value in (np.nan, np.inf, -np.inf)[: 1 if field == "wavelength" else 3]:
            yield spoiled(field, value), f"photon 11: {name} = {value} is not a finite"


@BOTH
@pytest.mark.parametrize("options", [{}, {"beyond": "error"}])
def test_refusals_change_nothing(kind, options):
    """Not the image, not the generator, not an exposure that can be resumed."""
    if options and kind is SiliconSensor:
        pytest.skip("SiliconSensor has no such option")
    sensor, image = make(kind, **options), blank()
    image.array[...] = 3.0
    good = photons()

    def refuse(error, message, some, target, **how):
        before = None if target is not image else target.array.copy()
        state = sensor.rng.serialize()
        with pytest.raises(error, match=message):
            sensor.accumulate(some, target, **how)
        assert sensor.rng.serialize() == state
        if before is not None:
            np.testing.assert_array_equal(target.array, before)

    def refuse_all(**how):
        for some, message in bad_photons():
            refuse(SensorError, message, some, image, **how)

    refuse(galsim.GalSimError, "not without it before", good, image, resume=True)
    refuse_all()
    dirty = blank()
    for value in (np.nan, np.inf):
        dirty.array[3, 3] = value
        refuse(SensorError, "the image holds values that are not finite", good, dirty)
        assert np.count_nonzero(dirty.array) == 1
    refuse(
        galsim.GalSimUndefinedBoundsError, "bounds", good, galsim.Image(dtype=np.float32)
    )
    for dtype in (np.int16, np.int32, np.uint16, np.uint32, np.complex64, np.complex128):
        integers = galsim.Image(9, 9, dtype=dtype)
        refuse(TypeError, "float32 or float64", good, integers)
        assert not np.any(integers.array)
    refuse(galsim.GalSimImmutableError, "writeable", good, image.view(make_const=True))
    assert np.all(image.array == 3.0)

    # And it works as if nothing had been, also between the pieces of an exposure.
    half = len(good) // 2
    sensor.accumulate(part(good, 0, half), image)
    refuse_all()
    refuse_all(resume=True)
    refuse_all(resume=True, recalc=True)
    other = blank()
    other.array[...] = 3.0
    message = "an image other than"
    refuse(galsim.GalSimError, message, good, other, resume=True)
    refuse(galsim.GalSimError, message, good, image.view(), resume=True)
    refuse(galsim.GalSimError, message, good, galsim.ImageI(9, 9), resume=True)
    assert np.all(other.array == 3.0)
    sensor.accumulate(part(good, half, len(good)), image, resume=True)
    make(kind, **options).accumulate(good, other)
    np.testing.assert_array_equal(image.array, other.array)


@BOTH
@pytest.mark.parametrize("values", [(np.inf, -np.inf), (-np.inf, np.inf)])
def test_infinities_of_both_signs_are_refused_without_warning(kind, values):
    # FAILS: _light and _check_finite (sensor/base.py) look at sums, and numpy warns of
    # inf - inf; a caller who turns warnings into errors gets a RuntimeWarning instead.
    bad = photons()
    bad.x[[7, 9]] = values
    with pytest.raises(SensorError, match="photon 7: x"):
        make(kind).accumulate(bad, blank())
    dirty = blank()
    dirty.array[3, [4, 5]] = values
    with pytest.raises(SensorError, match="the image holds values that are not finite"):
        make(kind).accumulate(photons(), dirty)


@BOTH
def test_photons_may_be_as_far_as_numbers_go(kind):
    # FAILS: as above; the sum of two finite positions overflows, and numpy warns.
    far = galsim.PhotonArray(2, np.full(2, 1.7e308), np.zeros(2), np.ones(2))
    assert make(kind).accumulate(far, blank()) == 0.0


@BOTH
def test_infinite_wavelengths_are_not_absorbed(kind):
    light = galsim.PhotonArray(100, np.zeros(100), np.zeros(100), np.ones(100),
                               wavelength=np.full(100, np.inf))  # fmt: skip
    added = make(kind).accumulate(light, blank())
    # Lengths are held at the end of the tables, 1450 nm: 0.1 mm absorb less than 1e-5.
    assert added == 0.0


# -- photons -------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("full", [False, True])
@settings(max_examples=15, deadline=None)
@given(
    cuts=st.lists(st.integers(0, 30_000), max_size=8),
    threads=st.integers(1, 2),
    signs=st.sampled_from([(1.0,), (1.0, -1.0, 1.0), (0.0, 2.5)]),
    dtype=st.sampled_from([np.float32, np.float64]),
)
def test_pieces_equal_one_call(kind, full, cuts, threads, signs, dtype):
    """Bit for bit: in single precision, with fractional, negative and no flux, on threads."""
    everything = photons(full=full, flux=0.73)
    everything.flux *= np.resize(signs, len(everything))
    whole, pieces = blank(dtype=dtype), blank(dtype=dtype)
    total = make(kind, nrecalc=1500.0).accumulate(everything, whole)
    sensor = make(kind, nrecalc=1500.0)
    sensor.threads = threads
    at = [0, *sorted(cuts), len(everything)]
    parts = [
        sensor.accumulate(part(everything, lo, hi), pieces, resume=n > 0)
        for n, (lo, hi) in enumerate(pairwise(at))
    ]
    np.testing.assert_array_equal(whole.array, pieces.array)
    # Sums of 3e4 numbers in another order: 3e4 eps of their moduli at most.
    assert sum(parts) == pytest.approx(total, abs=3e4 * 2.3e-16 * 55e3)


@pytest.mark.parametrize(
    ("kind", "options"), [(SiliconSensor, {}), (BrighterFatterSensor, {"predict": False})]
)
def test_nrecalc_by_hand_equals_automatic(kind, options):
    everything = photons(40_000, full=True)
    automatic = draw(make(kind, nrecalc=4000, **options), everything)
    by_hand = blank()
    sensor = make(kind, nrecalc=0, **options)
    for n in range(10):
        some = part(everything, 4000 * n, 4000 * (n + 1))
        sensor.accumulate(some, by_hand, resume=n > 0, recalc=True)
    np.testing.assert_array_equal(automatic, by_hand.array)
    # Without renewals the charge does not act: other pixels.
    assert not np.array_equal(draw(make(kind, nrecalc=0, **options), everything), automatic)


@BOTH
def test_precisions_agree(kind):
    """Whole electrons exactly; fractions to half of the last bit of the float32 pixel."""
    whole = photons(200_000)
    np.testing.assert_array_equal(
        draw(make(kind), whole), draw(make(kind), whole, dtype=np.float64)
    )
    parts = photons(200_000, flux=0.73)
    single = draw(make(kind), parts)
    double = draw(make(kind), parts, dtype=np.float64)
    # What a float32 pixel cannot hold is carried: one rounding, not 5000.
    error = np.abs(single - double) / np.spacing(double.astype(np.float32))
    assert error.max() < 0.51


@BOTH
def test_views(kind):
    """Steps, turned by 180 degrees, columns first: the same pixels, and no others change."""
    plain = draw(make(kind), dtype=np.float64)
    for dtype in (np.float32, np.float64):
        big = np.full((42, 63), 7.0, dtype)
        turned = np.full((21, 21), 7.0, dtype)
        for parent, view in (
            (big, big[::2, ::3]), (big, big[::-2, ::-3]), (big, big[:21, :21]),
            (turned, turned[::-1, ::-1]), (turned, turned.T),
        ):  # fmt: skip
            view[...] = 0
            image = galsim.Image(view)
            image.setCenter(0, 0)
            make(kind).accumulate(photons(), image)
            np.testing.assert_array_equal(view, plain)
            assert np.count_nonzero(parent == 7.0) >= parent.size - view.size
            view[...] = 7
        frame = galsim.Image(63, 42, dtype=dtype)
        frame.setOrigin(-20, -15)
        inner = frame[galsim.BoundsI(-10, 10, -10, 10)]
        make(kind).accumulate(photons(), inner)
        np.testing.assert_array_equal(inner.array, plain)
        assert frame.array.sum() == plain.sum()


@BOTH
@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (1, 3), (1, 40)])
def test_smallest_images(kind, shape):
    """At strength 0 each pixel is that of a larger image; photons beside it are lost."""
    image = galsim.Image(*shape, dtype=np.float32)
    image.setCenter(0, 0)
    large = galsim.ImageF(61, 61)
    large.setCenter(0, 0)
    added = make(kind, strength=0.0).accumulate(photons(), image)
    make(kind, strength=0.0).accumulate(photons(), large)
    np.testing.assert_array_equal(image.array, large[image.bounds].array)
    # And with shifts: what is added is what is in it.
    again = galsim.ImageF(image.bounds)
    added = make(kind).accumulate(photons(), again)
    assert 0 < added == again.array.sum() < len(photons())
    assert make(kind).calculate_pixel_areas(again).array.shape == shape[::-1]


@BOTH
def test_bounds_do_not_matter(kind):
    """An image and its photons elsewhere, rings kept in place by orig_center: same pixels."""
    options = {"treering_func": RINGS, "treering_center": galsim.PositionD(-35.0, 20.0)}
    here = photons()
    here.x = np.round(here.x * 2**20) / 2**20  # exact when moved
    here.y = np.round(here.y * 2**20) / 2**20
    image = blank()
    make(kind, **options).accumulate(here, image)
    for dx, dy in ((1000, -77), (-4095, 3)):
        moved = galsim.PhotonArray(len(here), here.x + dx, here.y + dy, here.flux)
        other = galsim.ImageF(image.bounds.shift(galsim.PositionI(dx, dy)))
        center = galsim.PositionI(-dx, -dy)
        make(kind, **options).accumulate(moved, other, orig_center=center)
        np.testing.assert_array_equal(other.array, image.array)
        areas, others = (
            make(kind, **options).calculate_pixel_areas(i, c)
            for i, c in ((image, galsim.PositionI(0, 0)), (other, center))
        )
        np.testing.assert_array_equal(areas.array, others.array)
        assert others.bounds == other.bounds
    make(kind, **options).accumulate(moved, other)
    assert not np.array_equal(other.array, image.array)


@BOTH
def test_flux_of_any_sign_and_size(kind):
    mixed = photons(20_000)
    mixed.flux[::3] = -1.0
    mixed.flux[::7] = 0.0
    image = blank(dtype=np.float64)
    sensor = make(kind, nrecalc=500.0)
    added = sensor.accumulate(mixed, image)
    assert added == image.array.sum()
    assert added + sensor.diagnostics["off_image"] == mixed.flux.sum()
    assert sensor.diagnostics["photons"] == 20_000
    # All negative: charge below zero, everything counted.
    negative = blank(dtype=np.float64)
    added = make(kind).accumulate(photons(flux=-2.0), negative)
    assert added == negative.array.sum() < -50_000
    assert negative.array.max() <= 0
    sensor.accumulate(photons(2000, flux=500.0), image)
    assert np.all(np.isfinite(image.array))


@BOTH
def test_nothing_changes_nothing(kind):
    """No photons, photons without flux, and photons far from the image."""
    start = np.random.default_rng(661).uniform(0, 5e4, (21, 21)).astype(np.float32)
    far = galsim.PhotonArray(4, np.array([1e9, -1e300, 50.0, 10.6]),
                             np.array([0.0, 5.0, -1e15, -40.0]), np.ones(4))  # fmt: skip
    for nothing in (galsim.PhotonArray(0), photons(flux=0.0), far):
        image = blank()
        image.array[...] = start
        sensor = make(kind)
        assert sensor.accumulate(nothing, image) == 0.0
        np.testing.assert_array_equal(image.array, start)
        assert sensor.accumulate(nothing, image, resume=True, recalc=True) == 0.0
        np.testing.assert_array_equal(image.array, start)
        assert sensor.diagnostics["off_image"] == (8.0 if nothing is far else 0.0)


@BOTH
def test_charge_in_the_image_acts(kind):
    """The same photons on a filled pixel and on an empty one; the charge itself stays."""
    filled = blank(dtype=np.float64)
    filled.array[10, 10] = 1e5
    make(kind).accumulate(photons(100_000), filled)
    filled.array[10, 10] -= 1e5
    empty = draw(make(kind), photons(100_000), dtype=np.float64)
    # Near 10 % of the 4000 photons of the pixel go elsewhere; those moved by diffusion are
    # the same in both.
    assert 0.8 < filled.array[10, 10] / empty[10, 10] < 0.97


@BOTH
def test_what_others_add_between_calls_stays(kind):
    """ImSim draws stars by Fourier transform into the image whose photons it pools."""
    everything = photons()
    image, sensor = blank(), make(kind, strength=0.0)
    sensor.accumulate(part(everything, 0, 10_000), image)
    image.array[...] += 100
    sensor.accumulate(part(everything, 10_000, 30_000), image, resume=True, recalc=True)
    np.testing.assert_array_equal(image.array - 100, draw(make(kind, strength=0.0)))


# -- areas ---------------------------------------------------------------------------------


@BOTH
def test_transpose_exchanges_the_axes(kind):
    rng = np.random.default_rng(5)
    image = galsim.ImageD(rng.uniform(0, 9e4, (17, 17)))
    turned = galsim.ImageD(image.array.T.copy())
    for rings in ({}, {"treering_func": RINGS}):
        here, there = rings, rings
        if rings:
            here = rings | {"treering_center": galsim.PositionD(-30, 12)}
            there = rings | {"treering_center": galsim.PositionD(12, -30)}
        areas = make(kind, **here).calculate_pixel_areas(image).array
        other = make(kind, transpose=True, **there).calculate_pixel_areas(turned).array
        # Shifts of 0.1 are sums of some 200 single precision terms in another order: 1e-7.
        np.testing.assert_allclose(areas, other.T, rtol=0, atol=1e-7)
        unturned = make(kind, **there).calculate_pixel_areas(turned).array
        assert np.abs(areas - unturned.T).max() > 1e-3


@BOTH
def test_areas_of_images_of_any_kind(kind):
    charge = np.random.default_rng(9).uniform(0, 9e4, (9, 12)).astype(np.float32)
    double = make(kind).calculate_pixel_areas(galsim.ImageD(charge.astype(float)))
    single = make(kind).calculate_pixel_areas(galsim.ImageF(charge))
    assert (double.dtype, single.dtype) == (np.float64, np.float32)
    np.testing.assert_array_equal(single.array, double.array.astype(np.float32))
    assert double.bounds == single.bounds == galsim.BoundsI(1, 12, 1, 9)
    assert np.abs(double.array - 1).max() > 0.01
    turned = galsim.ImageD(charge[::-1, ::-1].astype(float))
    view = galsim.Image(turned.array[::-1, ::-1])
    np.testing.assert_array_equal(
        make(kind).calculate_pixel_areas(view).array, double.array
    )
    with pytest.raises(TypeError, match="float32 or float64"):
        make(kind).calculate_pixel_areas(galsim.ImageI(9, 9))
    with pytest.raises(galsim.GalSimUndefinedBoundsError):
        make(kind).calculate_pixel_areas(galsim.ImageD())
    dirty = galsim.ImageD(9, 9)
    dirty.array[3, 3] = np.nan
    with pytest.raises(SensorError, match="not finite"):
        make(kind).calculate_pixel_areas(dirty)


@BOTH
def test_areas_of_an_image_that_must_not_change(kind):
    # FAILS: calculate_pixel_areas only reads, and GalSim's takes const images; ours asks
    # for one that can be written to (_pixels in sensor/base.py).
    image = galsim.ImageD(9, 9)
    image.array[4, 4] = 1e5
    areas = make(kind).calculate_pixel_areas(image.view(make_const=True))
    want = make(kind).calculate_pixel_areas(image).array
    np.testing.assert_array_equal(areas.array, want)


@BOTH
def test_areas_leave_image_exposure_and_generator(kind):
    sensor, image = make(kind), blank()
    sensor.accumulate(part(photons(), 0, 10_000), image)
    before, state = image.array.copy(), sensor.rng.serialize()
    sensor.calculate_pixel_areas(image)
    np.testing.assert_array_equal(image.array, before)
    assert sensor.rng.serialize() == state
    sensor.accumulate(part(photons(), 10_000, 30_000), image, resume=True)
    np.testing.assert_array_equal(image.array, draw(make(kind)))


# -- GalSim and imSim ----------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("method", ["phot", "fft"])
@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_draw_image(kind, method, dtype):
    """Nothing is lost, the star is larger than with strength 0, batches change nothing."""
    star = galsim.Gaussian(sigma=0.5, flux=8e5)

    def image(strength=1.0, **batch):
        return star.drawImage(
            galsim.Image(33, 33, dtype=dtype), scale=0.3, method=method,
            sensor=make(kind, strength=strength), rng=galsim.BaseDeviate(41), **batch,
        )  # fmt: skip

    def size(some):
        moments = galsim.utilities.unweighted_moments(some)
        return moments["Mxx"] + moments["Myy"]

    drawn, still = image(), image(strength=0.0)
    # By FFT 800,000 e- come in photons of fractional flux: single precision of 1089 pixels
    # of 46,000 e- at most (2e-3 each), and integers that are rounded (0.29 each, 5 sigma).
    error = {"phot": 0.0, "fft": 5 * 0.29 * 33 if dtype == np.int32 else 2.2}[method]
    assert drawn.added_flux == pytest.approx(drawn.array.sum(dtype=float), abs=error)
    # 5 sigma of Poisson; nothing is lost, 10 sigma of the star from the edge.
    assert drawn.added_flux == pytest.approx(8e5, abs=5 * np.sqrt(8e5))
    # GalSim's sensor gives 0.27 %, the table of itl_sta3800c more (diffusion is smaller, so
    # the star is).  Of the same photons some 2000 electrons end a pixel further out: the
    # growth is good to 3 %.
    assert 0.002 < size(drawn) / size(still) - 1 < 0.006
    if method == "phot" and dtype == np.float32:
        # GalSim draws integers batch by batch on fresh images: no charge is left to act.
        np.testing.assert_array_equal(image(maxN=70_000).array, drawn.array)


@BOTH
def test_draw_image_adds_to_an_image(kind):
    star = galsim.Gaussian(sigma=0.5, flux=1e5)
    image = galsim.ImageF(33, 33, scale=0.3, init_value=50.0)
    for n in range(2):
        added = star.drawImage(
            image, method="phot", sensor=make(kind), add_to_image=True, poisson_flux=False,
            rng=galsim.BaseDeviate(300 + n),
        ).added_flux  # fmt: skip
        assert added == 1e5
    assert image.array.sum(dtype=float) == 2e5 + 50 * 33**2


def pool(sensor, recalc=True):
    """Draw batches of objects into one image, as imSim's photon pooling does."""
    image = galsim.ImageF(200, 200)
    added = 0.0
    for batch in range(3):
        for sub in range(3):
            some = photons(40_000, seed=100 + 10 * batch + sub, full=True, width=1.5)
            some.x += 60.0 + 30 * sub
            some.y += 100.0
            added += sensor.accumulate(
                some, image, resume=batch + sub > 0, recalc=recalc and sub == 0
            )
    return image.array, added


@BOTH
def test_photon_pooling_in_processes(kind):
    """One sensor, nrecalc = 0, one float32 image, boundaries renewed once a batch."""
    sensor = make(kind, nrecalc=0)
    with ProcessPoolExecutor(2) as executor:
        away = [executor.submit(pool, sensor) for _ in range(2)]
        away = [future.result() for future in away]
    here, added = pool(sensor)
    for pixels, flux in away:
        np.testing.assert_array_equal(pixels, here)
        assert flux == added
    assert here.sum(dtype=float) == added > 300_000
    # The renewals are what makes stars wider: without them the charge does not act.
    still, _ = pool(make(kind, nrecalc=0), recalc=False)
    assert here.max() < still.max()
