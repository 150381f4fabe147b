"""Points of a boundary between rows, from the sheet of field lines that the boundary is lower down.

A sheet is the boundary between two rows within one column of pixels, at one height: y as a polynomial
in x, because the electrons that fall on it have all come together near the middle of the channel.
Arrays of the field are those of :mod:`bfsensor._kernels.drift`.
"""

import numba
import numpy as np

from bfsensor._kernels.drift import advance, choose_step, step_over_height

TRIALS = 12
"""Paths after which the search for a point of a boundary ends without one.

Chosen: it takes one to three paths; twice as many help only points that lie where columns meet and
jump between two sheets, which are bisected instead."""

BEYOND = 1.1
"""Largest argument at which the polynomial of a sheet is evaluated, 1 being the end of its range.

Chosen: the range has a margin for what boundaries shift, so that 1 is passed near corners only; at twice
the distance from 1, points that jump between columns are followed longer before they are bisected."""


@numba.njit(cache=True, error_model="numpy")
def _fall(phi, xs, ys, zs, start, height, coarseness, max_steps, turn, scratch, cell, out):
    """Follow an electron down to a height and write x and y there to ``out``; whether it arrives."""
    p = scratch[0]
    for m in range(3):
        p[m] = start[m]
    for _ in range(max_steps):
        h = choose_step(phi, xs, ys, zs, coarseness, turn, scratch, cell)
        if p[2] + advance(h, scratch, 2) < height:
            step_over_height(
                phi, xs, ys, zs, p[0], p[1], p[2], height - p[2], cell, scratch[7:13],
                scratch[6], out,
            )  # fmt: skip
            return True
        for m in range(3):
            p[m] += advance(h, scratch, m)
    return False


@numba.njit(cache=True, error_model="numpy")
def fall_to_height(phi, xs, ys, zs, starts, height, coarseness, max_steps, turn, out):
    """Follow electrons from ``starts`` (n, 3) down to a height; ``out`` (n, 2) gets x and y or nan."""
    scratch = np.zeros((13, 4))
    cell = np.ones(3, np.int64)
    for n in range(starts.shape[0]):
        if not _fall(
            phi, xs, ys, zs, starts[n], height, coarseness, max_steps, turn, scratch, cell, out[n]
        ):  # fmt: skip
            out[n] = np.nan


@numba.njit(cache=True, error_model="numpy")
def _height_of(coefficients, t):
    """Sum of Chebyshev polynomials at ``t``, by Clenshaw's recurrence."""
    one = 0.0
    two = 0.0
    for k in range(coefficients.size - 1, 0, -1):
        one, two = 2.0 * t * one - two + coefficients[k], one
    return t * one - two + coefficients[0]


@numba.njit(cache=True, error_model="numpy")
def meet_sheets(
    phi, xs, ys, zs, seeds, landings, lines, pitch, first, low, high, coefficients, height,
    coarseness, max_steps, turn, tolerance, out,
):  # fmt: skip
    """Find for every seed the y from which an electron falls onto the sheet of its line.

    ``seeds`` (n, 3) lie on nominal edges, and electrons from them land at ``landings`` (n, 2), x and
    y.  The sheet of line ``l`` in the column of pixels ``first + c`` (columns are ``pitch`` wide) has
    Chebyshev coefficients ``coefficients[l, c]`` in x from ``low[l, c]`` to ``high[l, c]``, nan where
    there is none.  The secant method ends with a step below ``tolerance``; ``out`` (n,) gets y, nan
    where none is found.
    """
    scratch = np.zeros((13, 4))
    cell = np.ones(3, np.int64)
    end = np.zeros(2)
    point = np.zeros(3)
    # Change of a landing with its start: that of the seed before, which lies near.
    slope = np.nan
    for n in range(seeds.shape[0]):
        for m in range(3):
            point[m] = seeds[n, m]
        end[:] = landings[n]
        line = lines[n]
        out[n] = np.nan
        miss = 0.0
        step = 0.0
        for trial in range(TRIALS):
            if trial > 0 and not _fall(
                phi, xs, ys, zs, point, height, coarseness, max_steps, turn, scratch, cell, end
            ):  # fmt: skip
                break
            column = int(np.floor(end[0] / pitch + 0.5)) - first
            if column < 0 or column >= low.shape[1]:
                break
            a = low[line, column]
            b = high[line, column]
            t = (2.0 * end[0] - a - b) / (b - a)
            if not abs(t) < BEYOND:
                break
            before = miss
            miss = end[1] - _height_of(coefficients[line, column], t)
            if trial > 0:
                slope = (miss - before) / step
            if np.isnan(slope):
                step = -miss if abs(miss) > tolerance else tolerance
                point[1] += step
                continue
            step = -miss / slope
            point[1] += step
            if abs(step) < tolerance:
                out[n] = point[1]
                break
        if np.isnan(out[n]):
            slope = np.nan  # that of a jump between sheets serves no other seed
