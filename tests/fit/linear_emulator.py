"""Emulators that are straight in the parameters: of given arrays, and of our device's tangents."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bfsensor import Device
from bfsensor.fit.changing import device_at
from bfsensor.fit.quantities import Prior
from bfsensor.recording.exposures import Condition
from bfsensor.response import area_matrix, solve_response


@dataclass(frozen=True)
class LinearResponse:
    kx: NDArray
    ky: NDArray
    dkx: NDArray
    dky: NDArray
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
        return LinearResponse(kx, ky, *self.slopes, quadrant(kx, ky), np.array(rows))


def quadrant(kx, ky):
    a = area_matrix(kx, ky)
    n = len(a) // 2
    return a[n:-1, n:-1]


def emulator_of_tangents(
    device: Device, priors: tuple[Prior, ...], *, condition: Condition, cells: int = 8
) -> LinearEmulator:
    """Tangent of the device's own response at one condition."""
    middle = np.array([prior.mean for prior in priors])
    here = device_at(device, condition)
    changed = []
    for n, prior in enumerate(priors):
        # To the one side where the other is no device: oxides of equal thickness.
        step = 1e-3 * prior.spread * (-1 if prior.name == "gates.gate_oxide" else 1)
        changed.append((device_at(here, Condition(), (prior,), middle[[n]] + step), step))
    found = solve_response(here, cells=cells, changed=changed)
    return LinearEmulator(
        tuple(prior.name for prior in priors), middle, (found.kx[-1], found.ky[-1]),
        (found.dkx[:, -1], found.dky[:, -1]),
    )  # fmt: skip
