"""Areas of all pixels, by convolution or as polygons through the displaced points.

The area of a polygon is the contour integral of -y dx; every side is integrated once, about its
nominal place.  Shifts of one point of all sides of a line are found together, so that the
inner loop runs along the row.
"""

import numba
import numpy as np

from bfsensor._kernels.compile_options import ENTRY, INLINED, INNER
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.photons import _at, fixed_shift, ring_shift
from bfsensor._kernels.shifts import MODES, NEAR_MODES
from bfsensor._kernels.window import add_8_kernels

GAUSS = 0.5 - 0.5 / np.sqrt(3.0)
"""Place of the first of Gauss's two points of a unit interval; exact for cubic polynomials."""


@numba.njit(**INNER, fastmath={"contract"})
def _add_rows(weights, start, lanes, rows, columns, charges, at, stride, out, count):
    """Add to ``out`` the weighted charges of ``count`` windows, the first of which begins at ``at``."""
    for r in range(rows):
        row = np.uint64(at + r * stride)
        first = start + r * lanes
        c = 0
        while c + 4 <= columns:
            a = weights[np.uint64(first + c)]
            b = weights[np.uint64(first + c + 1)]
            d = weights[np.uint64(first + c + 2)]
            e = weights[np.uint64(first + c + 3)]
            q = row + np.uint64(c)
            for n in range(np.uint64(count)):
                out[n] += (
                    a * charges[q + n]
                    + b * charges[q + n + np.uint64(1)]
                    + d * charges[q + n + np.uint64(2)]
                    + e * charges[q + n + np.uint64(3)]
                )
            c += 4
        while c < columns:
            a = weights[np.uint64(first + c)]
            q = row + np.uint64(c)
            for n in range(np.uint64(count)):
                out[n] += a * charges[q + n]
            c += 1


@numba.njit(**INNER, fastmath={"contract"})
def _add_near(weights, start, rows, columns, charges, at, stride, out, count):
    """Add to ``out`` as :func:`_add_rows`, where all modes of a pixel lie side by side."""
    for r in range(rows):
        for c in range(NEAR_MODES * columns):
            a = weights[np.uint64(start + 16 * r + c)]
            q = np.uint64(NEAR_MODES * (at + r * stride) + c)
            for n in range(np.uint64(count)):
                out[n] += a * charges[q + np.uint64(NEAR_MODES) * n]


@numba.njit(**INNER)
def _line_shifts(edges, charges, upright, layer, point, line, lows, out):
    """Shifts (x, y) of one point of every side of a row; ``line``: row or line."""
    q = edges.reach
    side = 0 if upright else 1
    count = charges.nx + 1 - side
    for component in range(2):
        to = out[component if upright else 1 - component]
        place = (layer * 2 + component) * edges.points.size + point
        total = MODES * (side * edges.layers * edges.points.size * 2 + place)
        constant = -edges.sums[total] * lows[0]
        for m in range(1, edges.modes):
            constant -= edges.sums[total + m] * lows[m]
        for n in range(count):
            to[n] = constant
        row = line - q - side
        column = -q - 1 + side
        rows = 2 * q + 1 + side
        columns = 2 * q + 2 - side
        _add_rows(
            edges.weights, edges.starts[side] + place * rows * edges.lanes, edges.lanes,
            rows, columns, charges.first,
            (row + charges.pad) * charges.stride + column + charges.pad, charges.stride,
            to, count,
        )  # fmt: skip
        if edges.modes > 1:
            _add_near(
                edges.weights, edges.starts[2 + side] + place * (3 + side) * 16,
                3 + side, 4 - side, charges.near,
                (line - 1 - side + charges.pad) * charges.stride + side - 2 + charges.pad,
                charges.stride, to, count,
            )  # fmt: skip


@numba.njit(**INNER)
def _integrate(edges, charges, pattern, flux, upright, line, lows, now, before, out):
    """Integral of y dx along every side of a row, and its ends.

    ``out`` [5, sides]: the integral about the nominal place of the line (of the row's
    middle for vertical sides), then the shifts (x, y) of both ends.
    """
    count = charges.nx + 1 if upright else charges.nx
    last = edges.points.size - 1
    fixed = pattern.rings.size > 0 or pattern.map_x.size > 0 or pattern.edge_x.size > 0
    for n in range(count):
        out[0, n] = 0.0
    for point in range(last + 1):
        if flux:
            _line_shifts(edges, charges, upright, edges.layers - 1, point, line, lows, now)
        else:
            for n in range(count):
                now[0, n] = 0.0
                now[1, n] = 0.0
        t = edges.points[point]
        if fixed:
            for n in range(count):
                if upright:
                    dx, dy = fixed_shift(pattern, float(n), line + t, 1.0)
                else:
                    dx, dy = fixed_shift(pattern, n + t, float(line), 1.0)
                now[0, n] += dx
                now[1, n] += dy
        if point > 0:
            step = t - edges.points[point - 1]
            if upright:
                middle = 0.5 * (t + edges.points[point - 1]) - 0.5
                for n in range(count):
                    out[0, n] += (middle + 0.5 * (now[1, n] + before[1, n])) * (
                        now[0, n] - before[0, n]
                    )
            else:
                for n in range(count):
                    out[0, n] += (
                        0.5 * (now[1, n] + before[1, n]) * (step + now[0, n] - before[0, n])
                    )
        first = 1 if point == 0 else 3
        if point == 0 or point == last:
            for n in range(count):
                out[first, n] = now[0, n]
                out[first + 1, n] = now[1, n]
        for n in range(count):
            before[0, n] = now[0, n]
            before[1, n] = now[1, n]


