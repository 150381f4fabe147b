"""Images without the brighter-fatter effect: what the sensor drew, taken back with its table."""

from __future__ import annotations

import galsim
import numpy as np
import pytest

from bfsensor import BrighterFatterSensor, DistortionTable
from bfsensor._kernels import correction
from bfsensor._kernels.shifts import MODES
from bfsensor.device.shipped import tables_dir
from bfsensor.device.silicon import absorption_length
from bfsensor.errors import BFSensorError
from bfsensor.measure.correct import correct_kernel
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.sensor import table_correction
from bfsensor.sensor.flats import draw_flat
from bfsensor.sensor.table_correction import correct_table
from bfsensor.sensor.weight_maps import corrected_variance
from bfsensor.table.lsst_format import solve_kernel
from bfsensor.table.quadrant_shifts import quadrant_shifts

E2V = DistortionTable.read(tables_dir() / "e2v_ccd250" / "table.fits")
ITL = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")


def star(peak=9e4, sigma=1.3, side=61, sky=0.0, at=(0.0, 0.0)):
    y, x = np.indices((side, side)) - side // 2
    return sky + peak * np.exp(-0.5 * ((x - at[0]) ** 2 + (y - at[1]) ** 2) / sigma**2)


# -- terms -----------------------------------------------------------------------------


def test_light_that_crosses_straight_boundaries_is_the_area_that_they_sweep():
    """In even light; terms of second order are 4/3 of those of mean shifts."""
    rng = np.random.default_rng(5)
    size = 0.02
    corners = size * rng.normal(size=(2, 6, 6))
    even, none = np.ones((6, 6)), np.zeros((6, 6))
    gained = np.zeros((6, 6))
    for k, upright in ((0, True), (1, False)):
        ends = np.roll(corners[k], -1, axis=k)
        moved = np.empty((6, 6))
        correction.moved_light(
            0.5 * (corners[k] + ends), none, corners[k], corners[1 - k], even, none, even, upright,
            moved,
        )  # fmt: skip
        gained -= moved
        gained += np.roll(moved, -1, axis=1 - k)
    for y, x in ((2, 2), (1, 3), (3, 1)):
        at = [(y, x), (y, x + 1), (y + 1, x + 1), (y + 1, x)]
        shifts = np.array([corners[:, j, i] for j, i in at])
        place = np.array([(i, j) for j, i in at], float)

        def area(p):
            q = np.roll(p, -1, axis=0)
            return 0.5 * np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])

        one, two = (area(place + f * shifts) - 1 for f in (1.0, -1.0))
        first, second = 0.5 * (one - two), 0.5 * (one + two)
        assert gained[y, x] == pytest.approx(first + 4 / 3 * second, abs=1e-12)
        assert abs(second) > 1e-5


def test_charges_are_averaged_over_an_exposure():
    rng = np.random.default_rng(6)
    light = rng.uniform(1e4, 5e4, (5, 7))
    image = light * rng.uniform(0.95, 1.05, (5, 7))
    charge, background = np.arange(0.0, 2e5, 1e3)[:, None], np.arange(0.0, 1e5, 2e3)
    first = charge + 1e-6 * charge**2 + 0 * background
    near = np.arange(1, MODES) * (3e-7 * background**2 + 0 * charge)[..., None]
    times, weights = np.polynomial.legendre.leggauss(2)
    out = np.zeros((MODES, 5, 7))
    correction.mean_charges(
        light, image, first.astype(np.float32), near.astype(np.float32), 1e3, 2e3, 0.5 * (times + 1),
        0.5 * weights, out,
    )  # fmt: skip
    fine = (np.arange(2000) + 0.5) / 2000

    def held(t, light, image):
        return t * light + t**2 * (image - light)

    q = np.array([held(t, light[2, 3], image[2, 3]) for t in fine])
    around = [(a[1:4, 2:5].sum() - a[2, 3]) / 8 for a in (light, image)]
    b = held(fine, *around)
    # Between the steps of the grids parabolas are chords: up to 0.25 and 0.3 e- too large.
    assert out[0, 2, 3] == pytest.approx(np.mean(q + 1e-6 * q**2), abs=0.5)
    for n in range(1, MODES):
        assert out[n, 2, 3] == pytest.approx(n * np.mean(3e-7 * b**2), abs=0.5 * n)


