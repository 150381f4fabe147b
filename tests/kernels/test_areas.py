"""Areas of pixels, against those of polygons drawn in full."""

import numpy as np
import pytest

from bfsensor._kernels.areas import pixel_areas, times_ring_areas
from bfsensor._kernels.shifts import MODES
from tests.kernels.plain_edges import (
    IMAGES,
    NO_PATTERN,
    charge_planes,
    displace,
    draw_sides,
    expose,
    lows_by_tile,
    make_image,
    polygon,
    silicon_sensor,
    table_sensor,
)
from tests.kernels.test_photons import PATTERNS, plain_shift


def find_areas(sensor, image, *, pattern=NO_PATTERN, flux=True, lows=None, rows=None):
    charges = expose(sensor, image).charges
    if lows is None:
        lows = lows_by_tile(charges).min(0)
    out = np.full(image.shape, np.nan)
    first, last = (0, image.shape[0]) if rows is None else rows
    pixel_areas(
        sensor.physics.edges,
        charges,
        pattern,
        flux,
        np.asarray(lows, np.float32),
        first,
        last,
        out,
    )
    return out, np.asarray(lows, float)


def area(corners):
    """Shoelace formula about the first corner."""
    x, y = (corners - corners[0]).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def plain_areas(sides, shape):
    return np.array(
        [[area(polygon(sides, j, i)) for i in range(shape[1])] for j in range(shape[0])]
    )


def sides_of(sensor, image, lows):
    # Photons that convert at the back surface: the topmost layer, the whole shift.
    return draw_sides(sensor, displace(sensor, image, sensor.layers - 1, lows))


@pytest.mark.kernels
def test_a_few_areas_are_those_of_the_polygons():
    sensor = silicon_sensor()
    image = np.zeros((3, 4))
    image[1, 2] = 1.2e5
    found, lows = find_areas(sensor, image)
    expected = plain_areas(sides_of(sensor, image, lows), image.shape)
    assert np.abs(found - expected).max() < 1e-6
    assert found[1, 2] < 0.9


@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
@pytest.mark.parametrize("name", IMAGES)
def test_areas_are_those_of_the_polygons(make, name):
    sensor = make()
    image = make_image(name)
    found, lows = find_areas(sensor, image)
    expected = plain_areas(sides_of(sensor, image, lows), image.shape)
    # Shifts of 0.2 pixel, sums of 90 terms in single precision: 2e-7 each; four sides,
    # of which neighbouring points share most of the error.
    assert np.abs(found - expected).max() < 1e-6
    assert np.abs(found - 1).max() > 0.05


@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
def test_areas_less_a_sheet_of_charge_are_those_of_the_polygons(make):
    sensor = make()
    image = make_image("random", (9, 10))
    # Not the lowest charge: next to corners it moves points along the edges by 1e-2.
    lows = np.array([1.1e5, -3e4, 2e4, 1e4])
    lows[1:] *= sensor.layers > 1
    found, _ = find_areas(sensor, image, lows=lows)
    expected = plain_areas(sides_of(sensor, image, lows), image.shape)
    # As above.
    assert np.abs(found - expected).max() < 1e-6
    plain = plain_areas(sides_of(sensor, image, np.zeros(MODES)), image.shape)
    assert np.abs(found - plain).max() > 1e-4


@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
def test_rows_can_be_found_by_themselves(make):
    sensor = make()
    image = make_image("random")
    whole, lows = find_areas(sensor, image)
    part, _ = find_areas(sensor, image, lows=lows, rows=(5, 9))
    assert np.array_equal(part[5:9], whole[5:9])
    assert np.isnan(part[:5]).all() and np.isnan(part[9:]).all()


@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
def test_a_uniform_charge_changes_no_area(make):
    sensor = make()
    image = np.full((24, 22), 1e5)
    charges = expose(sensor, image).charges
    inner = (slice(6, -6), slice(6, -6))
    at = 12 * charges.stride + 12
    lows = np.zeros(MODES)
    planes = charge_planes(charges)
    lows[: len(planes)] = planes[:, at]
    found, _ = find_areas(sensor, image, lows=lows)
    # Taken off, it leaves rounding: shifts of 1e5 x 1.2e-6 that cancel, 1e-8 each.
    assert np.abs(found[inner] - 1).max() < 1e-6
    # At the border it is not uniform: electrons are drawn to where there is no charge.
    assert found[0].max() < 0.97
    # Not taken off, corners move apart along the edges by t = 1e5 x (sum of the weights of
    # a corner along an edge), for the windows of edges that meet there differ: a pixel
    # then lacks at most four triangles of t x t / 2.
    edges = sensor.physics.edges
    sums = edges.sums.reshape(2, edges.layers, 2, edges.points.size, MODES)[:, -1, ..., 0]
    t = 1e5 * np.abs(sums).max()
    found, _ = find_areas(sensor, image, lows=np.zeros(MODES))
    assert np.abs(found[inner] - 1).max() < 2 * t**2 + 1e-6


