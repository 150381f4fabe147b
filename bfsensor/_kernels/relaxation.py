"""Multigrid relaxation for the linearised Poisson operator.

All fields are ``[y, z, x]`` with one halo cell on each side in y and in x, so that one
row of columns (fixed y) is a contiguous block that stays in cache while its columns are
relaxed together along z.  The geometry of a sensor does not depend on y except through
a few kinds of row, so the link coefficients are ``[kind, z, x]`` and stay in cache too:
a relaxation moves little more than the unknowns themselves.

With ``g = kind[j]`` the operator, divided by the row width ``dy_j``, is::

    (A phi) / dy = cx[i] (phi - phi_{i+1}) + cx[i-1] (phi - phi_{i-1})
                 + cz[k] (phi - phi_{k+1}) + cz[k-1] (phi - phi_{k-1})
                 + cy (north[j] (phi - phi_{j+1}) + south[j] (phi - phi_{j-1}))
                 + (cd + carriers / dy) phi

where ``cd`` collects the links to gates and back contact, and ``carriers`` is the
derivative of the mobile charge of a node, held for the first ``n_front`` planes only.
Nodes inside a conductor have ``cd = 1`` and no links.
"""

import numba
import numpy as np


@numba.njit(cache=True)
def fill_halo(a, periodic_x, periodic_y):
    """Copy the periodic images of the outer nodes into the halo of ``a``, in place."""
    ny, nz, nx = a.shape
    if periodic_x:
        for j in range(1, ny - 1):
            for k in range(nz):
                a[j, k, 0] = a[j, k, nx - 2]
                a[j, k, nx - 1] = a[j, k, 1]
    if periodic_y:
        for k in range(nz):
            for i in range(nx):
                a[0, k, i] = a[ny - 2, k, i]
                a[ny - 1, k, i] = a[1, k, i]


