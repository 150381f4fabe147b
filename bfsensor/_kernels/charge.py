"""Deposit of electrons in pixels, spilling, and the frozen charge that moves the boundaries.

The image holds the charge.  While a block of photons lasts, the effective charge that moves
boundaries is frozen; electrons go into the image at once, in the order of the photons, and the
first in a pixel marks it and enters it in a list, with the charge it had.  When the block ends
the effective charge of the listed pixels is updated to what it will be, on average, in the next
block: by the charge now and half of what the pixel gained in the last block.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.compile_options import ENTRY, INLINED, INNER
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.hot import cool, heat
from bfsensor._kernels.prefetch import prefetch
from bfsensor._kernels.surroundings import mirror_all, mirror_pixel, within

TILE = 16
"""Side of the square tiles for which bounds of the charge are kept [pixel].

Chosen: a power of two, for ``edges`` and ``hot`` have it written out as 16 and as shifts by 4 bits;
twice as large, a bound covers four times as many pixels and more electrons are decided at the
edges themselves."""
REFRESH = 256
"""Number of changes of a tile's pixels after which its range of charges is found again.

Derived: :data:`TILE` squared, so that a search over a tile costs one pixel per change."""
STALE = np.float32(512.0)
"""Charge that a pixel may gain before the background of its neighbours is found again [e-].

Chosen: the background of a pixel, the mean of eight neighbours, is then out of date by less than
this; twice as large, by twice as much, and the search is made half as often."""
QUEUE = 256
"""Number of pixels whose effective charge is updated together.

Chosen: they take 3 kB, which stay in the first-level cache; twice as many, no less time."""
MANY = 2048
"""Number of listed pixels from which they are sorted by row, so that they are near in memory.

Chosen: charge of so many pixels and of their neighbours no longer fits the first-level cache; with
twice as many small lists are left as they are, with the same bits."""
FAINT = np.float32(64.0)
"""Effective charge up to which that of a tile counts as of this size when edges are bounded [e-].

Chosen: edges move by 1e-4 pixel, so that hardly more light is looked at closely; ten times as large,
ten times as much.  A tenth of it, and where light is spread over many pixels each tile is bounded
again and again as electron follows electron."""
AHEAD = 32
"""Number of pixels whose memory is asked for before the first of them is used.

Chosen: ten lines of memory for each, 20 kB, fit in the first-level cache; four times as many do not
and gain no more."""
SCATTERED = 1 << 20
"""Number of pixels of an image from which on memory is asked for ahead.

