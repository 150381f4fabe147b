"""Transport of electrons to the wells, one at a time: drift and diffusion.

The first of two engines takes large steps.  Drift and diffusion both scale with the mobility
(Einstein), so in the time ``ds = mobility dt`` an electron obeys ``dX = E ds + sqrt(2 kT) dW``: its
last position does not depend on the mobility, and the noise is additive.  Heun's method is then of
second order in the mean.  The second, ``scatter``, takes free flights between collisions, at
constant speed in random directions, with the drift velocity of the field on top.

Random numbers are counted by electron and step, and so do not depend on threads or on
what else is traced.  Positions are in um; ``phi, xs, ys, zs`` as in ``_kernels.drift``.
"""

from typing import NamedTuple

import numba
import numpy as np

from bfsensor._kernels.counter_rng import log_uniform, philox, sine_cosine
from bfsensor._kernels.drift import gradient

ARRIVED, ABSORBED, LOST = 0, 1, 2
"""Fates of an electron: collected by a well, lost at the back surface, or out of steps."""


class Room(NamedTuple):
    """Limits of the domain and of the silicon.

    ``box`` is lowest x, highest x, lowest y, highest y [um] of the domain; beyond them it is
    continued periodically or mirrored.  At ``thickness`` [um] electrons are reflected, or absorbed
    with the probability ``absorbed`` at each visit.  ``surface`` holds the height of the silicon
    in the channel and in the channel stop, the half width of the stop, the width of the taper and
    the pitch in x [um]; it reflects as well.  ``zone`` is as in ``drift.find_well``.
    """

    box: np.ndarray
    periodic_x: bool
    periodic_y: bool
    thickness: float
    absorbed: float
    surface: np.ndarray
    zone: np.ndarray


class Pace(NamedTuple):
    """Lengths of large steps: a part of the height above the silicon, bounds [um], largest number."""

    part: float
    shortest: float
    longest: float
    most: int


@numba.njit(cache=True, inline="always", error_model="numpy")
def step_words(electron, step, stream, key0, key1):
    """Four random words of an electron's step: 1 its noise, 2 the surface, 3 a collision."""
    return philox(
        np.uint32(electron & np.uint64(0xFFFFFFFF)), np.uint32(electron >> np.uint64(32)),
        np.uint32(step), np.uint32(stream), key0, key1,
    )  # fmt: skip


@numba.njit(cache=True, inline="always", error_model="numpy")
def _normals(electron, step, key0, key1, out):
    """Three normal deviates."""
    a, b, c, d = step_words(electron, step, 1, key0, key1)
    radius = np.sqrt(np.float32(-2) * log_uniform(b))
    sine, cosine = sine_cosine(a)
    out[0] = radius * cosine
    out[1] = radius * sine
    radius = np.sqrt(np.float32(-2) * log_uniform(d))
    sine, cosine = sine_cosine(c)
    out[2] = radius * cosine


@numba.njit(cache=True, inline="always", error_model="numpy")
def _fold(value, low, high, periodic):
    """Place of the domain where a coordinate belongs, and the sign of its axis there."""
    if low <= value <= high:
        return value, 1.0
    width = high - low
    if periodic:
        return value - width * np.floor((value - low) / width), 1.0
    part = (value - low) % (2.0 * width)
    if part <= width:
        return low + part, 1.0
    return low + 2.0 * width - part, -1.0


@numba.njit(cache=True, inline="always", error_model="numpy")
def _field(phi, xs, ys, zs, room, p, cell, weights, out):
    """Gradient of the potential [V/um] at a point, in the domain or beyond."""
    x, sign_x = _fold(p[0], room.box[0], room.box[1], room.periodic_x)
    y, sign_y = _fold(p[1], room.box[2], room.box[3], room.periodic_y)
    gradient(phi, xs, ys, zs, x, y, p[2], cell, weights, out)
    out[0] *= sign_x
    out[1] *= sign_y


@numba.njit(cache=True, inline="always", error_model="numpy")
def _floor_height(surface, x):
    """Height of the silicon surface [um] at a place."""
    distance = 0.5 * surface[4] - abs(x - surface[4] * np.round(x / surface[4]))
    beyond = distance - surface[2]
    ramp = 1.0 if beyond > 0 else 0.0
    if surface[3] > 0.0:
        ramp = min(max(beyond / surface[3], 0.0), 1.0)
    return surface[1] + (surface[0] - surface[1]) * ramp


@numba.njit(cache=True, inline="always", error_model="numpy")
def _arrived(zone, x, y, z):
    if z >= zone[4]:
        return False
    ox = x - zone[0] * np.round(x / zone[0])
    oy = y - zone[1] * np.round(y / zone[1])
    return abs(ox) < zone[2] and abs(oy) < zone[3]


@numba.njit(cache=True, error_model="numpy")
def _confine(room, p, word):
    """Bring a point back into the silicon; True if the back surface took it."""
    if p[2] > room.thickness:
        if room.absorbed > 0.0 and (np.float64(word) + 0.5) * 2.0**-32 < room.absorbed:
            p[2] = room.thickness
            return True
        p[2] = 2.0 * room.thickness - p[2]
    floor = _floor_height(room.surface, p[0])
    if p[2] < floor:
        p[2] = min(2.0 * floor - p[2], room.thickness)
    return False