@numba.njit(cache=True, error_model="numpy")
def eliminate(carriers, cy, cz, centre, kind, north, south, inverse_dy, pivots):
    """Write the inverse pivots of all columns, eliminated from the gates up.

    ``cy``, ``cz`` and ``centre`` are packed, ``[kind, odd or even, z, column]``; ``centre`` is the sum
    of the x and z links and ``cd``.  ``pivots`` is ``[odd or even, y, z, column]``.
    """
    _, ny, nz, n = pivots.shape
    n_front = carriers.shape[1]
    one = pivots.dtype.type(1.0)
    for even in range(2):
        for j in range(1, ny - 1):
            g = kind[j]
            ay = north[j] + south[j]
            w = inverse_dy[j]
            for k in range(nz):
                out = pivots[even, j, k]
                for m in range(n):
                    out[m] = centre[g, even, k, m] + ay * cy[g, even, k, m]
                if k < n_front:
                    for m in range(min(n, (carriers.shape[2] - 1 - even) // 2)):
                        out[m] += carriers[j, k, 1 + even + 2 * m] * w
                if k > 0:
                    for m in range(n):
                        lower = cz[g, even, k - 1, m]
                        out[m] -= lower * lower * pivots[even, j, k - 1, m]
                for m in range(n):
                    out[m] = one / out[m]


@numba.njit(cache=True, error_model="numpy")
def relax_columns(
    phi,
    rhs,
    pivots,
    left,
    right,
    cy,
    cz,
    kind,
    north,
    south,
    inverse_dy,
    colour,
    work,
    first_sweep,
):
    """Solve every column (fixed x, y) of one colour exactly along z, in place.

    In the ``first_sweep`` the other columns count as zero, whatever they hold.

    ``rhs`` is the charge of each node, ``pivots`` what :func:`eliminate` wrote.  The links ``left``,
    ``right``, ``cy`` and ``cz`` are packed, ``[kind, odd or even, z, column]``: columns of odd number
    first (counted with the halo), as those of one colour in a row have one parity.  ``work`` is
    scratch, shape (nz, columns).  The loops are kept short so that the compiler can prove them
    free of aliasing and vectorise.
    """
    ny, nz, nx = phi.shape
    for j in range(1, ny - 1):
        g = kind[j]
        an = north[j]
        as_ = south[j]
        w = inverse_dy[j]
        even = (j + colour) % 2
        first = 1 + even
        n = (nx - first) // 2
        for k in range(nz):
            out = work[k]
            for m in range(n):
                out[m] = rhs[j, k, first + 2 * m] * w
            if not first_sweep:
                for m in range(n):
                    i = first + 2 * m
                    out[m] += cy[g, even, k, m] * (
                        an * phi[j + 1, k, i] + as_ * phi[j - 1, k, i]
                    )
                for m in range(n):
                    i = first + 2 * m
                    out[m] += (
                        right[g, even, k, m] * phi[j, k, i + 1]
                        + left[g, even, k, m] * phi[j, k, i - 1]
                    )
            if k > 0:
                for m in range(n):
                    out[m] += cz[g, even, k - 1, m] * work[k - 1, m]
            for m in range(n):
                out[m] *= pivots[even, j, k, m]
        for k in range(nz - 1, -1, -1):
            out = work[k]
            if k < nz - 1:
                for m in range(n):
                    out[m] += cz[g, even, k, m] * pivots[even, j, k, m] * work[k + 1, m]
            for m in range(n):
                phi[j, k, first + 2 * m] = out[m]


@numba.njit(cache=True)
def packed(field, out):
    """Copy the inner columns of ``field``, ``[kind, z, x]``, to ``[kind, odd or even, z, column]``."""
    kinds, nz, nx = field.shape
    for g in range(kinds):
        for k in range(nz):
            for i in range(1, nx - 1):
                out[g, (i + 1) % 2, k, (i - 1) // 2] = field[g, k, i]


@numba.njit(cache=True)
def residual(phi, rhs, carriers, cx, cy, cz, cd, kind, north, south, dy, out):
    """Write ``rhs - A phi`` to ``out``; returns nothing, halo of ``phi`` must be filled."""
    ny, nz, nx = phi.shape
    n_front = carriers.shape[1]
    for j in range(1, ny - 1):
        g = kind[j]
        an = north[j]
        as_ = south[j]
        w = dy[j]
        for k in range(nz):
            up = min(k + 1, nz - 1)
            down = max(k - 1, 0)
            below = cz[g, down] if k > 0 else cz[g, nz - 1]
            for i in range(1, nx - 1):
                p = phi[j, k, i]
                t = cx[g, k, i] * (p - phi[j, k, i + 1])
                t += cx[g, k, i - 1] * (p - phi[j, k, i - 1])
                t += cz[g, k, i] * (p - phi[j, up, i])
                t += below[i] * (p - phi[j, down, i])
                t += cy[g, k, i] * (
                    an * (p - phi[j + 1, k, i]) + as_ * (p - phi[j - 1, k, i])
                )
                t += cd[g, k, i] * p
                out[j, k, i] = rhs[j, k, i] - w * t
            if k < n_front:
                for i in range(1, nx - 1):
                    out[j, k, i] -= carriers[j, k, i] * phi[j, k, i]


@numba.njit(cache=True)
def apply_operator(phi, carriers, cx, cy, cz, cd, kind, north, south, dy, out):
    """Write ``A phi`` to ``out`` and return the scalar product of ``phi`` with it."""
    ny, nz, nx = phi.shape
    n_front = carriers.shape[1]
    total = 0.0
    for j in range(1, ny - 1):
        g = kind[j]
        an = north[j]
        as_ = south[j]
        w = dy[j]
        for k in range(nz):
            up = min(k + 1, nz - 1)
            down = max(k - 1, 0)
            below = cz[g, down] if k > 0 else cz[g, nz - 1]
            for i in range(1, nx - 1):
                p = phi[j, k, i]
                t = cx[g, k, i] * (p - phi[j, k, i + 1])
                t += cx[g, k, i - 1] * (p - phi[j, k, i - 1])
                t += cz[g, k, i] * (p - phi[j, up, i])
                t += below[i] * (p - phi[j, down, i])
                t += cy[g, k, i] * (
                    an * (p - phi[j + 1, k, i]) + as_ * (p - phi[j - 1, k, i])
                )
                t += cd[g, k, i] * p
                out[j, k, i] = w * t
            if k < n_front:
                for i in range(1, nx - 1):
                    out[j, k, i] += carriers[j, k, i] * phi[j, k, i]
            s = 0.0
            for i in range(1, nx - 1):
                s += out[j, k, i] * phi[j, k, i]
            total += s
    return total


@numba.njit(cache=True)
def restrict(fine, wx, wy, out):
    """Sum the charge of fine nodes onto the coarse nodes that interpolate them.

    ``wx[i]`` is the weight of the right coarse neighbour of the odd fine node ``i``
    between two coarse ones (even, counted with the halo), 1 - wx that of the left one; the
    transpose of :func:`prolong_add`.
    """
    nyc, nz, nxc = out.shape
    nyf = fine.shape[0]
    for jc in range(1, nyc - 1):
        jf = 2 * jc - 1
        for k in range(nz):
            for ic in range(1, nxc - 1):
                out[jc, k, ic] = 0.0
        for dj in range(-1, 2):
            jj = jf + dj
            if jj < 0 or jj > nyf - 1:
                continue
            if dj == 0:
                wj = np.float32(1.0)
            elif dj == -1:
                wj = wy[jj]
            else:
                wj = np.float32(1.0) - wy[jj]
            if wj == 0.0:
                continue
            for k in range(nz):
                for ic in range(1, nxc - 1):
                    i = 2 * ic - 1
                    left = wx[i - 1] * fine[jj, k, i - 1]
                    right = (np.float32(1.0) - wx[i + 1]) * fine[jj, k, i + 1]
                    out[jc, k, ic] += wj * (fine[jj, k, i] + left + right)


@numba.njit(cache=True)
def prolong_add(coarse, wx, wy, fine):
    """Add the bilinear (in x and y) interpolation of ``coarse`` to ``fine``, in place."""
    _, nz, nxc = coarse.shape
    nyf, _, nxf = fine.shape
    work = np.empty(nxc, coarse.dtype)
    for jf in range(1, nyf - 1):
        jc = (jf + 1) // 2
        if jf % 2 == 1:
            w = np.float32(0.0)
            j2 = jc
        else:
            w = wy[jf]
            j2 = jc + 1
        for k in range(nz):
            for ic in range(nxc):
                a = coarse[jc, k, ic]
                work[ic] = a + w * (coarse[j2, k, ic] - a)
            for ic in range(1, nxc - 1):
                fine[jf, k, 2 * ic - 1] += work[ic]
            for ic in range(1, nxc - 1):
                i = 2 * ic
                if i < nxf - 1:
                    fine[jf, k, i] += work[ic] + wx[i] * (work[ic + 1] - work[ic])
