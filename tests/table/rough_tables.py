"""Tables of random shifts, and the message of a refusal."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.errors import TableError
from bfsensor.simulate.boundaries import mirror_quadrant
from bfsensor.table.table import DistortionTable

CHARGES = np.array([0.0, 20e3, 50e3, 90e3, 150e3])
BACKGROUNDS = np.array([0.0, 20e3, 40e3, 60e3])
DEPTHS = np.array([1.0, 10.0, 40.0, 100.0])
ARRAYS = ("corners", "horizontal", "vertical")


def shapes(reach, vertices):
    n = 2 * reach + 1
    return {
        "corners": (n + 1, n + 1, 2),
        "horizontal": (n + 1, n, vertices, 2),
        "vertical": (n, n + 1, vertices, 2),
    }


def make_table(
    seed=20, *, symmetric=True, charges=CHARGES, backgrounds=BACKGROUNDS, depths=DEPTHS,
    reach=2, vertices=4, pitch=(10.0, 12.0), size=0.2, **more,
):  # fmt: skip
    """A table of random shifts of ``size`` um at most, zero where charge = background."""
    rng = np.random.default_rng(seed)
    levels = (len(charges), len(backgrounds), len(depths))
    arrays = {
        name: rng.uniform(-size, size, (np.prod(levels), *shape))
        for name, shape in shapes(reach, vertices).items()
    }
    if symmetric:
        mirror_quadrant(*(arrays[name] for name in ARRAYS))
    arrays = {name: a.reshape(*levels, *a.shape[1:]) for name, a in arrays.items()}
    for a in arrays.values():
        a[charges[:, None] == backgrounds] = 0.0
    return DistortionTable(
        charges=charges, backgrounds=backgrounds, depths=depths, pitch=pitch,
        thickness=100.0, vertices=vertices, reach=reach, symmetric=symmetric, **arrays,
        **more,
    )  # fmt: skip


def refusal(call, *args, **kwargs):
    """Message of the TableError that a call raises."""
    with pytest.raises(TableError) as caught:
        call(*args, **kwargs)
    return str(caught.value)


def shoelace(points):
    x, y = np.moveaxis(points, -1, 0)
    return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