# -- images ----------------------------------------------------------------------------


@pytest.mark.parametrize("surroundings", ["mirrored", 300.0])
def test_electrons_are_conserved(surroundings):
    rng = np.random.default_rng(3)
    image = rng.uniform(0, 1e5, (50, 43))
    corrected = correct_table(image, ITL, surroundings=surroundings)
    assert np.abs(corrected - image).max() > 500
    assert corrected.sum() == pytest.approx(image.sum(), rel=1e-14)


def test_even_light_stays_even():
    image = np.full((40, 30), 6e4)
    np.testing.assert_allclose(correct_table(image, E2V), image, rtol=1e-7)
    # Beside darkness boundaries of the last rows shift outwards, and take light from within.
    assert np.abs(correct_table(image, E2V, surroundings=0.0) - image)[:, 0].max() > 50


def test_bands_give_what_the_whole_does(monkeypatch):
    rng = np.random.default_rng(8)
    image = rng.uniform(0, 1e5, (100, 37))
    whole = correct_table(image, ITL, surroundings=100.0)
    monkeypatch.setattr(table_correction, "BAND", 16)
    np.testing.assert_allclose(
        correct_table(image, ITL, surroundings=100.0, threads=2), whole, rtol=0, atol=2e-3
    )


def test_mirror_images_are_corrected_alike():
    image = star(at=(0.3, -0.2), sky=100.0)
    plain = correct_table(image, ITL)
    for flip in (np.s_[::-1], np.s_[:, ::-1]):
        np.testing.assert_allclose(
            correct_table(image[flip], ITL)[flip], plain, rtol=1e-6, atol=0.01
        )


# -- pixels that light did not fill ------------------------------------------------------


def test_masked_pixels_get_the_light_of_the_nearest_good_ones():
    rng = np.random.default_rng(12)
    image = rng.uniform(0, 1e3, (9, 8))
    mask = rng.random((9, 8)) < 0.5
    mask[:, 0] = mask[0] = True
    found = image.copy()
    correction.fill_masked(image, mask, 3, found)
    for y, x in np.argwhere(mask):
        pairs = []
        for ray, bad in (
            (image[y, x + 1 :], mask[y, x + 1 :]), (image[y, :x][::-1], mask[y, :x][::-1]),
            (image[y + 1 :, x], mask[y + 1 :, x]), (image[:y, x][::-1], mask[:y, x][::-1]),
        ):  # fmt: skip
            good = np.flatnonzero(~bad[:3])
            if len(good):
                pairs.append((ray[good[0]], 1 / (good[0] + 1)))
        expected = sum(v * w for v, w in pairs) / sum(w for _, w in pairs) if pairs else 0
        assert found[y, x] == pytest.approx(expected, rel=1e-12)
    np.testing.assert_array_equal(found[~mask], image[~mask])


def test_a_cosmic_ray_moves_boundaries_and_does_not_spread():
    image = np.full((41, 41), 1e3)
    image[20, 20:22] = 1e5
    mask = image > 5e4
    change = correct_table(image, ITL, mask=mask) - image
    # The sky that its charge drove out of two pixels, and no more: by areas of the table.
    areas = ITL.area_changes(charge=5e4, depth=float(ITL.depths[-1])) / np.prod(ITL.pitch)
    assert change[19, 20] == pytest.approx(-1e3 * (areas[5, 4] + areas[5, 5]), rel=0.1)
    assert change[20, 20] == pytest.approx(-1e3 * (areas[4, 4] + areas[4, 5]), rel=0.1)
    assert abs(change.sum()) < 1e-6
    assert np.abs(correct_table(image, ITL) - image)[~mask].max() > 20 * change[19, 20]


