"""Accumulation of photons in an image: landing, pixels and deposit, block by block.

A block ends with the photon at which the flux since its start reaches its size.  Blocks
depend on the photons' order and flux alone.
"""

from types import FunctionType
from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.charge import (
    ADDED,
    BEFORE,
    IN_BLOCK,
    OPENED,
    PHOTONS,
    TAKEN,
    TOTAL,
    close_block,
    deposit,
    take_image,
)
from bfsensor._kernels.compile_options import ENTRY, INLINED, INNER
from bfsensor._kernels.edges import collect
from bfsensor._kernels.extremes import max, min
from bfsensor._kernels.hot import evaluate, fence
from bfsensor._kernels.photons import land

BATCH = 32768
"""Number of photons that land together while those of the batch before are deposited.

Chosen: buffers of 2 MB; twice as large takes twice that and gives the same bits."""
PIECE = 2048
"""Smallest share of a batch that is worth a thread [photon].

Chosen: at some 40 ns a photon a share takes 0.1 ms, far more than to wake a thread; twice as large,
small batches are spread over fewer shares, with the same bits."""


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
def _settle(
    image, plan, edges, charges, hot, ledger, response, flux, start, z, words, i, j, lo,
    hi, size,
):  # fmt: skip
    """Deposit the electrons lo to hi of a batch.

    A block of ``size`` electrons ends: the frozen charge is updated and hot edges are marked.
    """
    ledger.sums[ADDED] += deposit(
        image, charges, ledger, flux, start, i, j, z, words, lo, hi, plan.full_well,
        plan.spill_along_y, plan.loss,
    )  # fmt: skip
    ledger.counters[PHOTONS] += hi - lo
    if ledger.sums[IN_BLOCK] < size:
        return
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


def _shoot(
    image, light, medium, pattern, plan, edges, charges, hot, ledger, response, renew,
    threads, x, y, z, words, i, j, near_x, near_y,
):  # fmt: skip
    """Accumulate all photons; returns the flux that stays in the image.

    With ``renew`` the open block ends before them; charge that is in the image at the first call acts.
    ``x`` to ``words`` are pairs of buffers for BATCH photons, ``i`` to ``near_y`` buffers:
    one batch lands while the one before is deposited, which only one thread can do.
    ``image``, ``charges`` and ``ledger`` are changed.
    """
    ledger.sums[ADDED] = 0.0
    # Not 0, of which numba would make a type and compile all below for it as well.
    none = np.int64(0)
    if ledger.counters[TAKEN] == 0:
        take_image(image, charges, ledger, response, edges, np.float32(0))
    total = light.x.size
    number = ledger.counters[PHOTONS]
    count = min(BATCH, total)
    pieces = threads * ((count + threads * PIECE - 1) // (threads * PIECE))
    for piece in numba.prange(pieces):
        lo = piece * count // pieces
        hi = (piece + 1) * count // pieces
        land(
            light, medium, pattern, lo, hi, number + lo, plan.key0, plan.key1, plan.x0,
            plan.y0, x[0, lo:hi], y[0, lo:hi], z[0, lo:hi], words[0, lo:hi],
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
            parts = threads * ((end - done + threads * PIECE - 1) // (threads * PIECE))
            for part in numba.prange(parts):
                lo = done + part * (end - done) // parts
                hi = done + (part + 1) * (end - done) // parts
                collect(
                    edges, charges, hot, x[now], y[now], z[now], lo, hi, near_x[lo:hi],
                    near_y[lo:hi], i, j,
                )  # fmt: skip
            # The same share of the next batch.
            first = min(done, after)
            room = min(end, after) - first
            others = 2 * threads if threads > 1 else 1
            for task in numba.prange(others + 1):
                if task == 0:
                    _settle(
                        image, plan, edges, charges, hot, ledger, response, light.flux,
                        start, z[now], words[now], i, j, done, end, size,
                    )  # fmt: skip
                else:
                    lo = first + (task - 1) * room // others
                    hi = first + task * room // others
                    at = start + count
                    land(
                        light, medium, pattern, at + lo, at + hi, number + at + lo,
                        plan.key0, plan.key1, plan.x0, plan.y0, x[1 - now, lo:hi],
                        y[1 - now, lo:hi], z[1 - now, lo:hi], words[1 - now, lo:hi],
                    )  # fmt: skip
            if ledger.sums[IN_BLOCK] == 0.0 and hot.used[1] > 0:
                for part in numba.prange(threads):
                    evaluate(edges, charges, hot, np.int64(part), threads)
                    fence(edges, charges, hot, np.int64(part), threads)
            done = end
    return ledger.sums[ADDED]


shoot = numba.njit(**{**ENTRY, "_nrt": True})(_shoot)
# Under a name of its own: numba's cache knows functions by name and line, and would give
# back the code for one thread.
_shoot_on_threads = FunctionType(_shoot.__code__, globals(), "_shoot_on_threads")
_shoot_on_threads.__qualname__ = "_shoot_on_threads"
shoot_on_threads = numba.njit(cache=True, nogil=True, no_cfunc_wrapper=True, parallel=True)(
    _shoot_on_threads
)
