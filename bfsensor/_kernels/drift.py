"""Field lines in an interpolated potential: wells that electrons reach, and boundaries between them.

The potential is interpolated by cubic Hermite polynomials in each direction, slopes at
the nodes from the parabola through three neighbours (non-uniform mesh): the field is
continuous and third-order accurate.  ``phi`` is ``[y, z, x]``, padded by at least two
nodes on every side, and ``xs, ys, zs`` are the padded node positions.  Electrons move up
the gradient of the potential.
"""

import numba
import numpy as np


@numba.njit(cache=True, inline="always", error_model="numpy")
def _cell(nodes, value, guess):
    """Index of the interval that holds ``value``, searched from the last one."""
    i = guess
    last = nodes.size - 3
    while i < last and value > nodes[i + 1]:
        i += 1
    while i > 1 and value < nodes[i]:
        i -= 1
    return i


@numba.njit(cache=True, inline="always", error_model="numpy")
def _weights(nodes, i, value, w, d):
    """Weights of nodes i-1 .. i+2 for the value (``w``) and the derivative (``d``)."""
    h0 = nodes[i] - nodes[i - 1]
    h1 = nodes[i + 1] - nodes[i]
    h2 = nodes[i + 2] - nodes[i + 1]
    t = (value - nodes[i]) / h1
    t2 = t * t
    t3 = t2 * t
    # Hermite basis: values, and slopes times the interval.
    v0 = 2.0 * t3 - 3.0 * t2 + 1.0
    v1 = 1.0 - v0
    s0 = (t3 - 2.0 * t2 + t) * h1
    s1 = (t3 - t2) * h1
    e0 = 6.0 * (t2 - t) / h1
    g0 = 3.0 * t2 - 4.0 * t + 1.0
    g1 = 3.0 * t2 - 2.0 * t
    # Slopes from parabolas: m = a f[-1] + b f[0] + c f[1].
    a0 = -h1 / (h0 * (h0 + h1))
    c0 = h0 / (h1 * (h0 + h1))
    b0 = -a0 - c0
    a1 = -h2 / (h1 * (h1 + h2))
    c1 = h1 / (h2 * (h1 + h2))
    b1 = -a1 - c1
    w[0] = s0 * a0
    w[1] = v0 + s0 * b0 + s1 * a1
    w[2] = v1 + s0 * c0 + s1 * b1
    w[3] = s1 * c1
    d[0] = g0 * a0
    d[1] = e0 + g0 * b0 + g1 * a1
    d[2] = -e0 + g0 * c0 + g1 * b1
    d[3] = g1 * c1


@numba.njit(cache=True, error_model="numpy")
def gradient(phi, xs, ys, zs, x, y, z, cell, weights, out):
    """Write the gradient of the potential [V/um] at a point to ``out``; ``cell`` keeps the interval."""
    i = _cell(xs, x, cell[0])
    j = _cell(ys, y, cell[1])
    k = _cell(zs, z, cell[2])
    cell[0] = i
    cell[1] = j
    cell[2] = k
    wx = weights[0]
    dx = weights[1]
    wy = weights[2]
    dy = weights[3]
    wz = weights[4]
    dz = weights[5]
    _weights(xs, i, x, wx, dx)
    _weights(ys, j, y, wy, dy)
    _weights(zs, k, z, wz, dz)
    gx = 0.0
    gy = 0.0
    gz = 0.0
    for b in range(4):
        pv = 0.0
        px = 0.0
        pz = 0.0
        for c in range(4):
            f0 = phi[j - 1 + b, k - 1 + c, i - 1]
            f1 = phi[j - 1 + b, k - 1 + c, i]
            f2 = phi[j - 1 + b, k - 1 + c, i + 1]
            f3 = phi[j - 1 + b, k - 1 + c, i + 2]
            v = wx[0] * f0 + wx[1] * f1 + wx[2] * f2 + wx[3] * f3
            s = dx[0] * f0 + dx[1] * f1 + dx[2] * f2 + dx[3] * f3
            pv += wz[c] * v
            px += wz[c] * s
            pz += dz[c] * v
        gx += wy[b] * px
        gz += wy[b] * pz
        gy += dy[b] * pv
    out[0] = gx
    out[1] = gy
    out[2] = gz


