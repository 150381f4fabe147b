"""Accumulation of photons in an image: landing, pixels and deposit, block by block.

A block ends with the photon at which the flux since its start reaches its size.  Blocks
depend on the photons' order and flux alone.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.atomics import add, exchange, give_way, observe, publish
from bfsensor._kernels.charge import (
    ADDED,
    BEFORE,
    IN_BLOCK,
    OPENED,
    PHOTONS,
    TAKEN,
    TOTAL,
    take_image,
)
from bfsensor._kernels.compile_options import ENTRY, INLINED, INNER
from bfsensor._kernels.deposit import close_block, deposit
from bfsensor._kernels.edges import collect
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.hot import evaluate, fence
from bfsensor._kernels.photons import land

BATCH = 32768
"""Number of photons that land together while those of the batch before are deposited.

Chosen: buffers of 2 MB; twice as large takes twice that and gives the same bits."""
PIECE = 1024
"""Smallest share of a batch that is worth a thread [photon].

Chosen: at some 20 ns a photon a share takes 0.02 ms, far more than to hand it out; twice as large,
small blocks are spread over fewer shares, with the same bits."""
PATIENCE = 1000
"""Number of looks for a task after which a thread lets others run on its core between two of them.

Chosen: they take a few microseconds; ten times as large, threads that wait keep others from a core that
they share."""
MOST_PIECES = 16
"""Largest number of pieces of a batch, so that a bit for each says whether it is done.

