"""Sweeps over packed colours against dense matrices built from their definition."""

import numpy as np
import pytest

from bfsensor._kernels import colour_sweeps, relaxation

pytestmark = pytest.mark.kernels

KINDS, NZ, N_FRONT = 2, 4, 2


def packed_solution(inner, periodic):
    """A solution with halos, as a cycle leaves it."""
    ny, nz, nx = inner.shape
    field = np.zeros((ny + 2, nz, nx + 2))
    field[1:-1, :, 1:-1] = inner
    relaxation.fill_halo(field, *periodic)
    out = np.zeros((ny + 2, 2, nz, (nx + 1) // 2 + 2))
    for i in range(nx + 2):
        even = 1 - i % 2
        out[:, even, :, (i + 1 - even) // 2] = field[:, :, i]
    return out


class Case:
    """A random operator, by its packed coefficients and as a matrix over [y, z, x]."""

    def __init__(self, ny, nx, periodic_x, periodic_y):
        rng = np.random.default_rng(5119)
        self.ny, self.nx, self.periodic = ny, nx, (periodic_x, periodic_y)
        shape = KINDS, NZ, nx + 2
        cx, cz, cy = rng.uniform(0.5, 2.0, (3, *shape))
        cd = rng.uniform(0.1, 0.3, shape)
        cz[:, -1] = 0.0
        cx[:, :, 0] = cx[:, :, nx] if periodic_x else 0.0
        cx[:, :, nx:] = cx[:, :, nx:] if periodic_x else 0.0
        kind = np.array([0, *rng.integers(0, KINDS, ny), 0])
        dy = np.array([0.0, *rng.uniform(0.5, 1.5, ny), 0.0])
        gap = rng.uniform(0.5, 1.5, ny + 1)  # between rows j and j + 1
        gap[0] = gap[-1]
        north, south = np.zeros((2, ny + 2))
        north[1:-1] = 1 / (gap[1:] * dy[1:-1])
        south[1:-1] = 1 / (gap[:-1] * dy[1:-1])
        if not periodic_y:
            north[ny] = south[1] = 0.0
        carriers = np.zeros((ny + 2, N_FRONT, nx + 2))
        carriers[1:-1, :, 1:-1] = rng.uniform(0, 3.0, (ny, N_FRONT, nx))
        self.fields = cx, cy, cz, cd, kind, north, south, dy, carriers
        self.matrix = self.dense()

        half = (nx + 1) // 2
        left, below = np.zeros(shape), np.zeros(shape)
        left[:, :, 1:], below[:, 1:] = cx[:, :, :-1], cz[:, :-1]
        self.links = [self.pack(a) for a in (left, cx, cy, cz)]
        centre = np.ones((KINDS, 2, NZ, half))
        colour_sweeps.packed(cx + left + cz + below + cd, centre)
        inverse_dy = np.zeros(ny + 2)
        inverse_dy[1:-1] = 1 / dy[1:-1]
        self.pivots = np.zeros((ny + 2, 2, NZ, half))
        self.rows = kind, north, south
        self.dy, self.inverse_dy = dy, inverse_dy
        colour_sweeps.eliminate(
            carriers, *self.links[2:], centre, *self.rows, inverse_dy, self.pivots
        )
        self.work = np.zeros((NZ, nx // 2 + 6))
        self.red = (np.add.outer(np.arange(ny), np.arange(nx)) % 2 == 1)[:, None, :]
        self.red = np.broadcast_to(self.red, (ny, NZ, nx))

    def pack(self, field):
        out = np.zeros((len(field), 2, NZ, (self.nx + 1) // 2))
        colour_sweeps.packed(field, out)
        return out

    def packed_field(self, inner):
        field = np.zeros((self.ny + 2, NZ, self.nx + 2))
        field[1:-1, :, 1:-1] = inner
        return self.pack(field)

    def packed_solution(self, inner):
        return packed_solution(inner, self.periodic)

    def inner(self, packed):
        out = np.zeros((self.ny + 2, NZ, self.nx + 2))
        colour_sweeps.unpacked(packed, out)
        return out[1:-1, :, 1:-1]

    def dense(self):
        """The operator column by column, from the kernel that is tested against its formula."""
        cx, cy, cz, cd, kind, north, south, dy, carriers = self.fields
        shape = self.ny, NZ, self.nx
        out = []
        for n in range(np.prod(shape)):
            one = np.zeros((self.ny + 2, NZ, self.nx + 2))
            one[1:-1, :, 1:-1].flat[n] = 1.0
            relaxation.fill_halo(one, *self.periodic)
            product = np.zeros_like(one)
            relaxation.apply_operator(
                one, carriers, cx, cy, cz, cd, kind, north, south, dy, product
            )
            out.append(product[1:-1, :, 1:-1].ravel())
        return np.array(out).T

    def solve_columns(self, solution, charge, which):
        """Solve the columns of one colour exactly, the others held."""
        at = np.flatnonzero(which)
        left = charge.ravel() - self.matrix @ np.where(which, 0.0, solution).ravel()
        solution = solution.copy()
        solution.ravel()[at] = np.linalg.solve(self.matrix[np.ix_(at, at)], left[at])
        return solution

    def weights(self):
        """Of the upper coarse neighbour, as the multigrid makes them."""
        rng = np.random.default_rng(77)
        found = []
        for n, periodic in zip((self.nx, self.ny), self.periodic, strict=True):
            w = np.zeros(n + 2)
            w[2 : n + 1 : 2] = rng.uniform(0.3, 0.7, n // 2)
            w[0], w[-1] = (w[n], 0.0) if periodic else (0.0, 1.0)
            found.append(w)
        return found

    def interpolation(self, wx, wy):
        """Matrix from coarse to fine nodes of a plane, and the coarse shape."""
        one = []
        for w, n, periodic in zip(
            (wy, wx), (self.ny, self.nx), self.periodic[::-1], strict=True
        ):
            count = n // 2 if periodic else (n + 1) // 2
            p = np.zeros((n, count))
            for f in range(1, n + 1):
                c = (f + 1) // 2 - 1
                if f % 2 == 1:
                    p[f - 1, c] = 1.0
                else:
                    p[f - 1, c] += 1 - w[f]
                    p[f - 1, (c + 1) % count] += w[f]
            one.append(p)
        return one


@pytest.fixture(
    params=[(5, 7, 0, 0), (7, 9, 0, 0), (6, 8, 1, 1), (5, 8, 1, 0), (8, 7, 0, 1)]
)
def case(request):
    ny, nx, periodic_x, periodic_y = request.param
    return Case(ny, nx, bool(periodic_x), bool(periodic_y))


def random_fields(case, count):
    rng = np.random.default_rng(41)
    return rng.normal(size=(count, case.ny, NZ, case.nx))


def test_packed_columns_come_back(case):
    (field,) = random_fields(case, 1)
    np.testing.assert_array_equal(case.inner(case.packed_solution(field)), field)


@pytest.mark.parametrize("colour", [0, 1])
@pytest.mark.parametrize("alone", [False, True])
def test_a_sweep_solves_the_columns_of_its_colour(case, colour, alone):
    start, charge = random_fields(case, 2)
    solution = case.packed_solution(start)
    colour_sweeps.relax(
        solution, case.packed_field(charge), case.pivots, *case.links, *case.rows,
        case.inverse_dy, colour, case.nx, *case.periodic, case.work, alone,
    )  # fmt: skip
    visited = case.red if colour == 0 else ~case.red
    known = np.where(visited, start, 0.0) if alone else start
    expected = np.where(visited, case.solve_columns(known, charge, visited), start)
    np.testing.assert_allclose(case.inner(solution), expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(case.packed_solution(case.inner(solution)), solution)


def test_the_way_down_leaves_the_residual_on_coarse_nodes(case):
    start, charge = random_fields(case, 2)
    wx, wy = case.weights()
    py, px = case.interpolation(wx, wy)
    solution = case.packed_solution(start)  # whatever it holds
    coarse = np.full((py.shape[1] + 2, 2, NZ, (px.shape[1] + 1) // 2), 9.0)
    colour_sweeps.descend(
        solution, case.packed_field(charge), case.pivots, *case.links, *case.rows, case.dy,
        case.inverse_dy, case.nx, wx, wy, *case.periodic, case.work, coarse,
    )  # fmt: skip
    first = case.solve_columns(np.zeros_like(start), charge, case.red)
    expected = case.solve_columns(np.where(case.red, first, 0.0), charge, ~case.red)
    np.testing.assert_allclose(case.inner(solution), expected, rtol=0, atol=1e-12)
    left = charge - (case.matrix @ expected.ravel()).reshape(charge.shape)
    restricted = np.einsum("jc,jki,id->ckd", py, left, px)
    padded = np.zeros((coarse.shape[0], NZ, px.shape[1] + 2))
    padded[1:-1, :, 1:-1] = restricted
    packed = np.zeros_like(coarse)
    colour_sweeps.packed(padded, packed)
    np.testing.assert_allclose(coarse, packed, rtol=0, atol=1e-12)


def test_the_way_up_adds_the_coarse_solution_and_relaxes(case):
    start, charge = random_fields(case, 2)
    wx, wy = case.weights()
    py, px = case.interpolation(wx, wy)
    rng = np.random.default_rng(8)
    values = rng.normal(size=(py.shape[1], NZ, px.shape[1]))
    solution = case.packed_solution(start)
    colour_sweeps.ascend(
        solution, case.packed_field(charge), case.pivots, *case.links, *case.rows,
        case.inverse_dy, case.nx, wx, wy, *case.periodic, case.work,
        packed_solution(values, case.periodic),
    )  # fmt: skip
    corrected = start + np.einsum("jc,ckd,id->jki", py, values, px)
    black = case.solve_columns(corrected, charge, ~case.red)
    expected = case.solve_columns(black, charge, case.red)
    np.testing.assert_allclose(case.inner(solution), expected, rtol=0, atol=1e-12)
