"""The relaxation kernels against a dense matrix built from their definition."""

import numpy as np
import pytest

from bfsensor._kernels import relaxation

pytestmark = pytest.mark.kernels


def make_operator(rng, ny=5, nz=4, nx=7, n_front=2, kinds=2):
    """Random coefficients with the halo and Dirichlet conventions of the kernels."""
    cx = rng.uniform(0.5, 2.0, (kinds, nz, nx + 2))
    cx[:, :, 0] = 0.0
    cx[:, :, nx:] = 0.0
    cz = rng.uniform(0.5, 2.0, (kinds, nz, nx + 2))
    cz[:, -1] = 0.0
    cy = rng.uniform(0.5, 2.0, (kinds, nz, nx + 2))
    cd = rng.uniform(0.1, 0.3, (kinds, nz, nx + 2))
    kind = np.concatenate([[0], rng.integers(0, kinds, ny), [0]])
    dy = np.concatenate([[0.0], rng.uniform(0.5, 1.5, ny), [0.0]])
    gap = rng.uniform(0.5, 1.5, ny - 1)
    north = np.zeros(ny + 2)
    south = np.zeros(ny + 2)
    north[1:ny] = 1.0 / (gap * dy[1:ny])
    south[2 : ny + 1] = 1.0 / (gap * dy[2 : ny + 1])
    carriers = np.zeros((ny + 2, n_front, nx + 2))
    carriers[1:-1, :, 1:-1] = rng.uniform(0, 3.0, (ny, n_front, nx))
    return cx, cy, cz, cd, kind, north, south, dy, carriers


def dense(cx, cy, cz, cd, kind, north, south, dy, carriers, nz, nx):
    """The operator as a matrix, node by node, from the module's formula."""
    ny = len(dy) - 2
    number = np.arange(ny * nz * nx).reshape(ny, nz, nx)
    matrix = np.zeros((number.size, number.size))
    for j in range(ny):
        g = kind[j + 1]
        for k in range(nz):
            for i in range(nx):
                me = number[j, k, i]
                links = []
                if i + 1 < nx:
                    links.append((number[j, k, i + 1], cx[g, k, i + 1]))
                if i > 0:
                    links.append((number[j, k, i - 1], cx[g, k, i]))
                if k + 1 < nz:
                    links.append((number[j, k + 1, i], cz[g, k, i + 1]))
                if k > 0:
                    links.append((number[j, k - 1, i], cz[g, k - 1, i + 1]))
                if j + 1 < ny:
                    links.append((number[j + 1, k, i], cy[g, k, i + 1] * north[j + 1]))
                if j > 0:
                    links.append((number[j - 1, k, i], cy[g, k, i + 1] * south[j + 1]))
                for other, c in links:
                    matrix[me, me] += dy[j + 1] * c
                    matrix[me, other] -= dy[j + 1] * c
                matrix[me, me] += dy[j + 1] * cd[g, k, i + 1]
                if k < carriers.shape[1]:
                    matrix[me, me] += carriers[j + 1, k, i + 1]
    return matrix


@pytest.fixture
def case():
    rng = np.random.default_rng(5119)
    cx, cy, cz, cd, kind, north, south, dy, carriers = make_operator(rng)
    ny, nz, nx = 5, 4, 7
    matrix = dense(cx, cy, cz, cd, kind, north, south, dy, carriers, nz, nx)
    phi = np.zeros((ny + 2, nz, nx + 2))
    phi[1:-1, :, 1:-1] = rng.normal(size=(ny, nz, nx))
    rhs = np.zeros_like(phi)
    rhs[1:-1, :, 1:-1] = rng.normal(size=(ny, nz, nx))
    return cx, cy, cz, cd, kind, north, south, dy, carriers, matrix, phi, rhs


def test_residual_is_the_matrix(case):
    cx, cy, cz, cd, kind, north, south, dy, carriers, matrix, phi, rhs = case
    out = np.zeros_like(phi)
    relaxation.residual(phi, rhs, carriers, cx, cy, cz, cd, kind, north, south, dy, out)
    inner = (slice(1, -1), slice(None), slice(1, -1))
    expected = rhs[inner].ravel() - matrix @ phi[inner].ravel()
    assert np.allclose(out[inner].ravel(), expected, atol=1e-12)


def test_apply_operator_is_the_matrix_and_its_scalar_product(case):
    cx, cy, cz, cd, kind, north, south, dy, carriers, matrix, phi, _ = case
    out = np.zeros_like(phi)
    product = relaxation.apply_operator(
        phi, carriers, cx, cy, cz, cd, kind, north, south, dy, out
    )
    inner = (slice(1, -1), slice(None), slice(1, -1))
    expected = matrix @ phi[inner].ravel()
    assert np.allclose(out[inner].ravel(), expected, atol=1e-12)
    assert product == pytest.approx(phi[inner].ravel() @ expected, rel=1e-12)


