"""Photons into an image: land, find pixels, deposit, block by block.

A block ends with the photon at which the flux since its start reaches its size.  Blocks
depend on the photons' order and flux alone.
"""

from types import FunctionType
from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.charge import (
    BEFORE,
    IN_BLOCK,
    OPENED,
    PHOTONS,
    TOTAL,
    close_block,
    deposit,
)
from bfsensor._kernels.edges import collect
from bfsensor._kernels.photons import land

BATCH = 16384
PIECE = 2048


class Plan(NamedTuple):
    """How the charge is frozen: block size [e-] (0: never renewed), predicted or not.

    With prediction blocks start at 1/64 of the size and double.
    """

    block: float
    predict: bool
    full_well: float
    spill_along_y: bool
    x0: float
    y0: float
    key0: np.uint32
    key1: np.uint32


@numba.njit(cache=True, inline="always")
def _size(plan, total):
    """Size of the block that starts after ``total`` electrons."""
    if not plan.predict:
        return plan.block
    return min(plan.block, max(total, plan.block / 64.0))


@numba.njit(cache=True, nogil=True)
def finish_block(image, plan, edges, charges, hot, ledger, response):
    """End the open block: its charge is taken over."""
    ahead = np.float32(0.0)
    if plan.predict and ledger.sums[IN_BLOCK] > 0:
        ahead = np.float32(0.5)
        if plan.block > 0:
            size = _size(plan, ledger.sums[TOTAL])
            ahead = np.float32(0.5 * size / ledger.sums[IN_BLOCK])
    # As many electrons as make it worth while: an edge costs about so many lookups.
    photons = ledger.counters[PHOTONS] - ledger.counters[OPENED]
    crowd = np.float32(np.inf)
    if photons > 0:
        crowd = np.float32(
            0.05 * edges.points.size * edges.lanes * ledger.sums[IN_BLOCK] / photons
        )
    ledger.counters[OPENED] = ledger.counters[PHOTONS]
    close_block(image, charges, ledger, response, edges, hot, ahead, crowd)
    ledger.sums[BEFORE] = ledger.sums[IN_BLOCK]
    ledger.sums[IN_BLOCK] = 0.0


def _shoot(
    image, light, medium, pattern, plan, edges, charges, hot, ledger, response,
    x, y, z, words, i, j, near_x, near_y,
):  # fmt: skip
    """Accumulate all photons; returns the flux that stays in the image.

    ``x`` to ``near_y`` are buffers for BATCH photons.  ``image``, ``charges`` and ``ledger``
    are changed.
    """
    added = 0.0
    total = light.x.size
    for start in range(0, total, BATCH):
        count = min(BATCH, total - start)
        number = ledger.counters[PHOTONS]
        pieces = (count + PIECE - 1) // PIECE
        for piece in numba.prange(pieces):
            lo = piece * PIECE
            hi = min(lo + PIECE, count)
            land(
                light, medium, pattern, start + lo, start + hi, number + lo,
                plan.key0, plan.key1, plan.x0, plan.y0,
                x[lo:hi], y[lo:hi], z[lo:hi], words[lo:hi],
            )  # fmt: skip
        done = 0
        while done < count:
            size = np.inf
            if plan.block > 0:
                size = _size(plan, ledger.sums[TOTAL] - ledger.sums[IN_BLOCK])
            end = done
            while end < count and ledger.sums[IN_BLOCK] < size:
                flux = abs(light.flux[np.uint64(start + end)])
                ledger.sums[IN_BLOCK] += flux
                ledger.sums[TOTAL] += flux
                end += 1
            parts = (end - done + PIECE - 1) // PIECE
            for part in numba.prange(parts):
                lo = done + part * PIECE
                hi = min(lo + PIECE, end)
                collect(
                    edges, charges, hot, x, y, z, lo, hi, near_x[lo:hi], near_y[lo:hi], i, j
                )
            added += deposit(
                image, charges, ledger, light.flux, start, i, j, z, words, done, end,
                plan.full_well, plan.spill_along_y,
            )  # fmt: skip
            ledger.counters[PHOTONS] = number + end
            if ledger.sums[IN_BLOCK] >= size:
                finish_block(image, plan, edges, charges, hot, ledger, response)
            done = end
    return added


shoot = numba.njit(cache=True, nogil=True)(_shoot)
# Under a name of its own: numba's cache knows functions by name and line, and would give
# back the code for one thread.
_shoot_on_threads = FunctionType(_shoot.__code__, globals(), "_shoot_on_threads")
_shoot_on_threads.__qualname__ = "_shoot_on_threads"
shoot_on_threads = numba.njit(cache=True, nogil=True, parallel=True)(_shoot_on_threads)