def test_what_a_pixel_of_unknown_charge_holds_is_nowhere_seen():
    image = star(sky=200.0)
    whole = correct_table(image, ITL)
    broken = image.copy()
    broken[:, 31] = np.nan
    broken[40:43, 20] = np.inf
    given = ~np.isfinite(broken)
    found = correct_table(broken, ITL)
    np.testing.assert_array_equal(np.isfinite(found), ~given)
    # Straight lines through a star of 3 pixels are wrong by a quarter of its light at 1 pixel.
    change = np.abs(whole - image).max()
    assert np.abs(found - whole)[~given].max() < 0.15 * change
    far = np.abs(np.indices(image.shape)[1] - 31) > 4
    assert np.abs(found - whole)[~given & far].max() < 0.01 * change
    hidden = np.ma.array(image, mask=given)
    same = correct_table(hidden, ITL)
    np.testing.assert_array_equal(same, np.where(given, np.nan, found))


def test_a_saturated_neighbour_is_used_as_charge():
    """The star beside it is drawn wider by its charge, whatever light filled it."""
    image = star(sky=100.0) + star(peak=1.4e5, sigma=1.5, at=(6.0, 2.0))
    mask = image > 1e5
    open_eyes = correct_table(image, ITL)
    masked = correct_table(image, ITL, mask=mask)
    unknown = correct_table(np.where(mask, np.nan, image), ITL)
    near = np.hypot(*(np.indices(image.shape) - 30)) < 2
    known, lost = (np.abs(a - open_eyes)[near].max() for a in (masked, unknown))
    # Its charge pushes the star as before; without it 0.5 % of the correction are missing.
    assert known < 0.3 * lost
    assert lost > 0.004 * np.abs(open_eyes - image)[near].max()


@pytest.mark.parametrize("kind", ["int32", ">u2", "float32", ">f4"])
def test_images_of_any_real_type(kind):
    image = np.rint(star(peak=5e4, sky=100.0))
    np.testing.assert_allclose(
        correct_table(image.astype(kind), ITL), correct_table(image, ITL), atol=1e-9
    )


def test_bands_of_memory_maps(tmp_path, monkeypatch):
    rng = np.random.default_rng(18)
    image = rng.uniform(0, 1e5, (90, 40)).astype(np.float32)
    monkeypatch.setattr(table_correction, "BAND", 16)
    np.save(tmp_path / "image.npy", image)
    given = np.load(tmp_path / "image.npy", mmap_mode="r")
    out = np.lib.format.open_memmap(
        tmp_path / "out.npy", mode="w+", dtype=np.float32, shape=image.shape
    )
    assert correct_table(given, ITL, out=out, surroundings=50.0) is out
    whole = correct_table(image, ITL, surroundings=50.0, threads=3)
    np.testing.assert_array_equal(out, whole.astype(np.float32))


def test_charge_beyond_the_table_is_said():
    image = star(side=41)
    image[5, 6] = 170e3
    with pytest.warns(
        galsim.GalSimWarning, match="^1 pixels hold more charge than the tab"
    ):
        correct_table(image, ITL)
    with pytest.raises(BFSensorError, match=r"ends at 160000 e-.*: mask them"):
        correct_table(image, ITL, beyond="error")
    correct_table(image, ITL, beyond="error", mask=image > 1e5)
    # A level of 150,000 e- is within the charges of the table, and beyond its backgrounds.
    with pytest.warns(galsim.GalSimWarning, match="^400 pixels"):
        correct_table(np.full((20, 20), 1.5e5), ITL)


