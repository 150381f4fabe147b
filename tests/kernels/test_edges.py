"""Pixels of electrons next to displaced boundaries, against polygons drawn in full."""

import numpy as np
import pytest

from bfsensor._kernels import hot as hot_kernel
from bfsensor._kernels.charge import TILE
from bfsensor._kernels.compile_options import from_python
from bfsensor._kernels.hot import FENCES
from bfsensor._kernels.shifts import find_layer
from tests.kernels.plain_edges import (
    IMAGES,
    Truth,
    check,
    check_that_it_counted,
    displace,
    displace_sheet,
    displaced,
    draw_sides,
    expose,
    find_pixels,
    lows_by_tile,
    make_image,
    scatter,
    silicon_sensor,
    table_sensor,
)

heat, evaluate, fence, cool, decide_hot = (
    from_python(getattr(hot_kernel, name))
    for name in ("heat", "evaluate", "fence", "cool", "decide_hot")
)


@pytest.mark.kernels
def test_a_few_electrons_fall_where_the_polygons_say():
    sensor = silicon_sensor()
    image = np.zeros((4, 5))
    image[1, 2] = 1.4e5
    image[3, 0] = 6e4
    sides = draw_sides(sensor, displaced(sensor, image, 0), sensor.factor(40.0))
    _, x, _, i, _ = check(sensor, image, 40.0, sides, 80, 8112)
    # With straight boundaries some would go elsewhere.
    assert np.any((np.floor(x) != i) & (i >= 0))


@pytest.mark.parametrize("z", [99.0, 5.3])
@pytest.mark.parametrize("name", IMAGES)
def test_galsim_boundaries_are_the_polygons(name, z):
    sensor = silicon_sensor()
    image = make_image(name)
    sides = draw_sides(sensor, displaced(sensor, image, 0), sensor.factor(z))
    truth, x, _, i, _ = check(sensor, image, z, sides, 20000, 5513)
    check_that_it_counted(truth)
    assert (np.floor(x) != i).sum() > 10


@pytest.mark.parametrize("layer", [47, 13])
@pytest.mark.parametrize("name", IMAGES)
def test_table_boundaries_are_the_polygons(name, layer):
    sensor = table_sensor()
    edges = sensor.physics.edges
    image = make_image(name)
    z = float(np.exp(edges.log_z0 + layer * edges.log_step))
    sides = draw_sides(sensor, displaced(sensor, image, layer))
    truth, x, _, i, _ = check(sensor, image, z, sides, 20000, 70921)
    check_that_it_counted(truth)
    assert (np.floor(x) != i).sum() > 10


@pytest.mark.parametrize("part", [0.31, 0.77])
def test_boundaries_between_two_layers_are_interpolated(part):
    sensor = table_sensor()
    edges = sensor.physics.edges
    image = make_image("random")
    level = int(expose(sensor, image).charges.ranges.min())
    # Layers that differ by so much that they are interpolated, and that most do.
    apart = np.flatnonzero(edges.alike <= level)
    steps = [
        np.abs(displace(sensor, image, k + 1)[0] - displace(sensor, image, k)[0]).max()
        for k in apart[::16]
    ]
    layer = int(apart[::16][np.argmax(steps)])
    assert max(steps) > 1e-3
    z = float(np.exp(edges.log_z0 + (layer + part) * edges.log_step))
    below, above = (displaced(sensor, image, k) for k in (layer, layer + 1))
    shifts = [a + part * (b - a) for a, b in zip(below, above, strict=True)]
    # The logarithm is good to 2e-7 of itself (4.6), in steps of 0.1: 1e-5 of the step.
    check(sensor, image, z, draw_sides(sensor, shifts), 20000, 30103, 1e-5 * max(steps))


def test_layers_that_are_taken_for_alike_differ_little():
    sensor = table_sensor()
    edges = sensor.physics.edges
    image = make_image("negative")
    level = int(expose(sensor, image).charges.ranges.max())
    for layer in np.flatnonzero(edges.alike > level)[::6]:
        below, above = (displaced(sensor, image, k) for k in (layer, layer + 1))
        lengths = np.gradient(sensor.points)
        for a, b, component in zip(below, above, (0, 1), strict=True):
            # The claim: half a step moves an edge, in the mean over its points, by 5e-5.
            half = 0.5 * np.abs(b - a)[..., component].mean(-1)
            assert half.max() < 5e-5
            assert (0.5 * np.abs((b - a)[..., component]) @ lengths).max() < 1e-4