@numba.njit(**INLINED)
def _join(x0, y0, x1, y1):
    """Integral of y dx from one end to the next, where two sides do not quite meet."""
    return 0.5 * (y0 + y1) * (x1 - x0)


@numba.njit(**{**ENTRY, "_nrt": True})
def pixel_areas(edges, charges, pattern, flux, lows, first_row, last_row, out):
    """Write the areas [nominal area] of the rows ``first_row`` to ``last_row`` to ``out`` [ny, nx].

    ``lows`` are subtracted from the charges by mode, for a uniform charge moves no boundary.  With
    ``flux`` False only the fixed pattern moves boundaries.
    """
    nx = charges.nx
    now = np.zeros((2, nx + 1), np.float32)
    before = np.zeros((2, nx + 1), np.float32)
    bottom = np.zeros((5, nx + 1))
    top = np.zeros((5, nx + 1))
    sides = np.zeros((5, nx + 1))
    _integrate(edges, charges, pattern, flux, False, first_row, lows, now, before, top)
    for j in range(first_row, last_row):
        bottom[:] = top
        _integrate(edges, charges, pattern, flux, False, j + 1, lows, now, before, top)
        _integrate(edges, charges, pattern, flux, True, j, lows, now, before, sides)
        for i in range(nx):
            # Counter-clockwise about the pixel's middle: bottom, right, top, left.
            around = bottom[0, i] - 0.5 * (1.0 + bottom[3, i] - bottom[1, i])
            around += sides[0, i + 1]
            around -= top[0, i] + 0.5 * (1.0 + top[3, i] - top[1, i])
            around -= sides[0, i]
            around += _join(
                bottom[3, i] + 0.5,
                bottom[4, i] - 0.5,
                sides[1, i + 1] + 0.5,
                sides[2, i + 1] - 0.5,
            )
            around += _join(
                sides[3, i + 1] + 0.5,
                sides[4, i + 1] + 0.5,
                top[3, i] + 0.5,
                top[4, i] + 0.5,
            )
            around += _join(
                top[1, i] - 0.5, top[2, i] + 0.5, sides[3, i] - 0.5, sides[4, i] + 0.5
            )
            around += _join(
                sides[1, i] - 0.5, sides[2, i] - 0.5, bottom[1, i] - 0.5, bottom[2, i] - 0.5
            )
            out[j, i] = -around


@numba.njit(**ENTRY)
def charge_ranges(charges, lows, highs):
    """Write the lowest and the highest effective charge in the image, by mode."""
    modes = MODES if charges.near.size > 0 else 1
    for m in range(MODES):
        lows[m] = np.float32(np.inf) if m < modes else np.float32(0.0)
        highs[m] = np.float32(-np.inf) if m < modes else np.float32(0.0)
    for j in range(charges.ny):
        start = np.uint64((j + charges.pad) * charges.stride + charges.pad)
        for i in range(np.uint64(charges.nx)):
            value = charges.first[start + i]
            lows[0] = min(lows[0], value)
            highs[0] = max(highs[0], value)
        for m in range(np.uint64(modes - 1)):
            low, high = lows[np.uint64(1) + m], highs[np.uint64(1) + m]
            for i in range(np.uint64(charges.nx)):
                value = charges.near[np.uint64(NEAR_MODES) * (start + i) + m]
                low = min(low, value)
                high = max(high, value)
            lows[np.uint64(1) + m] = low
            highs[np.uint64(1) + m] = high


@numba.njit(**INNER)
def _take_rows(charges, first, last, planes):
    """Copy rows of the near modes to ``planes`` [modes, pixels], one mode after the other."""
    start = np.uint64(first * charges.stride)
    for n in range(np.uint64((last - first) * charges.stride)):
        for m in range(np.uint64(NEAR_MODES)):
            planes[m, n] = charges.near[np.uint64(NEAR_MODES) * (start + n) + m]