def test_variance_of_what_was_corrected():
    flat = np.full((300, 300), 6e4)
    noise = np.random.default_rng(77).normal(0, 30.0, flat.shape)
    left = correct_table(flat + noise, ITL) - correct_table(flat, ITL)
    left, noise = left[8:-8, 8:-8], noise[8:-8, 8:-8]
    variance = corrected_variance(flat, ITL, read_noise=30.0)
    # Both from the same noise, whose own scatter cancels; second order in the effect.
    grown = np.mean(left**2) / np.mean(noise**2)
    assert grown - 1 == pytest.approx((variance[0, 0] - 6e4) / 900 - 1, rel=0.1)
    assert grown > 1.05
    areas = quadrant_shifts(ITL, tail_slope=None).areas
    moved = [np.mean(a[1:] * a[:-1]) / 900 for a in (left, noise)]
    assert moved[0] - moved[1] == pytest.approx(-6e4 * areas[1, 0], rel=0.15)
    assert np.isinf(corrected_variance(flat, ITL, mask=flat > 0)).all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"corrected": [1.0]}, r"shape \(1,\), not \(ny, nx\)"),
        ({"read_noise": -1.0}, "read_noise = -1.0 e- must be finite"),
        ({"mask": [[True]]}, r"mask has the shape \(1, 1\), not \(2, 2\)"),
    ],
)
def test_variances_that_make_no_sense_are_refused(given, message):
    given = {"corrected": np.ones((2, 2)), **given}
    with pytest.raises(BFSensorError, match=message):
        corrected_variance(table=ITL, **given)


# -- stars and flats of the sensor ---------------------------------------------------------


def growth(image, without):
    """Growth of both second moments."""
    at = np.arange(len(image)) - len(image) // 2
    out = []
    for a in (image, without):
        for axis in (0, 1):
            p = a.sum(axis)
            mean = p @ at / p.sum()
            out.append(p @ (at - mean) ** 2 / p.sum())
    return np.array(out[:2]) / out[2:] - 1


@pytest.mark.parametrize(("name", "table"), [("itl_sta3800c", ITL), ("e2v_ccd250", E2V)])
def test_stars_of_the_sensor_come_back(name, table):
    """The same photons with and without the effect; stars of a FWHM of 3 pixels."""
    kernel = solve_kernel(quadrant_shifts(table, tail_slope=None).areas)
    before, after, by_kernel = [], [], []
    for seed in range(8):
        rng = np.random.default_rng([seed, 41])
        x, y = rng.normal(0, 1.27, (2, rng.poisson(1e5 * 2 * np.pi * 1.27**2)))
        light = galsim.PhotonArray(len(x), x + rng.uniform(-0.5, 0.5), y, np.ones(len(x)))
        drawn = []
        for strength in (1.0, 0.0):
            sensor = BrighterFatterSensor(
                name, strength=strength, nrecalc=500, rng=galsim.BaseDeviate(seed + 1)
            )
            image = galsim.ImageD(31, 31)
            image.setCenter(0, 0)
            sensor.accumulate(light, image)
            drawn.append(image.array)
        before.append(growth(*drawn))
        after.append(growth(correct_table(drawn[0], table, surroundings=0.0), drawn[1]))
        by_kernel.append(growth(correct_kernel(drawn[0], kernel), drawn[1]))
    before, after, by_kernel = (np.mean(a, axis=0) for a in (before, after, by_kernel))
    assert np.all(before > 0.006)
    # Measured within 0.3 %, with an error of 0.4 %.
    assert np.all(np.abs(after / before) < 0.015)
    assert np.all(by_kernel / before < -0.05)


def test_stars_of_a_sensor_of_image_charges_come_back():
    """A camera that was fitted to its covariances: one response, 15 um pixels, another engine."""
    table = DistortionTable.load("hsc_hamamatsu")
    before, after = [], []
    for seed in range(8):
        rng = np.random.default_rng([seed, 43])
        x, y = rng.normal(0, 1.3, (2, rng.poisson(9e4 * 2 * np.pi * 1.3**2)))
        light = galsim.PhotonArray(len(x), x + rng.uniform(-0.5, 0.5), y, np.ones(len(x)))
        drawn = []
        for strength in (1.0, 0.0):
            sensor = BrighterFatterSensor(
                table=table, strength=strength, nrecalc=800, rng=galsim.BaseDeviate(seed + 1),
                diffusion=3.0,
            )  # fmt: skip
            image = galsim.ImageD(31, 31)
            image.setCenter(0, 0)
            sensor.accumulate(light, image)
            drawn.append(image.array)
        before.append(growth(*drawn))
        after.append(growth(correct_table(drawn[0], table, surroundings=0.0), drawn[1]))
    before, after = (np.mean(a, axis=0) for a in (before, after))
    assert np.all(before > 0.008)
    # 16 stars of three widths are left with at most 1.3 %, with errors of 0.3 to 0.7 %.
    assert np.all(np.abs(after / before) < 0.03), after / before