@pytest.mark.parametrize("sensor", [silicon_sensor, table_sensor])
def test_edges_beyond_a_tile_of_charge_without_an_end(sensor):
    # Nine tiles on a pedestal; only the innermost sees no empty sky beyond the image.
    sensor = sensor()
    image = 3e4 + make_image("random", (48, 50)) / 3
    exposure = expose(sensor, image)
    layer = sensor.layers - 1
    assert lows_by_tile(exposure.charges)[5, 0] > 0
    z = 99.0
    rng = np.random.default_rng(40999)
    for row, column in ((1, 1), (2, 3)):
        tile = row * 4 + column
        lows = lows_by_tile(exposure.charges)[tile]
        shifts = displace(sensor, image, layer, lows)
        sides = draw_sides(sensor, shifts, sensor.factor(z))
        x, y = scatter(sides, 40000, int(rng.integers(3000, 9000)))
        # Not across the border of the tile, where the sheet taken off is another one.
        inside = (abs(x - 16 * column - 8) < 7.5) & (abs(y - 16 * row - 8) < 7.5)
        x, y = x[inside], y[inside]
        truth = Truth(sides, x, y)
        i, j = find_pixels(sensor, exposure, x, y, np.full(len(x), z))
        clear = truth.distance > 2e-5
        assert truth.agrees(i, j)[clear].all()


@pytest.mark.parametrize("sensor", [silicon_sensor, table_sensor])
@pytest.mark.parametrize("name", ["random", "bright pixel", "negative"])
@pytest.mark.parametrize("pedestal", [0.0, 2e4])
def test_margins_are_bounds(sensor, name, pedestal):
    sensor = sensor()
    image = make_image(name, (34, 37)) + pedestal
    charges = expose(sensor, image).charges
    edges = sensor.physics.edges
    tiles_y, tiles_x = 3, 3
    for layer in {0, sensor.layers - 1}:
        # The same for all tiles but for the sheet that is taken off.
        whole = displace(sensor, image, layer)
        sheets = [displace_sheet(sensor, layer, m) for m in range(len(sensor.modes))]
        for row in range(tiles_y):
            for column in range(tiles_x):
                tile = row * tiles_x + column
                lows = lows_by_tile(charges)[tile]
                vertical, horizontal = (
                    side
                    - sum(low * sheet[n] for low, sheet in zip(lows, sheets, strict=False))
                    for n, side in enumerate(whole)
                )
                margin = charges.margins[tile]
                ys = slice(row * TILE, (row + 1) * TILE)
                xs = slice(column * TILE, (column + 1) * TILE)
                y_lines = slice(row * TILE, (row + 1) * TILE + 1)
                x_lines = slice(column * TILE, (column + 1) * TILE + 1)
                largest = np.abs(vertical[ys, x_lines, :, 0]).max()
                assert margin * edges.shares[0] >= largest
                largest = np.abs(horizontal[y_lines, xs, :, 1]).max()
                assert margin * edges.shares[1] >= largest
                # A bound of use: a lone pixel moves edges by a third of it, or more.
                if name == "bright pixel" and pedestal == 0 and tile == 4:
                    assert largest > 0.2 * margin or layer < sensor.layers - 1


def look_everything_up(sensor, exposure):
    """Charges and edges with which no bound saves a look at the polyline."""
    charges = exposure.charges
    charges = charges._replace(
        margins=np.ones_like(charges.margins),
        ranges=np.full_like(charges.ranges, sensor.physics.edges.doubts.shape[1] - 1),
    )
    exact = exposure.copy()
    exact.charges = charges
    return exact


def check_bounds_change_nothing(sensor, image, z, count, seed):
    exposure = expose(sensor, image)
    # Layers taken for alike are decided by range; that is no bound and not meant here.
    edges = sensor.physics.edges
    edges = edges._replace(alike=np.zeros_like(edges.alike))
    shifts = displace(sensor, image, sensor.layers - 1)
    sides = draw_sides(sensor, shifts, sensor.factor(z.max()))
    x, y = scatter(sides, count, seed)
    z = z[np.arange(len(x)) % len(z)]
    fast = find_pixels(sensor, exposure, x, y, z, edges)
    slow = find_pixels(sensor, look_everything_up(sensor, exposure), x, y, z, edges)
    different = (fast[0] != slow[0]) | (fast[1] != slow[1])
    assert not different.any(), (x[different][0], y[different][0], z[different][0])


