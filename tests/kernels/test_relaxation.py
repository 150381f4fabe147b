"""The operator of Poisson's equation against a dense matrix built from its definition."""

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


def test_halo_holds_the_periodic_images():
    a = np.zeros((5, 2, 6))
    a[1:-1, :, 1:-1] = np.arange(24).reshape(3, 2, 4)
    relaxation.fill_halo(a, True, True)
    assert np.array_equal(a[0, :, 1:-1], a[3, :, 1:-1])
    assert np.array_equal(a[1:-1, :, 5], a[1:-1, :, 1])
    assert np.array_equal(a[4, :, 0], a[1, :, 4])
