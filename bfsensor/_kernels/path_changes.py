"""Derivatives of field lines, and of the boundary between two wells, by changes of the potential.

The linearised equations of the paths of :mod:`bfsensor._kernels.drift` are integrated with the same
steps.  ``phi`` and its nodes are as there.  Changes come in two kinds, in this order: derivatives of
the potential on nodes that stay, and potentials of a device with a quantity changed by a small
step, on nodes that moved with it.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.drift import SHORTEST, _cell, _weights, gradient, turns


class Changes(NamedTuple):
    """Changes of a potential by several quantities of the device.

    ``still`` ``[y, z, x, change]`` are derivatives [V per unit], padded as the potential; ``moved``
    ``[change, y, z, x]`` are potentials [V] where a quantity is changed by ``steps`` [unit], and
    ``x``, ``y``, ``z`` ``[change, node]`` the positions of their nodes [um].
    """

    still: np.ndarray
    moved: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    steps: np.ndarray


@numba.njit(cache=True, inline="always", error_model="numpy")
def _bends(nodes, i, value, b):
    """Weights of nodes i-1 .. i+2 for the second derivative."""
    h0 = nodes[i] - nodes[i - 1]
    h1 = nodes[i + 1] - nodes[i]
    h2 = nodes[i + 2] - nodes[i + 1]
    t = (value - nodes[i]) / h1
    e0 = (12.0 * t - 6.0) / (h1 * h1)
    g0 = (6.0 * t - 4.0) / h1
    g1 = (6.0 * t - 2.0) / h1
    a0 = -h1 / (h0 * (h0 + h1))
    c0 = h0 / (h1 * (h0 + h1))
    b0 = -a0 - c0
    a1 = -h2 / (h1 * (h1 + h2))
    c1 = h1 / (h2 * (h1 + h2))
    b1 = -a1 - c1
    b[0] = g0 * a0
    b[1] = e0 + g0 * b0 + g1 * a1
    b[2] = -e0 + g0 * c0 + g1 * b1
    b[3] = g1 * c1


@numba.njit(cache=True, error_model="numpy")
def _field_and_changes(phi, changes, xs, ys, zs, p, cell, weights, g, hess, out):
    """Write the gradient, its derivatives (xx, xy, xz, yy, yz, zz) and the changes' gradients (n, 3)."""
    i = _cell(xs, p[0], cell[0])
    j = _cell(ys, p[1], cell[1])
    k = _cell(zs, p[2], cell[2])
    cell[0] = i
    cell[1] = j
    cell[2] = k
    wx = weights[0]
    dx = weights[1]
    bx = weights[2]
    wy = weights[3]
    dy = weights[4]
    by = weights[5]
    wz = weights[6]
    dz = weights[7]
    bz = weights[8]
    _weights(xs, i, p[0], wx, dx)
    _weights(ys, j, p[1], wy, dy)
    _weights(zs, k, p[2], wz, dz)
    _bends(xs, i, p[0], bx)
    _bends(ys, j, p[1], by)
    _bends(zs, k, p[2], bz)
    n = changes.still.shape[3]
    for m in range(3):
        g[m] = 0.0
    for m in range(6):
        hess[m] = 0.0
    for q in range(n):
        out[q, 0] = 0.0
        out[q, 1] = 0.0
        out[q, 2] = 0.0
    for b in range(4):
        for c in range(4):
            for a in range(4):
                f = phi[j - 1 + b, k - 1 + c, i - 1 + a]
                yz = wy[b] * wz[c]
                g[0] += f * dx[a] * yz
                g[1] += f * wx[a] * dy[b] * wz[c]
                g[2] += f * wx[a] * wy[b] * dz[c]
                hess[0] += f * bx[a] * yz
                hess[1] += f * dx[a] * dy[b] * wz[c]
                hess[2] += f * dx[a] * wy[b] * dz[c]
                hess[3] += f * wx[a] * by[b] * wz[c]
                hess[4] += f * wx[a] * dy[b] * dz[c]
                hess[5] += f * wx[a] * wy[b] * bz[c]
                gx = dx[a] * yz
                gy = wx[a] * dy[b] * wz[c]
                gz = wx[a] * wy[b] * dz[c]
                for q in range(n):
                    v = changes.still[j - 1 + b, k - 1 + c, i - 1 + a, q]
                    out[q, 0] += v * gx
                    out[q, 1] += v * gy
                    out[q, 2] += v * gz
    for q in range(changes.steps.size):
        gradient(
            changes.moved[q], changes.x[q], changes.y[q], changes.z[q], p[0], p[1], p[2], cell,
            weights, out[n + q],
        )  # fmt: skip
        for m in range(3):
            out[n + q, m] = (out[n + q, m] - g[m]) / changes.steps[q]


