"""Emulators that are straight in the parameters: of given arrays, and of our device's walks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bfsensor import Device
from bfsensor.diagnose.baseline import area_matrix
from bfsensor.diagnose.walk import walk
from bfsensor.fit.changing import device_at
from bfsensor.fit.quantities import Prior
from bfsensor.recording.exposures import Condition


@dataclass(frozen=True)
class LinearResponse:
    kx: NDArray
    ky: NDArray
    areas: NDArray
    jacobian: NDArray


@dataclass(frozen=True)
class LinearEmulator:
    """Shifts straight in the parameters; areas are those of the shifts."""

    parameters: tuple[str, ...]
    nominal: NDArray
    edges: tuple[NDArray, NDArray]
    slopes: tuple[NDArray, NDArray]
    asked: list = field(default_factory=list)

    def predict(self, values, condition):
        by = np.asarray(values) - self.nominal
        self.asked.append(condition)
        kx, ky = (
            e + np.tensordot(by, s, 1) for e, s in zip(self.edges, self.slopes, strict=True)
        )
        rows = [quadrant(*pair) for pair in zip(*self.slopes, strict=True)]
        return LinearResponse(kx, ky, quadrant(kx, ky), np.array(rows))


def quadrant(kx, ky):
    a = area_matrix(kx, ky)
    n = len(a) // 2
    return a[n:-1, n:-1]


def emulator_of_walks(
    device: Device, priors: tuple[Prior, ...], keep: Path, cells: int = 8
) -> LinearEmulator:
    """Tangent of the device's own walks, half a spread to either side."""

    def edges(values):
        there = device_at(device, Condition(), priors, values)
        return walk(there, cells=cells, keep=keep).edges(None, 173.0)

    middle = np.array([prior.mean for prior in priors])
    slopes = []
    for n, prior in enumerate(priors):
        step = np.zeros(len(priors))
        step[n] = 0.5 * prior.spread
        up, down = edges(middle + step), edges(middle - step)
        slopes.append([(u - d) / prior.spread for u, d in zip(up, down, strict=True)])
    both = edges(middle)
    return LinearEmulator(
        tuple(prior.name for prior in priors), middle, both,
        (np.array([s[0] for s in slopes]), np.array([s[1] for s in slopes])),
    )  # fmt: skip
