"""Refusals of sensors: their messages, and that a refusal changes nothing."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor import SensorError, SiliconSensor
from tests.sensor.contract_cases import BOTH, blank, draw, make, part, photons


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
    refuse(
        galsim.GalSimError, message, good, image[galsim.BoundsI(-9, 9, -9, 9)], resume=True
    )
    refuse(
        galsim.GalSimImmutableError,
        "writeable",
        good,
        image.view(make_const=True),
        resume=True,
    )
    refuse(galsim.GalSimError, message, good, galsim.ImageI(9, 9), resume=True)
    assert np.all(other.array == 3.0)
    sensor.accumulate(part(good, half, len(good)), image, resume=True)
    make(kind, **options).accumulate(good, other)
    np.testing.assert_array_equal(image.array, other.array)


@BOTH
@pytest.mark.parametrize("values", [(np.inf, -np.inf), (-np.inf, np.inf)])
def test_infinities_of_both_signs_are_refused_without_warning(kind, values):
    # The checks look at sums first, and numpy would warn of inf - inf: a caller who turns
    # warnings into errors must get the SensorError.
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
    # The sum of two finite positions overflows: no warning, and no refusal.
    far = galsim.PhotonArray(2, np.full(2, 1.7e308), np.zeros(2), np.ones(2))
    assert make(kind).accumulate(far, blank()) == 0.0


@BOTH
def test_infinite_wavelengths_are_not_absorbed(kind):
    light = galsim.PhotonArray(100, np.zeros(100), np.zeros(100), np.ones(100),
                               wavelength=np.full(100, np.inf))  # fmt: skip
    added = make(kind).accumulate(light, blank())
    # Lengths are held at the end of the tables, 1450 nm: 0.1 mm absorb less than 1e-5.
    assert added == 0.0


@BOTH
@pytest.mark.parametrize("field", ["x", "dydz", "wavelength"])
def test_photons_without_flux_are_dropped_where_they_are_not_finite(kind, field):
    """As galsim.SiliconSensor does; the others fall as if those had never been there."""
    whole = photons(full=True)
    lost = np.zeros(whole.size(), bool)
    lost[::7] = True
    marked = part(whole, 0, whole.size())
    getattr(marked, field)[lost] = np.nan
    marked.flux[lost] = 0.0
    others = galsim.PhotonArray(
        int((~lost).sum()), *(getattr(whole, n)[~lost] for n in ("x", "y", "flux", "dxdz", "dydz")),
        wavelength=whole.wavelength[~lost],
    )  # fmt: skip
    sensor = make(kind)
    np.testing.assert_array_equal(draw(sensor, marked), draw(make(kind), others))
    # 30,000 photons in steps of 7; those of a resumed call add up.
    assert sensor.diagnostics["dropped"] == 4286
    assert sensor.diagnostics["photons"] == 30_000 - 4286
    sensor, target = make(kind), blank()
    for n in range(2):
        half = part(marked, 15_000 * n, 15_000 * (n + 1))
        sensor.accumulate(half, target, resume=n > 0)
    np.testing.assert_array_equal(target.array, draw(make(kind), others))
    assert sensor.diagnostics["dropped"] == 4286
    draw(sensor)
    assert sensor.diagnostics["dropped"] == 0
    marked.flux[14] = 1e-9
    with pytest.raises(SensorError, match=r"photon 14: .*1 of 30000 photons"):
        draw(make(kind), marked)


@BOTH
def test_total_reflection_loses_photons_and_no_image(kind):
    """GalSim's Refraction gives such photons no flux and a slope of nan."""
    light = photons(full=True)
    light.dxdz[:5000] = 3.0
    galsim.Refraction(index_ratio=0.5).applyTo(light)
    assert np.isnan(light.dxdz[:5000]).all() and not light.flux[:5000].any()
    others = draw(make(kind), part(light, 5000, 30_000))
    np.testing.assert_array_equal(draw(make(kind), light), others)
    assert others.sum() > 20_000


