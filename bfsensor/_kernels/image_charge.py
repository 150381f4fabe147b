"""Fields of uniformly charged rectangles in closed form, summed over images.

Units: lengths [um]; fields are those of one positive unit charge times 4 pi epsilon
[1/um^2].  All rectangles have their sides along x and y and their centre at x = y = 0.
The images that are not summed enter through the two lowest terms of their potential,
``tail[0] z + tail[1] (z^3 - 1.5 z rho^2)``, averaged over the rectangle.
"""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def across(u, v, h, half_u, half_v):
    """Field along u, the direction of a side, at (u, v) and ``h`` above a rectangle, times its area.

    One logarithm for the four corners.  v + r loses digits where v < 0: the field is even
    in v, so only the near corner can be there, and it is rewritten.
    """
    v = abs(v)
    low_u, high_u, low_v, high_v = u - half_u, u + half_u, v - half_v, v + half_v
    near, far = low_u * low_u + h * h, high_u * high_u + h * h
    near_low, near_high = np.sqrt(near + low_v * low_v), np.sqrt(near + high_v * high_v)
    far_low, far_high = np.sqrt(far + low_v * low_v), np.sqrt(far + high_v * high_v)
    ratio = (high_v + near_high) / (high_v + far_high)
    if low_v < 0:
        ratio *= far / near * (near_low - low_v) / (far_low - low_v)
    else:
        ratio *= (low_v + far_low) / (low_v + near_low)
    return np.log(ratio)


@njit(cache=True, error_model="numpy")
def across_edge(u, start, stop, h, half_u, half_v):
    """Integral of ``across`` over v from ``start`` to ``stop``, in closed form.

    The antiderivative is v asinh(v / rho) - r, even in v; sides at u - half_u and u + half_u
    are subtracted first.
    """
    low_u, high_u = u - half_u, u + half_u
    near, far = low_u * low_u + h * h, high_u * high_u + h * h
    log_ratio = 0.5 * np.log(far / near)
    total = 0.0
    for k in range(4):
        v = abs((start if k < 2 else stop) + (half_v if k % 2 else -half_v))
        r_near, r_far = np.sqrt(near + v * v), np.sqrt(far + v * v)
        part = v * (np.log((v + r_near) / (v + r_far)) + log_ratio) - (r_near - r_far)
        total += part if k == 0 or k == 3 else -part
    return total


@njit(cache=True, error_model="numpy")
def upward(x, y, h, half_x, half_y):
    """Field along z at (x, y) and ``h`` above a rectangle, times its area.

    The solid angle of the rectangle; in its plane the mean of both sides, zero.
    """
    if h == 0:
        return 0.0
    a = abs(h)
    low_x, high_x, low_y, high_y = x - half_x, x + half_x, y - half_y, y + half_y
    angle = (
        np.arctan2(high_x * high_y, a * np.sqrt(high_x**2 + high_y**2 + h * h))
        - np.arctan2(high_x * low_y, a * np.sqrt(high_x**2 + low_y**2 + h * h))
        - np.arctan2(low_x * high_y, a * np.sqrt(low_x**2 + high_y**2 + h * h))
        + np.arctan2(low_x * low_y, a * np.sqrt(low_x**2 + low_y**2 + h * h))
    )
    return angle if h > 0 else -angle


@njit(cache=True, error_model="numpy")
def add_fields(points, heights, signs, half, tail, out_fields):
    """Add the field of all images at each point.

    ``points`` (n, 3); ``heights``, ``signs`` (m,) of the images; ``half`` (2,), half sides;
    ``tail`` (2,), see above; ``out_fields`` (n, 3) is changed.  Infinite or nan on a rim.
    """
    a, b = half
    weight = 1.0 / (4.0 * a * b)
    spread = (a * a + b * b) / 3.0
    for p in range(len(points)):
        x, y, z = points[p]
        ex, ey, ez = 0.0, 0.0, 0.0
        for k in range(len(heights)):
            h = z - heights[k]
            ex += signs[k] * across(x, y, h, a, b)
            ey += signs[k] * across(y, x, h, b, a)
            ez += signs[k] * upward(x, y, h, a, b)
        out_fields[p, 0] += weight * ex + 3.0 * tail[1] * z * x
        out_fields[p, 1] += weight * ey + 3.0 * tail[1] * z * y
        square = x * x + y * y + spread
        out_fields[p, 2] += weight * ez - tail[0] - tail[1] * (3.0 * z * z - 1.5 * square)


@njit(cache=True, error_model="numpy")
def add_point_shifts(points, nodes, weights, interval, heights, signs, half, tail, out):
    """Add integrals over height of the field along u at points (u, v), one an interval.

    ``points`` (n, 2); ``nodes``, ``weights`` (k,) of the quadrature, weights over the drift
    field; ``interval`` (k,), the row of ``out`` (intervals, n) to which a node belongs;
    ``half`` (2,), half sides along u and v; the rest as in ``add_fields``.
    """
    a, b = half
    weight = 1.0 / (4.0 * a * b)
    for p in range(len(points)):
        u, v = points[p]
        for q in range(len(nodes)):
            z = nodes[q]
            total = 0.0
            for k in range(len(heights)):
                total += signs[k] * across(u, v, z - heights[k], a, b)
            out[interval[q], p] += weights[q] * (weight * total + 3.0 * tail[1] * z * u)


@njit(cache=True, error_model="numpy")
def add_edge_shifts(edges, nodes, weights, interval, heights, signs, half, tail, out):
    """Add the mean of ``add_point_shifts`` over edges (u, lowest v, highest v).

    ``edges`` (n, 3); the rest as there.
    """
    a, b = half
    weight = 1.0 / (4.0 * a * b)
    for p in range(len(edges)):
        u, start, stop = edges[p]
        for q in range(len(nodes)):
            z = nodes[q]
            total = 0.0
            for k in range(len(heights)):
                total += signs[k] * across_edge(u, start, stop, z - heights[k], a, b)
            mean = weight * total / (stop - start)
            out[interval[q], p] += weights[q] * (mean + 3.0 * tail[1] * z * u)
