"""Boundary shifts of a device at values of its parameters, solved without derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import Prior
from bfsensor.fit.device_at import device_at, stretch_at
from bfsensor.fit.linear_response import LinearEmulator, LinearResponse, level_of
from bfsensor.response.emulator_nodes import Node, solve_nodes
from bfsensor.response.light import conversion_depths, mixed
from bfsensor.typing import FloatArray

Shifts = tuple[FloatArray, FloatArray]
"""Shifts (kx, ky) of right and of upper edges [pixel/e-]."""


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
    """Solve for the shifts at all conditions; those that differ in wavelength share a solution.

    Parameters
    ----------
    device : Device
        Nominal device; its mesh is distorted with the parameters, not made again.
    priors : sequence of Prior
        Free parameters.
    values : ndarray, shape (p,)
        Their values [internal units].
    conditions : sequence of Condition
        Conditions of the measurements.
    cells, refine_z : int
        Mesh cells per pixel, even, and number of halvings in z.
    keep : Path, optional
        Folder that caches finished solutions, by a digest of version, device, mesh and level.
    progress : callable, optional
        Called with (solved, in all).

    Returns
    -------
    shifts : dict of Condition to (ndarray, ndarray)
        (kx, ky) [pixel/e-], [row dy, column dx].

    Raises
    ------
    FitError
        No device has these values.
    """
    devices: dict[Condition, tuple[Device, str]] = {}
    nodes: dict[str, Node] = {}
    for condition in dict.fromkeys(conditions):
        here = device_at(device, condition, priors, values)
        node = Node(
            here.physics, device_at(device, condition).physics, level_of(condition), cells,
            refine_z, (), (), (len(nodes), -1, 0),
        )  # fmt: skip
        devices[condition] = here, node.key
        nodes.setdefault(node.key, node)
    found = solve_nodes(list(nodes.values()), keep=keep, progress=progress, executor=None)
    out = {}
    for condition, (here, key) in devices.items():
        kx, ky = found[nodes[key].at][0]
        out[condition] = mixed(
            kx, ky, np.array(conversion_depths(here)), condition.wavelength,
            here.operating_point.temperature, stretch_at(priors, values),
        )  # fmt: skip
    return out


@dataclass(frozen=True, eq=False)
class FullSolutions:
    """Function that solves a device at values of its parameters; its emulator is valid there only.

    Attributes
    ----------
    device : Device
        Nominal device of the fit.
    priors : tuple of Prior
        All free parameters, in the order of the values.
    conditions : tuple of Condition
        All conditions for which predictions are made.
    cells, refine_z : int
        Mesh cells per pixel, even, and number of halvings in z.
    keep : Path, optional
        Folder that caches finished solutions.
    """

    device: Device
    priors: tuple[Prior, ...]
    conditions: tuple[Condition, ...]
    cells: int
    refine_z: int
    keep: Path | None = None

    def __call__(self, values: FloatArray) -> LinearEmulator:
        """Solve at the values of all free parameters [internal units], shape (p,)."""
        shifts = solve_shifts(
            self.device, self.priors, values, self.conditions, cells=self.cells,
            refine_z=self.refine_z, keep=self.keep,
        )  # fmt: skip
        responses = {}
        for condition, (x, y) in shifts.items():
            none = np.zeros((0, *x.shape))
            responses[condition] = LinearResponse(x, y, none, none)
        return LinearEmulator((), np.zeros(0), responses)