@numba.njit(cache=True, error_model="numpy")
def _begin(room, starts, n, p, path, length):
    """Put an electron where it is set free, and begin its path."""
    for m in range(3):
        p[m] = starts[n, m]
    _confine(room, p, np.uint32(0xFFFFFFFF))
    if path.shape[0] > 0:
        for m in range(3):
            path[n, 0, m] = p[m]
        length[n] = 1


@numba.njit(cache=True, error_model="numpy")
def _keep_path(path, length, n, p):
    if path.shape[0] > 0 and length[n] < path.shape[1]:
        for m in range(3):
            path[n, length[n], m] = p[m]
        length[n] += 1


@numba.njit(cache=True, nogil=True)
def walk(
    phi, xs, ys, zs, room, pace, kt, starts, numbers, key0, key1, out, out_fate, out_path,
    out_length,
):  # fmt: skip
    """Trace electrons to the wells in large steps.

    ``kt`` [V]: temperature of the diffusion, 0 for none.  ``starts`` (n, 3), ``numbers`` (n,)
    the electrons' count in the exposure.  ``out`` (n, 3) where they arrive, ``out_fate`` (n,);
    ``out_path`` (n, points, 3), size 0 for none, ``out_length`` (n,).
    """
    cell = np.ones(3, np.int64)
    weights = np.zeros((6, 4))
    here = np.zeros(3)
    there = np.zeros(3)
    p = np.zeros(3)
    q = np.zeros(3)
    noise = np.zeros(3)
    for n in range(starts.shape[0]):
        _begin(room, starts, n, p, out_path, out_length)
        fate, number = LOST, np.uint64(numbers[n])
        for step in range(pace.most):
            if _arrived(room.zone, p[0], p[1], p[2]):
                fate = ARRIVED
                break
            _field(phi, xs, ys, zs, room, p, cell, weights, here)
            size = np.sqrt(here[0] ** 2 + here[1] ** 2 + here[2] ** 2)
            length = pace.part * (p[2] - room.surface[0]) + pace.shortest
            length = min(max(length, pace.shortest), pace.longest)
            if room.absorbed > 0.0:
                # Who touches the back surface is decided within kT / E of it, some 0.03 um.
                length = min(length, 0.5 * max(room.thickness - p[2], 0.0) + 0.02)
            # Not longer than a step of the drift may be, nor than one of the diffusion:
            # sqrt(2 kT ds) = length where the field is weak.
            ds = length / max(size, 1e-9)
            if kt > 0.0:
                ds = min(ds, 0.5 * length * length / kt)
            width = np.sqrt(2.0 * kt * ds)
            _normals(number, step, key0, key1, noise)
            for m in range(3):
                noise[m] *= width
                q[m] = p[m] + ds * here[m] + noise[m]
            word = np.uint32(0)
            if room.absorbed > 0.0:
                word = step_words(number, step, 2, key0, key1)[0]
            for m in range(3):
                here[m] = p[m] + 0.5 * ds * here[m] + noise[m]
            # The field where the step would lead, held at the surfaces.
            _confine(room, q, np.uint32(0xFFFFFFFF))
            _field(phi, xs, ys, zs, room, q, cell, weights, there)
            for m in range(3):
                p[m] = here[m] + 0.5 * ds * there[m]
            if _confine(room, p, word):
                fate = ABSORBED
                break
            _keep_path(out_path, out_length, n, p)
        for m in range(3):
            out[n, m] = p[m]
        out_fate[n] = fate


@numba.njit(cache=True, inline="always", error_model="numpy")
def _mobility(size, law):
    """Jacoboni's law: low-field mobility, critical field and exponent in ``law``."""
    return law[0] / (1.0 + (size / law[1]) ** law[2]) ** (1.0 / law[2])


@numba.njit(cache=True, nogil=True)
def scatter(
    phi, xs, ys, zs, room, most, speed, mass, law, frozen, starts, numbers, key0, key1, out,
    out_fate, out_path, out_length,
):  # fmt: skip
    """Trace electrons to the wells from collision to collision.

    ``speed`` [um/s] between collisions, ``mass`` [V s^2/um^2] per charge: the free time is
    ``mass`` times the mobility [um^2/(V s)] of ``law``.  ``frozen``: that of the start is kept
    for the whole way.
    """
    cell = np.ones(3, np.int64)
    weights = np.zeros((6, 4))
    g = np.zeros(3)
    p = np.zeros(3)
    for n in range(starts.shape[0]):
        _begin(room, starts, n, p, out_path, out_length)
        fate, number = LOST, np.uint64(numbers[n])
        free = -1.0
        for step in range(most):
            if _arrived(room.zone, p[0], p[1], p[2]):
                fate = ARRIVED
                break
            _field(phi, xs, ys, zs, room, p, cell, weights, g)
            size = np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2)
            mobility = _mobility(size, law)
            if free < 0.0 or not frozen:
                free = mass * mobility
            a, b, c, d = step_words(number, step, 3, key0, key1)
            time = -np.float64(log_uniform(a)) * free
            up = 2.0 * (np.float64(b) + 0.5) * 2.0**-32 - 1.0
            flat = np.sqrt(max(1.0 - up * up, 0.0))
            sine, cosine = sine_cosine(c)
            p[0] += time * (speed * flat * cosine + mobility * g[0])
            p[1] += time * (speed * flat * sine + mobility * g[1])
            p[2] += time * (speed * up + mobility * g[2])
            if _confine(room, p, d):
                fate = ABSORBED
                break
            _keep_path(out_path, out_length, n, p)
        for m in range(3):
            out[n, m] = p[m]
        out_fate[n] = fate