@numba.njit(cache=True, error_model="numpy")
def _descent(phi, changes, xs, ys, zs, p, delta, cell, weights, g, hess, push, out_p, out):
    """Unit vector along the drift, and how the deviations ``delta`` (n + 1, 3) grow.

    The first deviation is of the start, the others are made by the changes.
    """
    _field_and_changes(phi, changes, xs, ys, zs, p, cell, weights, g, hess, push)
    norm = 1.0 / max(np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2]), 1e-12)
    vx = g[0] * norm
    vy = g[1] * norm
    vz = g[2] * norm
    out_p[0] = vx
    out_p[1] = vy
    out_p[2] = vz
    for q in range(delta.shape[0]):
        x = delta[q, 0]
        y = delta[q, 1]
        z = delta[q, 2]
        ex = hess[0] * x + hess[1] * y + hess[2] * z
        ey = hess[1] * x + hess[3] * y + hess[4] * z
        ez = hess[2] * x + hess[4] * y + hess[5] * z
        if q > 0:
            ex += push[q - 1, 0]
            ey += push[q - 1, 1]
            ez += push[q - 1, 2]
        along = vx * ex + vy * ey + vz * ez
        out[q, 0] = (ex - along * vx) * norm
        out[q, 1] = (ey - along * vy) * norm
        out[q, 2] = (ez - along * vz) * norm


@numba.njit(cache=True, error_model="numpy")
def boundary_changes(
    phi,
    changes,
    xs,
    ys,
    zs,
    seeds,
    axis,
    zone,
    coarseness,
    turn,
    max_steps,
    early,
    growth,
    out_early,
    out,
):
    """Write the shifts along ``axis`` of boundary points ``seeds`` (n, 3) to ``out`` (n, changes).

    An electron that starts on the boundary must stay on it: some way down, the deviation that a
    shift of the start makes cancels the deviation that the change of the potential makes.  The
    first grows on the way; changes of the potential further down count with the inverse of its
    growth, so that the descent ends at ``growth``; ``out_early`` gets the shift found when it had
    grown by ``early``.  Steps are those with which the seeds were found: with other steps the
    boundary lies a little elsewhere, and the path would leave it before the deviation has grown.
    """
    n = out.shape[1]
    p = np.zeros(3)
    q = np.zeros(3)
    delta = np.zeros((n + 1, 3))
    trial = np.zeros((n + 1, 3))
    ks = np.zeros((4, n + 1, 3))
    kp = np.zeros((4, 3))
    g = np.zeros(3)
    hess = np.zeros(6)
    push = np.zeros((n, 3))
    weights = np.zeros((9, 4))
    cell = np.ones(3, np.int64)
    for s in range(seeds.shape[0]):
        for m in range(3):
            p[m] = seeds[s, m]
        delta[:] = 0.0
        delta[0, axis] = 1.0
        best = 0.0
        grown = False
        for _ in range(max_steps):
            if p[2] < zone[4]:
                ox = p[0] - zone[0] * np.round(p[0] / zone[0])
                oy = p[1] - zone[1] * np.round(p[1] / zone[1])
                if abs(ox) < zone[2] and abs(oy) < zone[3]:
                    break
            h = coarseness * (0.3 + 0.12 * max(p[2] - 1.0, 0.0))
            shortest = SHORTEST * h
            stage = 0
            while stage < 4:
                part = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                last = max(stage - 1, 0)
                for m in range(3):
                    q[m] = p[m] + part * h * kp[last, m]
                for r in range(n + 1):
                    for m in range(3):
                        trial[r, m] = delta[r, m] + part * h * ks[last, r, m]
                _descent(
                    phi, changes, xs, ys, zs, q, trial, cell, weights, g, hess, push,
                    kp[stage], ks[stage],
                )  # fmt: skip
                stage += 1
                if (
                    stage == 4
                    and turns(kp[0], kp[1], kp[2], kp[3]) >= turn * turn
                    and h >= shortest
                ):
                    h *= 0.5
                    stage = 1
            for m in range(3):
                p[m] += h / 6.0 * (kp[0, m] + 2.0 * kp[1, m] + 2.0 * kp[2, m] + kp[3, m])
            for r in range(n + 1):
                for m in range(3):
                    delta[r, m] += (
                        h / 6.0
                        * (ks[0, r, m] + 2.0 * ks[1, r, m] + 2.0 * ks[2, r, m] + ks[3, r, m])
                    )  # fmt: skip
            size = abs(delta[0, axis])
            if size > best:
                best = size
                for r in range(n):
                    out[s, r] = -delta[r + 1, axis] / delta[0, axis]
                    if not grown:
                        out_early[s, r] = out[s, r]
                grown = grown or size > early
            if size > growth:
                break


