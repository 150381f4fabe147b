"""Photons in pieces, images of any kind, areas: the contract of accumulating."""

from __future__ import annotations

from itertools import pairwise
from unittest import mock

import galsim
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bfsensor import BrighterFatterSensor, SensorError, SiliconSensor
from bfsensor.sensor import image_exposure
from tests.sensor.contract_cases import BOTH, RINGS, blank, draw, make, part, photons


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
    sensor = make(kind, nrecalc=1500.0, threads=threads)
    at = [0, *sorted(cuts), len(everything)]
    # Otherwise blocks of 1500 e- would not be worth a second thread.
    with mock.patch.object(image_exposure, "_SHARE", 1):
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
