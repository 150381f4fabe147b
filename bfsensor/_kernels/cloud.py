"""Simultaneous transport of the electrons of one cloud: drift, diffusion, mutual repulsion.

The repulsion is that of a cloud whose charge depends only on the distance from its middle:
an electron feels the charge nearer to the middle, as if it sat there.  Sorted by distance that
sum takes N log N operations; ``pair_field`` sums over all pairs.
"""

import numba
import numpy as np

from bfsensor._kernels.transport import (
    ABSORBED,
    ARRIVED,
    LOST,
    _arrived,
    _confine,
    _field,
    _mobility,
    _normals,
    step_words,
)


@numba.njit(cache=True)
def shell_field(p, active, strength, out):
    """Write the field [V/um] of a round cloud on its electrons to ``out``; returns the rms radius [um].

    Electrons are taken as spread over shells.  ``strength`` [V um] is the field of one electron
    times the distance squared.
    """
    count = 0
    middle = np.zeros(3)
    for n in range(p.shape[0]):
        if active[n]:
            count += 1
            for m in range(3):
                middle[m] += p[n, m]
    out[:] = 0.0
    if count < 2:
        return 0.0
    middle /= count
    index = np.empty(count, np.int64)
    square = np.empty(count)
    k = 0
    for n in range(p.shape[0]):
        if active[n]:
            index[k] = n
            square[k] = (
                (p[n, 0] - middle[0]) ** 2
                + (p[n, 1] - middle[1]) ** 2
                + (p[n, 2] - middle[2]) ** 2
            )
            k += 1
    order = np.argsort(square)
    for k in range(count):
        n = index[order[k]]
        r2 = max(square[order[k]], 1e-8)
        size = strength * k / (r2 * np.sqrt(r2))
        for m in range(3):
            # The potential's gradient points where electrons go.
            out[n, m] = size * (p[n, m] - middle[m])
    return np.sqrt(square.mean())


@numba.njit(cache=True)
def pair_field(p, active, strength, softening, out):
    """Write the field [V/um] summed over all pairs, softened within ``softening`` [um], to ``out``."""
    out[:] = 0.0
    for n in range(p.shape[0]):
        if not active[n]:
            continue
        for k in range(n):
            if not active[k]:
                continue
            dx = p[n, 0] - p[k, 0]
            dy = p[n, 1] - p[k, 1]
            dz = p[n, 2] - p[k, 2]
            r2 = dx * dx + dy * dy + dz * dz + softening * softening
            size = strength / (r2 * np.sqrt(r2))
            out[n, 0] += size * dx
            out[n, 1] += size * dy
            out[n, 2] += size * dz
            out[k, 0] -= size * dx
            out[k, 1] -= size * dy
            out[k, 2] -= size * dz


@numba.njit(cache=True, nogil=True)
def drift_together(
    phi, xs, ys, zs, room, pace, kt, law, strength, pairs, starts, numbers, key0, key1, out,
    out_fate,
):  # fmt: skip
    """Trace the electrons of a cloud to the wells, in steps of the same time for all.

    ``kt`` [V] is the temperature of the diffusion and ``law`` that of the mobility; ``strength``
    is as in ``shell_field``, 0 for no repulsion; ``pairs`` is the softening [um] of the sum over
    pairs, negative for shells.  ``out`` (n, 3) gets the last positions, ``out_fate`` (n,) the
    fates.
    """
    total = starts.shape[0]
    cell = np.ones(3, np.int64)
    weights = np.zeros((6, 4))
    p = starts.copy()
    q = np.empty_like(p)
    push = np.zeros_like(p)
    field = np.zeros_like(p)
    g = np.zeros(3)
    noise = np.zeros(3)
    active = np.ones(total, np.bool_)
    out_fate[:] = LOST
    left = total
    for step in range(pace.most):
        spread = 0.0
        lowest = room.thickness
        slowest = np.inf
        for n in range(total):
            if active[n] and _arrived(room.zone, p[n, 0], p[n, 1], p[n, 2]):
                active[n] = False
                out_fate[n] = ARRIVED
                left -= 1
        if left == 0:
            break
        if strength > 0.0:
            spread = shell_field(p, active, strength, push)
            if pairs >= 0.0:
                pair_field(p, active, strength, pairs, push)
        for n in range(total):
            if not active[n]:
                continue
            _field(phi, xs, ys, zs, room, p[n], cell, weights, g)
            for m in range(3):
                field[n, m] = g[m] + push[n, m]
            lowest = min(lowest, p[n, 2])
            size = np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2)
            length = pace.part * (p[n, 2] - room.surface[0]) + pace.shortest
            length = min(max(length, pace.shortest), pace.longest)
            # Time of a step of this length.
            slowest = min(slowest, length / max(size, 1e-9) / _mobility(size, law))
        time = slowest
        if strength > 0.0 and spread > 0.0 and left > 1:
            # The cloud must not grow by more than a twentieth in a step.
            edge = strength * left / (spread * spread)
            time = min(time, 0.05 * spread / (edge * _mobility(edge, law)))
        for n in range(total):
            if not active[n]:
                continue
            size = np.sqrt(field[n, 0] ** 2 + field[n, 1] ** 2 + field[n, 2] ** 2)
            ds = time * _mobility(size, law)
            width = np.sqrt(2.0 * kt * ds)
            _normals(np.uint64(numbers[n]), step, key0, key1, noise)
            for m in range(3):
                noise[m] *= width
                q[n, m] = p[n, m] + ds * field[n, m] + noise[m]
            _confine(room, q[n], np.uint32(0xFFFFFFFF))
            _field(phi, xs, ys, zs, room, q[n], cell, weights, g)
            for m in range(3):
                p[n, m] += 0.5 * ds * (field[n, m] + g[m] + push[n, m]) + noise[m]
            word = step_words(np.uint64(numbers[n]), step, 2, key0, key1)[0]
            if _confine(room, p[n], word):
                active[n] = False
                out_fate[n] = ABSORBED
                left -= 1
    out[:] = p
