"""Pixels of electrons next to displaced boundaries, against polygons drawn in full."""

from functools import cache

import numpy as np
import pytest

from bfsensor._kernels import edges as kernel
from bfsensor._kernels import hot as hot_kernel
from bfsensor._kernels.charge import TILE
from bfsensor._kernels.photons import Pattern
from bfsensor.galsim_format import read_sides
from bfsensor.resources import tables_dir
from bfsensor.sensor.edges import make_edges
from bfsensor.sensor.exposure import Exposure, Physics
from bfsensor.sensor.response import factor_table
from bfsensor.sensor.silicon_sensor import SiliconSensor
from bfsensor.table import DistortionTable

NEAR = 1
"""Reach of the second mode [pixel]."""


# -- sensors ---------------------------------------------------------------------------


class Sensor:
    """Physics of the engine beside the float64 shifts around a source it was made of.

    ``modes``: pairs (vertical, horizontal) as for ``make_edges``, ``factor`` of all shifts
    by height.
    """

    def __init__(self, physics, modes, factor):
        self.physics = physics
        self.modes = modes
        self.factor = factor
        self.points = np.asarray(physics.edges.points)
        self.layers = physics.edges.layers


@cache
def silicon_sensor(predict=False):
    """GalSim's lsst_itl_50_8: linear, one layer, tanh(z / 12 um)."""
    sensor = SiliconSensor()
    physics = sensor._physics
    physics = Physics(
        physics.edges, physics.response, physics.medium, np.inf, True, 0.0, predict
    )
    sides, points = read_sides(sensor.config_file, sensor.vertex_file)
    assert np.array_equal(points, physics.edges.points)
    config = sensor.config
    per_electron = 1.0 / (config["CollectedCharge_0_0"] * config["PixelSizeX"])
    modes = [tuple(per_electron * np.broadcast_to(s, (1, *s.shape[-4:])) for s in sides)]

    def factor(z):
        steps = np.linspace(0, config["SensorThickness"], len(physics.edges.scale))
        return np.interp(z, steps, np.tanh(steps / 12.0))

    return Sensor(physics, modes, factor)


@cache
def table_sensor(linear=False):
    """Our table of the ITL STA3800C: two modes, 48 layers, a response."""
    table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
    f = factor_table(table, linear=linear)
    modes = [f.first] if f.second is None else [f.first, f.second]
    edges = make_edges(f.first, f.second, f.points, f.heights, table.reach)
    medium = silicon_sensor().physics.medium
    physics = Physics(edges, f.response, medium, np.inf, True, 0.0, predict=True)
    return Sensor(physics, modes, lambda z: 1.0)


NO_PATTERN = Pattern(
    rings=np.zeros(0), ring_step=1.0, ring_x=0.0, ring_y=0.0, ring_factor=np.ones(2),
    map_x=np.zeros((0, 0)), map_y=np.zeros((0, 0)), map_0x=0.0, map_0y=0.0,
    map_factor=np.ones(2),
)  # fmt: skip


def expose(sensor, image):
    return Exposure(image, sensor.physics, NO_PATTERN, (0.0, 0.0), (31, 57))


def find_pixels(sensor, exposure, x, y, z, edges=None, hot=None):
    """Pixels (i, j) of electrons by the kernel."""
    count = len(x)
    room = [np.zeros(count, np.int32) for _ in range(4)]
    kernel.collect(
        sensor.physics.edges if edges is None else edges, exposure.charges,
        exposure.hot if hot is None else hot, np.ascontiguousarray(x, float),
        np.ascontiguousarray(y, float), np.asarray(z, np.float32), 0, count, *room,
    )  # fmt: skip
    i, j = room[2:]
    return i, np.where(i < 0, -1, j)


# -- the plain twin --------------------------------------------------------------------


def effective_charges(sensor, image):
    """Effective charges of both modes, by two linear interpolations in a plain loop."""
    r = sensor.physics.response
    q = np.asarray(image, float)
    if r.first.size == 0:
        return [q]
    ny, nx = q.shape
    padded = np.pad(q, 1)
    around = sum(
        padded[1 + b : 1 + b + ny, 1 + a : 1 + a + nx]
        for a in (-1, 0, 1)
        for b in (-1, 0, 1)
        if (a, b) != (0, 0)
    )
    out = []
    charges = np.arange(r.first.shape[0]) * r.charge_step
    backgrounds = np.arange(r.first.shape[1]) * r.background_step
    for grid in (r.first, r.second):
        found = np.zeros((ny, nx))
        for j in range(ny):
            for i in range(nx):
                b = min(max(around[j, i] / 8, 0), r.last_background * r.background_step)
                # Along the background first; negative charge follows the first step.
                at_b = [np.interp(b, backgrounds, row) for row in grid.astype(float)]
                c = min(q[j, i], r.last_charge * r.charge_step)
                if c < 0:
                    found[j, i] = at_b[0] + c / r.charge_step * (at_b[1] - at_b[0])
                else:
                    found[j, i] = np.interp(c, charges, at_b)
        out.append(found)
    return out


