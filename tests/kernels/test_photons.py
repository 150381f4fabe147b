"""Photons on their way to the wells, against a plain twin in double precision."""

from itertools import pairwise

import numpy as np
import pytest

from bfsensor._kernels import photons as kernel
from bfsensor._kernels.compile_options import from_python
from bfsensor._kernels.counter_rng import deviates
from bfsensor._kernels.photons import Light, Medium, Pattern

land_photons, find_origin, fixed_shift = map(
    from_python, (kernel.land, kernel.find_origin, kernel.fixed_shift)
)

NONE = np.zeros(0)
KEY = (np.uint32(0xB0A3), np.uint32(0x71))
ORIGIN = (4.5, -2.5)

# Absorption lengths from a few 0.1 um to beyond the thickness, not linear in wavelength.
LENGTHS = 0.2 * np.exp(np.linspace(0.0, 7.5, 41))
MEDIUM = Medium(
    thickness=100.0, pitch_x=10.0, pitch_y=12.5, lengths=LENGTHS, wavelength_0=300.0,
    wavelength_step=20.0, surface_path=1.0, kept_path=np.inf, kept_slanted=False,
    variance=np.linspace(1.0, 6.0, 65) ** 1.5, diffuse=True,
)  # fmt: skip
NO_PATTERN = Pattern(
    rings=NONE, ring_step=1.0, ring_x=0.0, ring_y=0.0, ring_factor=np.ones(2),
    map_x=np.zeros((0, 0)), map_y=np.zeros((0, 0)), map_0x=0.0, map_0y=0.0,
    map_factor=np.ones(2),
)  # fmt: skip


def make_light(count, seed, *, coloured=False, slanted=False):
    rng = np.random.default_rng(seed)
    wavelength = rng.uniform(280.0, 1120.0, count) if coloured else NONE
    if coloured and count >= 8:
        # Below, at and above the ends of the table.
        wavelength[:8] = [0.0, np.inf, 300.0, 1100.0, 299.999, 1100.001, 320.0, 1e300]
    return Light(
        x=rng.uniform(-5, 60, count),
        y=rng.uniform(-5, 60, count),
        flux=np.ones(count),
        slope_x=rng.normal(0, 0.3, count) if slanted else NONE,
        slope_y=rng.normal(0, 0.3, count) if slanted else NONE,
        wavelength=wavelength,
    )


def land(light, medium, pattern=NO_PATTERN, lo=0, hi=None, number=1000):
    hi = light.x.size if hi is None else hi
    x, y = np.full((2, hi - lo), np.nan)
    z = np.full(hi - lo, np.nan, np.float32)
    words = np.full(hi - lo, 0xDEADBEEF, np.uint32)
    land_photons(light, medium, pattern, lo, hi, number, *KEY, *ORIGIN, x, y, z, words)
    return x, y, z, words


def random_numbers(count, number=1000):
    out = [np.zeros(count, np.float32) for _ in range(3)]
    words = np.zeros(count, np.uint32)
    deviates(number, *KEY, *out, words)
    return *(a.astype(float) for a in out), words


def plain(light, medium, n, normal_x, normal_y, path):
    """Landing position of one photon: x, y [pixel], height [um]."""
    coloured, slanted = light.wavelength.size > 0, light.slope_x.size > 0
    way = medium.surface_path
    if coloured:
        grid = medium.wavelength_0 + medium.wavelength_step * np.arange(medium.lengths.size)
        way = np.interp(light.wavelength[n], grid, medium.lengths) * path
    sx, sy = (light.slope_x[n], light.slope_y[n]) if slanted else (0.0, 0.0)
    depth = way / np.sqrt(1 + sx**2 + sy**2)
    if slanted or not medium.kept_slanted:
        depth = min(depth, medium.kept_path)
    z = medium.thickness - depth
    heights = np.linspace(0, medium.thickness, medium.variance.size)
    width = np.sqrt(np.interp(z, heights, medium.variance)) if medium.diffuse else 0.0
    x = light.x[n] - ORIGIN[0] + (sx * depth + width * normal_x) / medium.pitch_x
    y = light.y[n] - ORIGIN[1] + (sy * depth + width * normal_y) / medium.pitch_y
    return x, y, z


