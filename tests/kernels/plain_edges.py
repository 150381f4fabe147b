"""Boundaries around charge drawn in full, in plain numpy: the twin of the edge kernels."""

from functools import cache

import numpy as np

from bfsensor._kernels import edges as kernel
from bfsensor._kernels.compile_options import from_python
from bfsensor._kernels.photons import Pattern
from bfsensor._kernels.shifts import MODES
from bfsensor.device.shipped import tables_dir
from bfsensor.sensor.charge_response import factor_table
from bfsensor.sensor.edge_weights import make_edges
from bfsensor.sensor.image_exposure import ImageExposure, Physics
from bfsensor.sensor.silicon_sensor import SiliconSensor
from bfsensor.table.galsim_format import read_sides
from bfsensor.table.table import DistortionTable

collect = from_python(kernel.collect)

NEAR = 1
"""Reach of the other modes [pixel]."""


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
    """Our table of the ITL STA3800C: all modes, 48 layers, a response."""
    table = DistortionTable.read(tables_dir() / "itl_sta3800c" / "table.fits")
    f = factor_table(table, linear=linear)
    edges = make_edges(f.modes, f.points, f.heights, table.reach)
    medium = silicon_sensor().physics.medium
    physics = Physics(edges, f.response, medium, np.inf, True, 0.0, predict=True)
    return Sensor(physics, f.modes, lambda z: 1.0)


NO_PATTERN = Pattern(
    rings=np.zeros(0), ring_step=1.0, ring_x=0.0, ring_y=0.0, ring_factor=np.ones(2),
    map_x=np.zeros((0, 0)), map_y=np.zeros((0, 0)), map_0x=0.0, map_0y=0.0,
    map_factor=np.ones(2),
)  # fmt: skip


def expose(sensor, image):
    return ImageExposure(image, sensor.physics, NO_PATTERN, (0.0, 0.0), (31, 57))


def find_pixels(sensor, exposure, x, y, z, edges=None, hot=None):
    """Pixels (i, j) of electrons by the kernel."""
    count = len(x)
    room = [np.zeros(count, np.int32) for _ in range(4)]
    collect(
        sensor.physics.edges if edges is None else edges, exposure.charges,
        exposure.hot if hot is None else hot, np.ascontiguousarray(x, float),
        np.ascontiguousarray(y, float), np.asarray(z, np.float32), 0, count, *room,
    )  # fmt: skip
    i, j = room[2:]
    return i, np.where(i < 0, -1, j)


# -- the plain twin --------------------------------------------------------------------


def response_grids(sensor):
    """Effective charge of each mode, by charge and background."""
    r = sensor.physics.response
    return [r.first.astype(float), *np.moveaxis(r.near.astype(float), -1, 0)]


def charge_planes(charges):
    """Effective charges with one mode after the other, shape (modes, pixels with padding)."""
    return np.stack([charges.first, *charges.near.reshape(charges.first.size, -1).T])


def lows_by_tile(charges):
    """Charge that sums start from, shape (tiles, modes)."""
    return charges.lows.reshape(-1, MODES)


def effective_charges(sensor, image):
    """Effective charges of all modes, by two linear interpolations in a plain loop."""
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
    last = r.first.shape[1] - 2
    for grid in response_grids(sensor):
        found = np.zeros((ny, nx))
        for j in range(ny):
            for i in range(nx):
                # Along the background first; negative charge follows the first step.
                b = min(max(around[j, i] / 8 / r.background_step, 0), r.last_background)
                low = min(int(b), last)
                at_b = (low + 1 - b) * grid[:, low] + (b - low) * grid[:, low + 1]
                c = min(q[j, i], r.last_charge * r.charge_step)
                if c < 0:
                    found[j, i] = at_b[0] + c / r.charge_step * (at_b[1] - at_b[0])
                else:
                    found[j, i] = np.interp(c, charges, at_b)
        out.append(found)
    return out


def displace(sensor, image, layer, lows=(0.0,) * MODES):
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
        sides, reach = sensor.modes[mode], reaches[min(mode, 1)]
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
    reach = NEAR if mode else sensor.physics.edges.reach
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
        """Whether pixels (-1: none) are those of the polygons."""
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
    for mode, low in enumerate(lows_by_tile(charges).T[: len(sensor.modes)]):
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