def displace(sensor, image, layer, lows=(0.0, 0.0)):
    """Displaced points [pixel] of all sides of an image, source by source.

    ``lows``: charge of the uniform sheet that is taken off, by mode.

    Returns
    -------
    vertical, horizontal : ndarray, shapes (ny, nx + 1, points, 2), (ny + 1, nx, points, 2)
        Shifts (dx, dy) for a factor of 1.
    """
    ny, nx = np.shape(image)
    points = len(sensor.points)
    vertical = np.zeros((ny, nx + 1, points, 2))
    horizontal = np.zeros((ny + 1, nx, points, 2))
    reaches = (sensor.physics.edges.reach, NEAR)
    charges = effective_charges(sensor, image)
    for mode, (q, low) in enumerate(zip(charges, lows, strict=False)):
        sides, reach = sensor.modes[mode], reaches[mode]
        upright, flat = (side[layer] for side in sides)
        middle = upright.shape[0] // 2
        for j in range(ny):
            for i in range(nx):
                # Vertical sides of rows within the reach, the lines of columns within it.
                r0, r1 = max(j - reach, 0), min(j + reach + 1, ny)
                l0, l1 = max(i - reach, 0), min(i + reach + 2, nx + 1)
                a, b = middle - j, middle - i
                vertical[r0:r1, l0:l1] += (
                    q[j, i] * upright[a + r0 : a + r1, b + l0 : b + l1]
                )
                l0, l1 = max(j - reach, 0), min(j + reach + 2, ny + 1)
                r0, r1 = max(i - reach, 0), min(i + reach + 1, nx)
                horizontal[l0:l1, r0:r1] += q[j, i] * flat[a + l0 : a + l1, b + r0 : b + r1]
        sheet = displace_sheet(sensor, layer, mode)
        vertical -= low * sheet[0]
        horizontal -= low * sheet[1]
    return vertical, horizontal


def displace_sheet(sensor, layer, mode):
    """Shifts [points, 2] of both sides by one electron in every pixel within the reach.

    The sheet goes on beyond the image: every side has all of its sources.
    """
    reach = (sensor.physics.edges.reach, NEAR)[mode]
    upright, flat = (side[layer] for side in sensor.modes[mode])
    middle = upright.shape[-4] // 2
    across = slice(middle - reach, middle + reach + 1)
    lines = slice(middle - reach, middle + reach + 2)
    axes = (-4, -3)
    return (
        upright[..., across, lines, :, :].sum(axes),
        flat[..., lines, across, :, :].sum(axes),
    )


def draw_sides(sensor, shifts, factor=1.0):
    """Points (x, y) of all sides: nominal places plus shifts."""
    vertical, horizontal = (factor * s for s in shifts)
    ny, nx = vertical.shape[0], horizontal.shape[1]
    t = sensor.points
    vertical[..., 0] += np.arange(nx + 1)[None, :, None]
    vertical[..., 1] += np.arange(ny)[:, None, None] + t
    horizontal[..., 0] += np.arange(nx)[None, :, None] + t
    horizontal[..., 1] += np.arange(ny + 1)[:, None, None]
    return vertical, horizontal


def polygon(sides, j, i):
    """Corners of pixel (j, i), counter-clockwise, every side with its own ends."""
    vertical, horizontal = sides
    return np.concatenate(
        [
            horizontal[j, i], vertical[j, i + 1], horizontal[j + 1, i][::-1],
            vertical[j, i][::-1],
        ]
    )  # fmt: skip