@numba.njit(cache=True, error_model="numpy")
def _slope_along(phi, xs, ys, zs, p, sign, cell, weights, g, out):
    """Unit vector along (``sign`` = 1) or against the electron drift."""
    gradient(phi, xs, ys, zs, p[0], p[1], p[2], cell, weights, g)
    norm = sign / max(np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2]), 1e-12)
    out[0] = g[0] * norm
    out[1] = g[1] * norm
    out[2] = g[2] * norm


ANY_TURN = 3.0
"""Limit on the turn within a step that no step exceeds, so that steps are not shortened.

Derived: the difference of two unit vectors is at most 2."""

SHORTEST = 0.1
"""Length, relative to the usual one, below which a step is not halved further.

Chosen: where the field is weak and turns everywhere a path would take minutes without this limit;
twice as large, a step is halved three times instead of four."""


LEAVE = 0.5
"""Distance from an edge beyond which a path is not followed in the first bisection [um].

Chosen: boundaries shift by less, so that a path does not come back; the last two points are followed
all the way, and a wrong decision leads to a second bisection.  Twice as large gives the same
boundaries in more time."""


@numba.njit(cache=True, inline="always", error_model="numpy")
def turns(a, b, c, d):
    """Largest difference of the directions within a step from that at its start, squared."""
    first = 0.0
    middle = 0.0
    last = 0.0
    for m in range(3):
        first += (b[m] - a[m]) ** 2
        middle += (c[m] - a[m]) ** 2
        last += (d[m] - a[m]) ** 2
    return max(first, middle, last)


@numba.njit(cache=True, error_model="numpy")
def choose_step(phi, xs, ys, zs, coarseness, turn, scratch, cell):
    """Length of a Runge-Kutta step of fourth order from ``scratch[0]``; its directions to ``scratch``.

    The step is a part ``coarseness`` of the scale of the field, halved while the direction changes
    by ``turn`` or more within it; ``scratch[2:6]`` get the unit vectors at its four points.
    """
    p = scratch[0]
    q = scratch[1]
    a = scratch[2]
    b = scratch[3]
    c = scratch[4]
    d = scratch[5]
    g = scratch[6]
    weights = scratch[7:13]
    h = coarseness * (0.3 + 0.12 * max(p[2] - 1.0, 0.0))
    shortest = SHORTEST * h
    _slope_along(phi, xs, ys, zs, p, 1.0, cell, weights, g, a)
    while True:
        for m in range(3):
            q[m] = p[m] + 0.5 * h * a[m]
        _slope_along(phi, xs, ys, zs, q, 1.0, cell, weights, g, b)
        for m in range(3):
            q[m] = p[m] + 0.5 * h * b[m]
        _slope_along(phi, xs, ys, zs, q, 1.0, cell, weights, g, c)
        for m in range(3):
            q[m] = p[m] + h * c[m]
        _slope_along(phi, xs, ys, zs, q, 1.0, cell, weights, g, d)
        if turns(a, b, c, d) < turn * turn or h < shortest:
            return h
        h *= 0.5


@numba.njit(cache=True, inline="always", error_model="numpy")
def advance(h, scratch, m):
    """Way along axis ``m`` in a step whose directions :func:`choose_step` wrote."""
    return (
        h
        / 6.0
        * (scratch[2, m] + 2.0 * scratch[3, m] + 2.0 * scratch[4, m] + scratch[5, m])
    )