@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
def test_pixels_share_all_of_the_area(make):
    sensor = make()
    image = np.zeros((30, 32))
    image[6:-6, 6:-6] = make_image("random", (18, 20))
    found, lows = find_areas(sensor, image)
    # Pixels overlap or leave gaps where sides do not meet in their corners: polygons
    # through the ends that meet there, of the sign of what the pixels miss.
    sides = sides_of(sensor, image, lows)
    vertical, horizontal = sides
    gaps = 0.0
    for j in range(1, image.shape[0]):
        for i in range(1, image.shape[1]):
            ends = [
                vertical[j - 1, i, -1], horizontal[j, i, 0], vertical[j, i, 0],
                horizontal[j, i - 1, -1],
            ]  # fmt: skip
            gaps += area(np.array(ends))
    # 960 pixels, rounding of 2e-7 at random signs; the outermost sides stay in place.
    assert abs(found.sum() + gaps - image.size) < 1e-5
    assert abs(gaps) < 0.05
    assert np.abs(found - 1).max() > 0.05


@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
def test_a_lone_pixel_loses_what_its_neighbours_gain(make):
    # One source lies in the middle of all windows it is in; few corners do not meet.
    sensor = make()
    image = np.zeros((15, 15))
    image[7, 7] = 5e4
    found, _ = find_areas(sensor, image)
    assert found[7, 7] < 0.98
    assert found[7, 8] > 1.001 and found[8, 7] > 1.001
    # Gaps open at corners at the reach alone: 5e4 x (last weights, some 1e-8) squared.
    assert abs(found.sum() - 225) < 1e-5


@pytest.mark.parametrize("name", PATTERNS)
@pytest.mark.parametrize("flux", [False, True])
def test_fixed_patterns_move_the_corners_as_well(name, flux):
    sensor = silicon_sensor()
    pattern = PATTERNS[name]()
    image = make_image("bright pixel", (8, 9))
    found, lows = find_areas(sensor, image, pattern=pattern, flux=flux)
    if not flux:
        image = np.zeros_like(image)
    vertical, horizontal = sides_of(sensor, image, lows)
    t = sensor.points
    nominal = draw_sides(sensor, (0 * vertical, 0 * horizontal))
    for side, places in zip((vertical, horizontal), nominal, strict=True):
        for index in np.ndindex(side.shape[:3]):
            side[index] += plain_shift(pattern, *places[index], 1.0)
    assert t[0] == 0 and t[-1] == 1
    expected = plain_areas((vertical, horizontal), image.shape)
    assert np.abs(found - expected).max() < 1e-6
    assert np.abs(found - find_areas(sensor, image, flux=flux)[0]).max() > 1e-3


def test_without_flux_no_charge_is_looked_at():
    sensor = silicon_sensor()
    found, _ = find_areas(sensor, make_image("random"), flux=False)
    assert np.array_equal(found, np.ones((18, 20)))


def make_far_rings():
    """Half a pixel a period of 25, about a centre beside the image: areas change by an eighth."""
    radius = np.arange(1500) * 0.125
    rings = np.append(0.5 * np.cos(2 * np.pi * radius / 25.0), [0.0, 0.0])
    return NO_PATTERN._replace(
        rings=rings,
        ring_step=0.125,
        ring_x=-60.3,
        ring_y=-45.8,
        ring_factor=np.array([0.0, 1.0]),
    )


@pytest.mark.parametrize("make", [silicon_sensor, table_sensor])
def test_areas_under_rings_and_charge_are_those_that_light_meets(make):
    """Light that lands within the charge's boundaries came from there, shifted by the rings."""
    sensor, pattern = make(), make_far_rings()
    image = make_image("random", (9, 10))
    found, lows = find_areas(sensor, image)
    without = found.copy()
    times_ring_areas(pattern, found)
    vertical, horizontal = sides_of(sensor, image, lows)
    added = []
    for sides, nominal in zip(
        (vertical, horizontal),
        draw_sides(sensor, (0 * vertical, 0 * horizontal)),
        strict=True,
    ):
        added.append(sides.copy())
        for index in np.ndindex(sides.shape[:3]):
            added[-1][index] += plain_shift(pattern, *nominal[index], 1.0)
            sides[index] += plain_shift(pattern, *sides[index], 1.0)
    expected = plain_areas((vertical, horizontal), image.shape)
    # The product takes the rings' mean stretch of a pixel for that at its sides, which differs by
    # half its change across a pixel, 0.5 (2 pi / 25)^2 / 2 = 0.016; sides move by 0.02 (some by
    # 0.1), those across from one another alike but for a part.
    apart = np.abs(found - expected)
    assert apart.max() < 2e-3 and np.sqrt(np.mean(apart**2)) < 6e-4
    # Shifts that are added, both at the nominal place, are several times further off.
    other = plain_areas(added, image.shape)
    assert np.sqrt(np.mean((other - expected) ** 2)) > 5 * np.sqrt(np.mean(apart**2))
    assert np.abs(found - without).max() > 0.1


def test_areas_of_rings_alone_are_those_of_polygons():
    sensor, pattern = silicon_sensor(), make_far_rings()
    expected, _ = find_areas(sensor, np.zeros((11, 14)), pattern=pattern, flux=False)
    found = np.ones((11, 14))
    times_ring_areas(pattern, found)
    # A polygon's sides of an eighth of a pixel are chords: each side is off by (1/8)^2 / 12 of the
    # second derivative 0.5 (2 pi / 25)^2, which is 4e-5.
    assert np.abs(found - expected).max() < 5e-5
    assert np.abs(found - 1).max() > 0.1
