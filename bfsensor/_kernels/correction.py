"""Light that shifted boundaries moved between pixels, from an image and the shifts.

Fields are ``[y, x]``.  The left and the lower boundary of a pixel have its numbers, and so has the
corner in which both begin.
"""

import numba
import numpy as np

from bfsensor._kernels.shifts import NEAR_MODES

OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}
"""Bands of an image are corrected by threads side by side, which needs kernels that let others run."""


@numba.njit(**OPTIONS)
def mean_charges(
    light, image, first, near, charge_step, background_step, times, weights, out
):
    """Average the effective charges of all modes over an exposure, into ``out`` (modes, y, x).

    At a part t of the exposure a pixel holds ``t light + t^2 (image - light)``, as the effect grows with
    the square of the time; its background is the mean of the eight around it, those beyond the field
    being like the nearest.  Both grids [charge, background] are interpolated linearly, and their ends
    are held; grids of size 0 stand for a linear response.
    """
    ny, nx = image.shape
    linear = first.size == 0
    last_charge = first.shape[0] - 1.0
    last_background = first.shape[1] - 1.0
    per_charge = 1.0 / charge_step
    per_background = 1.0 / background_step
    # Sums of three rows, with a column more on either side.
    sums = np.empty(NEAR_MODES)
    lights = np.empty(nx + 2)
    images = np.empty(nx + 2)
    for y in range(ny):
        below = max(y - 1, 0)
        above = min(y + 1, ny - 1)
        for x in range(nx):
            lights[x + 1] = light[below, x] + light[y, x] + light[above, x]
            images[x + 1] = image[below, x] + image[y, x] + image[above, x]
        lights[0] = lights[1]
        images[0] = images[1]
        lights[nx + 1] = lights[nx]
        images[nx + 1] = images[nx]
        for x in range(nx):
            own = light[y, x]
            gained = image[y, x] - own
            around = 0.125 * (lights[x] + lights[x + 1] + lights[x + 2] - own)
            gained_around = (
                0.125 * (images[x] + images[x + 1] + images[x + 2] - image[y, x]) - around
            )
            one = 0.0
            sums[:] = 0.0
            for n in range(times.size):
                t = times[n]
                q = t * (own + t * gained)
                if linear:
                    one += weights[n] * q
                    continue
                q = min(max(q * per_charge, 0.0), last_charge)
                b = t * (around + t * gained_around) * per_background
                b = min(max(b, 0.0), last_background)
                i = min(int(q), first.shape[0] - 2)
                j = min(int(b), first.shape[1] - 2)
                u = q - i
                v = b - j
                w00 = weights[n] * (1.0 - u) * (1.0 - v)
                w01 = weights[n] * (1.0 - u) * v
                w10 = weights[n] * u * (1.0 - v)
                w11 = weights[n] * u * v
                one += w00 * first[i, j] + w01 * first[i, j + 1]
                one += w10 * first[i + 1, j] + w11 * first[i + 1, j + 1]
                for m in range(NEAR_MODES):
                    sums[m] += w00 * near[i, j, m] + w01 * near[i, j + 1, m]
                    sums[m] += w10 * near[i + 1, j, m] + w11 * near[i + 1, j + 1, m]
            out[0, y, x] = one
            for m in range(NEAR_MODES):
                out[1 + m, y, x] = sums[m]


