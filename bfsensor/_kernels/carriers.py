"""Mobile charge in thermal equilibrium: holes, and electrons of a given number a pixel.

Fields are ``[y, z, x]`` with one halo cell in y and x; carriers live in the first
``n_front`` planes.  ``silicon`` is the silicon volume of a node per row width and
``pixel`` the number of the pixel to which a node belongs (negative: none, as on the
borders between pixels, where no electron is stored).
"""

import math

import numba
import numpy as np

_NEGLIGIBLE = -80.0
"""Exponent below which a density of electrons counts as 0, relative to the reference level.

Derived: exp(-80) = 2e-35 of the density at the level, far below round-off of any sum."""


@numba.njit(cache=True)
def count_electrons(phi, silicon, kind, dy, pixel_y, pixel_x, n_px, reference, kt, out_sum):
    """Sum of ``volume exp((phi - reference) / kT)`` over each pixel [um^3]."""
    ny, _, nx = phi.shape
    n_front = silicon.shape[1]
    for p in range(out_sum.size):
        out_sum[p] = 0.0
    for j in range(1, ny - 1):
        if pixel_y[j] < 0:
            continue
        g = kind[j]
        for k in range(n_front):
            for i in range(1, nx - 1):
                if pixel_x[i] < 0:
                    continue
                p = pixel_y[j] * n_px + pixel_x[i]
                e = (phi[j, k, i] - reference[p]) / kt
                if e > _NEGLIGIBLE:
                    out_sum[p] += silicon[g, k, i] * dy[j] * math.exp(e)


@numba.njit(cache=True)
def highest_potential(phi, silicon, kind, pixel_y, pixel_x, n_px, out):
    """Highest potential in the silicon of each pixel [V]."""
    ny, _, nx = phi.shape
    n_front = silicon.shape[1]
    for p in range(out.size):
        out[p] = -1e30
    for j in range(1, ny - 1):
        if pixel_y[j] < 0:
            continue
        g = kind[j]
        for k in range(n_front):
            for i in range(1, nx - 1):
                if pixel_x[i] >= 0 and silicon[g, k, i] > 0.0:
                    p = pixel_y[j] * n_px + pixel_x[i]
                    out[p] = max(out[p], phi[j, k, i])


@numba.njit(cache=True)
def mobile_charge(
    phi,
    silicon,
    kind,
    dy,
    pixel_y,
    pixel_x,
    n_px,
    fermi_e,
    filled,
    fermi_h,
    ni,
    kt,
    out_e,
    out_h,
):
    """Electrons and holes of every front node [e-] at given quasi-Fermi levels [V]."""
    ny, _, nx = phi.shape
    n_front = silicon.shape[1]
    for j in range(1, ny - 1):
        g = kind[j]
        for k in range(n_front):
            for i in range(1, nx - 1):
                e = 0.0
                h = 0.0
                v = silicon[g, k, i] * dy[j]
                if v > 0.0:
                    a = (fermi_h - phi[j, k, i]) / kt
                    if a > 0.0:
                        h = v * ni * math.exp(min(a, 60.0))
                    if pixel_y[j] >= 0 and pixel_x[i] >= 0:
                        p = pixel_y[j] * n_px + pixel_x[i]
                        if filled[p]:
                            a = (phi[j, k, i] - fermi_e[p]) / kt
                            if a > _NEGLIGIBLE:
                                e = v * ni * math.exp(min(a, 60.0))
                out_e[j, k, i] = e
                out_h[j, k, i] = h


@numba.njit(cache=True)
def subtract_common_shift(electrons, pixel_y, pixel_x, n_px, count, kt, v, work, out):
    """Take the response at constant electron number off ``out``, in place.

    The density of a pixel follows only the potential relative to its own mean:
    ``out -= n <v>_n / kT`` with the mean over the electrons of the pixel; returns the
    scalar product of ``v`` with what was taken off.
    """
    ny, n_front, nx = electrons.shape
    for p in range(work.size):
        work[p] = 0.0
    for j in range(1, ny - 1):
        if pixel_y[j] >= 0:
            for k in range(n_front):
                for i in range(1, nx - 1):
                    e = electrons[j, k, i]
                    if e > 0.0:
                        work[pixel_y[j] * n_px + pixel_x[i]] += e * v[j, k, i]
    taken = 0.0
    for p in range(work.size):
        if count[p] > 0.0:
            taken += work[p] * work[p] / (count[p] * kt)
            work[p] /= count[p] * kt
        else:
            work[p] = 0.0
    for j in range(1, ny - 1):
        if pixel_y[j] >= 0:
            for k in range(n_front):
                for i in range(1, nx - 1):
                    e = electrons[j, k, i]
                    if e > 0.0:
                        out[j, k, i] -= e * work[pixel_y[j] * n_px + pixel_x[i]]
    return taken


@numba.njit(cache=True)
def damped_update(
    phi,
    step,
    silicon,
    kind,
    pixel_y,
    pixel_x,
    n_px,
    fermi_e,
    filled,
    fermi_h,
    shift,
    ni,
    kt,
    dense,
):
    """Add a Newton step to ``phi`` in place; where carriers would explode, logarithmically.

    A carrier density that the step would raise beyond ``dense`` [um^-3] is raised to the
    value that the linearisation predicts instead of its exponential.  ``shift`` is the
    common shift of each pixel's electrons [V].  Returns the largest change [V] and the
    largest change that was asked for.
    """
    ny, nz, nx = phi.shape
    n_front = silicon.shape[1]
    reach = kt * math.log(dense / ni)
    largest = 0.0
    asked = 0.0
    for j in range(1, ny - 1):
        g = kind[j]
        for k in range(nz):
            for i in range(1, nx - 1):
                d = step[j, k, i]
                asked = max(asked, abs(d))
                if k < n_front and silicon[g, k, i] > 0.0:
                    if d < 0.0:
                        free = max(0.0, phi[j, k, i] - fermi_h + reach)
                        if -d > free:
                            d = -(free + kt * math.log1p((-d - free) / kt))
                    if pixel_y[j] >= 0 and pixel_x[i] >= 0:
                        p = pixel_y[j] * n_px + pixel_x[i]
                        if filled[p]:
                            s = shift[p]
                            free = max(0.0, fermi_e[p] - phi[j, k, i] + reach)
                            if d - s > free:
                                d = s + free + kt * math.log1p((d - s - free) / kt)
                largest = max(largest, abs(d))
                phi[j, k, i] += d
    return largest, asked


@numba.njit(cache=True)
def inner(a, b):
    """Scalar product of two fields that vanish in the halo of the first.

    It is summed by columns first, as a sum of one number waits for each of its terms.
    """
    ny, nz, nx = a.shape
    sums = np.zeros(nx)
    for j in range(1, ny - 1):
        for k in range(nz):
            for i in range(nx):
                sums[i] += a[j, k, i] * b[j, k, i]
    return sums.sum()


@numba.njit(cache=True)
def step_solution(solution, direction, residual, product, length):
    """One conjugate-gradient step, in place; the norm of the new residual is not needed."""
    s = solution.ravel()
    d = direction.ravel()
    r = residual.ravel()
    q = product.ravel()
    for i in range(s.size):
        s[i] += length * d[i]
        r[i] -= length * q[i]


@numba.njit(cache=True)
def next_direction(direction, preconditioned, factor):
    """``direction = preconditioned + factor * direction`` in place."""
    d = direction.ravel()
    z = preconditioned.ravel()
    for i in range(d.size):
        d[i] = z[i] + factor * d[i]