@pytest.mark.kernels
def test_bounds_change_nothing_in_a_small_image():
    image = np.zeros((4, 5))
    image[2, 2] = 1.1e5
    check_bounds_change_nothing(silicon_sensor(), image, np.array([60.0, 3.0]), 60, 117)


@pytest.mark.parametrize("sensor", [silicon_sensor, table_sensor])
@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("scale", [1.0, 0.02])
def test_bounds_change_nothing(sensor, name, scale):
    sensor = sensor()
    image = scale * make_image(name, (37, 40)) + 500.0
    heights = np.exp(np.random.default_rng(9911).uniform(0, np.log(99.0), 4099))
    check_bounds_change_nothing(sensor, image, heights, 60000, 12007)


@pytest.mark.parametrize("sensor", [silicon_sensor, table_sensor])
@pytest.mark.parametrize("name", ["random", "bright corner"])
def test_hot_edges_are_the_same_polylines(sensor, name):
    sensor = sensor()
    image = make_image(name)
    exposure = expose(sensor, image)
    edges, charges, hot = sensor.physics.edges, exposure.charges, exposure.hot
    ny, nx = image.shape
    for j in range(2, ny, 1):
        for i in range(nx - 3):
            heat(edges, charges, hot, 0, i, j)
            heat(edges, charges, hot, 1, j, i)
    count = hot.used[1]
    assert count == 2 * (ny - 2) * (nx - 3)
    evaluate(edges, charges, hot, 0, 1)
    fence(edges, charges, hot, 0, 1)
    z = 99.0
    layer = sensor.layers - 1
    sides = draw_sides(sensor, displaced(sensor, image, layer), sensor.factor(z))
    truth, x, y, i, j = check(sensor, image, z, sides, 20000, 61403)
    given = find_pixels(sensor, exposure, x, y, np.full(len(x), z))
    clear = truth.distance > 2e-5
    # Single precision places along the edge: 1e-7 of a pixel times slopes below 1.
    far = clear & ~truth.sliver
    assert np.array_equal(given[0][far], i[far])
    assert np.array_equal(given[1][far], j[far])
    assert truth.agrees(*given)[clear].all()
    # They were looked at: with their shifts off the answers are the nominal pixels.
    hot.lines[:] = 0.0
    fence(edges, charges, hot, 0, 1)
    given = find_pixels(sensor, exposure, x, y, np.full(len(x), z))
    inner = (x > 0.5) & (x < nx - 4) & (y > 2.5) & (y < ny - 0.5)
    inner &= (abs(x - np.round(x)) > 1e-4) & (abs(y - np.round(y)) > 1e-4)
    assert np.array_equal(given[0][inner], np.floor(x[inner]))
    assert np.array_equal(given[1][inner], np.floor(y[inner]))
    # Cooled, they are forgotten.
    cool(hot)
    assert (hot.page_of == -1).all()
    again = find_pixels(sensor, exposure, x, y, np.full(len(x), z))
    assert np.array_equal(again[0], i)


@pytest.mark.parametrize("sensor", [silicon_sensor, table_sensor])
@pytest.mark.parametrize("name", ["random", "bright corner", "bright pixel", "negative"])
@pytest.mark.parametrize("pedestal", [0.0, 5e4])
def test_hot_edges_change_nothing_at_any_height(sensor, name, pedestal):
    sensor = sensor()
    image = make_image(name) + pedestal
    exposure = expose(sensor, image)
    edges, charges, hot = sensor.physics.edges, exposure.charges, exposure.hot
    ny, nx = image.shape
    rng = np.random.default_rng(55103)
    # Some edges are not hot, so that bounds end where a line does.
    for j, i in np.argwhere(rng.random((ny, nx)) < 0.8):
        heat(edges, charges, hot, 0, i, j)
        heat(edges, charges, hot, 1, j, i)
    evaluate(edges, charges, hot, 0, 1)
    fence(edges, charges, hot, 0, 1)
    sides = draw_sides(sensor, displaced(sensor, image, sensor.layers - 1))
    x, y = scatter(sides, 60000, 90121)
    z = rng.uniform(20.0, 99.9, len(x)).astype(np.float32)
    given = find_pixels(sensor, exposure, x, y, z)
    # The bounds decide most electrons: two thirds of them are at edges whose line is hot.
    u, v = rng.uniform(0, (nx, ny), (5000, 2)).T
    all_of_them = np.arange(5000, dtype=np.int32)
    left = decide_hot(
        edges, charges, hot, np.bool_(True), u, v, z[z > 70][:5000], all_of_them, 5000,
        np.zeros(5000, np.int32),
    )  # fmt: skip
    assert left < 2500 or charges.margins.max() >= 0.5
    cool(hot)
    again = find_pixels(sensor, exposure, x, y, z)
    assert np.array_equal(given[0], again[0])
    assert np.array_equal(given[1], again[1])