@numba.njit(cache=True, error_model="numpy")
def _ascent(phi, changes, xs, ys, zs, p, delta, cell, weights, g, hess, push, out_p, out):
    """Slopes dx/dz and dy/dz of a field line, and how deviations (n, 2) grow with z."""
    _field_and_changes(phi, changes, xs, ys, zs, p, cell, weights, g, hess, push)
    up = 1.0 / g[2]
    ax = g[0] * up
    ay = g[1] * up
    out_p[0] = ax
    out_p[1] = ay
    xx = (hess[0] - ax * hess[2]) * up
    xy = (hess[1] - ax * hess[4]) * up
    yx = (hess[1] - ay * hess[2]) * up
    yy = (hess[3] - ay * hess[4]) * up
    for q in range(delta.shape[0]):
        x = delta[q, 0]
        y = delta[q, 1]
        out[q, 0] = xx * x + xy * y + (push[q, 0] - ax * push[q, 2]) * up
        out[q, 1] = yx * x + yy * y + (push[q, 1] - ay * push[q, 2]) * up


@numba.njit(cache=True, error_model="numpy")
def trace_changes_up(
    phi, changes, xs, ys, zs, seeds, first, axis, depths, ratio, out, out_slopes
):
    """Carry shifts of seeds along ``axis``, ``first`` (n, changes), up the field lines.

    ``out`` (n, depths, changes, 2) gets the shifts in x and y at each depth, ``out_slopes``
    (n, depths, 2) the slopes dx/dz and dy/dz there; steps are those of
    :func:`bfsensor._kernels.drift.trace_up`.
    """
    n = first.shape[1]
    p = np.zeros(3)
    q = np.zeros(3)
    delta = np.zeros((n, 2))
    trial = np.zeros((n, 2))
    ks = np.zeros((4, n, 2))
    kp = np.zeros((4, 2))
    g = np.zeros(3)
    hess = np.zeros(6)
    push = np.zeros((n, 3))
    weights = np.zeros((9, 4))
    cell = np.ones(3, np.int64)
    for s in range(seeds.shape[0]):
        for m in range(3):
            p[m] = seeds[s, m]
        delta[:] = 0.0
        for r in range(n):
            delta[r, axis] = first[s, r]
        for d in range(depths.size):
            gap = depths[d] - p[2]
            if gap > 0.0:
                steps = int(np.ceil(np.log(depths[d] / p[2]) / np.log(1.0 + ratio)))
                steps = max(steps, 1)
                factor = (depths[d] / p[2]) ** (1.0 / steps)
                for step in range(steps):
                    h = p[2] * (factor - 1.0) if step < steps - 1 else depths[d] - p[2]
                    for stage in range(4):
                        part = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
                        last = max(stage - 1, 0)
                        q[0] = p[0] + part * h * kp[last, 0]
                        q[1] = p[1] + part * h * kp[last, 1]
                        q[2] = p[2] + part * h
                        for r in range(n):
                            trial[r, 0] = delta[r, 0] + part * h * ks[last, r, 0]
                            trial[r, 1] = delta[r, 1] + part * h * ks[last, r, 1]
                        _ascent(
                            phi, changes, xs, ys, zs, q, trial, cell, weights, g, hess, push,
                            kp[stage], ks[stage],
                        )  # fmt: skip
                    for m in range(2):
                        p[m] += (
                            h
                            / 6.0
                            * (kp[0, m] + 2.0 * kp[1, m] + 2.0 * kp[2, m] + kp[3, m])
                        )
                        for r in range(n):
                            delta[r, m] += (
                                h / 6.0
                                * (ks[0, r, m] + 2.0 * ks[1, r, m] + 2.0 * ks[2, r, m] + ks[3, r, m])
                            )  # fmt: skip
                    p[2] += h
            _ascent(
                phi,
                changes,
                xs,
                ys,
                zs,
                p,
                delta,
                cell,
                weights,
                g,
                hess,
                push,
                kp[0],
                ks[0],
            )
            for m in range(2):
                out_slopes[s, d, m] = kp[0, m]
                for r in range(n):
                    out[s, d, r, m] = delta[r, m]