VARIANTS = {
    "as they come": {},
    "no diffusion": {"diffuse": False},
    "red is kept": {"kept_path": 99.0},
    "slanted red is kept": {"kept_path": 99.0, "kept_slanted": True},
    "kept above the surface path": {"kept_path": 0.5},
    "the same for slanted": {"kept_path": 0.5, "kept_slanted": True},
}


def check(light, medium):
    count = light.x.size
    x, y, z, words = land(light, medium)
    normal_x, normal_y, path, expected_words = random_numbers(count)
    for n in range(count):
        px, py, pz = plain(light, medium, n, normal_x[n], normal_y[n], path[n])
        # A depth in single precision, up to thousands of um: 2^-24 of it, twice.
        depth = medium.thickness - pz
        rounding = 2.0**-22 * (depth + medium.thickness)
        if pz < -rounding:
            assert z[n] == kernel.LOST
        elif pz > rounding:
            assert abs(z[n] - pz) < rounding
        # The width of up to 4 um: its height's rounding times the slope of the variance
        # (0.2 um) over twice the width (1 um or more), and 3 roundings of its own.
        blur = 0.2 * rounding + 3 * 2.0**-23 * 4.0
        sx, sy = (light.slope_x[n], light.slope_y[n]) if light.slope_x.size else (0, 0)
        spread = (abs(normal_x[n]) * blur + abs(sx) * rounding) / medium.pitch_x
        assert abs(x[n] - px) < spread + 1e-12
        spread = (abs(normal_y[n]) * blur + abs(sy) * rounding) / medium.pitch_y
        assert abs(y[n] - py) < spread + 1e-12
    return x, y, z, words, expected_words


@pytest.mark.kernels
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("slanted", [False, True])
def test_photons_land_where_the_plain_twin_says(variant, coloured, slanted):
    medium = MEDIUM._replace(**VARIANTS[variant])
    light = make_light(40, 30211, coloured=coloured, slanted=slanted)
    _, _, _, words, expected_words = check(light, medium)
    # Without diffusion and wavelengths no deviate is drawn: see below.
    if medium.diffuse or coloured:
        assert np.array_equal(words, expected_words)


@pytest.mark.kernels
@pytest.mark.parametrize("slanted", [False, True])
def test_words_are_written_where_nothing_else_is_drawn(slanted):
    # They say to which side an electron spills.
    light = make_light(40, 30211, slanted=slanted)
    words = land(light, MEDIUM._replace(diffuse=False))[3]
    assert np.array_equal(words, random_numbers(40)[3])


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("slanted", [False, True])
def test_many_photons_land_where_the_plain_twin_says(variant, slanted):
    medium = MEDIUM._replace(**VARIANTS[variant])
    light = make_light(2500, 4079, coloured=True, slanted=slanted)
    _, _, z, _, _ = check(light, medium)
    # Some cross the silicon unless they are kept.
    kept = np.isfinite(medium.kept_path) and (slanted or not medium.kept_slanted)
    assert (z == kernel.LOST).any() != kept
    if kept:
        assert z.min() == np.float32(medium.thickness - medium.kept_path)


@pytest.mark.kernels
def test_wavelengths_beyond_the_table_have_the_lengths_of_its_ends():
    light = make_light(8, 517, coloured=True)
    _, _, z, _ = land(light, MEDIUM)
    path = random_numbers(8)[2]
    assert light.wavelength[0] == 0.0 and light.wavelength[1] == np.inf
    # Single precision: 2^-23 of 100 um.
    assert abs(z[0] - (100 - LENGTHS[0] * path[0])) < 2e-5
    deep = 100 - LENGTHS[-1] * path[1]
    assert z[1] == kernel.LOST if deep < 0 else abs(z[1] - deep) < 2e-5
    kept = land(light, MEDIUM._replace(kept_path=99.0))[2]
    assert kept[1] == max(np.float32(deep), np.float32(1.0))