Chosen: it serves four threads; twice as large serves eight, while what one thread does alone bounds
the gain at two or less."""
NEVER = np.int64(1) << np.int64(62)
"""Bit of a piece that no task has, by definition above those of MOST_PIECES twice: threads that serve
wait for it until all is done."""
# Places in the baton, int64, on three lines of memory.  The ticket of the next piece holds the number of
# the task in its upper half, then with 16 bits each the number of pieces and the piece; -1 when all
# is done.  DONE has a bit for each piece that is.  Then the task: how many pieces are to be collected,
# after which come those that land; whether it is to evaluate hot edges instead; the buffer; the photons
# to collect, and those of the batch that begins with AT to land.
TICKET, DONE = 0, 8
COLLECTED, HOT, NOW, LO, HI, LAND_LO, LAND_HI, AT = range(16, 24)
N_BATON = 24
"""Length of the baton, by definition three lines of memory."""


class Plan(NamedTuple):
    """Settings of an exposure: blocks of frozen charge, full well, spilling, random numbers.

    ``block`` is the size of a block [e-] (0: the charge is never updated); with ``predict`` the
    charge is extrapolated to the middle of the next block, and blocks start at 1/64 of the size and
    double.  ``full_well`` [e-]; ``x0``, ``y0`` [pixel] is the lower left corner of the image;
    ``loss`` [1/e-] is explained in :func:`deposit`.
    """

    block: float
    predict: bool
    full_well: float
    spill_along_y: bool
    x0: float
    y0: float
    key0: np.uint32
    key1: np.uint32
    loss: float


@numba.njit(**INLINED)
def _size(plan, total):
    """Size of the block that starts after ``total`` electrons."""
    if not plan.predict:
        return plan.block
    return min(plan.block, max(total, plan.block / 64.0))


@numba.njit(**INNER)
def _end_block(image, plan, edges, charges, hot, ledger, response):
    """Update the frozen charge and mark hot edges, as all electrons of a block are deposited."""
    ahead = np.float32(0.0)
    if plan.predict and ledger.sums[IN_BLOCK] > 0:
        ahead = np.float32(0.5)
        if plan.block > 0:
            size = _size(plan, ledger.sums[TOTAL])
            ahead = np.float32(0.5 * size / ledger.sums[IN_BLOCK])
    # As many electrons as make it worth while: an edge costs about so many lookups (measured).
    photons = ledger.counters[PHOTONS] - ledger.counters[OPENED]
    per_photon = np.float32(np.inf)
    if photons > 0:
        per_photon = np.float32(ledger.sums[IN_BLOCK] / photons)
    crowd = per_photon * np.float32(3.0 + 0.01 * edges.points.size * edges.lanes)
    ledger.counters[OPENED] = ledger.counters[PHOTONS]
    close_block(image, charges, ledger, response, edges, hot, ahead, crowd, per_photon)
    ledger.sums[BEFORE] = ledger.sums[IN_BLOCK]
    ledger.sums[IN_BLOCK] = 0.0


@numba.njit(**INNER)
def _all_one(flux, lo, hi):
    """Whether each of the photons lo to hi is one electron."""
    others = 0
    for n in range(np.uint64(lo), np.uint64(hi)):
        others += flux[n] != 1.0
    return others == 0


@numba.njit(**INNER)
def _end_of_block(flux, ledger, start, done, count, size, whole):
    """Photon of a batch with which a block of ``size`` electrons ends, and the sums up to it.

    Where all are ``whole`` electrons their number is the sum, exactly, for few enough of them.
    """
    in_block, total = ledger.sums[IN_BLOCK], ledger.sums[TOTAL]
    end = done
    whole = whole and in_block == np.floor(in_block) and total == np.floor(total)
    if whole and total < 2.0**52 and in_block < size:
        end = (
            count
            if in_block + (count - done) < size
            else done + np.int64(np.ceil(size - in_block))
        )
        in_block += end - done
        total += end - done
    while end < count and in_block < size:
        light = abs(flux[np.uint64(start + end)])
        in_block += light
        total += light
        end += 1
    ledger.sums[IN_BLOCK], ledger.sums[TOTAL] = in_block, total
    return end


@numba.njit(**{**INNER, "_nrt": True})
def _do_piece(
    light, medium, pattern, plan, edges, charges, hot, number, x, y, z, words, i, j, near_x,
    near_y, baton, piece, pieces,
):  # fmt: skip
    """Do one of the pieces of the task on the baton."""
    collected, now = baton[COLLECTED], baton[NOW]
    if baton[HOT]:
        evaluate(edges, charges, hot, piece, pieces)
        fence(edges, charges, hot, piece, pieces)
    elif piece < collected:
        lo, hi = _part(baton[LO], baton[HI], piece, collected)
        collect(
            edges, charges, hot, x[now], y[now], z[now], lo, hi, near_x[lo:hi],
            near_y[lo:hi], i, j,
        )  # fmt: skip
    else:
        lo, hi = _part(
            baton[LAND_LO], baton[LAND_HI], piece - collected, pieces - collected
        )
        at, to = baton[AT], 1 - now
        land(
            light, medium, pattern, at + lo, at + hi, number + at + lo, plan.key0, plan.key1,
            plan.x0, plan.y0, x[to, lo:hi], y[to, lo:hi], z[to, lo:hi], words[to, lo:hi],
        )  # fmt: skip


@numba.njit(**INLINED)
def _part(lo, hi, piece, pieces):
    """Begin and end of one of the pieces of lo to hi."""
    return lo + piece * (hi - lo) // pieces, lo + (piece + 1) * (hi - lo) // pieces


@numba.njit(**INNER)
def _pieces(photons, threads):
    """Number of pieces for so many photons: more than threads, as these are not free at once."""
    if threads == 1:
        return np.int64(photons > 0)
    return min(min((photons + PIECE - 1) // PIECE, 4 * threads), MOST_PIECES)


@numba.njit(**INNER)
def _offer(baton, pieces):
    """Offer the task on the baton to the threads that serve."""
    baton[DONE] = 0
    publish(baton, TICKET, (((baton[TICKET] >> 32) + 1) << 32) + (pieces << 16))


@numba.njit(**{**INNER, "_nrt": True})
def _work_until(
    light, medium, pattern, plan, edges, charges, hot, number, x, y, z, words, i, j, near_x,
    near_y, baton, wanted,
):  # fmt: skip
    """Do pieces of tasks until those in ``wanted``, a bit for each, are done by whomever."""
    looks = 0
    while observe(baton, DONE) & wanted != wanted:
        ticket = observe(baton, TICKET)
        piece, pieces = ticket & 0xFFFF, (ticket >> 16) & 0xFFFF
        if ticket < 0:
            return
        # While a piece is left the task stays what it is; it is left where the ticket has not changed.
        if piece < pieces:
            if exchange(baton, TICKET, ticket, ticket + 1):
                _do_piece(
                    light, medium, pattern, plan, edges, charges, hot, number, x, y, z, words,
                    i, j, near_x, near_y, baton, piece, pieces,
                )  # fmt: skip
                add(baton, DONE, np.int64(1) << piece)
                looks = 0
            continue
        looks += 1
        if looks > PATIENCE:
            give_way()


@numba.njit(**{**ENTRY, "_nrt": True})
def shoot(
    image, light, medium, pattern, plan, edges, charges, hot, ledger, response, renew,
    number, x, y, z, words, i, j, near_x, near_y, baton, threads, serve,
):  # fmt: skip
    """Accumulate all photons; returns the flux that stays in the image.

    With ``renew`` the open block ends before them; charge that is in the image at the first call acts.
    ``number`` is the count of the first photon in the exposure.  ``x`` to ``words`` are pairs of buffers
    for BATCH photons, ``i`` to ``near_y`` buffers.  ``image``, ``charges``, ``hot`` and ``ledger`` are
    changed.

    Where ``threads`` is above 1, others call with the same arguments and ``serve``: they take pieces of
    tasks from the ``baton``, zeros at the beginning, until all is done.  Photons of a block are
    collected, and those of the next batch land, while electrons are deposited in the photons' order by
    this thread alone.  Who comes late, or never, is not waited for; the numbers are the same.
    """
    # Not 0, of which numba would make a type and compile all below for it as well.
    none, one = np.int64(0), np.int64(1)
    if serve:
        _work_until(
            light, medium, pattern, plan, edges, charges, hot, number, x, y, z, words, i, j,
            near_x, near_y, baton, NEVER,
        )  # fmt: skip
        return 0.0
    ledger.sums[ADDED] = 0.0
    if ledger.counters[TAKEN] == 0:
        take_image(image, charges, ledger, response, edges, np.float32(0))
    total = light.x.size
    # The first batch lands alone.
    baton[COLLECTED], baton[HOT], baton[NOW], baton[AT] = 0, 0, 1, 0
    baton[LAND_LO], baton[LAND_HI] = 0, min(BATCH, total)
    pieces = _pieces(min(BATCH, total), threads)
    _offer(baton, pieces)
    _work_until(
        light, medium, pattern, plan, edges, charges, hot, number, x, y, z, words, i, j,
        near_x, near_y, baton, (one << pieces) - one,
    )  # fmt: skip
    open_block = renew
    for start in range(0, max(total, 1), BATCH):
        now = start // BATCH % 2
        count = min(BATCH, total - start)
        after = min(BATCH, total - start - count)
        whole = _all_one(light.flux, start, start + count)
        done = none
        while done < count or open_block:
            size = np.inf
            if open_block:
                # It ends as others do, so that one copy of the code will do, with no photon more.
                size = 0.0
                open_block = False
            elif plan.block > 0:
                size = _size(plan, ledger.sums[TOTAL] - ledger.sums[IN_BLOCK])
            end = _end_of_block(light.flux, ledger, start, done, count, size, whole)
            # The same share of the next batch lands meanwhile.
            lo, hi = min(done, after), min(end, after)
            collected = _pieces(end - done, threads)
            pieces = collected + _pieces(hi - lo, threads)
            baton[COLLECTED], baton[HOT], baton[NOW], baton[AT] = (
                collected,
                0,
                now,
                start + count,
            )
            baton[LO], baton[HI], baton[LAND_LO], baton[LAND_HI] = done, end, lo, hi
            _offer(baton, pieces)
            for piece in range(collected):
                _work_until(
                    light, medium, pattern, plan, edges, charges, hot, number, x, y, z, words,
                    i, j, near_x, near_y, baton, one << piece,
                )  # fmt: skip
                lo, hi = _part(done, end, piece, collected)
                deposit(
                    image, charges, ledger, light.flux, start, i, j, z[now], words[now], lo, hi,
                    plan.full_well, plan.spill_along_y, plan.loss,
                )  # fmt: skip
                ledger.counters[PHOTONS] += hi - lo
            ended = ledger.sums[IN_BLOCK] >= size
            if ended:
                _end_block(image, plan, edges, charges, hot, ledger, response)
            _work_until(
                light, medium, pattern, plan, edges, charges, hot, number, x, y, z, words, i,
                j, near_x, near_y, baton, (one << pieces) - one,
            )  # fmt: skip
            if ended and hot.used[1] > 0:
                baton[HOT] = 1
                _offer(baton, np.int64(threads))
                _work_until(
                    light, medium, pattern, plan, edges, charges, hot, number, x, y, z, words,
                    i, j, near_x, near_y, baton, (one << threads) - one,
                )  # fmt: skip
            done = end
    publish(baton, TICKET, -one)
    return ledger.sums[ADDED]