def test_flats_of_the_sensor_come_back_white():
    flats = [
        draw_flat(
            BrighterFatterSensor("e2v_ccd250"), (512, 512), 8e4, rng=galsim.BaseDeviate(n)
        ).array.astype(float)
        for n in range(1, 5)
    ]
    found = []
    for images in (flats, [correct_table(f, E2V) for f in flats]):
        pairs = [flat_covariances(*images[k : k + 2], lags=1) for k in (0, 2)]
        found.append(np.mean([p.covariances for p in pairs], axis=0) / 8e4)
        error = pairs[0].errors / 8e4 / np.sqrt(2)
    raw, corrected = found
    assert raw[0, 0] < 0.9 and raw[1, 0] > 5 * error[1, 0]
    assert corrected[0, 0] == pytest.approx(1.0, abs=4 * error[0, 0])
    assert np.all(np.abs(corrected[[0, 1, 1], [1, 0, 1]]) < 4 * error[[0, 1, 1], [1, 0, 1]])


def test_red_light_is_corrected_less():
    image = star()
    blue, same, red = (
        correct_table(image, ITL, wavelengths=w) - image
        for w in (350.0, [350.0, 350.0], 1000.0)
    )
    surface = correct_table(image, ITL) - image
    np.testing.assert_allclose(blue, same, atol=1e-9)
    np.testing.assert_allclose(blue, surface, atol=0.02 * np.abs(surface).max())
    assert 0.85 < red.max() / blue.max() < 0.92
    mixed = (
        correct_table(image, ITL, wavelengths=[350.0, 1000.0], photons=[3.0, 1.0]) - image
    )
    assert blue.max() > mixed.max() > red.max()


def test_light_that_crosses_the_silicon_makes_no_charge():
    image, waves = star(), np.array([700.0, 1060.0])
    one, two, both = (
        correct_table(image, ITL, wavelengths=w) - image for w in (*waves, waves)
    )
    shares = -np.expm1(-ITL.thickness / absorption_length(waves, 173.15))
    assert shares[1] < 0.3
    middle = np.array([a[30, 30] for a in (one, two, both)])
    assert middle[2] == pytest.approx(shares @ middle[:2] / shares.sum(), rel=1e-3)
    assert abs(middle[2] / middle[:2].mean() - 1) > 0.02


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"image": np.ones(5)}, r"image of shape \(5,\) must have two sides"),
        ({"image": np.full((4, 4), np.nan)}, "of 4 x 4 pixels has none that is finite"),
        ({"surroundings": -1.0}, "surroundings = -1.0 must be 'none', 'mirrored'"),
        ({"surroundings": "open"}, "surroundings = 'open' must be 'none'"),
        ({"mask": np.zeros((3, 3), bool)}, r"mask has the shape \(3, 3\), not \(9, 9\)"),
        ({"mask": np.ones((9, 9))}, "none that is finite and not masked"),
        ({"out": np.zeros((3, 3))}, r"out has the shape \(3, 3\), not \(9, 9\)"),
        ({"beyond": "clip"}, "beyond = 'clip' must be one of hold, error"),
        ({"threads": 0}, "threads = 0 must be at least 1"),
        ({"photons": [1.0]}, "photons need wavelengths"),
        ({"wavelengths": [500.0, 600.0], "photons": [1.0]}, "the shapes"),
        ({"wavelengths": [500.0], "photons": [-1.0]}, "none below 0"),
        ({"wavelengths": [1400.0]}, "none of this light converts"),
    ],
)
def test_what_cannot_be_corrected_is_refused(given, message):
    image = given.pop("image", star(side=9))
    with pytest.raises(BFSensorError, match=message):
        correct_table(image, ITL, **given)