def is_inside(corners, x, y):
    """Ray crossing: an odd number of sides lies to the right."""
    ax, ay = corners.T[..., None]
    bx, by = np.roll(corners, -1, axis=0).T[..., None]
    spans = (ay > y) != (by > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = ax + (y - ay) / (by - ay) * (bx - ax)
    return (spans & (x < at)).sum(0) % 2 == 1


def distance(corners, x, y):
    """Distance [pixel] of points from a polygon's sides."""
    a = corners
    step = np.roll(corners, -1, axis=0) - a
    length = np.maximum((step**2).sum(1), 1e-300)
    dx = x - a[:, :1]
    dy = y - a[:, 1:]
    share = np.clip((dx * step[:, :1] + dy * step[:, 1:]) / length[:, None], 0, 1)
    return np.hypot(dx - share * step[:, :1], dy - share * step[:, 1:]).min(0)


class Truth:
    """Pixels of electrons by polygons.

    ``inside`` and ``allowed`` [electrons, 9]: the pixel around the nominal one that holds
    the electron, and those it may be given to next to corners that do not meet;
    ``distance`` [pixel] from the next boundary.
    """

    def __init__(self, sides, x, y):
        ny, nx = sides[0].shape[0], sides[1].shape[1]
        self.shape = (ny, nx)
        self.i0 = np.floor(x).astype(int)
        self.j0 = np.floor(y).astype(int)
        self.inside = np.zeros((len(x), 9), bool)
        self.allowed = np.zeros((len(x), 9), bool)
        self.distance = np.full(len(x), np.inf)
        for j in range(ny):
            for i in range(nx):
                near = np.flatnonzero((abs(self.i0 - i) < 2) & (abs(self.j0 - j) < 2))
                if near.size == 0:
                    continue
                place = 3 * (j - self.j0[near] + 1) + i - self.i0[near] + 1
                corners = polygon(sides, j, i)
                self.inside[near, place] = is_inside(corners, x[near], y[near])
                found = distance(corners, x[near], y[near])
                self.distance[near] = np.minimum(self.distance[near], found)
        self.sliver = self._find_slivers(sides, x, y)

    def _find_slivers(self, sides, x, y):
        """Electrons closer to a corner than the copies of it are apart."""
        ny, nx = self.shape
        out = np.zeros(len(x), bool)
        for j in range(ny + 1):
            for i in range(nx + 1):
                near = np.flatnonzero((abs(x - i) < 0.7) & (abs(y - j) < 0.7))
                copies = corner_copies(sides, j, i)
                apart = max(np.hypot(*(a - b)) for a in copies for b in copies)
                for copy in copies:
                    close = np.hypot(x[near] - copy[0], y[near] - copy[1]) <= apart
                    close = near[close]
                    out[close] = True
                    for b in (j - 1, j):
                        for a in (i - 1, i):
                            db, da = b - self.j0[close] + 1, a - self.i0[close] + 1
                            fits = (abs(db - 1) < 2) & (abs(da - 1) < 2)
                            self.allowed[close[fits], (3 * db + da)[fits]] = True
        return out

    def agrees(self, i, j):
        """Tell whether pixels (-1: none) are those of the polygons."""
        place = 3 * (j - self.j0 + 1) + i - self.i0 + 1
        none = i < 0
        row = np.arange(len(i))
        fits = (abs(j - self.j0) < 2) & (abs(i - self.i0) < 2)
        place = np.where(fits & ~none, place, 0)
        here = np.where(none, ~self.inside.any(1), self.inside[row, place] & fits)
        ny, nx = self.shape
        border = (self.i0 <= 0) | (self.j0 <= 0) | (self.i0 >= nx - 1) | (self.j0 >= ny - 1)
        sliver = np.where(none, border, self.allowed[row, place] & fits) & self.sliver
        return here | sliver


def corner_copies(sides, j, i):
    """Ends of the sides that meet in corner (j, i)."""
    vertical, horizontal = sides
    ny, nx = vertical.shape[0], horizontal.shape[1]
    out = []
    if j < ny:
        out.append(vertical[j, i, 0])
    if j > 0:
        out.append(vertical[j - 1, i, -1])
    if i < nx:
        out.append(horizontal[j, i, 0])
    if i > 0:
        out.append(horizontal[j, i - 1, -1])
    return out


def scatter(sides, count, seed):
    """Electrons everywhere, and next to displaced sides and corners."""
    rng = np.random.default_rng(seed)
    vertical, horizontal = sides
    ny, nx = vertical.shape[0], horizontal.shape[1]
    part = count // 4
    anywhere = rng.uniform(-0.9, (nx + 0.9, ny + 0.9), (part, 2))
    lines = [vertical.reshape(-1, vertical.shape[2], 2)]
    lines.append(horizontal.reshape(-1, horizontal.shape[2], 2))
    lines = np.concatenate(lines)
    side = rng.integers(0, len(lines), 2 * part)
    first = rng.integers(0, lines.shape[1] - 1, 2 * part)
    share = rng.uniform(0, 1, (2 * part, 1))
    on = (1 - share) * lines[side, first] + share * lines[side, first + 1]
    # Half of them very close: within 0.02 and within 0.001 pixel.
    size = np.repeat([0.02, 0.001], part)[:, None]
    on += rng.uniform(-1, 1, (2 * part, 2)) * size
    corners = lines[rng.integers(0, len(lines), part), rng.choice([0, -1], part)]
    corners = corners + rng.uniform(-0.02, 0.02, (part, 2))
    points = np.concatenate([anywhere, on, corners])
    return points[:, 0].copy(), points[:, 1].copy()


# -- images ----------------------------------------------------------------------------


def make_image(name, shape=(18, 20)):
    rng = np.random.default_rng(26017)
    image = np.zeros(shape)
    if name == "random":
        image = rng.uniform(0, 1.5e5, shape)
    elif name == "bright pixel":
        image[shape[0] // 2, shape[1] // 2] = 1.5e5
    elif name == "bright corner":
        image[0, 0] = 1.5e5
        image[-1, shape[1] // 2] = 1.2e5
        image[shape[0] // 2, -1] = 0.9e5
    elif name == "full to the border":
        image[:] = 1.5e5
    elif name == "negative":
        image = rng.uniform(-800, 800, shape)
        # The same lowest charge in every tile.
        image[1::3, 1::3] = -800
        image[3, 5] = 8e4
    return image


IMAGES = ["random", "bright pixel", "bright corner", "full to the border", "negative"]


def lowest_charges(sensor, image):
    """Charge taken off by the kernel, where all tiles have the same or it does nothing."""
    charges = expose(sensor, image).charges
    out = []
    for mode, low in enumerate(
        (charges.low_first, charges.low_second)[: len(sensor.modes)]
    ):
        upright, flat = displace_sheet(sensor, slice(None), mode)
        spread = float(np.ptp(low))
        assert spread * np.abs(upright[..., 0]).max() < 2e-6
        assert spread * np.abs(flat[..., 1]).max() < 2e-6
        # Along an edge, whose slope is below 0.2, next to corners.
        assert spread * np.abs(upright[..., 1]).max() < 3.5e-5
        assert spread * np.abs(flat[..., 0]).max() < 3.5e-5
        out.append(float(low.mean()))
    return tuple(out)


def displaced(sensor, image, layer):
    """Displaced points less what the lowest charge everywhere does."""
    return displace(sensor, image, layer, lowest_charges(sensor, image))


def check(sensor, image, z, sides, count, seed, extra=0.0):
    exposure = expose(sensor, image)
    x, y = scatter(sides, count, seed)
    truth = Truth(sides, x, y)
    i, j = find_pixels(sensor, exposure, x, y, np.full(len(x), z))
    # Charges of 1.5e5 e- in single precision, shifts of 0.2 pixel summed over 90 sources:
    # rounding of 2^-24 x 0.2 x 90 in the worst case is 1e-6, in what cancels a few more.
    clear = truth.distance > 2e-5 + extra
    wrong = clear & ~truth.agrees(i, j)
    assert not wrong.any(), (
        f"{wrong.sum()} of {len(x)}, first x = {x[wrong][0]!r}, y = {y[wrong][0]!r}, "
        f"given ({i[wrong][0]}, {j[wrong][0]}), {truth.distance[wrong][0]:.2e} pixel from an "
        "edge"
    )
    return truth, x, y, i, j


def check_that_it_counted(truth):
    """Few electrons were left out as too close to an edge, or let off as in a sliver."""
    # A quarter lies within 0.001 pixel of an edge, of these one in fifty within 2e-5.
    assert (truth.distance <= 2e-5).mean() < 0.02
    # A quarter lies next to corners, whose copies are up to 0.04 pixel apart.
    assert truth.sliver.mean() < 0.3


# -- tests -----------------------------------------------------------------------------


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
    assert exposure.charges.low_first.reshape(3, 4)[1, 1] > 0
    z = 99.0
    rng = np.random.default_rng(40999)
    for row, column in ((1, 1), (2, 3)):
        tile = row * 4 + column
        lows = exposure.charges.low_first[tile], exposure.charges.low_second[tile]
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
                lows = charges.low_first[tile], charges.low_second[tile]
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
            hot_kernel.heat(edges, charges, hot, 0, i, j)
            hot_kernel.heat(edges, charges, hot, 1, j, i)
    count = hot.used[1]
    assert count == 2 * (ny - 2) * (nx - 3)
    hot_kernel.evaluate(edges, charges, hot, 0, count)
    hot_kernel.fence(edges, charges, hot, 0, count)
    z = 99.0 if sensor.layers > 1 else 31.0
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
    hot_kernel.fence(edges, charges, hot, 0, count)
    given = find_pixels(sensor, exposure, x, y, np.full(len(x), z))
    inner = (x > 0.5) & (x < nx - 4) & (y > 2.5) & (y < ny - 0.5)
    inner &= (abs(x - np.round(x)) > 1e-4) & (abs(y - np.round(y)) > 1e-4)
    assert np.array_equal(given[0][inner], np.floor(x[inner]))
    assert np.array_equal(given[1][inner], np.floor(y[inner]))
    # Cooled, they are forgotten.
    hot_kernel.cool(hot)
    assert (hot.page_of == -1).all()
    again = find_pixels(sensor, exposure, x, y, np.full(len(x), z))
    assert np.array_equal(again[0], i)


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