def test_depths_follow_the_law_of_absorption():
    # One wavelength, length L: mean depth of those within the silicon, and how many cross.
    light = make_light(60_000, 7717, coloured=True)
    light = light._replace(wavelength=np.full(60_000, 300.0 + 20.0 * 30))
    length = LENGTHS[30]
    z = land(light, MEDIUM)[2].astype(float)
    crossed = np.exp(-100.0 / length)
    assert 0.05 < crossed < 0.95
    sigma = np.sqrt(crossed * (1 - crossed) / z.size)
    assert abs((z < 0).mean() - crossed) < 5 * sigma
    depth = 100.0 - z[z >= 0]
    mean = length - 100.0 * crossed / (1 - crossed)
    assert abs(depth.mean() - mean) < 5 * depth.std() / np.sqrt(depth.size)


def test_diffusion_has_the_variance_of_its_height():
    count = 50_000
    light = make_light(count, 6673)._replace(x=np.zeros(count), y=np.zeros(count))
    x, y, z, _ = land(light, MEDIUM)
    assert np.all(z == np.float32(99.0))
    variance = np.interp(99.0, np.linspace(0, 100, 65), MEDIUM.variance)
    sigma = np.sqrt(2 / count)
    assert abs((x + ORIGIN[0]).var() * 10.0**2 / variance - 1) < 5 * sigma
    assert abs((y + ORIGIN[1]).var() * 12.5**2 / variance - 1) < 5 * sigma


@pytest.mark.kernels
@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("slanted", [False, True])
@pytest.mark.parametrize("diffuse", [False, True])
def test_chunks_give_the_same_bits(coloured, slanted, diffuse):
    light = make_light(50, 12301, coloured=coloured, slanted=slanted)
    check_chunks(light, (0, 1, 18, 19, 50), diffuse)


@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("slanted", [False, True])
def test_chunks_that_cut_across_buffers_give_the_same_bits(coloured, slanted):
    b = kernel.BUFFER
    light = make_light(3 * b + 100, 12302, coloured=coloured, slanted=slanted)
    check_chunks(light, (0, 700, b, 2 * b + 1, 3 * b + 99, 3 * b + 100), True)


def check_chunks(light, cuts, diffuse):
    medium = MEDIUM._replace(diffuse=diffuse)
    pattern = make_rings()
    whole = land(light, medium, pattern)
    for lo, hi in pairwise(cuts):
        part = land(light, medium, pattern, lo, hi, 1000 + lo)
        for a, b in zip(whole, part, strict=True):
            assert np.array_equal(a[lo:hi], b)


# -- fixed patterns --------------------------------------------------------------------


def make_rings():
    step = 0.25
    radius = step * np.arange(400)
    return NO_PATTERN._replace(
        rings=0.2 * np.sin(radius / 7.0) * radius / 100, ring_step=step, ring_x=-3.0,
        ring_y=20.0, ring_factor=np.linspace(0.0, 1.0, 17) ** 2,
    )  # fmt: skip


def make_map():
    rng = np.random.default_rng(40009)
    smooth = np.add.outer(np.sin(np.arange(70) / 5.0), np.cos(np.arange(71) / 4.0))
    return NO_PATTERN._replace(
        map_x=0.05 * smooth + rng.uniform(-1e-3, 1e-3, smooth.shape), map_y=-0.03 * smooth,
        map_0x=-8.25, map_0y=-6.5, map_factor=np.array([0.5, 1.0]),
    )  # fmt: skip


def make_both():
    return make_rings()._replace(
        **{k: v for k, v in make_map()._asdict().items() if "map" in k}
    )


def make_edges():
    """At two points a pixel, the same at all heights."""
    smooth = np.add.outer(np.sin(np.arange(140) / 10.0), np.cos(np.arange(142) / 8.0))
    return NO_PATTERN._replace(
        edge_x=(0.05 * smooth).astype(np.float32),
        edge_y=(-0.03 * smooth).astype(np.float32), edge_0x=-8.25, edge_0y=-6.5,
    )  # fmt: skip


PATTERNS = {"rings": make_rings, "map": make_map, "both": make_both, "edges": make_edges}


