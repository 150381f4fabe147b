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
    """Unit vector along (``sign`` = 1) or against the electron drift, then the field [V/um]."""
    gradient(phi, xs, ys, zs, p[0], p[1], p[2], cell, weights, g)
    field = max(np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2]), 1e-12)
    norm = sign / field
    out[0] = g[0] * norm
    out[1] = g[1] * norm
    out[2] = g[2] * norm
    out[3] = field


ANY_TURN = 3.0
"""Limit on the turn within a step that no step exceeds, so that steps are not shortened.

Derived: the difference of two unit vectors is at most 2."""

SHORTEST = 0.1
"""Length, relative to the usual one, below which a step is not halved further.

Chosen: where the field is weak and turns everywhere a path would take minutes without this limit;
twice as large, a step is halved three times instead of four."""


LEAVE = 0.5
"""Distance from an edge beyond which a path is not followed while a boundary is searched [um].

Chosen: boundaries shift by less, so that a path does not come back; the last two paths are followed
farther, and a wrong decision leads to a bisection.  Twice as large gives the same boundaries in more
time."""

FAR = 0.25
"""Distance from an edge beyond which the last two paths are not followed, in pixel pitches.

Chosen: half of the way to the well; boundaries shift by less even beside a full one.  At twice the value
paths are followed to the well, and the search takes half as long again."""

RATE = 1.0
"""Rate [V/um2] at which electrons leave a boundary, until the first point has given its own.

Derived: half of a donor density of 1.3e15 cm-3 times the electron's charge over the permittivity, the
curvature of the potential across a ridge that curves as much upwards.  Measured: with twice the value
points take 0 to 6 % more paths, as each starts from the rate of the one before."""

MOST_FAILED = 4
"""Number of points without a boundary after which no further ones are searched.

Chosen: each takes 0.3 s, a hundred times as long as one that has a boundary, and a field without one has
hundreds; twice as many take twice as long to say so."""

CLOSE = 8.0
"""Width of the interval, in units of the one asked for, at which the search of a point ends.

Measured on ITL and E2V: 8 to 11 paths find a point, where a bisection takes 17, and one point in 100
fails its last check and is bisected; at twice the value 2 or 3 in 100 fail, at half of it points take a
path more."""

