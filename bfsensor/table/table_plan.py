"""Plan of a distortion table: its levels, checked against the device, with defaults filled in."""

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
from bfsensor.response.light import conversion_depths, storage_height
from bfsensor.response.periodic_images import PERIOD
from bfsensor.simulate.well import full_well

if TYPE_CHECKING:
    from bfsensor.device.device import Device

ACCURACIES = {0.05: 16, 0.02: 24, 0.01: 32, 0.005: 48}
"""Cells a pixel for an accuracy aimed at in the nearest area changes.

Measured against 64 cells for the two LSST devices
(``python -m validation.boundaries.convergence``): at 32 cells 0.2 % or less at the
centre, 0.5 % at (0, 1), 0.1 % at (1, 1), and at (1, 0) 0.1 % (ITL) and 1.1 % (E2V)."""

CHARGE_FRACTIONS = (0.03, 0.15, 0.35, 0.55, 0.75, 0.9)
"""Source charges of a table beside 0, in full wells.

Chosen: closer at small charges, where the response changes fastest with the charge.  They end
below the full well; sensors hold the response of the last level up to it."""

BACKGROUND_FRACTIONS = (0.0, 0.25, 0.5, 0.8)
"""Charges of all other pixels in a table, in full wells.

Chosen: the response varies more slowly with the background than with the charge; twice as many
levels would take twice as long."""


@dataclass(frozen=True)
class TablePlan:
    """Everything that determines the numbers of a table.

    Attributes
    ----------
    device : Device
        Mirror-symmetric device, fully depleted.
    charges, backgrounds : tuple of float
        Source charges and charges of all other pixels [e-], ascending, up to the full well.
    depths : tuple of float
        Conversion depths [um above the gates], ascending.
    vertices : int
        Vertices a side between the corners.
    reach : int
        Largest pixel offset.
    cells : int
        Mesh cells a pixel.
    refine_z : int
        Further halvings of the mesh in z.
    full_well : float
        Charge at which a pixel spills along its column [e-].

    Examples
    --------
    >>> from bfsensor import Device
    >>> plan_table(Device.load("itl_sta3800c"), pixels=5).reach
    2
    """

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
        """Digest of all inputs of the levels and of the version, which names checkpoints."""
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
    """Plan a distortion table: check the levels against the device and fill in defaults.

    Parameters
    ----------
    device : Device
        Device that is mirror-symmetric in x and y and fully depleted.
    charges : sequence of float, optional
        Source charges [e-], ascending, from 0 to the full well; by default zero and
        :data:`CHARGE_FRACTIONS` of the full well, rounded to two digits.
    backgrounds : sequence of float, optional
        Charges of all other pixels [e-], ascending, from 0 to the full well; by default
        :data:`BACKGROUND_FRACTIONS` of the full well, rounded to two digits.
    depths : sequence of float, optional
        Conversion depths [um above the gates], ascending, from the height of the stored charge
        to the thickness; by default :func:`~bfsensor.response.light.conversion_depths`.
    vertices : int
        Vertices a side between the corners, at least 2.
    pixels : int
        Width of the table [pixel], odd, 3 to 11.
    accuracy : float
        Wanted relative accuracy of the nearest area changes, at least 0.005; it sets the mesh
        (:data:`ACCURACIES`).
    refine_z : int
        Further halvings of the mesh in z.

    Returns
    -------
    TablePlan
        Plan with the device's full well, which is solved for here (about 1 s).

    Raises
    ------
    TableError
        A level outside the device, levels that do not ascend, or another value that is not
        allowed; the message names the limit.
    DeviceError
        The back bias does not fully deplete the device.

    Examples
    --------
    >>> from bfsensor import Device
    >>> plan_table(Device.load("itl_sta3800c"), accuracy=0.02).cells
    24
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
    if not fitting or not np.isfinite(accuracy):
        raise TableError(
            f"accuracy = {accuracy:g} must be finite and at least {min(ACCURACIES):g}"
        )
    cells = min(fitting)
    # What needs no solution is refused before the full well is solved.
    for name, values in (
        ("charge", charges),
        ("background", backgrounds),
        ("depth", depths),
    ):
        _check_levels(name, values)
    low, high = storage_height(device), device.silicon.thickness
    for depth in depths or ():
        if not low - 1e-9 <= depth <= high:
            raise TableError(
                f"depth = {depth:g} um must lie in the silicon of {device.name}, from "
                f"{low:g} um, where charge is stored, to {high:g} um, the back surface"
            )
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
    if depths is None:
        depths = conversion_depths(device)
    return TablePlan(
        device, tuple(map(float, charges)), tuple(map(float, backgrounds)),
        tuple(map(float, depths)), vertices, pixels // 2, cells, refine_z, well,
    )  # fmt: skip


def _check_levels(name: str, values: Sequence[float] | None) -> None:
    """Refuse levels of a table that are not finite, below 0, or do not ascend."""
    if values is None:
        return
    for value in values:
        if not 0 <= value < np.inf:
            raise TableError(f"{name} = {value:g} must be a finite number from 0 on")
    if len(values) < 1 or any(b <= a for a, b in pairwise(values)):
        raise TableError(f"{name}s {list(values)} must ascend")


def _round(charge: float) -> float:
    """Round a charge to two digits, so that the levels of a table are easy to read."""
    if charge <= 0:
        return 0.0
    digits = 1 - int(np.floor(np.log10(charge)))
    return float(round(charge, digits))
