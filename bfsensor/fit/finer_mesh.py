"""What is predicted on the mesh of a fit, carried to a finer one wherever the device is solved.

On 16 cells a pixel a_01 is 4 % (ITL) and 9 % (E2V) above that on 64, more than the errors of a fit,
whose parameters would follow the mesh; by how much changes with the parameters (E2V, above that on
32: 7 % at the priors, 6 % where the fit ends, 2 % at a random draw).  Derivatives on the finer mesh
would cost some ten times as much as on the fit's own, the solution alone less than those.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import bfsensor
from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import Prior
from bfsensor.errors import FitError
from bfsensor.fit.full_solutions import Shifts, solve_shifts
from bfsensor.fit.linear_response import LinearResponse
from bfsensor.fit.predictors import Emulator
from bfsensor.response.edge_response import LEVEL
from bfsensor.typing import FloatArray

FINER = 48
"""Cells a pixel of the finer mesh: at the nearest lags within 0.6 % (ITL) and 1.1 % (E2V) of 64,
where 32 are within 2.2 %, in 8 CPU s and 1 GB a condition."""

REFINE_Z = 0
"""Halvings in z of the finer mesh: one changes the lags by 0.1 % on 48 cells, for twice the time;
what it does to derivatives does not matter here."""


@dataclass(frozen=True, eq=False)
class FinerEmulator:
    """An emulator whose shifts have the finer mesh's added less its own at one set of values.

    Derivatives are the emulator's.
    """

    emulator: Emulator
    added: Mapping[Condition, Shifts]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Dotted names."""
        return tuple(self.emulator.parameters)

    def predict(self, values: FloatArray, condition: Condition) -> LinearResponse:
        """Response at parameters and a condition, one of those that it was made for."""
        if condition not in self.added:
            raise FitError(f"no response was solved at {condition}")
        found, (x, y) = self.emulator.predict(values, condition), self.added[condition]
        return LinearResponse(found.kx + x, found.ky + y, found.dkx, found.dky)


@dataclass(frozen=True, eq=False)
class Finer:
    """Solves a device as another does, with its shifts, and so areas and slopes, on a finer mesh.

    In place of the other as ``linearise`` of :func:`~bfsensor.fit.fit.fit_device`: each round of the
    fit then ends on the finer mesh, whatever the parameters.

    Attributes
    ----------
    linearise : callable
        What solves the device at values of all free parameters.
    device : Device
        About which the fit is; its finer mesh, too, is moved with the parameters.
    priors : tuple of Prior
        Of all free parameters, in the order of the values.
    conditions : tuple of Condition
        All that will be asked for.
    cells, coarse : int
        Of the finer mesh and of that of the fit, a pixel; for what is written down.
    keep : Path, optional
        Folder that keeps finished solutions, by a digest of version, device, mesh and level.
    progress : callable, optional
        Called with (solved, in all).
    ratios : list
        Finer over own a_ij of every call, by condition; in the order of the calls.
    """

    linearise: Callable[[FloatArray], Emulator]
    device: Device
    priors: tuple[Prior, ...]
    conditions: tuple[Condition, ...]
    cells: int = FINER
    coarse: int = 16
    keep: Path | None = None
    progress: Callable[[int, int], None] | None = None
    ratios: list[tuple[FloatArray, dict[Condition, FloatArray]]] = field(
        default_factory=list
    )

    def __post_init__(self) -> None:
        if self.cells <= self.coarse or self.cells % 2:
            raise FitError(
                f"finer = {self.cells} cells a pixel must be even and above the {self.coarse} of "
                "the fit"
            )

    def __call__(self, values: FloatArray) -> FinerEmulator:
        """Solve on both meshes at values [internal units], shape (p,)."""
        values = np.asarray(values, float)
        emulator = self.linearise(values)
        names = [prior.name for prior in self.priors]
        own = np.array([values[names.index(name)] for name in emulator.parameters])
        added, ratios = {}, {}
        for condition, (x, y) in self._solved(values).items():
            before = emulator.predict(own, condition)
            added[condition] = x - before.kx, y - before.ky
            after = LinearResponse(x, y, before.dkx, before.dky)
            ratios[condition] = after.areas / np.asarray(before.areas)
        self.ratios.append((values, ratios))
        return FinerEmulator(emulator, added)

    def _solved(self, values: FloatArray) -> dict[Condition, Shifts]:
        """Shifts on the finer mesh."""
        return solve_shifts(
            self.device, self.priors, values, self.conditions, cells=self.cells,
            refine_z=REFINE_Z, keep=self.keep, progress=self.progress,
        )  # fmt: skip

    def record(self, values: FloatArray) -> dict[str, Any]:
        """Give what is to be kept with a fit that ended at these values: meshes and ratios.

        The ratios are those of the nearest solution, in spreads of the priors.

        Raises
        ------
        FitError
            Nothing was solved.
        """
        if not self.ratios:
            raise FitError("nothing was solved on the finer mesh")
        spreads = np.array([prior.spread for prior in self.priors])
        near = [np.sum(((there - values) / spreads) ** 2) for there, _ in self.ratios]
        first, last = self.ratios[0][1], self.ratios[int(np.argmin(near))][1]
        return {
            "cells": self.coarse, "finer": self.cells, "finer_refine_z": REFINE_Z,
            "level": LEVEL, "version": bfsensor.__version__, "solutions": len(self.ratios),
            "ratios": [
                {
                    "condition": str(condition), "finer_over_own": ratio.tolist(),
                    "at_the_priors": first[condition].tolist(),
                }
                for condition, ratio in last.items()
            ],
        }  # fmt: skip


TOLD = ((1, 0), (0, 1), (1, 1))
"""Lags (i, j) whose ratios are told."""


def say(record: Mapping[str, Any]) -> str:
    """Put a record in a sentence, with the ratios of its first condition."""
    one, more = record["ratios"][0], len(record["ratios"]) - 1
    lags = ", ".join(
        f"({i},{j}) {one['finer_over_own'][j][i]:.3f} ({one['at_the_priors'][j][i]:.3f})"
        for i, j in TOLD
    )
    return (
        f"a_ij and slopes are those of {record['finer']} cells a pixel, their derivatives of "
        f"{record['cells']}; finer over own a_ij where the fit ends (at the priors): {lags}"
        + (f"; {more} more conditions in fit.json" if more else "")
    )
