"""Tables of a smooth response, known everywhere in closed form."""

from __future__ import annotations

import numpy as np

from bfsensor.response.vertices import vertex_fractions
from bfsensor.table.table import DistortionTable

PITCH = (10.0, 10.0)
CHARGES = np.array([0.0, 20_000.0, 50_000.0, 90_000.0, 150_000.0])
BACKGROUNDS = np.array([0.0, 20_000.0, 60_000.0, 100_000.0])
DEPTHS = np.array([2.0, 6.0, 20.0, 50.0, 100.0])
# Arrays are kept in single precision: half a unit in the last of 24 bits.
SINGLE = 2.0**-24


def pull(x, y):
    """Shift [um] towards the origin, larger across rows than across columns."""
    # Beyond one pixel its divergence is positive: neighbours gain what the source loses.
    softened = (1.0 + (x**2 + y**2) / 40.0) ** 2
    return np.stack(np.broadcast_arrays(-0.08 * x / softened, -0.12 * y / softened), -1)


def unit_response(charge, background, depth):
    """Smooth response, a cubic in the charge and in the background, rising with depth."""
    q, b = charge / 1e5, background / 1e5
    return (
        (1 - 0.3 * q + 0.1 * q**2 + 0.05 * q**3)
        * (1 + 0.2 * b - 0.1 * b**3)
        * (1 + 0 * depth)
    )


def make_table(
    charges=CHARGES, backgrounds=BACKGROUNDS, depths=DEPTHS, *, reach=2, vertices=4,
    response=unit_response, field=pull, pitch=PITCH, **other,
):  # fmt: skip
    """A table of (Q - B) / 1e5 times a response times a field of shifts."""
    charges, backgrounds, depths = (np.array(a) for a in (charges, backgrounds, depths))
    n = 2 * reach + 1
    x, y = ((np.arange(n + 1) - reach - 0.5) * p for p in pitch)
    f = vertex_fractions(vertices)
    inner_x, inner_y = x[:-1, None] + f * pitch[0], y[:-1, None] + f * pitch[1]
    q, b, z = np.meshgrid(charges, backgrounds, depths, indexing="ij")
    weight = (q - b) / 1e5 * response(q, b, z)

    def spread(shift):
        return weight[(...,) + (None,) * shift.ndim] * shift

    return DistortionTable(
        charges=charges, backgrounds=backgrounds, depths=depths, pitch=pitch,
        thickness=100.0, vertices=vertices, reach=reach,
        corners=spread(field(x[None, :], y[:, None])),
        horizontal=spread(field(inner_x[None], y[:, None, None])),
        vertical=spread(field(x[None, :, None], inner_y[:, None])),
        **other,
    )  # fmt: skip


def make_rough_table(seed, *, reach=2, vertices=3, pitch=(10.0, 8.0), **other):
    """A table of random shifts, without any symmetry."""
    rng = np.random.default_rng(seed)

    def field(x, y):
        return 0.3 * rng.normal(size=(*np.broadcast_shapes(x.shape, y.shape), 2))

    return make_table(
        [0.0, 70_000.0], [0.0, 30_000.0], [5.0, 100.0], reach=reach, vertices=vertices,
        pitch=pitch, symmetric=False, field=field, **other,
    )  # fmt: skip


def parts(shifts):
    return shifts.corners, shifts.horizontal, shifts.vertical


def polygon_area(points):
    after = np.roll(points, -1, axis=-2)
    return 0.5 * np.sum(points[..., 0] * after[..., 1] - points[..., 1] * after[..., 0], -1)
