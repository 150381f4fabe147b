"""Sweeps of a multigrid cycle over columns of two colours, each colour packed by itself.

The operator is that of :mod:`bfsensor._kernels.relaxation`.  Columns are red and black like a
chessboard, so that those of one colour in a row are every second one.  They lie next to each other
here: a field is ``[y, odd or even, z, column]``, first the columns of odd number (counted with the halo,
1 being the first inner one), then those of even number.  Solutions have a column more at either end:
column ``1 + 2 m`` or ``2 + 2 m`` is at ``m + 1``, and the halo of even columns at 0, that of odd ones at
the end.  Loops then run over neighbours in memory, and a sweep is limited by memory.

A cycle goes down by :func:`descend` and up by :func:`ascend`, each one pass over the rows in which every
sweep follows the one before it by a row, so that a row is fetched once.  Along a periodic y, where the
first row is next to the last, every sweep waits for the one before it to end.
"""

import numba


@numba.njit(cache=True)
def packed(field, out):
    """Copy the inner columns of ``field``, ``[a, z, x]``, to ``[a, odd or even, z, column]``."""
    rows, nz, nx = field.shape
    for j in range(rows):
        for k in range(nz):
            for m in range((nx - 1) // 2):
                out[j, 0, k, m] = field[j, k, 2 * m + 1]
            for m in range((nx - 2) // 2):
                out[j, 1, k, m] = field[j, k, 2 * m + 2]


@numba.njit(cache=True)
def unpacked(solution, out):
    """Copy a packed solution to the inner columns of ``out``, ``[y, z, x]``."""
    ny, nz, nx = out.shape
    for j in range(1, ny - 1):
        for k in range(nz):
            for m in range((nx - 1) // 2):
                out[j, k, 2 * m + 1] = solution[j, 0, k, m + 1]
            for m in range((nx - 2) // 2):
                out[j, k, 2 * m + 2] = solution[j, 1, k, m + 1]


@numba.njit(cache=True, error_model="numpy")
def eliminate(carriers, cy, cz, centre, kind, north, south, inverse_dy, pivots):
    """Write the inverse pivots of all columns, eliminated from the gates up.

    ``carriers`` is ``[y, z, x]`` with halo; ``cy``, ``cz`` and ``centre``, the sum of the x and z links
    and ``cd``, are packed by kind of row, and ``pivots`` by row.
    """
    ny, _, nz, n = pivots.shape
    n_front = carriers.shape[1]
    one = pivots.dtype.type(1.0)
    for j in range(1, ny - 1):
        g = kind[j]
        ay = north[j] + south[j]
        w = inverse_dy[j]
        for even in range(2):
            for k in range(nz):
                out = pivots[j, even, k]
                for m in range(n):
                    out[m] = centre[g, even, k, m] + ay * cy[g, even, k, m]
                if k < n_front:
                    for m in range(min(n, (carriers.shape[2] - 1 - even) // 2)):
                        out[m] += carriers[j, k, 1 + even + 2 * m] * w
                if k > 0:
                    for m in range(n):
                        lower = cz[g, even, k - 1, m]
                        out[m] -= lower * lower * pivots[j, even, k - 1, m]
                for m in range(n):
                    out[m] = one / out[m]


@numba.njit(cache=True, error_model="numpy")
def _fill_halo_of_row(solution, j, even, n, periodic_x, periodic_y):
    """Copy the periodic images of the columns of one colour in row ``j``."""
    ny, _, nz, _ = solution.shape
    if periodic_x:
        here, there = (0, n) if even else (n + 1, 1)
        for k in range(nz):
            solution[j, even, k, here] = solution[j, even, k, there]
    if periodic_y:
        if j == 1:
            solution[ny - 1, even] = solution[1, even]
        if j == ny - 2:
            solution[0, even] = solution[ny - 2, even]


@numba.njit(cache=True, error_model="numpy")
def _relax_row(
    solution, charge, pivots, left, right, cy, cz, g, an, as_, w, j, even, n, work, alone,
):  # fmt: skip
    """Solve the columns of one colour in row ``j`` exactly along z.

    Where ``alone``, the other columns count as zero, whatever they hold.
    """
    nz = work.shape[0]
    rhs, p, x = charge[j, even], pivots[j, even], solution[j, even]
    above, below, other = (
        solution[j + 1, even],
        solution[j - 1, even],
        solution[j, 1 - even],
    )
    from_left, from_right, across, along = (
        left[g, even],
        right[g, even],
        cy[g, even],
        cz[g, even],
    )
    for k in range(nz):
        if alone:
            for m in range(n):
                work[k, m] = rhs[k, m] * w
        elif even:
            for m in range(n):
                work[k, m] = (
                    rhs[k, m] * w
                    + across[k, m] * (an * above[k, m + 1] + as_ * below[k, m + 1])
                    + (
                        from_right[k, m] * other[k, m + 2]
                        + from_left[k, m] * other[k, m + 1]
                    )
                )
        else:
            for m in range(n):
                work[k, m] = (
                    rhs[k, m] * w
                    + across[k, m] * (an * above[k, m + 1] + as_ * below[k, m + 1])
                    + (from_right[k, m] * other[k, m + 1] + from_left[k, m] * other[k, m])
                )
        if k > 0:
            for m in range(n):
                work[k, m] += along[k - 1, m] * work[k - 1, m]
        for m in range(n):
            work[k, m] *= p[k, m]
    for k in range(nz - 1, -1, -1):
        if k < nz - 1:
            for m in range(n):
                work[k, m] += along[k, m] * p[k, m] * work[k + 1, m]
        for m in range(n):
            x[k, m + 1] = work[k, m]


@numba.njit(cache=True, error_model="numpy")
def _restrict_row(
    solution, left, right, cy, g, an, as_, dy, j, even, n, weight_x, weight_y, work, periodic_x,
    periodic_y, out,
):  # fmt: skip
    """Sum the residual of one colour in row ``j`` onto coarse nodes.

    Its columns were solved exactly before the other colour, starting from zero, was: their residual is
    what has come from there since.
    """
    nz = work.shape[0]
    above, below, other = (
        solution[j + 1, even],
        solution[j - 1, even],
        solution[j, 1 - even],
    )
    from_left, from_right, across = left[g, even], right[g, even], cy[g, even]
    for k in range(nz):
        if even:
            for m in range(n):
                work[k, m + 1] = dy * (
                    across[k, m] * (an * above[k, m + 1] + as_ * below[k, m + 1])
                    + (
                        from_right[k, m] * other[k, m + 2]
                        + from_left[k, m] * other[k, m + 1]
                    )
                )
            work[k, 0] = work[k, n] if periodic_x else work.dtype.type(0.0)
        else:
            for m in range(n):
                work[k, m + 1] = dy * (
                    across[k, m] * (an * above[k, m + 1] + as_ * below[k, m + 1])
                    + (from_right[k, m] * other[k, m + 1] + from_left[k, m] * other[k, m])
                )
        work[k, n + 1] = 0.0
    one = work.dtype.type(1.0)
    last = out.shape[0] - 2
    coarse_columns = (weight_x.shape[0] - 1) // 2
    for up in range(1 + (j + 1) % 2):
        # Odd rows are coarse ones themselves, even ones lie between two.
        row = (j + 1) // 2 + up
        if j % 2 == 1:
            wj = one
        elif up:
            wj = weight_y[j]
        else:
            wj = one - weight_y[j]
        if row > last:
            if not periodic_y:
                continue
            row = 1
        for coarse_even in range(2):
            count = (coarse_columns + 1 - coarse_even) // 2
            for k in range(nz):
                if even:
                    # Columns between two coarse ones: c lies between those at c and c - 1.
                    for m in range(count):
                        c = 2 * m + 1 + coarse_even
                        out[row, coarse_even, k, m] += wj * (
                            (one - weight_x[2 * c]) * work[k, c]
                            + weight_x[2 * c - 2] * work[k, c - 1]
                        )
                else:
                    for m in range(count):
                        out[row, coarse_even, k, m] += wj * work[k, 2 * m + 1 + coarse_even]


@numba.njit(cache=True, error_model="numpy")
def _prolong_row(coarse, j, even, n, weight_x, weight_y, work, solution):
    """Add the interpolation of coarse nodes to the columns of one colour in row ``j``."""
    nz = solution.shape[2]
    row = (j + 1) // 2
    w = work.dtype.type(0.0) if j % 2 == 1 else weight_y[j]
    half = coarse.shape[3] - 1
    for k in range(nz):
        # The coarse row, interpolated in y, as it lies in space: work[0, c] is column c.
        for m in range(half):
            a = coarse[row, 1, k, m]
            b = coarse[row, 0, k, m + 1]
            if w != 0.0:
                a += w * (coarse[row + 1, 1, k, m] - a)
                b += w * (coarse[row + 1, 0, k, m + 1] - b)
            work[0, 2 * m] = a
            work[0, 2 * m + 1] = b
        if even:
            for m in range(n):
                a = work[0, m + 1]
                solution[j, 1, k, m + 1] += a + weight_x[2 * m + 2] * (work[0, m + 2] - a)
        else:
            for m in range(n):
                solution[j, 0, k, m + 1] += work[0, m + 1]


@numba.njit(cache=True, error_model="numpy")
def relax(
    solution, charge, pivots, left, right, cy, cz, kind, north, south, inverse_dy, colour, columns,
    periodic_x, periodic_y, work, alone,
):  # fmt: skip
    """Solve every column of one colour exactly along z, in place; halos are filled.

    Where ``alone``, the other columns count as zero, whatever they hold.  ``columns`` is the number of
    inner columns of a row, and ``work`` scratch, shape (nz, columns // 2 + 6).
    """
    for j in range(1, solution.shape[0] - 1):
        even = (j + colour) % 2
        n = (columns + 1 - even) // 2
        _relax_row(
            solution, charge, pivots, left, right, cy, cz, kind[j], north[j], south[j],
            inverse_dy[j], j, even, n, work, alone,
        )  # fmt: skip
        _fill_halo_of_row(solution, j, even, n, periodic_x, periodic_y)


@numba.njit(cache=True, error_model="numpy")
def descend(
    solution, charge, pivots, left, right, cy, cz, kind, north, south, dy, inverse_dy, columns,
    weight_x, weight_y, periodic_x, periodic_y, work, coarse_charge,
):  # fmt: skip
    """Relax both colours from zero and sum what is left onto the coarse nodes.

    ``coarse_charge`` is packed; ``weight_x[i]`` is the weight of the right coarse neighbour of the even
    column ``i``, ``weight_y`` that of even rows.
    """
    rows = solution.shape[0] - 2
    coarse_charge[...] = 0.0
    behind = rows if periodic_y else 1
    for s in range(1, rows + 2 * behind + 1):
        for colour in range(2):
            j = s - colour * behind
            if 1 <= j <= rows:
                even = (j + colour) % 2
                n = (columns + 1 - even) // 2
                _relax_row(
                    solution, charge, pivots, left, right, cy, cz, kind[j], north[j], south[j],
                    inverse_dy[j], j, even, n, work, colour == 0,
                )  # fmt: skip
                _fill_halo_of_row(solution, j, even, n, periodic_x, periodic_y)
        j = s - 2 * behind
        if j >= 1:
            even = j % 2
            _restrict_row(
                solution, left, right, cy, kind[j], north[j], south[j], dy[j], j, even,
                (columns + 1 - even) // 2, weight_x, weight_y, work, periodic_x, periodic_y,
                coarse_charge,
            )  # fmt: skip


@numba.njit(cache=True, error_model="numpy")
def ascend(
    solution, charge, pivots, left, right, cy, cz, kind, north, south, inverse_dy, columns, weight_x,
    weight_y, periodic_x, periodic_y, work, coarse,
):  # fmt: skip
    """Add the coarse solution and relax both colours, in the order opposite to :func:`descend`.

    Only the colour that is relaxed last needs the coarse solution: the other is solved from it.
    """
    rows = solution.shape[0] - 2
    behind = rows if periodic_y else 1
    for s in range(1, rows + 2 * behind + 1):
        if s <= rows:
            even = s % 2
            n = (columns + 1 - even) // 2
            _prolong_row(coarse, s, even, n, weight_x, weight_y, work, solution)
            _fill_halo_of_row(solution, s, even, n, periodic_x, periodic_y)
        for colour in range(1, -1, -1):
            j = s - (2 - colour) * behind
            if 1 <= j <= rows:
                even = (j + colour) % 2
                n = (columns + 1 - even) // 2
                _relax_row(
                    solution, charge, pivots, left, right, cy, cz, kind[j], north[j], south[j],
                    inverse_dy[j], j, even, n, work, False,
                )  # fmt: skip
                _fill_halo_of_row(solution, j, even, n, periodic_x, periodic_y)
