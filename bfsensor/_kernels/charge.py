"""Frozen charge that moves the boundaries: state of an exposure, and its update from the image.

While a block of photons lasts, the effective charge is frozen.  When it ends, that of the pixels that
gained charge is found again, or that of all pixels of the image.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.compile_options import ENTRY, INLINED, INNER
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.shifts import MODES, NEAR_MODES
from bfsensor._kernels.surroundings import mirror_all, mirror_pixel, within

TILE = 16
"""Side of the square tiles for which bounds of the charge are kept [pixel].

Chosen: a power of two, for ``edges`` and ``hot`` have it written out as 16 and as shifts by 4 bits;
twice as large, a bound covers four times as many pixels and more electrons are decided at the
edges themselves."""
REFRESH = 256
"""Number of changes of a tile's pixels after which its range of charges is found again.

Derived: :data:`TILE` squared, so that a search over a tile costs one pixel per change."""
QUEUE = 256
"""Number of pixels whose effective charge is updated together.

Chosen: they take 3 kB, which stay in the first-level cache; twice as many, no less time."""
FAINT = np.float32(64.0)
"""Effective charge up to which that of a tile counts as of this size when edges are bounded [e-].

Chosen: edges move by 1e-4 pixel, so that hardly more light is looked at closely; ten times as large,
ten times as much.  A tenth of it, and where light is spread over many pixels each tile is bounded
again and again as electron follows electron."""
# Indices of the counters, int64: numbers of listed pixels in this block and in the last, whether
# the list is full in this block and was in the last, flagged tiles, photons, pixels beyond the
# response, photons when the block began, full pixels that were met, whether an image was taken,
# whether single precision has lost anything.
(
    LISTED, LISTED_BEFORE, DENSE, DENSE_BEFORE, FLAGGED, PHOTONS, BEYOND, OPENED, STRUCK, TAKEN,
    CARRIED,
) = range(11)  # fmt: skip
N_COUNTERS = 11
"""Number of counters, by definition that of the names above."""
# Indices of the sums [e-], float64: flux of this block, of the last and of the exposure; what was
# added, spilled, spilled off the image, crossed the silicon, fell outside, and was lost.
IN_BLOCK, BEFORE, TOTAL, ADDED, SPILLED, SPILLED_OFF, CROSSED, OFF_IMAGE, LOST = range(9)
N_SUMS = 9
"""Number of sums, by definition that of the names above."""


class Pixels(NamedTuple):
    """Image [rows, columns] of single or of double precision; the other array is of size 0.

    Both are one type to numba, which compiles once for images of either precision.
    """

    single: np.ndarray
    double: np.ndarray


class Response(NamedTuple):
    """Effective charge by charge and background, on equal steps [e-]: first mode, and the others.

    The last index of ``near`` is the mode.  Arrays of size 0 stand for a linear sensor, whose
    effective charge is the charge.
    ``last_charge`` and ``last_background`` are the ends of the grid, in steps.
    """

    first: np.ndarray
    near: np.ndarray
    charge_step: float
    background_step: float
    last_charge: float
    last_background: float


class Ledger(NamedTuple):
    """State of an exposure, see the module; arrays are changed in place.

    ``carry`` [rows, columns] is what single precision loses of the image, ``marks`` a bit for each
    pixel that gained charge in the block, ``listed`` these pixels and ``gained`` the charge that they
    had, then how much they gained [e-]; ``before`` [pixels] is the charge that those had for which the
    list has no room, or room for gains row by row, from ``starts`` [rows + 1] on; ``listed_before``
    are the pixels of the last block.  ``rows`` [3, columns + 2] is room for rows of charge, ``queue``
    and ``ahead`` [2, QUEUE] for pixels to be updated, what is to be added to their charge and their
    background, and ``found`` [QUEUE, NEAR_MODES], flat, for effective charges.  ``highs`` are the
    largest effective charges by tile and mode, ``changes`` the number of changes since they were
    found, ``flags`` and ``flagged`` the tiles whose bounds are out of date.  ``spill_from`` and
    ``spill_to`` [side, column] is where a column was full when it last spilled.  ``strikes`` [rows,
    columns] counts the electrons that met a full pixel in the block, ``struck`` lists these pixels.
    ``outside`` holds the effective charges and then the charge of pixels beyond the image, unless they
    are ``mirrored``.
    """

    carry: np.ndarray
    marks: np.ndarray
    listed: np.ndarray
    gained: np.ndarray
    before: np.ndarray
    rows: np.ndarray
    starts: np.ndarray
    queue: np.ndarray
    ahead: np.ndarray
    found: np.ndarray
    listed_before: np.ndarray
    highs: np.ndarray
    changes: np.ndarray
    flags: np.ndarray
    flagged: np.ndarray
    spill_from: np.ndarray
    spill_to: np.ndarray
    strikes: np.ndarray
    struck: np.ndarray
    counters: np.ndarray
    sums: np.ndarray
    outside: np.ndarray
    mirrored: bool


@numba.njit(**INLINED)
def charge_of(image, j, i):
    """Charge of a pixel, in double precision."""
    return np.float64(image.single[j, i]) if image.single.size > 0 else image.double[j, i]


@numba.njit(**INLINED)
def _shape(image):
    """Rows and columns of an image."""
    return image.single.shape if image.single.size > 0 else image.double.shape


@numba.njit(**INLINED)
def _between(first, near, i, j, u, v, out, at):
    """First effective charge between four points of the grid; those of pixel ``at`` go to ``out``."""
    one, up = np.float32(1.0), np.uint64(1)
    a, c = (one - u) * (one - v), u * (one - v)
    d, e = (one - u) * v, u * v
    to = np.uint64(NEAR_MODES) * at
    for w in range(np.uint64(NEAR_MODES)):
        out[to + w] = (
            a * near[i, j, w] + c * near[i + up, j, w]
            + d * near[i, j + up, w] + e * near[i + up, j + up, w]
        )  # fmt: skip
    below = a * first[i, j] + c * first[i + up, j]
    return below + d * first[i, j + up] + e * first[i + up, j + up]


@numba.njit(**INNER)
def _effective(response, charges, backgrounds, near, count):
    """Replace charges of ``count`` pixels by the first effective charge, and find the others.

    Beyond the grid the last values are held.  Returns how many pixels hold more than the grid.
    """
    f, s = response.first, response.near
    per_charge, per_background = response.charge_step, response.background_step
    last_q, last_b = response.last_charge, response.last_background
    largest = last_q * per_charge
    rows, columns = np.int32(f.shape[0] - 2), np.int32(f.shape[1] - 2)
    zero = np.float32(0.0)
    beyond = 0
    for n in range(np.uint64(count)):
        beyond += charges[n] > largest
        q = min(charges[n] / per_charge, last_q)
        b = min(max(backgrounds[n], zero) / per_background, last_b)
        i = min(np.int32(max(q, 0.0)), rows)
        j = min(np.int32(b), columns)
        u, v = np.float32(q - i), np.float32(b - j)
        m, k = np.uint64(i), np.uint64(j)
        charges[n] = _between(f, s, m, k, u, v, near, n)
    return beyond


@numba.njit(**INNER)
def _flag(ledger, tile):
    if not ledger.flags[tile]:
        ledger.flags[tile] = True
        ledger.flagged[ledger.counters[FLAGGED]] = tile
        ledger.counters[FLAGGED] += 1


@numba.njit(**INNER)
def _charge(image, ledger, j, i):
    """Charge of a pixel in single precision; outside the image that of its surroundings."""
    ny, nx = _shape(image)
    if not (0 <= j < ny and 0 <= i < nx):
        if not ledger.mirrored:
            return ledger.outside[MODES]
        j, i = within(j, ny), within(i, nx)
    return np.float32(charge_of(image, np.uint64(j), np.uint64(i)))


@numba.njit(**INLINED)
def _sum_around(pixels, j, i):
    """Sum of the neighbours of a pixel that is not at the border, in single precision."""
    up = np.uint64(1)
    j, i = np.uint64(j), np.uint64(i)
    above = np.float32(pixels[j - up, i - up]) + np.float32(pixels[j - up, i])
    above += np.float32(pixels[j - up, i + up])
    here = np.float32(pixels[j, i - up]) + np.float32(pixels[j, i + up])
    below = np.float32(pixels[j + up, i - up]) + np.float32(pixels[j + up, i])
    below += np.float32(pixels[j + up, i + up])
    return above + here + below


@numba.njit(**INNER)
def _sum_at_border(image, ledger, j, i):
    """Sum of the neighbours of a pixel, of which some lie outside the image."""
    above = _charge(image, ledger, j - 1, i - 1) + _charge(image, ledger, j - 1, i)
    above += _charge(image, ledger, j - 1, i + 1)
    here = _charge(image, ledger, j, i - 1) + _charge(image, ledger, j, i + 1)
    below = _charge(image, ledger, j + 1, i - 1) + _charge(image, ledger, j + 1, i)
    below += _charge(image, ledger, j + 1, i + 1)
    return above + here + below


@numba.njit(**INLINED)
def _counted(charges, ledger, tile, mode):
    """Lowest and highest effective charge of a mode in a tile, as it counts where edges are bounded."""
    at = np.uint64(MODES) * np.uint64(tile) + np.uint64(mode)
    low, high = charges.lows[at], ledger.highs[at]
    if low >= -FAINT and high <= FAINT:
        return (low if mode == 0 else -FAINT), FAINT
    return low, high


@numba.njit(**INLINED)
def _around(image, ledger, j, i):
    """Mean charge of the neighbours of a pixel."""
    ny, nx = _shape(image)
    if not (0 < j < ny - 1 and 0 < i < nx - 1):
        total = _sum_at_border(image, ledger, j, i)
    elif image.single.size > 0:
        total = _sum_around(image.single, j, i)
    else:
        total = _sum_around(image.double, j, i)
    return total * np.float32(0.125)


@numba.njit(**INNER)
def set_pixels(image, charges, ledger, response, count):
    """Update the effective charge of the first ``count`` pixels of the queue.

    One step after the other for all of them, so that many loads are under way at once.
    """
    pixels, first, around = ledger.queue, ledger.ahead[0], ledger.ahead[1]
    width, pad, stride = np.uint64(charges.nx), np.uint64(charges.pad), charges.stride
    modes = response.first.size > 0
    for n in range(np.uint64(count)):
        pixel = np.uint64(pixels[n])
        j = pixel // width
        i = pixel - j * width
        first[n] += np.float32(charge_of(image, j, i))
        if modes:
            around[n] = _around(image, ledger, np.int64(j), np.int64(i))
    if modes:
        ledger.counters[BEYOND] += _effective(response, first, around, ledger.found, count)
    tiles_x = np.uint64((charges.nx + TILE - 1) // TILE)
    for n in range(np.uint64(count)):
        pixel = np.uint64(pixels[n])
        j = pixel // width
        i = pixel - j * width
        at = (j + pad) * np.uint64(stride) + i + pad
        value = first[n]
        charges.first[at] = value
        if modes:
            for m in range(np.uint64(NEAR_MODES)):
                charges.near[np.uint64(NEAR_MODES) * at + m] = ledger.found[
                    np.uint64(NEAR_MODES) * n + m
                ]
        if ledger.mirrored:
            mirror_pixel(charges, charges.first, 1, np.int64(j), np.int64(i))
            if modes:
                mirror_pixel(charges, charges.near, NEAR_MODES, np.int64(j), np.int64(i))
        tile = (j >> np.uint64(4)) * tiles_x + (i >> np.uint64(4))
        ledger.changes[tile] += 1
        # Margins follow from the ranges, most of which a few electrons leave as they were.
        changed = ledger.changes[tile] >= REFRESH
        for m in range(np.uint64(MODES if modes else 1)):
            place = np.uint64(MODES) * tile + m
            if m > 0:
                value = charges.near[np.uint64(NEAR_MODES) * at + m - np.uint64(1)]
            if value < charges.lows[place] or value > ledger.highs[place]:
                counted = _counted(charges, ledger, tile, m)
                charges.lows[place] = min(charges.lows[place], value)
                ledger.highs[place] = max(ledger.highs[place], value)
                changed = changed or counted != _counted(charges, ledger, tile, m)
        if changed:
            _flag(ledger, np.int64(tile))


@numba.njit(**INNER)
def _find_range(charges, ledger, tile):
    """Find the lowest and highest effective charge of a tile, beyond the image included."""
    tiles_x = (charges.nx + TILE - 1) // TILE
    tiles_y = (charges.ny + TILE - 1) // TILE
    row = tile // tiles_x
    column = tile - row * tiles_x
    border = row == 0 or column == 0 or row == tiles_y - 1 or column == tiles_x - 1
    # Mirrored charge is that of this tile and of its neighbours.
    border = border and not ledger.mirrored
    for m in range(MODES):
        place = np.uint64(MODES * tile + m)
        if m > 0 and charges.near.size == 0:
            charges.lows[place] = np.float32(0.0)
            ledger.highs[place] = np.float32(0.0)
            continue
        low = ledger.outside[m] if border else np.float32(np.inf)
        high = ledger.outside[m] if border else np.float32(-np.inf)
        for j in range(row * TILE, min((row + 1) * TILE, charges.ny)):
            start = (j + charges.pad) * charges.stride + charges.pad
            for i in range(column * TILE, min((column + 1) * TILE, charges.nx)):
                at = start + i
                value = (
                    charges.first[np.uint64(at)]
                    if m == 0
                    else charges.near[np.uint64(NEAR_MODES * at + m - 1)]
                )
                low = min(low, value)
                high = max(high, value)
        charges.lows[place] = low
        ledger.highs[place] = high
    ledger.changes[tile] = 0


@numba.njit(**INNER)
def _find_margin(charges, ledger, edges, tile):
    """Bound the shift of edges in a tile, and the error of that of the nearest point."""
    tiles_x = (charges.nx + TILE - 1) // TILE
    tiles_y = (charges.ny + TILE - 1) // TILE
    row = tile // tiles_x
    column = tile - row * tiles_x
    size, most = np.float32(0.0), np.float32(0.0)
    for m in range(edges.modes):
        low, high = _counted(charges, ledger, tile, m)
        for j in range(max(row - 1, 0), min(row + 2, tiles_y)):
            for i in range(max(column - 1, 0), min(column + 2, tiles_x)):
                here = _counted(charges, ledger, j * tiles_x + i, m)
                low = min(low, here[0])
                high = max(high, here[1])
        size = max(size, high - low)
        most = max(most, max(abs(low), abs(high)))
    # Single precision: rounding of the shift, and of what cancels in its sum.
    margin = np.float32(edges.normal) * (size + np.float32(1e-6) * most) + np.float32(2e-6)
    charges.margins[tile] = margin if margin < 0.5 else np.float32(1.0)
    level = 0
    if size > 250.0:
        level = np.int64(np.ceil(8.0 * np.log2(size / 250.0)))
    charges.ranges[tile] = min(level, edges.doubts.shape[1] - 1)


@numba.njit(**INNER)
def find_margins(charges, ledger, edges):
    """Renew ranges and margins of the flagged tiles and their neighbours."""
    tiles_x = (charges.nx + TILE - 1) // TILE
    tiles_y = (charges.ny + TILE - 1) // TILE
    count = ledger.counters[FLAGGED]
    for n in range(count):
        if ledger.changes[ledger.flagged[n]] >= REFRESH:
            _find_range(charges, ledger, ledger.flagged[n])
    for n in range(count):
        row = ledger.flagged[n] // tiles_x
        column = ledger.flagged[n] - row * tiles_x
        for j in range(max(row - 1, 0), min(row + 2, tiles_y)):
            for i in range(max(column - 1, 0), min(column + 2, tiles_x)):
                _flag(ledger, j * tiles_x + i)
    count = ledger.counters[FLAGGED]
    for n in range(count):
        tile = ledger.flagged[n]
        _find_margin(charges, ledger, edges, tile)
        ledger.flags[tile] = False
    ledger.counters[FLAGGED] = 0


@numba.njit(**INNER)
def _respond(response, above, here, below, begin, first, near, start, count):
    """Find the effective charge of ``count`` pixels of a row from the rows around them.

    ``first`` holds what is to be added ahead; the pixels are at ``start`` there and in ``near``, and
    at ``begin`` in the rows of charge.
    """
    f, s = response.first, response.near
    last_q = np.float32(response.last_charge)
    last_b = np.float32(response.last_background)
    per_q = np.float32(1.0 / response.charge_step)
    per_b = np.float32(0.125 / response.background_step)
    rows = np.int32(f.shape[0] - 2)
    columns = np.int32(f.shape[1] - 2)
    zero = np.float32(0.0)
    up = np.uint64(1)
    beyond = 0
    for n in range(np.uint64(count)):
        at = start + n
        k = begin + n
        q = (here[k] + first[at]) * per_q
        b = (
            (above[k - up] + above[k] + above[k + up])
            + (here[k - up] + here[k + up])
            + (below[k - up] + below[k] + below[k + up])
        ) * per_b
        beyond += q > last_q
        q = min(q, last_q)
        b = min(max(b, zero), last_b)
        m = np.int32(min(max(np.int32(q), np.int32(0)), rows))
        level = np.int32(min(np.int32(b), columns))
        u = q - np.float32(m)
        v = b - np.float32(level)
        i = np.uint64(m)
        j = np.uint64(level)
        first[at] = _between(f, s, i, j, u, v, near, at)
    return beyond


@numba.njit(**INLINED)
def marked(marks, pixel):
    """Whether a pixel has gained charge in this block."""
    bit = np.uint8(1) << np.uint8(pixel & np.uint64(7))
    return (marks[pixel >> np.uint64(3)] & bit) != 0


@numba.njit(**INNER)
def _any_charge(image, j, first, last):
    """Whether a part of a row holds charge; without a branch, so that it is read in vectors."""
    found = False
    for i in range(np.uint64(first), np.uint64(last)):
        found |= charge_of(image, np.uint64(j), i) != 0.0
    return found


@numba.njit(**INNER)
def _take_pixels(image, j, first, last, charges, ledger, ahead, apart):
    """Take the charge of a part of a row; where it is ``apart``, the gain waits for the response."""
    start = (j + charges.pad) * charges.stride + charges.pad
    for i in range(first, last):
        at = np.uint64(start + i)
        now = np.float32(charge_of(image, j, i))
        if apart:
            gain = np.float32(0.0)
            pixel = np.uint64(j * charges.nx + i)
            if ledger.before.size > 0 and marked(ledger.marks, pixel):
                gain = now - ledger.before[pixel]
            charges.first[at] = ahead * gain
        else:
            charges.first[at] = now


@numba.njit(**INNER)
def _flag_charge(image, charges, ledger, ahead, apart, fresh):
    """Take the charge of all tiles that hold some, and flag these and their neighbours.

    Unless the exposure is ``fresh`` they are all tiles.
    """
    nx, ny = charges.nx, charges.ny
    tiles_x = (nx + TILE - 1) // TILE
    for j in range(ny):
        # Untouched pages of an empty image cost neither time nor memory.
        if fresh and not _any_charge(image, j, 0, nx):
            continue
        for column in range(tiles_x):
            first = column * TILE
            last = min(first + TILE, nx)
            if fresh and not _any_charge(image, j, first, last):
                continue
            _take_pixels(image, j, first, last, charges, ledger, ahead, apart)
            # Charge at the border of a tile changes the background beyond it.
            for row in range(max(j - 1, 0) // TILE, min(j + 1, ny - 1) // TILE + 1):
                for k in range(max(column - 1, 0), min(column + 2, tiles_x)):
                    ledger.flags[row * tiles_x + k] = True


@numba.njit(**INNER)
def _flag_sides(charges, ledger):
    """Flag the tiles at the sides of the image, where charge beyond it acts."""
    tiles_x = (charges.nx + TILE - 1) // TILE
    tiles_y = (charges.ny + TILE - 1) // TILE
    for row in range(tiles_y):
        for column in range(tiles_x):
            if row in (0, tiles_y - 1) or column in (0, tiles_x - 1):
                ledger.flags[row * tiles_x + column] = True


@numba.njit(**INNER)
def _load_row(image, ledger, j, out):
    """Copy a row of the image in single precision, with a pixel of the surroundings on each side."""
    ny, nx = _shape(image)
    if not (0 <= j < ny or ledger.mirrored):
        out[:] = ledger.outside[MODES]
        return
    row = np.uint64(within(j, ny))
    for i in range(np.uint64(nx)):
        out[i + np.uint64(1)] = np.float32(charge_of(image, row, i))
    out[0] = _charge(image, ledger, j, -1)
    out[nx + 1] = _charge(image, ledger, j, nx)


@numba.njit(**INNER)
def _respond_in_row(charges, ledger, response, j):
    """Find the effective charge of the flagged tiles in a row, whose ``first`` holds the gain ahead."""
    rows = ledger.rows
    above, here, below = rows[(j + 2) % 3], rows[j % 3], rows[(j + 1) % 3]
    tiles_x = (charges.nx + TILE - 1) // TILE
    start = (j + charges.pad) * charges.stride + charges.pad
    column = 0
    while column < tiles_x:
        first = column * TILE
        while column < tiles_x and ledger.flags[(j // TILE) * tiles_x + column]:
            column += 1
        count = min(column * TILE, charges.nx) - first
        if count > 0 and response.first.size > 0:
            ledger.counters[BEYOND] += _respond(
                response, above, here, below, np.uint64(first + 1), charges.first,
                charges.near, np.uint64(start + first), count,
            )  # fmt: skip
        for i in range(0 if response.first.size > 0 else count):
            charges.first[np.uint64(start + first + i)] += here[np.uint64(first + 1 + i)]
        column += 1


@numba.njit(**INNER)
def _respond_flagged(image, charges, ledger, response):
    """Find the effective charge of the flagged tiles."""
    tiles_x = (charges.nx + TILE - 1) // TILE
    for row in range((charges.ny + TILE - 1) // TILE):
        if not ledger.flags[row * tiles_x : (row + 1) * tiles_x].any():
            continue
        first = row * TILE
        _load_row(image, ledger, first - 1, ledger.rows[(first + 2) % 3])
        _load_row(image, ledger, first, ledger.rows[first % 3])
        for j in range(first, min(first + TILE, charges.ny)):
            _load_row(image, ledger, j + 1, ledger.rows[(j + 1) % 3])
            _respond_in_row(charges, ledger, response, j)


@numba.njit(**INNER)
def take_image(image, charges, ledger, response, edges, ahead):
    """Update the frozen charge from the whole image; ``ahead`` times each pixel's gain is added."""
    # Without other modes and without prediction the charge itself is the effective one.
    apart = response.first.size > 0 or ledger.listed_before.size > 0
    # At first all is zero, and where the image is it may stay so.
    fresh = ledger.counters[TAKEN] == 0
    ledger.counters[TAKEN] = 1
    if fresh and ledger.outside[MODES] != np.float32(0.0):
        _flag_sides(charges, ledger)
    _flag_charge(image, charges, ledger, ahead, apart, fresh)
    if apart:
        _respond_flagged(image, charges, ledger, response)
    if ledger.mirrored:
        mirror_all(charges, charges.first, 1)
        if response.first.size > 0:
            mirror_all(charges, charges.near, NEAR_MODES)
    ledger.counters[FLAGGED] = 0
    for tile in range(ledger.flags.size):
        if ledger.flags[tile]:
            _find_range(charges, ledger, tile)
        ledger.flags[tile] = False
    for tile in range(ledger.flags.size):
        _find_margin(charges, ledger, edges, tile)


@numba.njit(**ENTRY)
def hold_image(image, charges, ledger, response, edges):
    """Let the charge of an image act, without light."""
    take_image(image, charges, ledger, response, edges, np.float32(0))
