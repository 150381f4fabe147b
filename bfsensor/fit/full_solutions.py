"""Responses of a device at values of its parameters, solved without derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import Prior
from bfsensor.fit.device_at import device_at
from bfsensor.fit.linear_response import LinearEmulator, LinearResponse
from bfsensor.response.edge_response import LEVEL, mixed, response_depths
from bfsensor.response.emulator_nodes import Node, solve_nodes
from bfsensor.typing import FloatArray

Shifts = tuple[FloatArray, FloatArray]
"""Of right and of upper edges [pixel/e-]."""


def solve_shifts(
    device: Device,
    priors: Sequence[Prior],
    values: FloatArray,
    conditions: Sequence[Condition],
    *,
    cells: int,
    refine_z: int,
    keep: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[Condition, Shifts]:
    """Solve for the shifts; conditions that differ in wavelength share a solution.

    Parameters
    ----------
    device : Device
        Whose mesh is moved with the parameters.
    priors, values
        Of all free parameters [internal units].
    conditions : sequence of Condition
        At which.
    cells, refine_z : int
        Of the mesh.
    keep : Path, optional
        Folder that keeps finished solutions, by a digest of version, device, mesh and level.
    progress : callable, optional
        Called with (solved, in all).
    """
    devices: dict[Condition, tuple[Device, str]] = {}
    nodes: dict[str, Node] = {}
    for condition in dict.fromkeys(conditions):
        here = device_at(device, condition, priors, values)
        node = Node(
            here.physics, device_at(device, condition).physics, LEVEL, cells, refine_z, (), (),
            (len(nodes), -1, 0),
        )  # fmt: skip
        devices[condition] = here, node.key
        nodes.setdefault(node.key, node)
    found = solve_nodes(list(nodes.values()), keep=keep, progress=progress, executor=None)
    out = {}
    for condition, (here, key) in devices.items():
        kx, ky = found[nodes[key].at][0]
        out[condition] = mixed(
            kx, ky, np.array(response_depths(here)), condition.wavelength,
            here.operating_point.temperature,
        )  # fmt: skip
    return out


@dataclass(frozen=True, eq=False)
class FullSolutions:
    """Solves a device at values of its parameters: an emulator for these alone.

    Attributes
    ----------
    device : Device
        About which the fit is.
    priors : tuple of Prior
        Of all free parameters, in the order of the values.
    conditions : tuple of Condition
        All that will be asked for.
    cells, refine_z : int
        Of the mesh.
    keep : Path, optional
        Folder that keeps finished solutions.
    """

    device: Device
    priors: tuple[Prior, ...]
    conditions: tuple[Condition, ...]
    cells: int
    refine_z: int
    keep: Path | None = None

    def __call__(self, values: FloatArray) -> LinearEmulator:
        """Solve at values [internal units], shape (p,)."""
        shifts = solve_shifts(
            self.device, self.priors, values, self.conditions, cells=self.cells,
            refine_z=self.refine_z, keep=self.keep,
        )  # fmt: skip
        responses = {}
        for condition, (x, y) in shifts.items():
            none = np.zeros((0, *x.shape))
            responses[condition] = LinearResponse(x, y, none, none)
        return LinearEmulator((), np.zeros(0), responses)
