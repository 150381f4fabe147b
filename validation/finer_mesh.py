"""Areas on the mesh of a fit, made those of a finer mesh by their ratio for the unfitted device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.device import Device
from bfsensor.fit.linearised import Linearise
from bfsensor.recording.exposures import Condition
from bfsensor.resources import tables_dir
from bfsensor.response import CHARGE, LEVEL
from bfsensor.table import DistortionTable


@dataclass(frozen=True)
class _FinerResponse:
    """A response whose areas are multiplied by what a finer mesh gives of the unfitted device."""

    response: Any
    ratio: NDArray[np.float64]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.response, name)

    @property
    def areas(self) -> NDArray[np.float64]:
        """By lag."""
        return np.asarray(self.response.areas * self.ratio)

    @property
    def jacobian(self) -> NDArray[np.float64]:
        """By parameter and lag."""
        return np.asarray(self.response.jacobian * self.ratio)


@dataclass(frozen=True)
class Finer:
    """Solves a device as ``linearise`` does, its areas multiplied by a ratio of each condition.

    On 16 cells a_01 is 5 % (ITL) and 8 % (E2V) above that of the shipped tables, made on 32, and
    a_10 of the E2V device 8 % below: more than the errors of the fit.  A finer mesh for every
    round would cost ten times as much; what the mesh does is taken to be the same along the fit.
    Shifts, which slopes are made of, are left as they are.
    """

    linearise: Linearise
    ratios: Mapping[Condition, NDArray[np.float64]]

    def __call__(self, values: NDArray[np.float64]) -> Any:
        """Solve at values of the parameters."""
        return _FinerEmulator(self.linearise(values), self.ratios)


@dataclass(frozen=True)
class _FinerEmulator:
    emulator: Any
    ratios: Mapping[Condition, NDArray[np.float64]]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Dotted names."""
        return tuple(self.emulator.parameters)

    def predict(self, values: NDArray[np.float64], condition: Condition) -> Any:
        """Response with corrected areas."""
        return _FinerResponse(
            self.emulator.predict(values, condition), self.ratios[condition]
        )


def coarse_areas(device: Device, condition: Condition, cells: int) -> NDArray[np.float64]:
    """a_ij of the unfitted device on the mesh of the fit, [j, i] to lag 4."""
    found = Linearise(device, (), (condition,), cells)(np.empty(0))
    return np.asarray(found.predict(np.empty(0), condition).areas)


def table_areas(name: str) -> NDArray[np.float64]:
    """The same of its shipped table, on 32 cells a pixel."""
    table = DistortionTable.read(tables_dir() / name / "table.fits")
    change = table.area_changes(
        charge=LEVEL + CHARGE, background=LEVEL, depth=table.thickness
    )
    return change[table.reach :, table.reach :] / (CHARGE * table.pitch[0] * table.pitch[1])