def test_hot_edges_that_overlap_where_they_meet_are_bounded_as_well():
    # Far beyond any full well the ends of two edges pass each other, by what their windows leave out.
    sensor = silicon_sensor()
    ny, nx = 20, 21
    y, x = np.mgrid[:ny, :nx]
    image = 7e5 * np.exp(-0.5 * ((x - 10) ** 2 + (y - 9.5) ** 2) / 1.1**2)
    exposure = expose(sensor, image)
    edges, charges, hot = sensor.physics.edges, exposure.charges, exposure.hot
    for j in range(ny):
        for i in range(nx):
            heat(edges, charges, hot, 0, i, j)
            heat(edges, charges, hot, 1, j, i)
    evaluate(edges, charges, hot, 0, 1)
    fence(edges, charges, hot, 0, 1)
    line = 10
    chosen = {
        int(other): n
        for n, (side, where, other) in enumerate(hot.edge[: hot.used[1]])
        if side == 0 and where == line
    }
    points = edges.points.size
    # Where each edge ends and the next begins: place along them, and shift.
    ends, begins = (
        np.array([
            (other + k + edges.points[p] + hot.lines[chosen[other + k], 16 + p],
             hot.lines[chosen[other + k], p]) for other in range(5, 14)
        ]) for k, p in ((0, points - 1), (1, 0))
    )  # fmt: skip
    back = np.floor(FENCES * ends[:, 0]) > np.floor(FENCES * begins[:, 0])
    # Some go back across the end of a step along an edge, and no step is left open for that.
    assert back.any()
    for other in range(6, 14):
        assert np.isfinite(hot.fences[chosen[other]]).all()
    # Electrons about these points, where it matters which of the two edges decides.
    rng = np.random.default_rng(71843)
    part, more = rng.uniform(-0.2, 1.2, (2, 20000, back.sum()))
    y, x = (
        (begins[back, n] + t * (ends - begins)[back, n]).ravel()
        for n, t in ((0, part), (1, more))
    )
    x += line
    z = np.full(x.size, 99.0)
    given = find_pixels(sensor, exposure, x, y, z)
    cool(hot)
    again = find_pixels(sensor, exposure, x, y, z)
    assert np.array_equal(given[0], again[0])
    assert np.array_equal(given[1], again[1])


def test_electrons_outside_or_lost_have_no_pixel():
    sensor = silicon_sensor()
    image = make_image("random")
    exposure = expose(sensor, image)
    ny, nx = image.shape
    x = np.array([-0.95, nx + 0.9, 5.5, -40.0, 1e9, 5.5, 5.5, np.nextafter(nx + 1, 0)])
    y = np.array([5.5, 5.5, ny + 0.99, 5.5, 5.5, -1e18, 5.5, 5.5])
    z = np.array([50, 50, 50, 50, 50, 50, -1, 50])
    i, _ = find_pixels(sensor, exposure, x, y, z)
    assert (i == -1).all()
    i, j = find_pixels(sensor, exposure, np.array([5.5]), np.array([5.5]), np.array([0.0]))
    assert (i[0], j[0]) == (5, 5)


@pytest.mark.kernels
def test_heights_lie_between_their_layers():
    """Layers of a table have a constant ratio of heights: 5 to 80 um in 4 steps of 2."""
    find = from_python(find_layer)
    log_z0, per_log = np.float32(np.log(5.0)), np.float32(1 / np.log(2.0))
    for height in (5.0, 7.3, 20.0, 39.0, 79.0):
        layer, part = find(log_z0, per_log, 5, np.float32(height))
        assert 0 <= layer <= 3 and 0.0 <= part <= 1.0
        # Logarithms in single precision: a few 1e-7 of log2(80).
        assert 5.0 * 2.0 ** (layer + part) == pytest.approx(height, rel=5e-6)
    for height, end in ((2.0, 0.0), (95.0, 4.0)):  # below the lowest and above the highest
        assert sum(find(log_z0, per_log, 5, np.float32(height))) == end
    assert find(log_z0, per_log, 1, np.float32(20.0)) == (0, 0.0)