LEAST_PART = 0.1
"""Nearest that a path is tried to an end of the interval, of its width.

Measured: at twice the value the search takes one or two paths more, at half of it as many."""


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
    not followed.  Returns the integral of the path over the field [um2/V], the time of the drift at a
    mobility of one.
    """
    p = scratch[0]
    time = 0.0
    for m in range(3):
        p[m] = start[m]
    for _ in range(max_steps):
        if p[2] < zone[4]:
            ox = p[0] - zone[0] * np.round(p[0] / zone[0])
            oy = p[1] - zone[1] * np.round(p[1] / zone[1])
            if abs(ox) < zone[2] and abs(oy) < zone[3]:
                break
        off = abs(p[axis] - edge)
        if off > leave:
            break
        h = choose_step(phi, xs, ys, zs, coarseness, turn, scratch, cell)
        for m in range(3):
            p[m] += advance(h, scratch, m)
        spent = 2.0 * h / (scratch[2, 3] + scratch[5, 3])
        beyond = abs(p[axis] - edge)
        if beyond > leave:
            spent *= (leave - off) / (beyond - off)
        time += spent
    for m in range(3):
        out[m] = p[m]
    return time


@numba.njit(cache=True, error_model="numpy")
def _side(
    phi, xs, ys, zs, point, axis, edge, off, zone, coarseness, max_steps, scratch, cell, turn, leave,
):  # fmt: skip
    """Side of the edge that an electron from ``off`` it reaches, -1, 0 or 1, and the time it takes."""
    end = np.zeros(3)
    point[axis] = edge + off
    time = find_well(
        phi, xs, ys, zs, point, zone, coarseness, max_steps, scratch, cell, end, turn, axis, edge,
        leave,
    )  # fmt: skip
    return np.sign(end[axis] - edge), time


@numba.njit(cache=True, error_model="numpy")
def _search(
    phi, xs, ys, zs, point, axis, edge, a, b, tolerance, zone, coarseness, max_steps, scratch,
    cell, turn, leave, rate,
):  # fmt: skip
    """Find where the side that electrons reach changes, from the times that they take.

    Near a boundary the time on either side is minus the logarithm of the distance over a common rate,
    plus almost the same constant: the ends of an interval show where in it the boundary lies.  The path
    after one that was tried there is as far beyond the boundary, so that both ends move.  A ``rate`` of
    0 bisects.  Returns the position, nan where both ends reach the same side, and the rate.
    """
    found = False
    for _ in range(8):
        below, early = _side(
            phi, xs, ys, zs, point, axis, edge, a, zone, coarseness, max_steps, scratch, cell,
            turn, leave,
        )  # fmt: skip
        above, late = _side(
            phi, xs, ys, zs, point, axis, edge, b, zone, coarseness, max_steps, scratch, cell,
            turn, leave,
        )  # fmt: skip
        if below < 0 and above > 0:
            found = True
            break
        width = b - a
        if below >= 0:
            a -= 2.0 * width
        if above <= 0:
            b += 2.0 * width
    if not found:
        return np.nan, rate
    first, start = a, early
    width = b - a
    part = 1.0 / (1.0 + np.exp(rate * (early - late)))
    aim = part
    mirrored = False
    while b - a > tolerance:
        if not mirrored:
            aim = part
        middle = a + min(max(aim, LEAST_PART), 1.0 - LEAST_PART) * (b - a)
        side, time = _side(
            phi, xs, ys, zs, point, axis, edge, middle, zone, coarseness, max_steps, scratch, cell,
            turn, leave,
        )  # fmt: skip
        if side < 0:
            a, early = middle, time
        else:
            b, late = middle, time
        part = 1.0 / (1.0 + np.exp(rate * (early - late)))
        mirrored = not mirrored
        if mirrored:
            aim = 2.0 * part if side < 0 else 2.0 * part - 1.0
        elif b - a > 0.5 * width:
            part = 0.5
        if not mirrored:
            width = b - a
    place = a + part * (b - a)
    if rate > 0.0 and early > start and a > first:
        rate = np.log((place - first) / (place - a)) / (early - start)
    return place, rate


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
    (nan in ``out``), and leaves the others nan after :data:`MOST_FAILED`.  ``turn`` as in
    :func:`find_well`.  Paths are followed until they are ``leave`` [um] off the edge; those of two
    points ``tolerance`` apart until they are :data:`FAR` pitches off, and where these do not end below
    and above it, that seed is bisected with whole paths.
    """
    scratch = np.zeros((13, 4))
    cell = np.ones(3, np.int64)
    point = np.zeros(3)
    failed = 0
    rate = RATE
    for n in range(seeds.shape[0]):
        if failed == MOST_FAILED:
            out[n] = np.nan
            continue
        for m in range(3):
            point[m] = seeds[n, m]
        place, rate = _search(
            phi, xs, ys, zs, point, axis, edge[n], low[n], high[n], CLOSE * tolerance, zone,
            coarseness, max_steps, scratch, cell, turn, leave, rate,
        )  # fmt: skip
        held = not np.isnan(place)
        for sign in (-1, 1):
            if held:
                side, _ = _side(
                    phi, xs, ys, zs, point, axis, edge[n], place + sign * 0.5 * tolerance, zone,
                    coarseness, max_steps, scratch, cell, turn, FAR * zone[axis],
                )  # fmt: skip
                held = side == sign
        if not held:
            rate = RATE
            place, _ = _search(
                phi, xs, ys, zs, point, axis, edge[n], low[n], high[n], tolerance, zone,
                coarseness, max_steps, scratch, cell, turn, np.inf, 0.0,
            )  # fmt: skip
        out[n] = edge[n] + place
        if np.isnan(place):
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
