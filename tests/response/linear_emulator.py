"""An emulator that is linear in the parameters, made of given arrays."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bfsensor.response.edge_response import area_matrix


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
    """Shifts linear in the parameters; areas are those of the shifts."""

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
