"""Deposit of electrons in pixels, spilling, and the end of a block of photons.

The image holds the charge.  While a block of photons lasts, the effective charge that moves
boundaries is frozen; electrons go into the image at once, in the order of the photons, and the
first in a pixel marks it and enters it in a list, with the charge it had.  When the block ends
the effective charge of the listed pixels is updated to what it will be, on average, in the next
block: by the charge now and half of what the pixel gained in the last block.
"""

import numba
import numpy as np

from bfsensor._kernels.charge import (
    ADDED,
    CARRIED,
    CROSSED,
    DENSE,
    DENSE_BEFORE,
    LISTED,
    LISTED_BEFORE,
    LOST,
    OFF_IMAGE,
    QUEUE,
    SPILLED,
    SPILLED_OFF,
    STRUCK,
    TILE,
    charge_of,
    find_margins,
    marked,
    set_pixels,
    take_image,
)
from bfsensor._kernels.compile_options import INLINED, INNER
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.hot import cool, heat
from bfsensor._kernels.prefetch import prefetch

STALE = np.float32(512.0)
"""Charge that a pixel may gain before the background of its neighbours is found again [e-].

Chosen: the background of a pixel, the mean of eight neighbours, is then out of date by less than
this; twice as large, by twice as much, and the search is made half as often."""
MANY = 2048
"""Number of listed pixels from which they are sorted by row, so that they are near in memory.

Chosen: charge of so many pixels and of their neighbours no longer fits the first-level cache; with
twice as many small lists are left as they are, with the same bits."""
AHEAD = 32
"""Number of pixels whose memory is asked for before the first of them is used.

Chosen: ten lines of memory for each, 20 kB, fit in the first-level cache; four times as many do not
and gain no more."""
SCATTERED = 1 << 20
"""Number of pixels of an image from which on memory is asked for ahead.

Chosen: all that belongs to a smaller one stays in the larger caches, and to ask costs more than it
gains (4 % of a flat at a quarter of it); twice as large, images of 4 MB are not served."""


@numba.njit(**INLINED)
def _queue(image, charges, ledger, response, waiting, pixel, ahead):
    """Put a pixel in the queue, with ``ahead`` electrons to add; returns how many wait there."""
    ledger.queue[np.uint64(waiting)] = pixel
    ledger.ahead[0, np.uint64(waiting)] = ahead
    waiting += 1
    if waiting == QUEUE:
        set_pixels(image, charges, ledger, response, waiting)
        waiting = 0
    return waiting


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
        now = np.float32(charge_of(image, j, i))
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
    set_pixels(image, charges, ledger, response, waiting)
    ledger.counters[LISTED_BEFORE] = count if ahead > 0 else 0
    ledger.counters[LISTED] = 0
    find_margins(charges, ledger, edges)
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
    before = charge_of(image, j, i)
    pixel = j * np.uint64(nx) + i
    if not marked(ledger.marks, pixel):
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
    room = full_well - charge_of(image, j, i)
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
        room = full_well - charge_of(image, tj, ti)
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
            if word >= np.exp(-loss * charge_of(image, cj, ci)):
                lost += w
                continue
        if w > 0 and charge_of(image, np.uint64(cj), np.uint64(ci)) + w > full_well:
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
