"""The physics that GalSim's sensor lacks: each is there, and each can be switched off."""

from __future__ import annotations

import dataclasses
import warnings

import galsim
import numpy as np
import pytest

from bfsensor import (
    BrighterFatterSensor,
    Device,
    DistortionTable,
    ShiftMap,
    SiliconSensor,
)
from bfsensor.device.parts import ElectronTransport
from bfsensor.device.shipped import tables_dir
from bfsensor.device.silicon import absorption_length
from bfsensor.errors import SensorError
from bfsensor.sensor.charge_response import factor_table
from bfsensor.sensor.drift_field import solve_drift

ITL = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
TOP = float(ITL.depths[-1])


def sensor(**options):
    return BrighterFatterSensor(rng=galsim.BaseDeviate(3301), **options)


def area_change(charge, background=0.0, *, lag=(0, 0), by_background=True, **options):
    """Area change [nominal] beside a pixel that holds a charge, all others the background."""
    side = 15
    image = galsim.ImageD(side, side)
    image.array[...] = background
    image.array[side // 2, side // 2] = charge
    areas = sensor(background=by_background, **options).calculate_pixel_areas(image).array
    return areas[side // 2 + lag[1], side // 2 + lag[0]] - 1


def expected_change(charge, background=0.0, lag=(0, 0)):
    changes = ITL.area_changes(charge=charge, background=background, depth=TOP)
    return changes[4 + lag[1], 4 + lag[0]] / 100


def uniform_photons(count, side, seed, **extra):
    rng = np.random.default_rng(seed)
    x, y = rng.random((2, count)) * side + 0.5
    return galsim.PhotonArray(count, x, y, np.ones(count), **extra)


# The factors of a table give areas to about half a per cent (EffectiveCharge.residual).
TOLERANCE = 0.01


@pytest.mark.parametrize("charge", [10e3, 50e3, 100e3, 150e3])
def test_response_depends_on_charge(charge):
    found = area_change(charge)
    assert found == pytest.approx(expected_change(charge), rel=TOLERANCE)
    if charge > 40e3:
        # A small charge's response would be 5 % (50,000 e-) to 14 % (150,000 e-) larger.
        assert area_change(charge, charge_response=False) < found * 1.04


def test_without_response_to_charge_shifts_are_linear():
    """Areas are then quadratic in charge: their third difference is zero."""
    one, two, three = (area_change(n * 50e3, charge_response=False) for n in (1, 2, 3))
    # Single precision of a sum of about 100 weights.
    assert three - 3 * two + 3 * one == pytest.approx(0.0, abs=1e-6)


def test_response_depends_on_background():
    """On 120,000 e- the lag (1, 0) gains some 5 % less from 30,000 e- than it would."""
    for charge, background in ((100e3, 60e3), (150e3, 120e3)):
        on_sky = area_change(charge, background)
        assert on_sky == pytest.approx(expected_change(charge, background), rel=0.02)
    lag = (1, 0)
    on_sky = area_change(150e3, 120e3, lag=lag)
    assert on_sky == pytest.approx(expected_change(150e3, 120e3, lag), rel=0.01)
    ignored = area_change(150e3, 120e3, lag=lag, by_background=False)
    assert ignored > 1.03 * on_sky


def captured(instrument, charge, at, side, count, seed):
    """Part of uniform photons that a filled pixel captures, as an area; its error."""
    image = galsim.ImageD(side, side)
    image.array[at[1], at[0]] = charge
    instrument.nrecalc = 0.0
    instrument._init_silicon()
    photons = uniform_photons(count, side, seed)
    instrument.accumulate(photons, image)
    electrons = image.array[at[1], at[0]] - charge
    per_pixel = count / side**2
    return electrons / per_pixel, np.sqrt(electrons) / per_pixel


@pytest.mark.parametrize("height", [5.0, 10.0, 40.0])
def test_shifts_depend_on_the_height_of_conversion(height):
    options = {"diffusion_factor": 0.0, "conversion_depth": ITL.thickness - height}
    area, error = captured(sensor(**options), 1e5, (4, 4), 9, 2_000_000, 5519)
    want = 1 + ITL.area_changes(charge=1e5, depth=height)[4, 4] / 100
    # 4 sigma of the counts, and 2 % of the change for factors and layers.
    assert area == pytest.approx(want, abs=4 * error + 0.02 * (1 - want))
    flat, error = captured(sensor(depth=False, **options), 1e5, (4, 4), 9, 2_000_000, 5520)
    top = 1 + expected_change(1e5)
    assert flat == pytest.approx(top, abs=4 * error + TOLERANCE * (1 - top))


@pytest.mark.parametrize("kind", [SiliconSensor, BrighterFatterSensor])
def test_all_four_edges_of_the_image_move(kind):
    """A pixel at the right or the top loses as much as one at the left or the bottom."""
    instrument = kind(rng=galsim.BaseDeviate(77))
    side = 11
    areas = []
    for j, i in ((5, 0), (5, side - 1), (0, 5), (side - 1, 5)):
        image = galsim.ImageD(side, side)
        image.array[j, i] = 1e5
        areas.append(instrument.calculate_pixel_areas(image).array[j, i])
    # GalSim's tables are symmetric to 1e-4 of an area, ours bit for bit.
    assert areas[0] == pytest.approx(areas[1], abs=2e-4)
    assert areas[2] == pytest.approx(areas[3], abs=2e-4)
    assert max(areas) < 0.93
    # And photons find them there.
    for at in ((0, 5), (side - 1, 5), (5, 0), (5, side - 1)):
        fresh = kind(rng=galsim.BaseDeviate(78), diffusion_factor=0.0)
        area, error = captured(fresh, 1e5, at, side, 1_000_000, 411)
        # Light that falls beyond the image is not drawn: what moves out is lost, no more.
        index = 0 if at[0] in (0, side - 1) else 2
        assert area == pytest.approx(areas[index], abs=4 * error + 1e-3)


@pytest.mark.parametrize("angles", [False, True])
def test_red_light_is_lost_with_and_without_angles_alike(angles):
    count, wave = 200_000, 1000.0
    extra = {"wavelength": np.full(count, wave)}
    if angles:
        extra |= {"dxdz": np.zeros(count), "dydz": np.zeros(count)}
    photons = galsim.PhotonArray(count, np.full(count, 5.0), np.full(count, 5.0), **extra)
    photons.flux = 1.0
    image = galsim.ImageD(9, 9)
    instrument = sensor(strength=0.0)
    found = instrument.accumulate(photons, image) / count
    length = float(absorption_length(wave, 173.0))
    absorbed = 1 - np.exp(-ITL.thickness / length)
    assert 0.1 < absorbed < 0.8
    assert found == pytest.approx(absorbed, abs=4 * np.sqrt(absorbed / count))
    crossed = instrument.diagnostics["crossed"]
    assert crossed == count - image.array.sum()
    kept = sensor(strength=0.0, red="kept").accumulate(photons, galsim.ImageD(9, 9))
    assert kept == count


def test_absorption_follows_temperature():
    count = 200_000
    photons = galsim.PhotonArray(
        count, np.full(count, 5.0), np.full(count, 5.0), wavelength=np.full(count, 1000.0)
    )
    photons.flux = 1.0
    found = []
    for temperature in (173.0, 300.0):
        instrument = sensor(strength=0.0, temperature=temperature)
        found.append(instrument.accumulate(photons, galsim.ImageD(9, 9)) / count)
        want = 1 - np.exp(-ITL.thickness / float(absorption_length(1000.0, temperature)))
        assert found[-1] == pytest.approx(want, abs=4 * np.sqrt(want / count))
    assert found[1] > 1.2 * found[0]


@pytest.mark.parametrize("height", [20.0, 60.0, 99.0])
def test_diffusion_comes_from_the_drift_field(height):
    """Einstein's width from the field by height, times the device's ratio or a given one."""
    count = 100_000
    drift = solve_drift(ITL.device_text, 173.0, float(ITL.depths[1]))
    sigma = np.sqrt(np.interp(height, drift.heights, drift.variance))
    # A uniform field of the mean bulk value gives the same within the doping's gradient.
    mean = np.interp(height, drift.heights, drift.field)
    assert sigma == pytest.approx(np.sqrt(2 * 0.026 * 173 / 300 * height / mean), rel=0.25)
    for options, factor in (
        ({}, 1.92), ({"diffusion": "einstein"}, 1.0), ({"diffusion": 1.4}, 1.4),
        ({"diffusion": 2.8, "diffusion_factor": 0.5}, 1.4),
    ):  # fmt: skip
        instrument = sensor(
            strength=0.0, conversion_depth=ITL.thickness - height, **options
        )
        image = galsim.ImageD(9, 9)
        image.setCenter(0, 0)
        photons = galsim.PhotonArray(count, np.full(count, 0.5), np.zeros(count))
        photons.flux = 1.0
        instrument.accumulate(photons, image)
        # From an edge half go either way; the width shows in what goes a pixel further.
        from scipy.special import erfc

        want = 0.5 * erfc(10.0 / (np.sqrt(2) * factor * sigma))
        found = image.array[:, 6:].sum() / count
        assert found == pytest.approx(want, abs=4 * np.sqrt(want / count) + 2e-5)
    none = sensor(strength=0.0, diffusion_factor=0.0)
    image = galsim.ImageD(9, 9)
    image.setCenter(0, 0)
    photons.x[...] = 0.49
    none.accumulate(photons, image)
    assert image[0, 0] == count


def unknown_width(name="a_device_of_unknown_width"):
    """The table of ITL as one whose device states no width of the diffusion."""
    device = Device.load("itl_sta3800c")
    device = dataclasses.replace(device, name=name, transport=ElectronTransport())
    return dataclasses.replace(ITL, device_text=device.to_toml())


def test_a_device_without_a_width_has_einsteins_and_says_so_once(caplog):
    table = unknown_width()
    assert "[transport]" not in table.device_text
    images = []
    for options in ({}, {"diffusion": "einstein"}, {}):
        image = galsim.ImageD(9, 9)
        given = {"table": table} | options
        sensor(**given).accumulate(uniform_photons(5000, 9, 71), image)
        images.append(image.array)
    assert (images[0] == images[1]).all() and (images[2] == images[1]).all()
    said = [r for r in caplog.records if "a_device_of_unknown_width" in r.getMessage()]
    assert len(said) == 1 and "Einstein" in said[0].getMessage()


def test_a_width_that_does_not_matter_is_not_missed(caplog):
    """Without diffusion, or with a stated width, nothing is said."""
    table = unknown_width("another_device_of_unknown_width")
    for options in ({"diffusion_factor": 0.0}, {"diffusion": 1.5}):
        sensor(table=table, **options)
    assert not caplog.records


def test_a_faint_star_is_as_wide_as_with_galsims_sensor():
    """What a swap of the sensor changes is the effect of charge, not the width of the star."""
    star = galsim.Moffat(beta=3, fwhm=0.7, flux=4e5)

    def trace(instrument):
        image = star.drawImage(
            nx=43, ny=43, scale=0.2, method="phot", sensor=instrument,
            rng=galsim.BaseDeviate(515), poisson_flux=False,
        )  # fmt: skip
        return image.FindAdaptiveMom().moments_sigma

    galsims = trace(galsim.SiliconSensor(strength=1e-9, rng=galsim.BaseDeviate(52)))
    by_width = {
        width: trace(sensor(strength=0.0, diffusion=width)) / galsims - 1
        for width in ("device", "einstein")
    }
    # 4e5 photons measure a width to 0.1 %; the drift field is not GalSim's even field.
    assert abs(by_width["device"]) < 0.005
    assert by_width["einstein"] < -0.025


@pytest.mark.parametrize("width", ["measured", -0.1, float("nan"), float("inf"), None])
def test_a_width_that_is_none_is_refused(width):
    with pytest.raises(SensorError, match=r"diffusion = .*einstein"):
        sensor(diffusion=width)


def rings(amplitude=0.3, length=2000.0):
    return galsim.LookupTable([0.0, length], [amplitude, amplitude], interpolant="linear")


@pytest.mark.parametrize("kind", [SiliconSensor, BrighterFatterSensor])
def test_a_ring_pattern_of_two_points_counts(kind):
    """GalSim takes it for the absence of rings."""
    instrument = kind(
        rng=galsim.BaseDeviate(10), treering_func=rings(),
        treering_center=galsim.PositionD(-500.0, 5.0), diffusion_factor=0.0,
    )  # fmt: skip
    image = galsim.ImageD(11, 11)
    photons = galsim.PhotonArray(1000, np.full(1000, 5.6), np.full(1000, 5.0))
    photons.flux = 1.0
    instrument.accumulate(photons, image)
    # The boundary at 5.5 is now at 5.8.
    assert image[5, 5] == 1000


def test_rings_and_maps_follow_the_height_of_conversion():
    centre = galsim.PositionD(-1e6, 5.0)
    function = galsim.LookupTable([0.0, 2e6], [0.3, 0.3], interpolant="linear")
    drift = solve_drift(ITL.device_text, 173.0, float(ITL.depths[1]))
    uniform = ShiftMap(np.full((30, 30), 0.3), np.zeros((30, 30)), x0=-5.0, y0=-5.0,
                       depth="uniform")  # fmt: skip
    for height in (10.0, 50.0, 99.0):
        factor = np.interp(height, drift.heights, drift.ripple)
        options = {"diffusion_factor": 0.0, "conversion_depth": ITL.thickness - height}
        for fixed, shift in (
            ({"treering_func": function, "treering_center": centre}, 0.3 * factor),
            ({"shift_map": uniform}, 0.3),
        ):
            for x, column in ((5.5 + shift - 0.004, 5), (5.5 + shift + 0.004, 6)):
                image = galsim.ImageD(11, 11)
                photons = galsim.PhotonArray(10, np.full(10, x), np.full(10, 5.0))
                photons.flux = 1.0
                sensor(**fixed, **options).accumulate(photons, image)
                assert image[column, 5] == 10, (height, fixed, shift)


def test_a_map_changes_areas_by_its_divergence():
    n = 21
    x, y = np.meshgrid(np.arange(n), np.arange(n))
    bend = 1e-3 * (x - 10.0)
    image = galsim.ImageD(n - 1, n - 1)
    areas = sensor(shift_map=ShiftMap(bend, 0 * y)).calculate_pixel_areas(image).array
    assert areas == pytest.approx(1.001, abs=1e-6)
    assert sensor().calculate_pixel_areas(image, use_flux=False).array == pytest.approx(1.0)


def bright_star(flux, seed=909, sigma=1.0):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0, sigma, (2, flux))
    return galsim.PhotonArray(flux, x, y, np.ones(flux))


def test_full_pixels_spill_along_the_column():
    image = galsim.ImageF(15, 61)
    image.setCenter(0, 0)
    instrument = sensor(full_well=50e3)
    added = instrument.accumulate(bright_star(3_000_000), image)
    pixels = image.array
    assert pixels.max() == 50e3
    full = pixels == 50e3
    # The bleed trail: rows in which the column of the peak is full, both ways alike.
    trail = np.nonzero(full[:, 7])[0] - 30
    assert len(trail) > 15
    assert abs(trail.max() + trail.min()) <= 2
    assert not full[30, 11] and full[30 + trail.max(), 7]
    lost = instrument.diagnostics
    assert pixels.sum(dtype=float) == added
    assert added + lost["off_image"] + lost["spilled_off_image"] == 3_000_000
    assert lost["spilled"] > 1e6
    # Off: nothing spills, and the peak is what GalSim would have.
    image = galsim.ImageF(15, 61)
    image.setCenter(0, 0)
    endless = sensor(full_well=np.inf)
    with pytest.warns(galsim.GalSimWarning, match="beyond='error'"):
        endless.accumulate(bright_star(3_000_000), image)
    assert image.array.max() > 3e5
    assert instrument.transpose is False
    image = galsim.ImageF(61, 15)
    image.setCenter(0, 0)
    sensor(full_well=50e3, transpose=True).accumulate(bright_star(3_000_000), image)
    assert np.sum(image.array[7] == 50e3) > 15


def test_a_bright_star_never_aborts_unless_asked():
    photons = bright_star(4_000_000)
    hold = sensor(full_well=np.inf)
    image = galsim.ImageF(21, 21)
    image.setCenter(0, 0)
    with pytest.warns(galsim.GalSimWarning, match="itl_sta3800c"):
        hold.accumulate(photons, image)
    assert hold.diagnostics["beyond_table"] > 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hold.accumulate(photons, image)  # one warning a sensor
    image = galsim.ImageF(21, 21)
    image.setCenter(0, 0)
    image.array[...] = 7
    strict = sensor(full_well=np.inf, beyond="error")
    with pytest.raises(
        SensorError, match=f"the table of itl_sta3800c ends at {ITL.full_well:.0f} e-"
    ):
        strict.accumulate(photons, image)
    assert np.all(image.array == 7)


@pytest.mark.parametrize("depths", [1, 5, 6])
def test_a_table_that_ends_below_the_light_says_so_once(depths):
    kept = slice(6 - depths, 6) if depths == 1 else slice(depths)
    low = dataclasses.replace(
        ITL, depths=ITL.depths[kept],
        **{n: getattr(ITL, n)[:, :, kept] for n in ("corners", "horizontal", "vertical")},
    )  # fmt: skip
    said = rf"up to 100 um above the gates; the given table ends at {low.depths[-1]:g} um"
    with pytest.warns(galsim.GalSimWarning, match=said) as caught:
        instrument = BrighterFatterSensor(table=low)
    assert [issubclass(w.category, UserWarning) for w in caught] == [True]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        instrument.accumulate(bright_star(2000), galsim.ImageF(21, 21))
        BrighterFatterSensor(table=ITL, beyond="error")
    with pytest.raises(SensorError, match="make one with the depth 100 um"):
        BrighterFatterSensor(table=low, beyond="error")


DEEP = float(ITL.depths[5])
"""A depth of the table some 20 um above the gates."""


def table_from(depth):
    """The table of ITL without the depths below one of its own."""
    kept = slice(ITL.depths.tolist().index(depth), None)
    return dataclasses.replace(
        ITL, depths=ITL.depths[kept],
        **{n: getattr(ITL, n)[:, :, kept] for n in ("corners", "horizontal", "vertical")},
    )  # fmt: skip


def coloured(wavelength, flux=1.0):
    photons = bright_star(200)
    photons.wavelength = wavelength
    photons.flux = flux
    return photons


@pytest.mark.parametrize(
    ("table", "wavelength", "said"),
    [
        (ITL, 0.62, "wavelengths from 0.62 to 0.62 nm.* from 250 to 1450 nm"),
        (ITL, 1500.0, "wavelengths from 1500 to 1500 nm"),
        (
            table_from(DEEP),
            1000.0,
            f"% of light of 1000 nm converts below {0.9 * DEEP:.6g} um; the lowest depth .* is "
            f"{DEEP:.6g}",
        ),
    ],
)
def test_light_outside_the_table_is_said_once_or_refused(table, wavelength, said):
    instrument = BrighterFatterSensor(table=table)
    image = galsim.ImageF(21, 21)
    with pytest.warns(galsim.GalSimWarning, match=said):
        instrument.accumulate(coloured(wavelength), image)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        instrument.accumulate(coloured(wavelength), image, resume=True)
        BrighterFatterSensor(table=table).accumulate(coloured(620.0), galsim.ImageF(21, 21))
    image.array[...] = 7
    strict = BrighterFatterSensor(table=table, beyond="error")
    with pytest.raises(SensorError, match=said):
        strict.accumulate(coloured(wavelength), image)
    assert np.all(image.array == 7)
    strict.accumulate(coloured(620.0), image)


def test_the_part_of_deep_light_is_what_converts_there():
    length = float(absorption_length(1000.0, 173.0))
    part = np.exp(-(100.0 - 0.9 * DEEP) / length) - np.exp(-100.0 / length)
    with pytest.warns(galsim.GalSimWarning, match=f"^{100 * part:.2g} % of light"):
        BrighterFatterSensor(table=table_from(DEEP)).accumulate(
            coloured(1000.0), galsim.ImageF(21, 21)
        )


def test_light_within_the_table_says_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for red in ("lost", "kept"):
            for wavelength in (250.0, 1000.0, 1100.0, 1450.0, np.inf):
                sensor(red=red).accumulate(coloured(wavelength), galsim.ImageF(21, 21))
        sensor(table=table_from(DEEP), depth=False).accumulate(
            coloured(1000.0), galsim.ImageF(21, 21)
        )
        # A photon that was lost before has no wavelength.
        sensor(beyond="error").accumulate(coloured(np.nan, flux=0.0), galsim.ImageF(21, 21))
        sensor(conversion_depth=99.8)
        # A table of the back surface, with light as blue as it is for.
        top = BrighterFatterSensor(table=table_from(100.0), beyond="error")
        top.accumulate(coloured(450.0), galsim.ImageF(21, 21))


def test_light_without_wavelengths_below_the_table_is_said_or_refused():
    said = f"light converts 5 um above the gates; the given table begins at {DEEP:.6g}"
    with pytest.warns(galsim.GalSimWarning, match=said):
        BrighterFatterSensor(table=table_from(DEEP), conversion_depth=95.0)
    with pytest.raises(SensorError, match=said):
        BrighterFatterSensor(table=table_from(DEEP), conversion_depth=95.0, beyond="error")


def growth(photons, **options):
    """Second moment (x and y) with the effect over that without, less 1."""
    out = []
    for strength in (1.0, 0.0):
        image = galsim.ImageD(41, 41)
        image.setCenter(0, 0)
        sensor(strength=strength, **options).accumulate(photons, image)
        j, i = np.indices(image.array.shape) - 20
        out.append((image.array * (i * i + j * j)).sum() / image.array.sum())
    return out[0] / out[1] - 1


def test_boundaries_do_not_lag_behind_the_charge():
    """Default blocks against blocks of 100 e-: the growth of a star of 1e6 e- (see GalSim).

    Photons and random numbers are the same; about 30,000 electrons make the growth and some
    100 land elsewhere, so that the mean over three stars is good to 4e-4.
    """
    lags, lags_without = [], []
    for seed in (41, 43, 47):
        photons = bright_star(1_000_000, seed=seed)
        fine = growth(photons, nrecalc=100.0)
        lags.append(growth(photons) / fine - 1)
        lags_without.append(growth(photons, predict=False) / fine - 1)
    assert abs(np.mean(lags)) < 1e-3
    assert np.mean(lags_without) < -5e-3


def test_strength_zero_moves_nothing():
    photons = bright_star(200_000)
    assert growth(photons) > 0.002
    image = galsim.ImageD(9, 9)
    image.array[4, 4] = 1e5
    assert np.all(sensor(strength=0.0).calculate_pixel_areas(image).array == 1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "itl"}, r"name = 'itl' is neither a built-in table \(e2v_ccd250"),
        ({"name": "nowhere.fits"}, "nowhere.fits: no such file"),
        ({"qdist": 5}, "qdist = 5 must be from 0 to 4"),
        ({"nrecalc": -1}, "nrecalc = -1 must be a finite number from 0"),
        ({"strength": np.nan}, "strength = nan must be a finite number"),
        ({"red": "kept?"}, "red = 'kept.' must be one of lost, kept"),
        ({"temperature": 20.0}, "temperature = 20.0 must be a finite number from 77"),
        ({"full_well": 0.0}, "full_well = 0.0 must be above 0 e-"),
        ({"threads": 0}, "threads = 0 must be at least 1"),
        ({"shift_map": "none.fits"}, "none.fits: not a shift map"),
        ({"conversion_depth": 101.0}, "conversion_depth = 101.0 must be a finite number"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(SensorError, match=message):
        BrighterFatterSensor(**options)


def test_areas_of_tall_images_are_written_to_the_last_row():
    """Rows are made in bands of 262,144 pixels."""
    small, tall = galsim.ImageD(41, 41), galsim.ImageD(300, 1200)
    small.array[20, 20] = tall.array[1100, 150] = 8e4
    areas = [sensor().calculate_pixel_areas(image).array for image in (small, tall)]
    assert abs(areas[0][20, 20] - 1) > 0.01
    np.testing.assert_allclose(areas[1][1080:1121, 130:171], areas[0], rtol=0, atol=1e-6)


def test_diffusion_is_that_of_galsim():
    """GalSim steps its photons by this width times the square root of the way they have to go."""
    ours = SiliconSensor(rng=galsim.BaseDeviate(1))
    theirs = galsim.SiliconSensor(rng=galsim.BaseDeviate(1))
    assert ours._diffusion() == pytest.approx(theirs._calculate_diff_step(), rel=1e-12)


def test_a_linear_response_that_grows_is_the_same_on_any_background():
    """Charges 0 to the top, on backgrounds: Q (1 + b Q / 2), whatever the background is."""
    growth = 2e-6
    found = factor_table(ITL, linear=True, growth=growth).response.first
    alone = found[:, :1]
    assert found.shape[1] > 2
    np.testing.assert_allclose(
        found, np.broadcast_to(alone, found.shape), rtol=3e-6, atol=1e-2
    )
