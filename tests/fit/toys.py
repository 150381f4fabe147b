"""Toy shifts whose posterior is known in closed form."""

from __future__ import annotations

import numpy as np

from bfsensor.device.quantities import Prior
from bfsensor.fit.data import DataSet, area_data
from tests.response.linear_emulator import LinearEmulator, quadrant

NAMES = ("silicon.thickness", "silicon.background_doping", "operating_point.back_bias")
SPREADS = (5.0, 0.8, 2.0)
MEANS = (100.0, -2.4, -50.0)

PRIORS = tuple(
    Prior(name, mean, spread)
    for name, mean, spread in zip(NAMES, MEANS, SPREADS, strict=True)
)


def toy_emulator(seed: int = 801, count: int = 3) -> LinearEmulator:
    """Shifts of nine by nine pixels, odd as they have to be, and their change."""
    rng = np.random.default_rng(seed)
    at = np.arange(-5, 6)
    r = np.hypot(at[:, None], at[None] + 0.5)
    own = -1e-7 * np.sign(at + 0.5) / r**2
    edges = own, 1.5 * own.T
    slopes = [
        np.array([e * rng.normal(0.0, 0.1, e.shape) / s for s in SPREADS[:count]])
        for e in edges
    ]
    return LinearEmulator(
        NAMES[:count], np.array(MEANS[:count]), edges, (slopes[0], slopes[1])
    )


def toy_data(
    emulator: LinearEmulator, truth: np.ndarray, seed: int, *, part: float = 0.02, **more
) -> DataSet:
    """Areas at the true values with noise of ``part`` of the largest neighbour's."""
    a = quadrant(
        *(
            e + np.tensordot(truth - emulator.nominal, s, 1)
            for e, s in zip(emulator.edges, emulator.slopes, strict=True)
        )
    )
    errors = np.full(a.shape, part * np.abs(a[0, 1]))
    drawn = a + np.random.default_rng(seed).normal(0.0, 1.0, a.shape) * errors
    return area_data("toy", drawn, errors, **more)