@numba.njit(cache=True, error_model="numpy")
def find_well(
    phi,
    xs,
    ys,
    zs,
    start,
    zone,
    coarseness,
    max_steps,
    scratch,
    cell,
    out,
    turn=ANY_TURN,
    axis=0,
    edge=0.0,
    leave=np.inf,
):
    """Follow an electron from ``start`` to its well; write where it ended to ``out``.

    ``zone`` is (pitch_x, pitch_y, half width, half height, top): the electron has arrived
    when it is below ``top`` and within the half width and height of a pixel centre.  Steps
    are Runge-Kutta of fourth order in arc length; within one the direction changes by less than
    ``turn`` (of a unit vector), or it is halved: by default any length will do, and a step may
    lead over a saddle of the potential.  Farther than ``leave`` from ``edge`` along ``axis`` it is
    not followed.
    """
    p = scratch[0]
    for m in range(3):
        p[m] = start[m]
    for _ in range(max_steps):
        if p[2] < zone[4]:
            ox = p[0] - zone[0] * np.round(p[0] / zone[0])
            oy = p[1] - zone[1] * np.round(p[1] / zone[1])
            if abs(ox) < zone[2] and abs(oy) < zone[3]:
                break
        if abs(p[axis] - edge) > leave:
            break
        h = choose_step(phi, xs, ys, zs, coarseness, turn, scratch, cell)
        for m in range(3):
            p[m] += advance(h, scratch, m)
    for m in range(3):
        out[m] = p[m]


@numba.njit(cache=True, error_model="numpy")
def _sides(
    phi, xs, ys, zs, point, axis, edge, a, b, zone, coarseness, max_steps, scratch, cell, turn,
    leave,
):  # fmt: skip
    """Whether electrons from ``a`` and ``b`` off the edge go below and above it."""
    end = np.zeros(3)
    point[axis] = edge + a
    find_well(
        phi, xs, ys, zs, point, zone, coarseness, max_steps, scratch, cell, end, turn, axis, edge,
        leave,
    )  # fmt: skip
    below = end[axis] < edge
    point[axis] = edge + b
    find_well(
        phi, xs, ys, zs, point, zone, coarseness, max_steps, scratch, cell, end, turn, axis, edge,
        leave,
    )  # fmt: skip
    return below, end[axis] > edge


@numba.njit(cache=True, error_model="numpy")
def _bisect(
    phi, xs, ys, zs, point, axis, edge, a, b, tolerance, zone, coarseness, max_steps, scratch,
    cell, turn, leave,
):  # fmt: skip
    """Ends of the last interval of the bisection, nan where both ends reach the same side."""
    end = np.zeros(3)
    found = False
    for _ in range(8):
        below, above = _sides(
            phi, xs, ys, zs, point, axis, edge, a, b, zone, coarseness, max_steps, scratch, cell,
            turn, leave,
        )  # fmt: skip
        if below and above:
            found = True
            break
        width = b - a
        if not below:
            a -= 2.0 * width
        if not above:
            b += 2.0 * width
    if not found:
        return np.nan, np.nan
    while b - a > tolerance:
        middle = 0.5 * (a + b)
        point[axis] = edge + middle
        find_well(
            phi, xs, ys, zs, point, zone, coarseness, max_steps, scratch, cell, end, turn, axis,
            edge, leave,
        )  # fmt: skip
        if end[axis] < edge:
            a = middle
        else:
            b = middle
    return a, b


@numba.njit(cache=True, error_model="numpy")
def bisect_edge(
    phi,
    xs,
    ys,
    zs,
    seeds,
    axis,
    edge,
    low,
    high,
    tolerance,
    zone,
    coarseness,
    max_steps,
    out,
    turn=ANY_TURN,
    leave=LEAVE,
):
    """Find, for every seed, where the well that an electron reaches changes across an edge.

    ``seeds`` (n, 3) are points on the nominal edge; the coordinate ``axis`` (0: x, 1: y) is
    searched from ``edge + low`` to ``edge + high``, which are widened while both ends reach
    the same side.  ``out`` (n,) gets the position; returns the number of seeds that failed
    (nan in ``out``).  ``turn`` as in :func:`find_well`.  Paths are followed until they are
    ``leave`` [um] off the edge; those of the last two points all the way, and where these do not
    end on the sides that they had left to, all of that seed's are, from the beginning.
    """
    scratch = np.zeros((13, 4))
    cell = np.ones(3, np.int64)
    point = np.zeros(3)
    failed = 0
    for n in range(seeds.shape[0]):
        for m in range(3):
            point[m] = seeds[n, m]
        out[n] = np.nan
        for far in (leave, np.inf):
            a, b = _bisect(
                phi, xs, ys, zs, point, axis, edge[n], low[n], high[n], tolerance, zone,
                coarseness, max_steps, scratch, cell, turn, far,
            )  # fmt: skip
            below, above = True, not np.isnan(a)
            if above and far < np.inf:
                below, above = _sides(
                    phi, xs, ys, zs, point, axis, edge[n], a, b, zone, coarseness, max_steps,
                    scratch, cell, turn, np.inf,
                )  # fmt: skip
            if below and above:
                out[n] = edge[n] + 0.5 * (a + b)
                break
        if np.isnan(out[n]):
            failed += 1
    return failed