def test_relaxation_zeroes_the_residual_of_the_columns_it_visits(case):
    cx, cy, cz, cd, kind, north, south, dy, carriers, matrix, phi, rhs = case
    ny, nz, nx = 5, 4, 7
    centre = cx + cz + cd
    centre[:, :, 1:] += cx[:, :, :-1]
    centre[:, 1:] += cz[:, :-1]
    inverse_dy = np.zeros(ny + 2)
    inverse_dy[1:-1] = 1 / dy[1:-1]
    cx_left = np.zeros_like(cx)
    cx_left[:, :, 1:] = cx[:, :, :-1]
    n = (nx + 1) // 2
    links = [np.zeros((len(cx), 2, nz, n)) for _ in range(4)]
    for link, field in zip(links, (cx_left, cx, cy, cz), strict=True):
        relaxation.packed(field, link)
    diagonal = np.ones_like(links[0])
    relaxation.packed(centre, diagonal)
    pivots, work = np.zeros((2, ny + 2, nz, n)), np.zeros((nz, n))
    relaxation.eliminate(
        carriers, links[2], links[3], diagonal, kind, north, south, inverse_dy, pivots
    )
    before = phi.copy()
    relaxation.relax_columns(
        phi, rhs, pivots, *links, kind, north, south, inverse_dy, 0, work, False
    )
    inner = (slice(1, -1), slice(None), slice(1, -1))
    left = (rhs[inner].ravel() - matrix @ phi[inner].ravel()).reshape(ny, nz, nx)
    visited = np.array([[(j + i) % 2 == 1 for i in range(nx)] for j in range(ny)])
    # No two columns of one colour touch, so those visited hold their own equation exactly.
    assert np.abs(left.transpose(0, 2, 1)[visited]).max() < 1e-12
    unchanged = (
        phi[inner].transpose(0, 2, 1)[~visited]
        == before[inner].transpose(0, 2, 1)[~visited]
    )
    assert unchanged.all()
    # In the first sweep of a cycle nothing is known of the other columns, whatever they hold.
    empty = np.zeros_like(phi)
    for field, first in ((empty, False), (before, True)):
        relaxation.relax_columns(
            field, rhs, pivots, *links, kind, north, south, inverse_dy, 0, work, first
        )
    columns = before[inner].transpose(0, 2, 1), empty[inner].transpose(0, 2, 1)
    np.testing.assert_array_equal(columns[0][visited], columns[1][visited])


@pytest.mark.parametrize(("coarse_y", "coarse_x"), [(3, 4), (5, 3)])
def test_restriction_is_the_transpose_of_interpolation(coarse_y, coarse_x):
    rng = np.random.default_rng(773)
    nz = 2
    ny, nx = 2 * coarse_y - 1, 2 * coarse_x - 1
    weights = []
    for n in (ny, nx):
        w = np.zeros(n + 2)
        w[2 : n + 1 : 2] = rng.uniform(0.3, 0.7, (n - 1) // 2)
        w[0], w[-1] = 0.0, 1.0
        weights.append(w)
    wy, wx = weights
    fine = np.zeros((ny + 2, nz, nx + 2))
    fine[1:-1, :, 1:-1] = rng.normal(size=(ny, nz, nx))
    coarse = np.zeros((coarse_y + 2, nz, coarse_x + 2))
    coarse[1:-1, :, 1:-1] = rng.normal(size=(coarse_y, nz, coarse_x))
    down = np.zeros_like(coarse)
    relaxation.restrict(fine, wx, wy, down)
    up = np.zeros_like(fine)
    relaxation.prolong_add(coarse, wx, wy, up)
    inner = (slice(1, -1), slice(None), slice(1, -1))
    assert np.sum(up[inner] * fine[inner]) == pytest.approx(
        np.sum(down[inner] * coarse[inner]), rel=1e-12
    )


def test_interpolation_is_exact_for_linear_fields_on_a_graded_mesh():
    y = np.array([0.0, 1.0, 1.5, 3.5, 4.0])
    x = np.array([0.0, 0.4, 2.0, 2.5, 3.5])
    wy, wx = np.zeros(7), np.zeros(7)
    wy[2:5:2] = (y[1::2] - y[:-1:2]) / (y[2::2] - y[:-1:2])
    wx[2:5:2] = (x[1::2] - x[:-1:2]) / (x[2::2] - x[:-1:2])
    field = 2.0 * y[:, None] - 3.0 * x[None, :] + 1.0
    coarse = np.zeros((5, 1, 5))
    coarse[1:-1, 0, 1:-1] = field[::2, ::2]
    fine = np.zeros((7, 1, 7))
    relaxation.prolong_add(coarse, wx, wy, fine)
    assert np.allclose(fine[1:-1, 0, 1:-1], field, atol=1e-12)


def test_halo_holds_the_periodic_images():
    a = np.zeros((5, 2, 6))
    a[1:-1, :, 1:-1] = np.arange(24).reshape(3, 2, 4)
    relaxation.fill_halo(a, True, True)
    assert np.array_equal(a[0, :, 1:-1], a[3, :, 1:-1])
    assert np.array_equal(a[1:-1, :, 5], a[1:-1, :, 1])
    assert np.array_equal(a[4, :, 0], a[1, :, 4])