@BOTH
def test_negative_wavelengths_are_refused_with_flux(kind):
    """GalSim takes them for its shortest; without flux they change nothing."""
    light = photons(full=True)
    light.wavelength[5:8] = -500.0
    with pytest.raises(
        SensorError,
        match=r"photon 5: wavelength = -500.0 nm must not be negative \(3 of 30000",
    ):
        draw(make(kind), light)
    light.flux[5:8] = 0.0
    image = draw(make(kind), light)
    light.wavelength[5:8] = 500.0
    np.testing.assert_array_equal(image, draw(make(kind), light))


# -- the image between resumed calls -------------------------------------------------------


@BOTH
def test_a_view_of_the_same_pixels_continues(kind):
    """As GalSim's drawing makes one each time; other bounds, or other pixels, are refused."""
    everything = photons()
    whole = draw(make(kind), everything)
    sensor, image = make(kind), blank()
    sensor.accumulate(part(everything, 0, 10_000), image)
    sensor.accumulate(part(everything, 10_000, 20_000), image.view(), resume=True)
    again = galsim.Image(image.array, bounds=image.bounds)
    sensor.accumulate(part(everything, 20_000, 30_000), again, resume=True)
    np.testing.assert_array_equal(image.array, whole)

    moved = image.view()
    moved.setOrigin(1, 1)
    for other, message in (
        (moved, r"the image was moved: its bounds are galsim.BoundsI\(1,21,1,21\), at the call "
                r"before galsim.BoundsI\(-10,10,-10,10\)"),
        (galsim.Image(image.array[::-1], bounds=image.bounds), "an image other than"),
        (galsim.Image(image.array.T, bounds=image.bounds), "an image other than"),
        (image.copy(), "an image other than"),
    ):  # fmt: skip
        with pytest.raises(galsim.GalSimError, match=message):
            sensor.accumulate(everything, other, resume=True)
    # The same object, moved after the call.
    image.setOrigin(1, 1)
    with pytest.raises(galsim.GalSimError, match="the image was moved"):
        sensor.accumulate(everything, image, resume=True)
    np.testing.assert_array_equal(image.array, whole)
    image.setCenter(0, 0)
    assert sensor.accumulate(everything, image, resume=True) == 30_000


@BOTH
def test_charge_from_outside_acts_where_light_falls_later(kind):
    """As documented for ``resume``: at once with a new call, else where electrons land."""
    light = photons(2000, seed=5, width=0.2)
    shares = {}
    for how in ("never", "resumed", "new"):
        sensor, image = make(kind, nrecalc=0), blank(dtype=np.float64)
        sensor.accumulate(light, image)
        before = image.array.copy()
        if how != "never":
            image[0, 0] += 5e4  # where all the light falls
        sensor.accumulate(light, image, resume=how == "resumed", recalc=how == "resumed")
        sensor.accumulate(
            photons(40_000, seed=6, width=0.5), image, resume=True, recalc=True
        )
        shares[how] = image[0, 0] - before[10, 10] - (5e4 if how != "never" else 0.0)
    # The charge repels some per cent of what falls near its pixel's edges.
    assert shares["resumed"] < 0.97 * shares["never"]
    # Poisson of the electrons that change sides, of 20,000 some 1000.
    assert shares["resumed"] == pytest.approx(shares["new"], abs=5 * np.sqrt(2 * 1000))
    # A pixel on which nothing falls is not looked at again before a call without resume.
    areas = []
    for resume in (True, False):
        sensor, image = make(kind, nrecalc=0), blank(dtype=np.float64)
        sensor.accumulate(light, image)
        image[3, 0] += 5e6
        sensor.accumulate(light, image, resume=resume, recalc=resume)
        beside = galsim.PhotonArray(
            20_000, np.full(20_000, 2.0), np.linspace(-0.5, 0.5, 20_000), np.ones(20_000)
        )
        before = image[2, 0]
        sensor.accumulate(beside, image, resume=True)
        areas.append(image[2, 0] - before)
    assert areas[0] != areas[1]
