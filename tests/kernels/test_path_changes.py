"""Field, its derivatives and changes of the potential, where they are parabolas: exact."""

import numpy as np
import pytest

from bfsensor._kernels.path_changes import Changes, _field_and_changes
from tests.kernels.test_drift import NODES, grid

pytestmark = pytest.mark.kernels


def parabola(c, x, y, z):
    return (
        c[0] * x**2 + c[1] * y**2 + c[2] * z**2 + c[3] * x * y + c[4] * x * z + c[5] * y * z
        + c[6] * x + c[7] * y + c[8] * z
    )  # fmt: skip


def slopes(c, x, y, z):
    return [
        2 * c[0] * x + c[3] * y + c[4] * z + c[6],
        2 * c[1] * y + c[3] * x + c[5] * z + c[7],
        2 * c[2] * z + c[4] * x + c[5] * y + c[8],
    ]


def test_changes_of_the_field_are_those_of_the_potential():
    """One change on nodes that stay, and one device with a quantity larger by 0.1 on moved nodes."""
    field, still, other = np.random.default_rng(611).uniform(-1, 1, (3, 9))
    phi = grid(lambda *p: parabola(field, *p), NODES, NODES, NODES)
    derivative = grid(lambda *p: parabola(still, *p), NODES, NODES, NODES)
    axes = [NODES * stretch for stretch in (1.02, 0.97, 1.01)]
    moved = grid(lambda *p: parabola(other, *p), *axes)
    changes = Changes(
        derivative[..., None], moved[None], *(a[None] for a in axes), np.array([0.1])
    )
    for place in ((0.3, -1.0, 0.9), (1.69, 0.05, 2.0), (-1.3, 1.6, -0.7)):
        g, second, out = np.zeros(3), np.zeros(6), np.zeros((2, 3))
        _field_and_changes(
            phi, changes, NODES, NODES, NODES, np.array(place), np.ones(3, np.int64),
            np.zeros((9, 4)), g, second, out,
        )  # fmt: skip
        np.testing.assert_allclose(g, slopes(field, *place), atol=1e-10)
        xx, yy, zz, xy, xz, yz = field[:6] * [2, 2, 2, 1, 1, 1]
        np.testing.assert_allclose(second, [xx, xy, xz, yy, yz, zz], atol=1e-9)
        np.testing.assert_allclose(out[0], slopes(still, *place), atol=1e-10)
        change = np.subtract(slopes(other, *place), slopes(field, *place)) / 0.1
        np.testing.assert_allclose(out[1], change, atol=1e-9)
