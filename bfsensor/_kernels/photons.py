"""Conversion of photons at the surface to electrons above the wells: depth, angle, diffusion.

Positions out are in pixels from the lower left corner of the image: pixel (j, i) holds
x from i to i + 1 and y from j to j + 1.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.compile_options import INLINED, INNER
from bfsensor._kernels.counter_rng import draw_words, exponentials, normals
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.lookups import get, looked_up, put

BUFFER = 1024
"""Number of photons in a buffer of deviates.

Chosen: four buffers of single precision, 16 kB, stay in the first-level cache; twice as large gives
the same bits."""
LOST = np.float32(-1.0)
"""Height of a photon that crossed the silicon, by definition below the gates."""
_ORIGIN_STEPS = 64
"""Largest number of steps of the search for the origin of a shifted point; the last one counts.

Chosen: rings take four steps; twice as many change only points where pixels overlap."""
_FLATTEST, _STEEPEST = 0.02, 50.0
"""Bounds on the slope of a secant step, the relative size of pixels under a shift.

Chosen: pixels next to a guard ring are several times too large or small, well inside; with a range
twice as wide a step may go further in the wrong place."""
_NEWTON_STEPS = 5
"""Largest number of Newton's steps to the origin of a point shifted by a map.

Chosen: smooth maps take three; with twice as many the slower search is begun later."""
_ORIGIN_TOLERANCE = 1e-6
"""Largest distance between a point and its shifted origin at which the search ends [pixel].