@numba.njit(**OPTIONS)
def light_on_boundaries(light, values, slopes, out_values, out_slopes, out_corners):
    """Write the light at boundaries [1/pixel], its change across them, and the light at corners.

    ``out_values`` and ``out_slopes`` (2, y, x) are those of left and of lower boundaries.  Weights
    ``values`` and ``slopes`` belong to the pixels above and right of a boundary, nearest first; those on
    the other side have the same and the opposite ones.  Closer to the sides of the field than the
    weights reach only two pixels count.
    """
    ny, nx = light.shape
    half = values.size
    for y in range(ny):
        for x in range(nx):
            left = light[y, max(x - 1, 0)]
            out_values[0, y, x] = 0.5 * (light[y, x] + left)
            out_slopes[0, y, x] = light[y, x] - left
        if nx > 2 * half:
            for x in range(half, nx - half):
                out_values[0, y, x] = 0.0
                out_slopes[0, y, x] = 0.0
            for k in range(half):
                for x in range(half, nx - half):
                    right = light[y, x + k]
                    left = light[y, x - 1 - k]
                    out_values[0, y, x] += values[k] * (right + left)
                    out_slopes[0, y, x] += slopes[k] * (right - left)
    for y in range(ny):
        below = max(y - 1, 0)
        if half <= y < ny - half:
            for x in range(nx):
                out_values[1, y, x] = 0.0
                out_slopes[1, y, x] = 0.0
                out_corners[y, x] = 0.0
            for k in range(half):
                for x in range(nx):
                    up = light[y + k, x]
                    down = light[y - 1 - k, x]
                    out_values[1, y, x] += values[k] * (up + down)
                    out_slopes[1, y, x] += slopes[k] * (up - down)
                    out_corners[y, x] += values[k] * (
                        out_values[0, y + k, x] + out_values[0, y - 1 - k, x]
                    )
        else:
            for x in range(nx):
                out_values[1, y, x] = 0.5 * (light[y, x] + light[below, x])
                out_slopes[1, y, x] = light[y, x] - light[below, x]
                out_corners[y, x] = 0.5 * (out_values[0, y, x] + out_values[0, below, x])


@numba.njit(**OPTIONS)
def give_back(image, left, lower, first_row, first_column, out):
    """Write the image with the light that crossed left and lower boundaries where it came from.

    ``left`` and ``lower`` moved to the left and down; the image's first pixel is theirs at
    ``first_row``, ``first_column``.  Boundaries beyond the fields moved nothing.
    """
    ny, nx = image.shape
    for y in range(ny):
        j = y + first_row
        for x in range(nx):
            i = x + first_column
            back = np.float64(left[j, i]) + np.float64(lower[j, i])
            if i + 1 < left.shape[1]:
                back -= np.float64(left[j, i + 1])
            if j + 1 < left.shape[0]:
                back -= np.float64(lower[j + 1, i])
            out[y, x] = image[y, x] + back


@numba.njit(**OPTIONS)
def fill_masked(image, mask, reach, out_light):
    """Write into masked pixels the light that the nearest good ones suggest.

    In each of four directions the nearest good pixel within ``reach`` counts, with a weight of one over
    its distance: between two of a row or column that is a straight line.  Pixels without any get 0.
    """
    ny, nx = image.shape
    for y in range(ny):
        for x in range(nx):
            if not mask[y, x]:
                continue
            total = 0.0
            weight = 0.0
            for direction in range(4):
                step_x = (1, -1, 0, 0)[direction]
                step_y = (0, 0, 1, -1)[direction]
                for n in range(1, reach + 1):
                    j = y + n * step_y
                    i = x + n * step_x
                    if j < 0 or j >= ny or i < 0 or i >= nx:
                        break
                    if not mask[j, i]:
                        total += image[j, i] / n
                        weight += 1.0 / n
                        break
            out_light[y, x] = total / weight if weight > 0.0 else 0.0


@numba.njit(**OPTIONS)
def moved_light(shifts, tilts, normal, tangential, value, slope, ends, upright, out):
    """Write the light that crossed left (``upright``) or lower boundaries, to the left or down.

    All shifts are means over the exposure, during which they grow in proportion to the time, so that
    products of two are 4/3 of the product of their means.

    ``shifts`` are mean normal shifts of the boundaries [pixel], ``tilts`` their first Legendre moments
    along the boundary, ``normal`` and ``tangential`` the shifts of the corners.  ``value`` and ``slope``
    are light at the boundary [1/pixel] and its change across it, ``ends`` light at the corners.  A
    boundary with shifted ends sweeps the area of a polygon whose edge is longer or shorter than a
    pixel.
    """
    ny, nx = out.shape
    for y in range(ny):
        for x in range(nx):
            # The boundary runs from its own corner to that of the next pixel along it.
            j = min(y + 1, ny - 1) if upright else y
            i = x if upright else min(x + 1, nx - 1)
            s = shifts[y, x]
            longer = tangential[j, i] - tangential[y, x]
            turned = normal[y, x] * tangential[y, x] - normal[j, i] * tangential[j, i]
            out[y, x] = (
                value[y, x] * (s + 4.0 / 3.0 * (s * longer + 0.5 * turned))
                + 2.0 / 3.0 * s * s * slope[y, x]
                + 0.5 * tilts[y, x] * (ends[j, i] - ends[y, x])
            )
