"""The linearised Poisson operator.

All fields are ``[y, z, x]`` with one halo cell on each side in y and in x, so that one
row of columns (fixed y) is a contiguous block.  The geometry of a sensor does not depend on y
except through a few kinds of row, so the link coefficients are ``[kind, z, x]`` and stay in cache:
the operator moves little more than the unknowns themselves.

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
    """Write ``A phi`` to ``out`` and return the scalar product of ``phi`` with it.

    The product is summed by columns first, as a sum of one number waits for each of its terms.
    """
    ny, nz, nx = phi.shape
    n_front = carriers.shape[1]
    sums = np.zeros(nx)
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
            for i in range(1, nx - 1):
                sums[i] += out[j, k, i] * phi[j, k, i]
    return sums.sum()


@numba.njit(cache=True)
def restrict(fine, wx, wy, out):
    """Sum the charge of fine nodes onto the coarse nodes that interpolate them.

    ``wx[i]`` is the weight of the right coarse neighbour of the odd fine node ``i``
    between two coarse ones (even, counted with the halo), 1 - wx that of the left one.
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