def plain_shift(pattern, x, y, part):
    """Shift of a boundary: rings by one interpolation, the map by two."""
    shift = np.zeros(2)
    if pattern.rings.size:
        away = np.array([x - pattern.ring_x, y - pattern.ring_y])
        r = np.hypot(*away)
        radii = pattern.ring_step * np.arange(pattern.rings.size)
        heights = np.linspace(0, 1, pattern.ring_factor.size)
        if 0 < r < radii[-1]:
            size = np.interp(r, radii, pattern.rings)
            size *= np.interp(part, heights, pattern.ring_factor)
            shift += size * away / r
    if pattern.map_x.size:
        ny, nx = pattern.map_x.shape
        xs, ys = pattern.map_0x + np.arange(nx), pattern.map_0y + np.arange(ny)
        heights = np.linspace(0, 1, pattern.map_factor.size)
        if xs[0] <= x <= xs[-1] and ys[0] <= y <= ys[-1]:
            factor = np.interp(part, heights, pattern.map_factor)
            for n, field in enumerate((pattern.map_x, pattern.map_y)):
                rows = [np.interp(x, xs, row) for row in field]
                shift[n] += factor * np.interp(y, ys, rows)
    if pattern.edge_x.size:
        ny, nx = pattern.edge_x.shape
        xs, ys = pattern.edge_0x + np.arange(nx) / 2, pattern.edge_0y + np.arange(ny) / 2
        if xs[0] <= x <= xs[-1] and ys[0] <= y <= ys[-1]:
            for n, field in enumerate((pattern.edge_x, pattern.edge_y)):
                rows = [np.interp(x, xs, row) for row in field.astype(float)]
                shift[n] += np.interp(y, ys, rows)
    return shift


@pytest.mark.kernels
@pytest.mark.parametrize("name", PATTERNS)
def test_fixed_shifts_equal_their_plain_twin(name):
    pattern = PATTERNS[name]()
    rng = np.random.default_rng(88301)
    points = rng.uniform(-12, 72, (40, 2))
    # Centre and edges of the patterns too.
    points[:5] = [
        [-3.0, 20.0],
        [-8.25, -6.5],
        [61.75, 62.5],
        [-8.2500001, 0],
        [96.75, 20.0],
    ]
    for (x, y), part in zip(points, rng.uniform(0, 1, 40), strict=True):
        found = fixed_shift(pattern, x, y, part)
        # Double precision; a position of 70 in steps of 0.25 is good to 1e-13.
        assert np.allclose(found, plain_shift(pattern, x, y, part), rtol=0, atol=1e-13)


@pytest.mark.kernels
@pytest.mark.parametrize("name", PATTERNS)
def test_points_come_back_from_where_they_were_shifted(name):
    pattern = PATTERNS[name]()
    medium = MEDIUM._replace(diffuse=False)
    rng = np.random.default_rng(50023)
    points = rng.uniform(2, 50, (30, 2))
    part = (medium.thickness - medium.surface_path) / medium.thickness
    shifts = np.array([plain_shift(pattern, *p, part) for p in points])
    there = points + shifts + ORIGIN
    light = make_light(30, 881)._replace(x=there[:, 0].copy(), y=there[:, 1].copy())
    x, y, _, _ = land(light, medium, pattern)
    # Every round of the iteration leaves the slope of the shift times the error: below
    # 0.03 for rings (0.2 / 7 + 0.2 / 100) and for the map (0.05 (1/5 + 1/4) + 0.002),
    # 0.06 for both; the first error is the shift itself, four rounds follow.
    slope = 0.06 if name == "both" else 0.03
    found = np.stack([x, y], 1)
    assert np.abs(shifts).max() > 0.03
    assert np.abs(found - points).max() < 2 * np.abs(shifts).max() * slope**4


@pytest.mark.kernels
@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_act_by_height_and_not_on_lost_photons(name):
    pattern = PATTERNS[name]()
    light = make_light(40, 60029, coloured=True, slanted=True)
    x, y, z, words = land(light, MEDIUM, pattern)
    ux, uy, uz, uwords = land(light, MEDIUM)
    assert np.array_equal(z, uz) and np.array_equal(words, uwords)
    moved = 0
    for n in range(40):
        p = np.array([ux[n], uy[n]])
        if z[n] >= 0:
            for _ in range(30):
                p = np.array([ux[n], uy[n]]) - plain_shift(pattern, *p, float(z[n]) / 100)
        # The tolerance of the search.
        assert abs(x[n] - p[0]) < 1e-6 and abs(y[n] - p[1]) < 1e-6
        moved += abs(x[n] - ux[n]) > 1e-4
    assert moved > 10
    assert (z == kernel.LOST).any()


