"""Predicted shifts corrected to a finer mesh, wherever a fit solves the device.

On 16 cells per pixel a_01 is 4 % (ITL) and 9 % (E2V) larger than on 64, which exceeds the errors of a
fit and would bias its parameters.  The ratio depends on the parameters (E2V, relative to 32 cells: 7 %
at the priors, 6 % at the fitted values, 2 % at a random draw), so that it is solved again in each
round.  Derivatives on the finer mesh would cost about ten times those of the fit's own mesh; the
solution alone costs less than those.
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
from bfsensor.fit.linear_response import LinearEmulator, LinearResponse, level_of
from bfsensor.fit.predictors import Emulator
from bfsensor.typing import FloatArray

FINER = 48
"""Cells per pixel of the finer mesh.

Chosen: at the nearest lags within 0.6 % (ITL) and 1.1 % (E2V) of 64 cells, in 8 CPU s and 1 GB for
each condition, where 32 cells are within 2.2 %; twice as large takes at least four times both."""

REFINE_Z = 0
"""Number of halvings in z of the finer mesh.

Chosen: one halving changes a_ij by 0.1 % on 48 cells and doubles the time; derivatives, which would
need it, are not taken on this mesh."""


DRAWN = 32
"""Cells per pixel on which draws from the posterior are solved, at most those of the finer mesh.

Chosen: only what they add to the difference at the solution counts, in a variance that 12 draws give
to 41 %; with 48 cells a draw takes 2.5 times as long."""


@dataclass(frozen=True, eq=False)
class FinerEmulator:
    """Emulator plus the difference of shifts between the finer and its own mesh at one point.

    Attributes
    ----------
    emulator : Emulator
        Emulator on the mesh of the fit, which gives the derivatives too.
    added : mapping of Condition to (ndarray, ndarray)
        Shifts (kx, ky) on the finer mesh minus those of the emulator [pixel/e-].
    """

    emulator: Emulator
    added: Mapping[Condition, Shifts]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Dotted names."""
        return tuple(self.emulator.parameters)

    def predict(self, values: FloatArray, condition: Condition) -> LinearResponse:
        """Predict the response at parameters [internal units] and one of the solved conditions."""
        if condition not in self.added:
            raise FitError(
                f"no response was solved at {condition}; solved were {', '.join(map(str, self.added))}"
            )
        found, (x, y) = self.emulator.predict(values, condition), self.added[condition]
        return LinearResponse(found.kx + x, found.ky + y, found.dkx, found.dky)