Chosen: all that belongs to a smaller one stays in the larger caches, and to ask costs more than it
gains (4 % of a flat at a quarter of it); twice as large, images of 4 MB are not served."""

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
    """Effective charge of both modes by charge and background, on equal steps [e-].

    Arrays of size 0 stand for a linear sensor, whose effective charge is the charge.
    ``last_charge`` and ``last_background`` are the ends of the grid, in steps.
    """

    first: np.ndarray
    second: np.ndarray
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
    background, and then both effective charges.  ``high_*`` are the largest
    effective charges by tile, ``changes`` the number of changes since they were found, ``flags``
    and ``flagged`` the tiles whose bounds are out of date.  ``spill_from`` and ``spill_to`` [side,
    column] is where a column was full when it last spilled.  ``strikes`` [rows, columns] counts
    the electrons that met a full pixel in the block, ``struck`` lists these pixels.  ``outside`` holds
    both effective charges and the charge of the pixels beyond the image, unless they are ``mirrored``.
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
    listed_before: np.ndarray
    high_first: np.ndarray
    high_second: np.ndarray
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
def _charge_of(image, j, i):
    """Charge of a pixel, in double precision."""
    return np.float64(image.single[j, i]) if image.single.size > 0 else image.double[j, i]


@numba.njit(**INLINED)
def _shape(image):
    """Rows and columns of an image."""
    return image.single.shape if image.single.size > 0 else image.double.shape


@numba.njit(**INNER)
def _effective(response, charges, backgrounds, count):
    """Replace charges and backgrounds of ``count`` pixels by both effective charges.

    Beyond the grid the last values are held.  Returns how many pixels hold more than the grid.
    """
    f, s = response.first, response.second
    per_charge, per_background = response.charge_step, response.background_step
    last_q, last_b = response.last_charge, response.last_background
    largest = last_q * per_charge
    rows, columns = np.int32(f.shape[0] - 2), np.int32(f.shape[1] - 2)
    zero, one, up = np.float32(0.0), np.float32(1.0), np.uint64(1)
    beyond = 0
    for n in range(np.uint64(count)):
        beyond += charges[n] > largest
        q = min(charges[n] / per_charge, last_q)
        b = min(max(backgrounds[n], zero) / per_background, last_b)
        i = min(np.int32(max(q, 0.0)), rows)
        j = min(np.int32(b), columns)
        u, v = np.float32(q - i), np.float32(b - j)
        m, k = np.uint64(i), np.uint64(j)
        a, c = (one - u) * (one - v), u * (one - v)
        d, e = (one - u) * v, u * v
        charges[n] = (
            a * f[m, k] + c * f[m + up, k] + d * f[m, k + up] + e * f[m + up, k + up]
        )
        backgrounds[n] = (
            a * s[m, k] + c * s[m + up, k] + d * s[m, k + up] + e * s[m + up, k + up]
        )
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
            return ledger.outside[2]
        j, i = within(j, ny), within(i, nx)
    return np.float32(_charge_of(image, np.uint64(j), np.uint64(i)))


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
def _counted(charges, ledger, tile):
    """Lowest and highest effective charge of both modes by which edges of a tile are bounded."""
    low, high = charges.low_first[tile], ledger.high_first[tile]
    low_second, high_second = charges.low_second[tile], ledger.high_second[tile]
    if low >= -FAINT and high <= FAINT:
        high = FAINT
    if low_second >= -FAINT and high_second <= FAINT:
        low_second, high_second = -FAINT, FAINT
    return low, high, low_second, high_second


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
def _set_pixels(image, charges, ledger, response, count):
    """Update the effective charge of the first ``count`` pixels of the queue.

    One step after the other for all of them, so that many loads are under way at once.
    """
    pixels, first, second = ledger.queue, ledger.ahead[0], ledger.ahead[1]
    width, pad, stride = np.uint64(charges.nx), np.uint64(charges.pad), charges.stride
    modes = response.first.size > 0
    for n in range(np.uint64(count)):
        pixel = np.uint64(pixels[n])
        j = pixel // width
        i = pixel - j * width
        first[n] += np.float32(_charge_of(image, j, i))
        if modes:
            second[n] = _around(image, ledger, np.int64(j), np.int64(i))
    if modes:
        ledger.counters[BEYOND] += _effective(response, first, second, count)
    tiles_x = np.uint64((charges.nx + TILE - 1) // TILE)
    for n in range(np.uint64(count)):
        pixel = np.uint64(pixels[n])
        j = pixel // width
        i = pixel - j * width
        at = (j + pad) * np.uint64(stride) + i + pad
        value = first[n]
        charges.first[at] = value
        more = np.float32(0.0)
        if modes:
            more = second[n]
            charges.second[at] = more
        if ledger.mirrored:
            mirror_pixel(charges, charges.first, np.int64(j), np.int64(i))
            if modes:
                mirror_pixel(charges, charges.second, np.int64(j), np.int64(i))
        tile = (j >> np.uint64(4)) * tiles_x + (i >> np.uint64(4))
        ledger.changes[tile] += 1
        # Margins follow from the ranges, most of which a few electrons leave as they were.
        wider = value < charges.low_first[tile] or value > ledger.high_first[tile]
        wider = wider or more < charges.low_second[tile] or more > ledger.high_second[tile]
        if wider or ledger.changes[tile] >= REFRESH:
            counted = _counted(charges, ledger, tile)
            charges.low_first[tile] = min(charges.low_first[tile], value)
            ledger.high_first[tile] = max(ledger.high_first[tile], value)
            charges.low_second[tile] = min(charges.low_second[tile], more)
            ledger.high_second[tile] = max(ledger.high_second[tile], more)
            if ledger.changes[tile] >= REFRESH or counted != _counted(
                charges, ledger, tile
            ):
                _flag(ledger, np.int64(tile))


@numba.njit(**INLINED)
def _queue(image, charges, ledger, response, waiting, pixel, ahead):
    """Put a pixel in the queue, with ``ahead`` electrons to add; returns how many wait there."""
    ledger.queue[np.uint64(waiting)] = pixel
    ledger.ahead[0, np.uint64(waiting)] = ahead
    waiting += 1
    if waiting == QUEUE:
        _set_pixels(image, charges, ledger, response, waiting)
        waiting = 0
    return waiting


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
    low = ledger.outside[0] if border else np.float32(np.inf)
    high = ledger.outside[0] if border else np.float32(-np.inf)
    low_second = ledger.outside[1] if border else low
    high_second = ledger.outside[1] if border else high
    for j in range(row * TILE, min((row + 1) * TILE, charges.ny)):
        start = (j + charges.pad) * charges.stride + charges.pad
        for i in range(column * TILE, min((column + 1) * TILE, charges.nx)):
            at = np.uint64(start + i)
            low = min(low, charges.first[at])
            high = max(high, charges.first[at])
            if charges.second.size > 0:
                low_second = min(low_second, charges.second[at])
                high_second = max(high_second, charges.second[at])
    charges.low_first[tile] = low
    ledger.high_first[tile] = high
    if charges.second.size > 0:
        charges.low_second[tile] = low_second
        ledger.high_second[tile] = high_second
    else:
        charges.low_second[tile] = np.float32(0.0)
        ledger.high_second[tile] = np.float32(0.0)
    ledger.changes[tile] = 0


@numba.njit(**INNER)
def _find_margin(charges, ledger, edges, tile):
    """Bound the shift of edges in a tile, and the error of that of the nearest point."""
    tiles_x = (charges.nx + TILE - 1) // TILE
    tiles_y = (charges.ny + TILE - 1) // TILE
    row = tile // tiles_x
    column = tile - row * tiles_x
    low, high, low_second, high_second = _counted(charges, ledger, tile)
    for j in range(max(row - 1, 0), min(row + 2, tiles_y)):
        for i in range(max(column - 1, 0), min(column + 2, tiles_x)):
            here = _counted(charges, ledger, j * tiles_x + i)
            low = min(low, here[0])
            high = max(high, here[1])
            low_second = min(low_second, here[2])
            high_second = max(high_second, here[3])
    size = max(high - low, high_second - low_second)
    # Single precision: rounding of the shift, and of what cancels in its sum.
    margin = np.float32(edges.normal) * (
        size + np.float32(1e-6) * max(abs(low), abs(high))
    ) + np.float32(2e-6)
    charges.margins[tile] = margin if margin < 0.5 else np.float32(1.0)
    level = 0
    if size > 250.0:
        level = np.int64(np.ceil(8.0 * np.log2(size / 250.0)))
    charges.ranges[tile] = min(level, edges.doubts.shape[1] - 1)


@numba.njit(**INNER)
def _find_margins(charges, ledger, edges):
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
def _respond(response, above, here, below, begin, first, second, start, count):
    """Find the effective charge of ``count`` pixels of a row from the rows around them.

    ``first`` holds what is to be added ahead; the pixels are at ``start`` there and in ``second``, and
    at ``begin`` in the rows of charge.
    """
    f, s = response.first, response.second
    last_q = np.float32(response.last_charge)
    last_b = np.float32(response.last_background)
    per_q = np.float32(1.0 / response.charge_step)
    per_b = np.float32(0.125 / response.background_step)
    rows = np.int32(f.shape[0] - 2)
    columns = np.int32(f.shape[1] - 2)
    zero = np.float32(0.0)
    one = np.float32(1.0)
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
        a, c = (one - u) * (one - v), u * (one - v)
        d, e = (one - u) * v, u * v
        first[at] = (
            a * f[i, j] + c * f[i + up, j] + d * f[i, j + up] + e * f[i + up, j + up]
        )
        second[at] = (
            a * s[i, j] + c * s[i + up, j] + d * s[i, j + up] + e * s[i + up, j + up]
        )
    return beyond


@numba.njit(**INLINED)
def _marked(marks, pixel):
    """Whether a pixel has gained charge in this block."""
    bit = np.uint8(1) << np.uint8(pixel & np.uint64(7))
    return (marks[pixel >> np.uint64(3)] & bit) != 0


@numba.njit(**INNER)
def _any_charge(image, j, first, last):
    """Whether a part of a row holds charge; without a branch, so that it is read in vectors."""
    found = False
    for i in range(np.uint64(first), np.uint64(last)):
        found |= _charge_of(image, np.uint64(j), i) != 0.0
    return found


@numba.njit(**INNER)
def _take_pixels(image, j, first, last, charges, ledger, ahead, apart):
    """Take the charge of a part of a row; where it is ``apart``, the gain waits for the response."""
    start = (j + charges.pad) * charges.stride + charges.pad
    for i in range(first, last):
        at = np.uint64(start + i)
        now = np.float32(_charge_of(image, j, i))
        if apart:
            gain = np.float32(0.0)
            pixel = np.uint64(j * charges.nx + i)
            if ledger.before.size > 0 and _marked(ledger.marks, pixel):
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
        out[:] = ledger.outside[2]
        return
    row = np.uint64(within(j, ny))
    for i in range(np.uint64(nx)):
        out[i + np.uint64(1)] = np.float32(_charge_of(image, row, i))
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
                charges.second, np.uint64(start + first), count,
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
    # Without a second mode and without prediction the charge itself is the effective one.
    apart = response.first.size > 0 or ledger.listed_before.size > 0
    # At first all is zero, and where the image is it may stay so.
    fresh = ledger.counters[TAKEN] == 0
    ledger.counters[TAKEN] = 1
    if fresh and ledger.outside[2] != np.float32(0.0):
        _flag_sides(charges, ledger)
    _flag_charge(image, charges, ledger, ahead, apart, fresh)
    if apart:
        _respond_flagged(image, charges, ledger, response)
    if ledger.mirrored:
        mirror_all(charges, charges.first)
        if response.first.size > 0:
            mirror_all(charges, charges.second)
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


@numba.njit(**INNER)
def _heat_pixel(edges, charges, hot, j, i, electrons, crowd):
    """Mark the edges of a pixel as hot if ``crowd`` electrons come near one of them."""
    margin = charges.margins[(j // TILE) * ((charges.nx + TILE - 1) // TILE) + i // TILE]
    if electrons * min(np.float32(4.0) * margin, np.float32(1.0)) >= crowd:
        # A loop, so that there is one copy of the code.
        for n in range(4):
            line, other = (i, j) if n < 2 else (j, i)
            heat(edges, charges, hot, n >> 1, line + (n & 1), other)


@numba.njit(**INNER)
def _expect_charge(image, place):
    """Ask for the memory of a pixel of the image."""
    if image.single.size > 0:
        prefetch(image.single, place)
    else:
        prefetch(image.double, place)


@numba.njit(**INNER)
def _sort_by_row(ledger, nx, count):
    """Write the listed pixels to ``listed_before`` and their gains to ``before``, row after row."""
    starts = ledger.starts
    starts[:] = 0
    width = np.uint64(nx)
    for n in range(np.uint64(count)):
        starts[np.uint64(ledger.listed[n]) // width + np.uint64(1)] += 1
    for j in range(1, starts.size):
        starts[j] += starts[j - 1]
    for n in range(np.uint64(count)):
        pixel = np.uint64(ledger.listed[n])
        row = pixel // width
        to = np.uint64(starts[row])
        starts[row] += 1
        ledger.listed_before[to] = pixel
        ledger.before[to] = ledger.gained[n]


@numba.njit(**INNER)
def close_block(image, charges, ledger, response, edges, hot, ahead, crowd, per_photon):
    """Update the charge with what the block brought; ``ahead`` times each pixel's gain is added.

    The edges of pixels where ``crowd`` electrons or more came near one are marked as
    hot; ``per_photon`` is the number of electrons per photon.
    """
    cool(hot)
    if ledger.counters[DENSE] or ledger.counters[DENSE_BEFORE]:
        if ledger.before.size > 0:
            for n in range(ledger.counters[LISTED]):
                ledger.before[ledger.listed[n]] = ledger.gained[n]
        take_image(image, charges, ledger, response, edges, ahead)
        ledger.marks[:] = 0
        ledger.counters[DENSE_BEFORE] = ledger.counters[DENSE] and ahead > 0
        ledger.counters[DENSE] = 0
        ledger.counters[LISTED_BEFORE] = 0
        ledger.counters[LISTED] = 0
        for n in range(ledger.counters[STRUCK]):
            ledger.strikes[
                ledger.struck[n] // charges.nx, ledger.struck[n] % charges.nx
            ] = 0
        ledger.counters[STRUCK] = 0
        return
    nx = charges.nx
    count = np.int64(0)
    waiting = np.int64(0)
    none = np.float32(0.0)
    modes = response.first.size > 0
    for n in range(ledger.counters[LISTED]):
        pixel = ledger.listed[n]
        j = np.int64(np.uint64(pixel) // np.uint64(nx))
        i = pixel - j * nx
        # The other pixels of this byte are in the list as well.
        ledger.marks[np.uint64(pixel) >> np.uint64(3)] = 0
        now = np.float32(_charge_of(image, j, i))
        gain = now - ledger.gained[n]
        if gain == none:
            # Negative flux had brought it back, or nothing came of it.
            continue
        ledger.listed[count] = pixel
        ledger.gained[count] = gain
        count += 1
        if modes and np.floor(now / STALE) != np.floor((now - gain) / STALE):
            for m in range(max(j - 1, 0), min(j + 2, charges.ny)):
                for k in range(max(i - 1, 0), min(i + 2, nx)):
                    waiting = _queue(
                        image,
                        charges,
                        ledger,
                        response,
                        waiting,
                        np.int64(m * nx + k),
                        none,
                    )
    for n in range(ledger.counters[LISTED_BEFORE]):
        waiting = _queue(
            image,
            charges,
            ledger,
            response,
            waiting,
            np.int64(ledger.listed_before[n]),
            none,
        )
    pixels, gained = ledger.listed, ledger.gained
    if ahead > 0:
        pixels = ledger.listed_before
        if count > MANY:
            gained = ledger.before
            _sort_by_row(ledger, nx, count)
        else:
            for n in range(count):
                pixels[n] = ledger.listed[n]
    # What the block brought acts last: the same pixels may wait already, without it.
    for n in range(count):
        waiting = _queue(
            image,
            charges,
            ledger,
            response,
            waiting,
            np.int64(pixels[n]),
            ahead * gained[n],
        )
    _set_pixels(image, charges, ledger, response, waiting)
    ledger.counters[LISTED_BEFORE] = count if ahead > 0 else 0
    ledger.counters[LISTED] = 0
    _find_margins(charges, ledger, edges)
    for n in range(count):
        if ledger.gained[n] >= crowd:
            j = ledger.listed[n] // nx
            i = ledger.listed[n] - j * nx
            _heat_pixel(edges, charges, hot, j, i, ledger.gained[n], crowd)
    # Full pixels gain nothing, yet electrons come.
    for n in range(ledger.counters[STRUCK]):
        j = ledger.struck[n] // nx
        i = ledger.struck[n] - j * nx
        electrons = np.float32(ledger.strikes[j, i]) * per_photon
        _heat_pixel(edges, charges, hot, j, i, electrons, crowd)
        ledger.strikes[j, i] = 0
    ledger.counters[STRUCK] = 0


@numba.njit(**INLINED)
def _put(image, ledger, nx, j, i, flux):
    """Add electrons to a pixel; what single precision loses is kept in ``carry``."""
    j, i = np.uint64(j), np.uint64(i)
    before = _charge_of(image, j, i)
    pixel = j * np.uint64(nx) + i
    if not _marked(ledger.marks, pixel):
        ledger.marks[pixel >> np.uint64(3)] |= np.uint8(1) << np.uint8(pixel & np.uint64(7))
        count = ledger.counters[LISTED]
        if count < ledger.listed.size:
            ledger.listed[np.uint64(count)] = pixel
            ledger.gained[np.uint64(count)] = before
            ledger.counters[LISTED] = count + 1
        else:
            ledger.counters[DENSE] = 1
            if ledger.before.size > 0:
                ledger.before[pixel] = before
    carry = ledger.carry
    if carry.size == 0:
        image.double[j, i] = before + flux
    elif ledger.counters[CARRIED] == 0:
        # Whole electrons are not lost, and nothing carried is looked up before anything is lost.
        total = before + flux
        now = np.float32(total)
        image.single[j, i] = now
        if np.float64(now) != total:
            ledger.counters[CARRIED] = 1
            carry[j, i] = np.float32(total - np.float64(now))
    else:
        carried = carry[j, i]
        total = before + np.float64(carried) + flux
        now = np.float32(total)
        image.single[j, i] = now
        rest = np.float32(total - np.float64(now))
        # Not written where nothing is carried: untouched pages cost no memory.
        if rest != carried:
            carry[j, i] = rest


@numba.njit(**INNER)
def _spill(image, charges, ledger, j, i, flux, full_well, along_y, up):
    """Fill a pixel, then those beyond it along its column; returns the flux that stays inside [e-]."""
    room = full_well - _charge_of(image, j, i)
    kept = 0.0
    if room > 0:
        part = min(room, flux)
        _put(image, ledger, charges.nx, j, i, part)
        flux -= part
        kept += part
    ledger.sums[SPILLED] += flux
    step = 1 if up else -1
    column = i if along_y else j
    place = j if along_y else i
    last = charges.ny if along_y else charges.nx
    side = 1 if up else 0
    # A column remembers from where to where it was full when it last spilled.
    start = ledger.spill_from[side, column]
    end = ledger.spill_to[side, column]
    to = place + step
    if start >= 0 and (start - place) * step <= 0 and (end - place) * step > 0:
        to = end
    else:
        ledger.spill_from[side, column] = place
    while flux > 0 and 0 <= to < last:
        tj = to if along_y else j
        ti = i if along_y else to
        room = full_well - _charge_of(image, tj, ti)
        if room > 0:
            part = min(room, flux)
            _put(image, ledger, charges.nx, tj, ti, part)
            flux -= part
            kept += part
            if flux <= 0:
                break
        to += step
    ledger.spill_to[side, column] = to
    if flux > 0:
        ledger.sums[SPILLED_OFF] += flux
    return kept


@numba.njit(**INNER)
def _strike(ledger, j, i, nx):
    """Count an electron that meets a full pixel."""
    if ledger.strikes.size == 0:
        return
    before = ledger.strikes[j, i]
    if before == 0:
        count = ledger.counters[STRUCK]
        if count >= ledger.struck.size:
            return
        ledger.struck[count] = j * nx + i
        ledger.counters[STRUCK] = count + 1
    ledger.strikes[j, i] = before + 1


@numba.njit(**INNER)
def deposit(
    image, charges, ledger, flux, first, i, j, z, words, lo, hi, full_well, along_y, loss
):
    """Add the electrons lo to hi to the image, in their order, and to the sums of the ledger.

    ``flux`` is indexed from ``first``, all else from 0.  An electron is lost with
    probability 1 - exp(-loss Q), Q [e-] the charge that it meets.
    """
    nx = charges.nx
    # One sum after the other, whatever the pieces in which electrons come.
    added, crossed = ledger.sums[ADDED], ledger.sums[CROSSED]
    off, lost = ledger.sums[OFF_IMAGE], ledger.sums[LOST]
    scattered = nx * charges.ny >= SCATTERED
    for n in range(np.uint64(lo), np.uint64(hi)):
        if scattered and (n - np.uint64(lo)) % np.uint64(AHEAD) == np.uint64(0):
            for m in range(n, min(n + np.uint64(AHEAD), np.uint64(hi))):
                place = np.int64(j[m]) * nx + np.int64(i[m])
                _expect_charge(image, place)
                prefetch(ledger.marks, place >> 3)
        w = flux[np.uint64(first) + n]
        ci = np.int64(i[n])
        cj = np.int64(j[n])
        if ci < 0:
            if z[n] < 0:
                crossed += w
            else:
                off += w
            continue
        if loss > 0.0:
            # The lowest bit says where electrons spill to.
            word = (np.float64(words[n] >> np.uint32(1)) + 0.5) * 2.0**-31
            if word >= np.exp(-loss * _charge_of(image, cj, ci)):
                lost += w
                continue
        if w > 0 and _charge_of(image, np.uint64(cj), np.uint64(ci)) + w > full_well:
            up = (words[n] & np.uint32(1)) == np.uint32(1)
            _strike(ledger, cj, ci, nx)
            added += _spill(image, charges, ledger, cj, ci, w, full_well, along_y, up)
        else:
            if w < 0.0:
                # A full column may have a hole now.
                column = ci if along_y else cj
                ledger.spill_from[0, column] = -1
                ledger.spill_from[1, column] = -1
            _put(image, ledger, nx, cj, ci, w)
            added += w
    ledger.sums[ADDED], ledger.sums[CROSSED] = added, crossed
    ledger.sums[OFF_IMAGE], ledger.sums[LOST] = off, lost