@pytest.mark.kernels
def test_origins_under_large_shifts_are_found():
    """Next to a guard ring pixels can be several times too large, or without light."""
    # Boundaries of a row: the first three at one place, then pixels of 3, 0.2, 1 and 1.
    shift = np.array([2.0, 1.0, 0.0, 2.0, 1.2, 1.2, 1.2, 1.2, 1.2])
    pattern = NO_PATTERN._replace(map_x=np.tile(shift, (3, 1)), map_y=np.zeros((3, 9)))
    places = np.linspace(2.05, 7.15, 103)
    moved = np.arange(9.0) + shift
    for x in places:
        px, py = find_origin(pattern, x, 1.3, 1.0)
        assert px == pytest.approx(np.interp(x, moved[2:], np.arange(2.0, 9.0)), abs=3e-6)
        assert py == 1.3


@pytest.mark.kernels
def test_origins_under_small_shifts_take_four_steps():
    pattern = NO_PATTERN._replace(
        map_x=np.array([[0.1, 0.12], [0.1, 0.12]]), map_y=np.zeros((2, 2))
    )
    px = 0.5
    for _ in range(4):
        px = 0.5 - fixed_shift(pattern, px, 0.5, 1.0)[0]
    assert find_origin(pattern, 0.5, 0.5, 1.0)[0] == px


@pytest.mark.kernels
@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("amplitude", [0.3, 6.0])
def test_origins_under_rings_are_found(amplitude, coloured):
    """Solved along the radius, by secants where rings are so steep that pixels nearly vanish.

    Every place is that of its origin and the rings' shift there: below the gates none, at the
    rings' centre, next to it, and beyond the last ring too.
    """
    radius = np.arange(801) * 0.125
    values = amplitude * np.sin(2 * np.pi * radius / 43.0) * np.minimum(radius / 9, 1)
    rings = np.append(values, [0.0, 0.0])
    pattern = NO_PATTERN._replace(
        rings=rings,
        ring_step=0.125,
        ring_x=21.3,
        ring_y=8.7,
        ring_factor=np.linspace(0.2, 1, 6),
    )
    light = make_light(300, 6120, coloured=coloured)
    light.x[8:16], light.y[8:16] = 21.3 + ORIGIN[0], 8.7 + ORIGIN[1]
    light.x[12:16] += np.array([1e-9, 0.01, 99.9, 150.0])
    medium = MEDIUM._replace(diffuse=False)
    nominal_x, nominal_y, z, _ = land(light, medium)
    x, y, _, _ = land(light, medium, pattern)
    moved = 0
    for n in range(300):
        if z[n] < 0:
            assert (x[n], y[n]) == (nominal_x[n], nominal_y[n])
            continue
        dx, dy = plain_shift(pattern, x[n], y[n], float(z[n]) / 100)
        # The last step of .125 pixel, where the rings fall to nothing, is steeper than any ring.
        if abs(np.hypot(x[n] - 21.3, y[n] - 8.7) - 100) < 0.3:
            continue
        assert abs(x[n] + dx - nominal_x[n]) + abs(y[n] + dy - nominal_y[n]) < 4e-6
        moved += abs(x[n] - nominal_x[n]) > 0.02
    assert moved > 100


@pytest.mark.kernels
@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")  # uncompiled
def test_rings_that_leave_a_pixel_no_width_give_numbers():
    """Where the shift falls by a pixel a pixel, Newton's step divides by zero."""
    radius = np.arange(41) * 0.5
    rings = np.append(np.where(radius < 12, 0.0, np.maximum(12 - radius, -2.0)), [0.0, 0.0])
    pattern = NO_PATTERN._replace(rings=rings, ring_step=0.5, ring_factor=np.ones(2))
    light = make_light(200, 7731)._replace(
        x=np.linspace(10.0, 16.0, 200) + ORIGIN[0], y=np.full(200, ORIGIN[1])
    )
    x, y, _, _ = land(light, MEDIUM._replace(diffuse=False), pattern)
    assert np.isfinite(x).all() and np.isfinite(y).all()
    # Up to 12 nothing moves; from 14 on the shift is -2.
    nominal = light.x - ORIGIN[0]
    assert np.array_equal(x[nominal < 11.9], nominal[nominal < 11.9])
    assert np.abs(x - nominal - 2)[nominal > 12.1].max() < 1e-5
