"""Sums over columns of nodes for shifts of the potential about each pixel's electrons.

Fields are ``[y, z, x]`` with halo, as in :mod:`bfsensor._kernels.relaxation`; a profile holds the first
planes of one.
"""

import numba


@numba.njit(cache=True, error_model="numpy")
def link_energies(profile, stiffness, cx, cy, cz, cd, kind, north, dy, out):
    """Sum the energies of a profile's nodes and links over z.

    ``out`` is (7, y, x): a node's own, and then of the link to the next node in x, and of that in y, the
    sums of coefficient times value squared here, value here times there, and squared there.
    """
    ny, nz, nx = profile.shape
    out[...] = 0.0
    for j in range(1, ny - 1):
        g = kind[j]
        w = dy[j]
        for k in range(nz):
            for i in range(1, nx - 1):
                t = profile[j, k, i]
                above = profile[j, k + 1, i] if k < nz - 1 else 0.0
                along_x = profile[j, k, i + 1]
                along_y = profile[j + 1, k, i]
                out[0, j, i] += w * (cd[g, k, i] * t * t + cz[g, k, i] * (t - above) ** 2)
                c = w * cx[g, k, i]
                out[1, j, i] += c * t * t
                out[2, j, i] += c * t * along_x
                out[3, j, i] += c * along_x * along_x
                c = w * north[j] * cy[g, k, i]
                out[4, j, i] += c * t * t
                out[5, j, i] += c * t * along_y
                out[6, j, i] += c * along_y * along_y
                if k < stiffness.shape[1]:
                    out[0, j, i] += stiffness[j, k, i] * t * t


@numba.njit(cache=True, error_model="numpy")
def column_products(profile, field, out):
    """Write the products of a profile and a field, summed over z, to ``out``, (y, x)."""
    ny, _, nx = profile.shape
    nz = min(profile.shape[1], field.shape[1])
    for j in range(ny):
        for i in range(nx):
            out[j, i] = 0.0
        for k in range(nz):
            for i in range(nx):
                out[j, i] += profile[j, k, i] * field[j, k, i]


@numba.njit(cache=True, error_model="numpy")
def add_columns(profile, factors, field):
    """Add a profile times a factor for each column, (y, x), to a field, in place."""
    ny, nz, nx = profile.shape
    for j in range(1, ny - 1):
        for k in range(nz):
            for i in range(1, nx - 1):
                field[j, k, i] += profile[j, k, i] * factors[j, i]
