"""An emulator on a coarse mesh, put right at one device by a solution on a fine one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bfsensor.device import Device
from bfsensor.fit.changing import device_at
from bfsensor.fit.predictors import Emulator, Response, held
from bfsensor.fit.quantities import Prior
from bfsensor.recording.exposures import Condition
from bfsensor.response import area_matrix, solve_response

CELLS = 32
"""Of the fine mesh, a pixel: shipped tables have it."""

Edges = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class FinerResponse:
    """Response of the coarse mesh with what the fine one adds at one device."""

    coarse: Response
    added: Edges

    @property
    def kx(self) -> NDArray[np.float64]:
        """Shifts of right edges [pixel/e-]."""
        return self.coarse.kx + self.added[0]

    @property
    def ky(self) -> NDArray[np.float64]:
        """Shifts of upper edges [pixel/e-]."""
        return self.coarse.ky + self.added[1]

    @property
    def dkx(self) -> NDArray[np.float64]:
        """By parameter, as the coarse mesh has them."""
        return self.coarse.dkx

    @property
    def dky(self) -> NDArray[np.float64]:
        """By parameter, as the coarse mesh has them."""
        return self.coarse.dky

    @cached_property
    def areas(self) -> NDArray[np.float64]:
        """a_ij [1/e-]."""
        coarse = np.asarray(self.coarse.areas)
        a = area_matrix(*self.added)
        n = a.shape[-1] // 2
        ny, nx = coarse.shape
        return np.asarray(coarse + a[n : n + ny, n : n + nx])

    @property
    def jacobian(self) -> NDArray[np.float64]:
        """By parameter and lag, as the coarse mesh has it."""
        return self.coarse.jacobian


class FinerEmulator:
    """An emulator plus, at each condition, fine less coarse shifts of one device.

    Parameters
    ----------
    emulator : Emulator
        On a coarse mesh.
    added : dict
        By condition.
    """

    def __init__(self, emulator: Emulator, added: dict[Condition, Edges]) -> None:
        self._emulator, self._added = emulator, added

    @property
    def parameters(self) -> Sequence[str]:
        """Dotted names."""
        return self._emulator.parameters

    def predict(self, values: NDArray[np.float64], condition: Condition) -> Response:
        """Response at parameters and a condition."""
        return FinerResponse(
            self._emulator.predict(values, condition), self._added[condition]
        )


@dataclass(frozen=True, eq=False)
class Refiner:
    """Puts an emulator right at any device by a solution on a fine mesh.

    Attributes
    ----------
    emulator : Emulator
        On a coarse mesh.
    device : Device
        About which it is.
    priors : tuple of Prior
        All free parameters; the emulator's are among them.
    conditions : tuple of Condition
        All that will be asked for.
    cells : int
        Of the fine mesh, a pixel: 4 CPU s for each condition on 32.
    progress : callable, optional
        Called with (solved, in all).

    Notes
    -----
    Of the E2V device at -70 V a_01 on a background of 40,000 e- is 5.0e-7 on 8 cells a pixel, 3.05e-7
    on 16 and 2.87e-7 on 32.  At a device fitted with derivatives on 8 cells the nearest a_ij of
    ITL were 10 % off what 32 cells give there: a fit is done only when it is right where it ends.
    """

    emulator: Emulator
    device: Device
    priors: tuple[Prior, ...]
    conditions: tuple[Condition, ...]
    cells: int = CELLS
    progress: Callable[[int, int], None] | None = None

    def __call__(self, values: NDArray[np.float64]) -> FinerEmulator:
        """Give an emulator that is right at values of all free parameters [internal units]."""
        names = [prior.name for prior in self.priors]
        at = [names.index(name) for name in self.emulator.parameters]
        means = np.array([prior.mean for prior in self.priors])
        added: dict[Condition, Edges] = {}
        for condition in dict.fromkeys(self.conditions):
            here = device_at(self.device, condition, self.priors, values)
            fine = solve_response(here, cells=self.cells)
            kx, ky = fine.edges(condition.wavelength, here.operating_point.temperature)
            own = np.where(held(names, condition), means, values)[at]
            coarse = self.emulator.predict(own, condition)
            added[condition] = kx - coarse.kx, ky - coarse.ky
            if self.progress is not None:
                self.progress(len(added), len(set(self.conditions)))
        return FinerEmulator(self.emulator, added)