Chosen: half of the 2e-6 pixel by which bounds of edges are widened for rounding; twice as large,
origins may be off by as much as that."""


class Light(NamedTuple):
    """Photons: positions [pixel], flux [e-], slopes dx/dz and dy/dz, wavelengths [nm].

    Arrays that the photons do not have are of size 0.
    """

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    slope_x: np.ndarray
    slope_y: np.ndarray
    wavelength: np.ndarray


class Medium(NamedTuple):
    """The silicon: thickness [um], pitch [um], absorption lengths and diffusion.

    ``lengths`` are absorption lengths [um] at wavelengths ``wavelength_0 + n wavelength_step`` [nm],
    held at the ends beyond them; ``variance`` is that of the diffusion [um^2] at heights
    ``n thickness / (size - 1)``.  ``surface_path`` is the depth [um] at which photons without
    wavelength convert.  Photons that would convert deeper than ``kept_path`` [um] convert there
    (inf: they are lost); with ``kept_slanted`` this holds only for photons with angles.
    """

    thickness: float
    pitch_x: float
    pitch_y: float
    lengths: np.ndarray
    wavelength_0: float
    wavelength_step: float
    surface_path: float
    kept_path: float
    kept_slanted: bool
    variance: np.ndarray
    diffuse: bool


class Pattern(NamedTuple):
    """Fixed shifts of the pixel boundaries [pixel]: rings and a map, each by height.

    ``rings`` at radii ``n ring_step`` from (``ring_x``, ``ring_y``) in the coordinates of
    the positions out, the last two 0; none beyond them.  ``map_x, map_y`` at the points
    (``map_0x`` + i, ``map_0y`` + j); none outside.  The factors belong to heights
    ``n thickness / (size - 1)``.  ``edge_x, edge_y`` at two points a pixel,
    (``edge_0x`` + i / 2, ``edge_0y`` + j / 2), the same at all heights; none outside.
    """

    rings: np.ndarray
    ring_step: float
    ring_x: float
    ring_y: float
    ring_factor: np.ndarray
    map_x: np.ndarray
    map_y: np.ndarray
    map_0x: float
    map_0y: float
    map_factor: np.ndarray
    edge_x: np.ndarray = np.zeros((0, 0), np.float32)
    edge_y: np.ndarray = np.zeros((0, 0), np.float32)
    edge_0x: float = 0.0
    edge_0y: float = 0.0


@numba.njit(**INLINED)
def _at(table, position):
    """Linear interpolation at ``position`` in units of the spacing, the ends held."""
    last = np.float64(table.size - 1)
    position = min(max(position, 0.0), last)
    # Vector code converts to integers of 32 bits.
    n = np.int32(min(position, last - 1.0))
    low = looked_up(table, n)
    return low + (position - n) * (looked_up(table, n + 1) - low)


@numba.njit(**INLINED)
def _between(map_x, map_y, u, v, factor):
    """Shift between the points of a map, u and v steps from its first one, and its changes a step.

    Returned are dx and dy, their changes along x, and those along y; 0 outside the map.
    """
    ny, nx = map_x.shape
    if not (0.0 <= u <= nx - 1 and 0.0 <= v <= ny - 1):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    i = np.uint64(min(np.int64(u), nx - 2))
    j = np.uint64(min(np.int64(v), ny - 2))
    one = np.uint64(1)
    u -= i
    v -= j
    a = factor * (1 - u) * (1 - v)
    b = factor * u * (1 - v)
    c = factor * (1 - u) * v
    d = factor * u * v
    xa, xb, xc, xd = (
        map_x[j, i],
        map_x[j, i + one],
        map_x[j + one, i],
        map_x[j + one, i + one],
    )
    ya, yb, yc, yd = (
        map_y[j, i],
        map_y[j, i + one],
        map_y[j + one, i],
        map_y[j + one, i + one],
    )
    return (
        a * xa + b * xb + c * xc + d * xd,
        a * ya + b * yb + c * yc + d * yd,
        factor * ((1 - v) * (xb - xa) + v * (xd - xc)),
        factor * ((1 - v) * (yb - ya) + v * (yd - yc)),
        factor * ((1 - u) * (xc - xa) + u * (xd - xb)),
        factor * ((1 - u) * (yc - ya) + u * (yd - yb)),
    )


@numba.njit(**INNER)
def _shift_and_slopes(pattern, x, y, ring_factor, map_factor):
    """Shift (dx, dy) [pixel] of a boundary at (x, y), its changes by x, and its changes by y."""
    dx = dy = dx_x = dy_x = dx_y = dy_y = 0.0
    if pattern.rings.size > 0:
        rx = x - pattern.ring_x
        ry = y - pattern.ring_y
        r = np.sqrt(rx * rx + ry * ry)
        at = r / pattern.ring_step
        if 0.0 < at < pattern.rings.size - 2:
            n = np.uint64(min(np.int64(at), pattern.rings.size - 2))
            low = pattern.rings[n]
            change = pattern.rings[n + np.uint64(1)] - low
            size = ring_factor * (low + (at - n) * change) / r
            dx = size * rx
            dy = size * ry
            # Across the rings they change by their slope, along them by the shift over the radius.
            across = (ring_factor * change / pattern.ring_step - size) / (r * r)
            dx_x = size + across * rx * rx
            dy_x = dx_y = across * rx * ry
            dy_y = size + across * ry * ry
    if pattern.map_x.size > 0:
        mx, my, mx_x, my_x, mx_y, my_y = _between(
            pattern.map_x, pattern.map_y, x - pattern.map_0x, y - pattern.map_0y, map_factor
        )
        dx, dy = dx + mx, dy + my
        dx_x, dy_x, dx_y, dy_y = dx_x + mx_x, dy_x + my_x, dx_y + mx_y, dy_y + my_y
    if pattern.edge_x.size > 0:
        # Two points a pixel.
        mx, my, mx_x, my_x, mx_y, my_y = _between(
            pattern.edge_x, pattern.edge_y, 2 * (x - pattern.edge_0x),
            2 * (y - pattern.edge_0y), 1.0,
        )  # fmt: skip
        dx, dy = dx + mx, dy + my
        dx_x, dy_x = dx_x + 2 * mx_x, dy_x + 2 * my_x
        dx_y, dy_y = dx_y + 2 * mx_y, dy_y + 2 * my_y
    return dx, dy, dx_x, dy_x, dx_y, dy_y


@numba.njit(**INLINED)
def _factors(pattern, part):
    """Factors of rings and map at ``part`` of the thickness."""
    return (
        _at(pattern.ring_factor, part * (pattern.ring_factor.size - 1)),
        _at(pattern.map_factor, part * (pattern.map_factor.size - 1)),
    )


@numba.njit(**INNER)
def fixed_shift(pattern, x, y, part):
    """Shift (dx, dy) [pixel] of a boundary at (x, y), for ``part`` of the thickness."""
    ring_factor, map_factor = _factors(pattern, part)
    found = _shift_and_slopes(pattern, x, y, ring_factor, map_factor)
    return found[0], found[1]


@numba.njit(**INLINED)
def _next_place(now, before, excess, excess_before):
    """Secant step, each axis by itself, its slope kept positive: boundaries never cross."""
    moved = now - before
    slope = 1.0
    if abs(moved) > 1e-12:
        slope = min(max((excess - excess_before) / moved, _FLATTEST), _STEEPEST)
    return now - excess / slope


@numba.njit(**INNER)
def find_origin(pattern, x, y, part):
    """Point whose shift leads to (x, y) [pixel], for ``part`` of the thickness.

    Four plain steps are enough for rings; where they are not, as next to a guard ring, whose
    pixels can be several times too large or small, secants go on.
    """
    px = x
    py = y
    before_x = x
    before_y = y
    excess_x = 0.0
    excess_y = 0.0
    for n in range(_ORIGIN_STEPS):
        dx, dy = fixed_shift(pattern, px, py, part)
        new_x = px + dx - x
        new_y = py + dy - y
        if n >= 3 and abs(new_x) + abs(new_y) < _ORIGIN_TOLERANCE:
            return x - dx, y - dy
        if n >= 4:
            to_x = _next_place(px, before_x, new_x, excess_x)
            to_y = _next_place(py, before_y, new_y, excess_y)
        else:
            to_x = x - dx
            to_y = y - dy
        before_x = px
        before_y = py
        excess_x = new_x
        excess_y = new_y
        px = to_x
        py = to_y
    return px, py


@numba.njit(**INLINED)
def ring_shift(rings, last, at):
    """Shift at a radius in steps of the rings, and its change over the step there.

    Rings are lines between their radii, and end with 0 and 0: beyond nothing moves.
    """
    at = at if at < last else last
    n = np.int32(at)
    low = looked_up(rings, n)
    change = looked_up(rings, n + 1) - low
    return low + (at - np.float64(n)) * change, change


@numba.njit(**INNER)
def _ring_origins(pattern, thickness, z, alike, x, y, to, count, factor, radius, scale):
    """Move electrons to the points whose rings' shifts lead to where they are, in place.

    Rings are radial, so with ``g`` their shift the radius ``s`` is sought at which
    ``s + g(s)`` is the electron's.  Two of Newton's steps leave 1e-8 pixel where rings of 0.3
    pixel have a period of 50; what is further off than the tolerance goes to :func:`find_origin`.
    ``factor``, ``radius``, ``scale``: room for ``count`` numbers.  ``alike``: all electrons come
    from the height of the first.  Those below the gates (``z`` negative) stay where they are.
    """
    rings = pattern.rings
    last = np.float64(rings.size - 2)
    per_step = 1.0 / pattern.ring_step
    heights = np.float64(pattern.ring_factor.size - 1) / thickness
    if alike:
        factor[:count] = _at(pattern.ring_factor, np.float64(z[to]) * heights)
    else:
        for m in range(np.uint64(count)):
            put(factor, m, _at(pattern.ring_factor, np.float64(get(z, to + m)) * heights))
    for m in range(np.uint64(count)):
        rx = x[to + m] - pattern.ring_x
        ry = y[to + m] - pattern.ring_y
        radius[m] = np.sqrt(rx * rx + ry * ry)
    far = 0
    for m in range(np.uint64(count)):
        r = get(radius, m)
        size = get(factor, m)
        shift, change = ring_shift(rings, last, r * per_step)
        s = abs(r - size * shift / (1.0 + size * change * per_step))
        shift, change = ring_shift(rings, last, s * per_step)
        s = abs(s - (s + size * shift - r) / (1.0 + size * change * per_step))
        shift, change = ring_shift(rings, last, s * per_step)
        off = abs(s + size * shift - r)
        # At the centre itself there is no direction, and nothing moves.
        put(scale, m, s / r if r > 0.0 else 1.0)
        put(factor, m, off)
        # Written so that nan, of a step with slope 0, is far as well.
        far += not off < _ORIGIN_TOLERANCE
    for m in range(np.uint64(count)):
        here_x = x[to + m]
        here_y = y[to + m]
        found = factor[m] < _ORIGIN_TOLERANCE and z[to + m] >= np.float32(0.0)
        there_x = pattern.ring_x + scale[m] * (here_x - pattern.ring_x)
        there_y = pattern.ring_y + scale[m] * (here_y - pattern.ring_y)
        x[to + m] = there_x if found else here_x
        y[to + m] = there_y if found else here_y
    if far == 0:
        return
    for m in range(np.uint64(count)):
        if not factor[m] < _ORIGIN_TOLERANCE and z[to + m] >= np.float32(0.0):
            part = np.float64(z[to + m]) / thickness
            x[to + m], y[to + m] = find_origin(pattern, x[to + m], y[to + m], part)


@numba.njit(**INNER)
def _origins(pattern, thickness, z, x, y, to, count):
    """Move electrons to the points whose shifts, by rings and maps, lead to where they are, in place.

    Newton's steps: between the points of a map the shift is smooth, and two steps leave 1e-8 pixel
    of 0.3.  What is not within the tolerance after five goes to :func:`find_origin`.  Those below
    the gates (``z`` negative) stay where they are.
    """
    for m in range(np.uint64(count)):
        n = to + m
        if z[n] < np.float32(0.0):
            continue
        part = np.float64(z[n]) / thickness
        ring_factor, map_factor = _factors(pattern, part)
        px = x[n]
        py = y[n]
        for _ in range(_NEWTON_STEPS):
            dx, dy, dx_x, dy_x, dx_y, dy_y = _shift_and_slopes(
                pattern, px, py, ring_factor, map_factor
            )
            off_x = px + dx - x[n]
            off_y = py + dy - y[n]
            size = (1.0 + dx_x) * (1.0 + dy_y) - dx_y * dy_x
            per_size = 1.0 / size
            px -= per_size * ((1.0 + dy_y) * off_x - dx_y * off_y)
            py -= per_size * ((1.0 + dx_x) * off_y - dy_x * off_x)
            off = abs(off_x) + abs(off_y)
            if off < _ORIGIN_TOLERANCE:
                break
        # Written so that nan, of a step where nothing is left of a pixel, is off as well.
        if not (off < _ORIGIN_TOLERANCE and size > _FLATTEST):
            px, py = find_origin(pattern, x[n], y[n], part)
        x[n] = px
        y[n] = py


@numba.njit(**INNER)
def _shift_all(positions, first, spread, normal, origin, out, to, count):
    if spread == 0.0:
        for m in range(np.uint64(count)):
            out[to + m] = positions[first + m] - origin
    else:
        for m in range(np.uint64(count)):
            out[to + m] = positions[first + m] - origin + spread * normal[m]


@numba.njit(**INNER)
def _absorb(wavelength, first, lengths, start, per_step, path, out, count):
    """Paths [um] from exponential deviates and absorption lengths."""
    last = np.float64(lengths.size - 1)
    for m in range(np.uint64(count)):
        at = min(max((get(wavelength, first + m) - start) * per_step, 0.0), last)
        n = np.int32(min(at, last - 1.0))
        here = looked_up(lengths, n)
        there = looked_up(lengths, n + 1)
        put(out, m, np.float32((here + (at - n) * (there - here)) * get(path, m)))


# Division by zero, which cannot happen, is not looked for: that would not be vector code.
@numba.njit(**INNER)
def _tilt(slope_x, slope_y, first, kept, out, count):
    """Depths [um] of paths along the slopes."""
    for m in range(np.uint64(count)):
        sx = slope_x[first + m]
        sy = slope_y[first + m]
        out[m] = np.float32(min(out[m] / np.sqrt(1.0 + sx * sx + sy * sy), kept))


@numba.njit(**INNER)
def _widths(depth, thickness, variance, out_z, to, out, count):
    """Heights [um], LOST below the gates, and widths of the diffusion [um] from there."""
    last = np.float32(variance.size - 1)
    per_um = np.float32(last / np.float32(thickness))
    for m in range(np.uint64(count)):
        z = np.float32(thickness) - get(depth, m)
        put(out_z, to + m, z if z >= np.float32(0.0) else LOST)
        at = min(max(z * per_um, np.float32(0.0)), last)
        n = np.int32(min(at, last - np.float32(1.0)))
        here = np.float32(looked_up(variance, n))
        there = np.float32(looked_up(variance, n + 1))
        put(out, m, np.sqrt(here + (at - np.float32(n)) * (there - here)))


@numba.njit(**INNER)
def _place(positions, slopes, slanted, first, depth, width, normal, pitch, origin, out, to,
           count):  # fmt: skip
    """Landing positions along one axis [pixel]."""
    per_um = 1.0 / pitch
    for m in range(np.uint64(count)):
        x = positions[first + m] - origin + np.float64(width[m] * normal[m]) * per_um
        if slanted:
            x += slopes[first + m] * depth[m] * per_um
        out[to + m] = x


@numba.njit(**{**INNER, "_nrt": True})
def land(
    light,
    medium,
    pattern,
    lo,
    hi,
    number,
    key0,
    key1,
    x0,
    y0,
    out_x,
    out_y,
    out_z,
    out_word,
):
    """Send the photons lo to hi to where their electrons start to feel the wells.

    ``number`` is the count of photon ``lo`` in the exposure; positions less (``x0``,
    ``y0``) are written.  ``out_z`` [um] is the height of conversion, -1 for a photon that
    crossed the silicon.  Only ``out_*`` from 0 to ``hi - lo`` is changed.
    """
    coloured = light.wavelength.size > 0
    slanted = light.slope_x.size > 0
    fixed = pattern.rings.size > 0 or pattern.map_x.size > 0 or pattern.edge_x.size > 0
    only_rings = pattern.map_x.size == 0 and pattern.edge_x.size == 0 and fixed
    rooms = np.empty((3, BUFFER if only_rings else 0))
    # By index: rows that are unpacked are not known to be contiguous.
    factor, radius, scale = rooms[0], rooms[1], rooms[2]
    kept = np.inf
    if slanted or not medium.kept_slanted:
        kept = medium.kept_path
    words = np.empty((3, BUFFER), np.uint32)
    word_a, word_b, word_c = words[0], words[1], words[2]
    normal_x = np.empty(BUFFER, np.float32)
    normal_y = np.empty(BUFFER, np.float32)
    depth = np.empty(BUFFER, np.float32)
    width = np.empty(BUFFER, np.float32)
    steps = medium.variance.size - 1
    plain = min(medium.surface_path, kept)
    for start in range(lo, hi, BUFFER):
        count = min(BUFFER, hi - start)
        done = start - lo
        first = np.uint64(start)
        to = np.uint64(done)
        draw_words(
            number + done, key0, key1, word_a, word_b, word_c, out_word[done : done + count]
        )
        if medium.diffuse:
            normals(word_a[:count], word_b, normal_x, normal_y)
        if coloured:
            exponentials(word_c[:count], depth)
        if not coloured and not slanted:
            # All convert at one depth.
            z = medium.thickness - plain
            spread = np.sqrt(_at(medium.variance, z / medium.thickness * steps))
            spread = spread if medium.diffuse else 0.0
            _shift_all(
                light.x, first, spread / medium.pitch_x, normal_x, x0, out_x, to, count
            )
            _shift_all(
                light.y, first, spread / medium.pitch_y, normal_y, y0, out_y, to, count
            )
            out_z[done : done + count] = np.float32(z)
        else:
            if coloured:
                _absorb(
                    light.wavelength, first, medium.lengths, medium.wavelength_0,
                    1.0 / medium.wavelength_step, depth, depth, count,
                )  # fmt: skip
            else:
                depth[:count] = np.float32(medium.surface_path)
            if slanted:
                _tilt(light.slope_x, light.slope_y, first, kept, depth, count)
            elif kept < np.inf:
                for m in range(count):
                    depth[m] = min(depth[m], np.float32(kept))
            _widths(depth, medium.thickness, medium.variance, out_z, to, width, count)
            if not medium.diffuse:
                width[:count] = np.float32(0.0)
                normal_x[:count] = np.float32(0.0)
                normal_y[:count] = np.float32(0.0)
            _place(
                light.x, light.slope_x, slanted, first, depth, width, normal_x,
                medium.pitch_x, x0, out_x, to, count,
            )  # fmt: skip
            _place(
                light.y, light.slope_y, slanted, first, depth, width, normal_y,
                medium.pitch_y, y0, out_y, to, count,
            )  # fmt: skip
        if only_rings:
            _ring_origins(
                pattern, medium.thickness, out_z, not (coloured or slanted), out_x, out_y, to,
                count, factor, radius, scale,
            )  # fmt: skip
        elif fixed:
            _origins(pattern, medium.thickness, out_z, out_x, out_y, to, count)
