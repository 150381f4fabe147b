"""Light that shifted boundaries moved between pixels, from an image and the shifts.

Fields are ``[y, x]``.  The left and the lower boundary of a pixel have its numbers, and so has the
corner in which both begin.
"""

import numba


@numba.njit(cache=True, error_model="numpy")
def _at(grid, q, b):
    """Bilinear value of a grid [charge, background] at a place in steps; its ends are held."""
    q = min(max(q, 0.0), grid.shape[0] - 1.0)
    b = min(max(b, 0.0), grid.shape[1] - 1.0)
    i = min(int(q), grid.shape[0] - 2)
    j = min(int(b), grid.shape[1] - 2)
    u = q - i
    v = b - j
    low = (1.0 - u) * grid[i, j] + u * grid[i + 1, j]
    high = (1.0 - u) * grid[i, j + 1] + u * grid[i + 1, j + 1]
    return (1.0 - v) * low + v * high


@numba.njit(cache=True, error_model="numpy")
def mean_charges(
    light, image, first, second, charge_step, background_step, times, weights, out
):
    """Average the effective charges of both modes over an exposure, into ``out`` (2, y, x).

    At a part t of the exposure a pixel holds ``t light + t^2 (image - light)``, as the effect grows with
    the square of the time; its background is the mean of the eight around it, those beyond the field
    being like the nearest.  Grids of size 0 stand for a linear response.
    """
    ny, nx = image.shape
    linear = first.size == 0
    for y in range(ny):
        for x in range(nx):
            around_light = 0.0
            around_image = 0.0
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    if dy != 0 or dx != 0:
                        j = min(max(y + dy, 0), ny - 1)
                        i = min(max(x + dx, 0), nx - 1)
                        around_light += 0.125 * light[j, i]
                        around_image += 0.125 * image[j, i]
            one = 0.0
            two = 0.0
            for n in range(times.size):
                t = times[n]
                q = t * light[y, x] + t * t * (image[y, x] - light[y, x])
                if linear:
                    one += weights[n] * q
                    continue
                b = t * around_light + t * t * (around_image - around_light)
                q /= charge_step
                b /= background_step
                one += weights[n] * _at(first, q, b)
                two += weights[n] * _at(second, q, b)
            out[0, y, x] = one
            out[1, y, x] = two


@numba.njit(cache=True, error_model="numpy")
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
