"""What a distortion table is to hold: checked against the device, defaults filled in."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

import bfsensor
from bfsensor.device.depletion import check_depleted
from bfsensor.errors import TableError
from bfsensor.response.periodic_images import PERIOD
from bfsensor.simulate.boundaries import SPLIT_HEIGHT
from bfsensor.simulate.mesh import Surfaces
from bfsensor.simulate.well import full_well

if TYPE_CHECKING:
    from bfsensor.device.device import Device

ACCURACIES = {0.05: 16, 0.02: 24, 0.01: 32, 0.005: 48}
"""Cells a pixel for an accuracy aimed at in the nearest area changes.

Measured against 64 cells for the two LSST devices
(``python -m validation.boundaries.convergence``): at 32 cells 0.2 % or less at the
centre, 0.5 % at (0, 1), 0.1 % at (1, 1), and at (1, 0) 0.1 % (ITL) and 1.1 % (E2V)."""

CHARGE_FRACTIONS = (0.03, 0.15, 0.35, 0.55, 0.75, 0.9)
"""Source charges of a table in full wells; the response bends most at small charges."""

BACKGROUND_FRACTIONS = (0.0, 0.25, 0.5, 0.8)
"""Background charges of a table in full wells."""

STORAGE_DEPTH = 0.3
"""Depth of the stored charge below the channel's silicon surface [um].

The mean depth of the electrons is 0.25 to 0.36 um in the four built-in devices from 20,000 to
150,000 e- (tests); a device with deeper implants stores deeper, and its table's lowest level
is then too low by that much."""


@dataclass(frozen=True)
class TablePlan:
    """Everything that determines a table's numbers."""

    device: Device
    charges: tuple[float, ...]
    backgrounds: tuple[float, ...]
    depths: tuple[float, ...]
    vertices: int
    reach: int
    cells: int
    refine_z: int
    full_well: float

    @property
    def key(self) -> str:
        """Digest that changes with anything that would change a level."""
        text = json.dumps(
            [
                bfsensor.__version__,
                self.device.physics,
                self.charges,
                self.backgrounds,
                self.depths,
                self.vertices,
                self.reach,
                self.cells,
                self.refine_z,
            ]
        )
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def default_depths(device: Device) -> tuple[float, ...]:
    """Seven conversion depths [um above the gates], from the stored charge to the light side.

    At the first, the height of the charge (0.3 um into the silicon of the channel), nothing
    moves; the second is the lowest at which every electron's well is well defined.  The
    response rises over one pixel pitch and is nearly flat beyond four.
    """
    surfaces = Surfaces.of(device)
    thickness = device.silicon.thickness
    pitch = 0.5 * (device.pixel.pitch_x + device.pixel.pitch_y)
    deepest = max(surfaces.silicon_channel, surfaces.silicon_stop)
    low = (deepest + 2.0, deepest + SPLIT_HEIGHT)
    inner = [
        d for d in (pitch, 2.0 * pitch, 4.0 * pitch) if low[1] + 1 < d < 0.8 * thickness
    ]
    return (storage_height(device), *low, *inner, thickness)


def storage_height(device: Device) -> float:
    """Height above the gates [um] at and below which boundaries are taken as fixed.

    Where the charge is stored, :data:`STORAGE_DEPTH` into the silicon of the channel.
    """
    return Surfaces.of(device).silicon_channel + STORAGE_DEPTH


def plan_table(
    device: Device,
    *,
    charges: Sequence[float] | None = None,
    backgrounds: Sequence[float] | None = None,
    depths: Sequence[float] | None = None,
    vertices: int = 32,
    pixels: int = 9,
    accuracy: float = 0.01,
    refine_z: int = 0,
) -> TablePlan:
    """Check a request against the device and fill in what was left open.

    Parameters
    ----------
    device : Device
        Mirror-symmetric in x and y.
    charges : sequence of float, optional
        Source charges [e-]; by default zero and :data:`CHARGE_FRACTIONS` of the full well.
    backgrounds : sequence of float, optional
        Charge of all other pixels [e-]; by default :data:`BACKGROUND_FRACTIONS`.
    depths : sequence of float, optional
        Conversion depths [um above the gates]; by default :func:`default_depths`.
    vertices : int
        Vertices a side between the corners.
    pixels : int
        Width of the table [pixel], odd.
    accuracy : float
        Wanted accuracy of area changes, relative; sets the mesh (:data:`ACCURACIES`).
    refine_z : int
        Further halvings of the mesh in z.

    Returns
    -------
    TablePlan

    Raises
    ------
    TableError
        Something does not fit; says the limit.
    DeviceError
        The back bias does not fully deplete the device.
    """
    if not device.is_mirror_symmetric:
        raise TableError(
            f"{device.name}: a table needs a device that is mirror-symmetric about a pixel "
            "(no ripples, no edge, centred dots)"
        )
    if pixels % 2 == 0 or not 3 <= pixels <= PERIOD - 1:
        raise TableError(f"pixels = {pixels} must be odd and from 3 to {PERIOD - 1}")
    if vertices < 2:
        raise TableError(f"vertices = {vertices} must be at least 2 a side")
    fitting = [
        cells for limit, cells in ACCURACIES.items() if limit <= accuracy * (1 + 1e-9)
    ]
    if not fitting:
        raise TableError(f"accuracy = {accuracy:g} must be at least {min(ACCURACIES):g}")
    cells = min(fitting)
    check_depleted(device, depths or ())
    well = full_well(device)
    if charges is None:
        charges = (0.0, *(_round(f * well) for f in CHARGE_FRACTIONS))
    if backgrounds is None:
        backgrounds = tuple(_round(f * well) for f in BACKGROUND_FRACTIONS)
    for name, values in (("charge", charges), ("background", backgrounds)):
        for value in values:
            if not 0 <= value <= well:
                raise TableError(
                    f"{name} = {value:g} e- must be from 0 to the full well of "
                    f"{device.name}, {well:.6g} e-, where the barrier along the column "
                    f"falls to {device.well.spill_barrier:g} V"
                )
        if len(values) < 1 or any(b <= a for a, b in pairwise(values)):
            raise TableError(f"{name}s {list(values)} must ascend")
    if depths is None:
        depths = default_depths(device)
    low, high = storage_height(device), device.silicon.thickness
    for depth in depths:
        if not low - 1e-9 <= depth <= high:
            raise TableError(
                f"depth = {depth:g} um must lie in the silicon of {device.name}, from "
                f"{low:g} um, where charge is stored, to {high:g} um, the back surface"
            )
    if any(b <= a for a, b in pairwise(depths)):
        raise TableError(f"depths {list(depths)} must ascend")
    return TablePlan(
        device, tuple(map(float, charges)), tuple(map(float, backgrounds)),
        tuple(map(float, depths)), vertices, pixels // 2, cells, refine_z, well,
    )  # fmt: skip


def _round(charge: float) -> float:
    """Round to two digits: a table's levels are meant to be read."""
    if charge <= 0:
        return 0.0
    digits = 1 - int(np.floor(np.log10(charge)))
    return float(round(charge, digits))