@numba.njit(**ENTRY)
def convolved_areas(
    charges,
    planes,
    first,
    near,
    values,
    lows,
    bottom,
    top,
    left,
    right,
    sums,
    first_row,
    out,
):
    """Write areas [nominal area] by convolution to ``out``, which begins with the row ``first_row``.

    Only the rows ``bottom`` to ``top`` and the columns ``left`` to ``right`` are written.

    ``first`` [groups, width, width, 8] and ``near`` [groups, modes (0: none), 5, 5, 8] are kernels,
    eight side by side, of which the very first is the linear one; the squares of the other sums are
    added with the factors ``values`` [groups, 8], and ``lows`` subtracted from the charges.  ``sums``
    [9, 16] is scratch, of the type of the kernels, and so is ``planes`` [modes, pixels] in single
    precision, with room for the rows and six more.
    """
    width = first.shape[1]
    modes, side = near.shape[1], near.shape[2]
    flat = first.reshape(-1)
    flat_near = near.reshape(-1)
    corner = charges.pad * charges.stride + charges.pad
    stride = np.uint64(charges.stride)
    constant = sums[8]
    half = width // 2
    # Rows of the near modes from two below the first on, and the sixteen pixels beyond the last.
    base = bottom + charges.pad - 2
    if modes > 0:
        _take_rows(
            charges, base, min(top + charges.pad + 3, charges.ny + 2 * charges.pad), planes
        )
    for group in range(first.shape[0]):
        begin = group * width * width * 8
        begin_near = group * modes * side * side * 8
        for k in range(8):
            constant[k] = 0
        for n in range(width * width):
            for k in range(8):
                constant[k] -= flat[begin + 8 * n + k] * lows[0]
        for n in range(modes * side * side):
            for k in range(8):
                constant[k] -= (
                    flat_near[begin_near + 8 * n + k] * lows[1 + n // (side * side)]
                )
        for j in range(bottom, top):
            for i in range(left, right, 16):
                for k in range(8):
                    sums[k] = constant[k]
                add_8_kernels(
                    flat, np.uint64(begin), charges.first,
                    np.uint64(corner + (j - half) * charges.stride + i - half), stride,
                    np.uint64(width), np.uint64(width), sums,
                )  # fmt: skip
                for m in range(modes):
                    add_8_kernels(
                        flat_near, np.uint64(begin_near + 8 * side * side * m), planes[m],
                        np.uint64(corner + (j - 2 - base) * charges.stride + i - 2), stride,
                        np.uint64(side), np.uint64(side), sums,
                    )  # fmt: skip
                # Eight squares whatever the number of kernels: the others' factors are 0.
                for m in range(np.uint64(min(right - i, 16))):
                    area = out[j - first_row, np.uint64(i) + m]
                    squared = np.int64(0)
                    if group == 0:
                        area = 1.0 + np.float64(sums[0, m])
                        squared = np.int64(1)
                    for k in range(squared, 8):
                        total = np.float64(sums[k, m])
                        area += values[group, k] * total * total
                    out[j - first_row, np.uint64(i) + m] = area


@numba.njit(**INLINED)
def _mean_shift(pattern, factor, last, per_step, x, y, along_x, along_y):
    """Mean shift (x, y) by rings of the side from (x, y) to (x + along_x, y + along_y)."""
    dx = 0.0
    dy = 0.0
    for t in (GAUSS, 1.0 - GAUSS):
        rx = x + t * along_x - pattern.ring_x
        ry = y + t * along_y - pattern.ring_y
        r = np.sqrt(rx * rx + ry * ry)
        shift, _ = ring_shift(pattern.rings, last, r * per_step)
        size = 0.5 * factor * shift / r
        dx += size * rx
        dy += size * ry
    return dx, dy


@numba.njit(**{**ENTRY, "_nrt": True})
def times_ring_areas(pattern, out):
    """Multiply areas by those that rings give the pixels, at full height.

    The area of a pixel under shifts ``p`` that change little across it is ``(1 + dxx) (1 + dyy) -
    dxy dyx`` with the differences of the mean shifts of opposite sides.  The rings' centre must
    not be in the image: there the shift has no direction.
    """
    ny, nx = out.shape
    last = np.float64(pattern.rings.size - 2)
    per_step = 1.0 / pattern.ring_step
    factor = _at(pattern.ring_factor, np.float64(pattern.ring_factor.size - 1))
    bottom = np.empty((2, nx))
    top = np.empty((2, nx))
    sides = np.empty((2, nx + 1))
    for i in range(nx):
        top[0, i], top[1, i] = _mean_shift(
            pattern, factor, last, per_step, float(i), 0.0, 1.0, 0.0
        )
    for j in range(ny):
        bottom[:] = top
        for i in range(nx):
            top[0, i], top[1, i] = _mean_shift(
                pattern, factor, last, per_step, float(i), j + 1.0, 1.0, 0.0
            )
        for i in range(nx + 1):
            sides[0, i], sides[1, i] = _mean_shift(
                pattern, factor, last, per_step, float(i), float(j), 0.0, 1.0
            )
        for i in range(nx):
            dxx = sides[0, i + 1] - sides[0, i]
            dyx = sides[1, i + 1] - sides[1, i]
            dxy = top[0, i] - bottom[0, i]
            dyy = top[1, i] - bottom[1, i]
            out[j, i] *= (1.0 + dxx) * (1.0 + dyy) - dxy * dyx