@dataclass(frozen=True, eq=False)
class Finer:
    """Wrapper of ``linearise`` whose predicted shifts are those of a finer mesh.

    :func:`~bfsensor.fit.fit.fit_device` takes it as ``linearise``: each round of the fit then ends at
    the solution on the finer mesh, with derivatives of the coarser one.

    Attributes
    ----------
    linearise : callable
        Function that solves the device and its derivatives at values of all free parameters.
    device : Device
        Nominal device of the fit; its finer mesh is distorted with the parameters too.
    priors : tuple of Prior
        All free parameters, in the order of the values.
    conditions : tuple of Condition
        All conditions for which predictions are made.
    cells, coarse : int
        Cells per pixel of the finer mesh, even, and of the mesh of the fit, for the record.
    keep : Path, optional
        Folder that caches finished solutions, by a digest of version, device, mesh and level.
    progress : callable, optional
        Called with (solved, in all).
    ratios : list
        For every call, its values and the ratios of a_ij on both meshes by condition.

    Raises
    ------
    FitError
        The number of cells is odd, or not above that of the fit.
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
    _last: dict[str, dict[Condition, Shifts]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        if self.cells <= self.coarse or self.cells % 2:
            raise FitError(
                f"finer = {self.cells} cells per pixel must be even and above the {self.coarse} of "
                "the fit"
            )

    def __call__(self, values: FloatArray) -> FinerEmulator:
        """Solve on both meshes at the values of all free parameters [internal units], shape (p,)."""
        values = np.asarray(values, float)
        emulator = self.linearise(values)
        names = [prior.name for prior in self.priors]
        own = np.array([values[names.index(name)] for name in emulator.parameters])
        added, ratios = {}, {}
        shifts = self._solved(values, self.cells)
        self._last.clear()
        self._last["finer"] = shifts
        for condition, (x, y) in shifts.items():
            before = emulator.predict(own, condition)
            added[condition] = x - before.kx, y - before.ky
            after = LinearResponse(x, y, before.dkx, before.dky)
            ratios[condition] = after.areas / np.asarray(before.areas)
        self.ratios.append((values, ratios))
        return FinerEmulator(emulator, added)

    def at_draw(self, values: FloatArray) -> LinearEmulator:
        """Solve at a draw from the posterior, without derivatives.

        It is solved on :data:`DRAWN` cells; what the finer mesh adds is taken from the solution at
        the last values that this object was called with.

        Parameters
        ----------
        values : ndarray, shape (p,)
            All free parameters [internal units].

        Raises
        ------
        FitError
            No solution was made yet.
        """
        if not self.ratios:
            raise FitError("nothing was solved on the finer mesh")
        cells = min(DRAWN, self.cells)
        if "drawn" not in self._last:
            self._last["drawn"] = self._solved(self.ratios[-1][0], cells)
        responses = {}
        for condition, (x, y) in self._solved(np.asarray(values, float), cells).items():
            fine, less = self._last["finer"][condition], self._last["drawn"][condition]
            none = np.zeros((0, *x.shape))
            moved = x + fine[0] - less[0], y + fine[1] - less[1]
            responses[condition] = LinearResponse(*moved, none, none)
        return LinearEmulator((), np.zeros(0), responses)

    def _solved(self, values: FloatArray, cells: int) -> dict[Condition, Shifts]:
        """Shifts on a mesh of given cells per pixel."""
        return solve_shifts(
            self.device, self.priors, values, self.conditions, cells=cells,
            refine_z=REFINE_Z, keep=self.keep, progress=self.progress,
        )  # fmt: skip

    def record(self, values: FloatArray) -> dict[str, Any]:
        """Give the record of the meshes for a fit that ended at these values [internal units].

        Its ratios of a_ij are those of the nearest solution, in widths of the priors, and those of
        the first one.

        Raises
        ------
        FitError
            No solution was made yet.
        """
        if not self.ratios:
            raise FitError("nothing was solved on the finer mesh")
        spreads = np.array([prior.spread for prior in self.priors])
        near = [np.sum(((there - values) / spreads) ** 2) for there, _ in self.ratios]
        first, last = self.ratios[0][1], self.ratios[int(np.argmin(near))][1]
        return {
            "cells": self.coarse, "finer": self.cells, "finer_refine_z": REFINE_Z,
            "level": sorted({level_of(c) for c in self.conditions}),
            "version": bfsensor.__version__, "solutions": len(self.ratios),
            "ratios": [
                {
                    "condition": str(condition), "finer_over_own": ratio.tolist(),
                    "at_the_priors": first[condition].tolist(),
                }
                for condition, ratio in last.items()
            ],
        }  # fmt: skip


TOLD = ((1, 0), (0, 1), (1, 1))
"""Lags (i, j) whose ratios the note states.  Chosen: the nearest; fit.json holds all."""


def say(record: Mapping[str, Any]) -> str:
    """Give the note on a record of :meth:`Finer.record`, with the ratios of its first condition."""
    one, more = record["ratios"][0], len(record["ratios"]) - 1
    lags = ", ".join(
        f"({i},{j}) {one['finer_over_own'][j][i]:.3f} ({one['at_the_priors'][j][i]:.3f})"
        for i, j in TOLD
    )
    return (
        f"a_ij and slopes are solved on {record['finer']} cells per pixel, their derivatives on "
        f"{record['cells']}; ratio of a_ij on both meshes at the fit (at the priors): {lags}"
        + (f"; {more} more conditions in fit.json" if more else "")
    )