@numba.njit(cache=True, error_model="numpy")
def step_over_height(phi, xs, ys, zs, x, y, z, h, cell, weights, g, out):
    """Write where a field line is after a Runge-Kutta step ``h`` in height to ``out``, x and y."""
    gradient(phi, xs, ys, zs, x, y, z, cell, weights, g)
    ax = g[0] / g[2]
    ay = g[1] / g[2]
    half = 0.5 * h
    gradient(phi, xs, ys, zs, x + half * ax, y + half * ay, z + half, cell, weights, g)
    bx = g[0] / g[2]
    by = g[1] / g[2]
    gradient(phi, xs, ys, zs, x + half * bx, y + half * by, z + half, cell, weights, g)
    cx = g[0] / g[2]
    cy = g[1] / g[2]
    gradient(phi, xs, ys, zs, x + h * cx, y + h * cy, z + h, cell, weights, g)
    out[0] = x + h / 6.0 * (ax + 2.0 * bx + 2.0 * cx + g[0] / g[2])
    out[1] = y + h / 6.0 * (ay + 2.0 * by + 2.0 * cy + g[1] / g[2])


@numba.njit(cache=True, error_model="numpy")
def trace_up(phi, xs, ys, zs, seeds, depths, ratio, out):
    """Follow field lines from seeds up to each depth, against the electron drift.

    Integrates x and y over z with Runge-Kutta of fourth order, in steps that grow by
    ``ratio`` of the height, and lands on every depth.  ``depths`` ascend and lie above
    the seeds; ``out`` (n, depths, 2) gets x and y.
    """
    cell = np.ones(3, np.int64)
    weights = np.zeros((6, 4))
    g = np.zeros(3)
    end = np.zeros(2)
    for n in range(seeds.shape[0]):
        x = seeds[n, 0]
        y = seeds[n, 1]
        z = seeds[n, 2]
        for m in range(depths.size):
            gap = depths[m] - z
            if gap > 0.0:
                steps = int(np.ceil(np.log(depths[m] / z) / np.log(1.0 + ratio)))
                steps = max(steps, 1)
                factor = (depths[m] / z) ** (1.0 / steps)
                for s in range(steps):
                    h = z * (factor - 1.0) if s < steps - 1 else depths[m] - z
                    step_over_height(phi, xs, ys, zs, x, y, z, h, cell, weights, g, end)
                    x = end[0]
                    y = end[1]
                    z += h
            out[n, m, 0] = x
            out[n, m, 1] = y


@numba.njit(cache=True, error_model="numpy")
def trace_down(phi, xs, ys, zs, starts, zone, coarseness, max_steps, out_path, out_length):
    """Follow electrons down; ``out_path`` (n, max_steps, 3) gets the points, ``out_length`` how many."""
    scratch = np.zeros((13, 4))
    cell = np.ones(3, np.int64)
    p = np.zeros(3)
    end = np.zeros(3)
    for n in range(starts.shape[0]):
        for m in range(3):
            p[m] = starts[n, m]
        count = 0
        for s in range(max_steps):
            for m in range(3):
                out_path[n, s, m] = p[m]
            count = s + 1
            find_well(phi, xs, ys, zs, p, zone, coarseness, 1, scratch, cell, end)
            if end[0] == p[0] and end[1] == p[1] and end[2] == p[2]:
                break
            for m in range(3):
                p[m] = end[m]
        out_length[n] = count
