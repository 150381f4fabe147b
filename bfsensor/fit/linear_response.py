"""Boundary shifts linear in the parameters, from one solution and its linearised system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import ABSORPTION, Prior
from bfsensor.errors import FitError
from bfsensor.fit.device_at import device_at, stretch_at
from bfsensor.fit.predictors import PredictedEdges, held
from bfsensor.response.edge_response import LEVEL, area_matrix, solve_response
from bfsensor.response.light import mixed
from bfsensor.typing import FloatArray

STEP = 1e-4
"""Step over which the device, not its solution, is differentiated by a parameter [prior widths].

Chosen: geometry and doping change almost linearly over it; twice as large doubles the relative error
of a one-sided difference, itself of the order of the step."""


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """Shifts of right (kx) and upper edges (ky), and their derivatives by the parameters.

    Attributes
    ----------
    kx, ky : ndarray, shape (2 n + 1, 2 n + 1)
        Shifts [pixel/e-], [row dy, column dx].
    dkx, dky : ndarray, shape (p, 2 n + 1, 2 n + 1)
        Derivatives [pixel/e- per internal unit].
    """

    kx: FloatArray
    ky: FloatArray
    dkx: FloatArray
    dky: FloatArray

    @property
    def areas(self) -> FloatArray:
        """Relative area changes a_ij [1/e-], ``[j, i]`` from lag (0, 0)."""
        return _lags(area_matrix(self.kx, self.ky))

    @property
    def jacobian(self) -> FloatArray:
        """Derivatives of the areas by the parameters, first axis."""
        return _lags(area_matrix(self.dkx, self.dky))


@dataclass(frozen=True, eq=False)
class LinearEmulator:
    """Emulator that predicts linearly in the parameters, about a solution at each condition.

    Attributes
    ----------
    parameters : tuple of str
        Dotted names of the parameters.
    values : ndarray, shape (p,)
        Values at which the device was solved [internal units].
    responses : dict of Condition to LinearResponse
        Shifts and derivatives there.
    """

    parameters: tuple[str, ...]
    values: FloatArray
    responses: dict[Condition, LinearResponse]

    def predict(self, values: FloatArray, condition: Condition) -> PredictedEdges:
        """Predict the response at parameters [internal units] and one of the solved conditions."""
        found = self.responses.get(condition)
        if found is None:
            raise FitError(
                f"no response was solved at {condition}; solved were "
                f"{', '.join(map(str, self.responses))}"
            )
        by = np.where(held(self.parameters, condition), 0.0, values - self.values)
        return LinearResponse(
            found.kx + np.tensordot(by, found.dkx, 1),
            found.ky + np.tensordot(by, found.dky, 1),
            found.dkx, found.dky,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Linearise:
    """Function that solves a device and all derivatives at values of its parameters.

    Attributes
    ----------
    device : Device
        Nominal device of the fit; its mesh is distorted with the parameters, not made again.
    priors : tuple of Prior
        Free parameters that change the shifts.
    conditions : tuple of Condition
        All conditions for which predictions are made.
    cells : int
        Mesh cells per pixel, even.
    progress : callable, optional
        Called with (solved, in all).

    Notes
    -----
    With 24 parameters a condition takes about 13 CPU s on 16 cells.  8 cells are too few: there a_10
    of the ITL device rises as the channel stop is made narrower, while it falls on 16; derivatives
    of the E2V device, compared with solutions at neighbouring values, are wrong by 13 % and more on
    8 cells, by 0.3 % on 16.
    """

    device: Device
    priors: tuple[Prior, ...]
    conditions: tuple[Condition, ...]
    cells: int = 16
    progress: Callable[[int, int], None] | None = None

    def __call__(self, values: FloatArray) -> LinearEmulator:
        """Solve at the values of the parameters [internal units], shape (p,)."""
        names = tuple(prior.name for prior in self.priors)
        responses = {}
        for condition in dict.fromkeys(self.conditions):
            responses[condition] = self._at(np.asarray(values, float), condition, names)
            if self.progress is not None:
                self.progress(len(responses), len(set(self.conditions)))
        return LinearEmulator(names, np.array(values, float), responses)

    def _at(
        self, values: FloatArray, condition: Condition, names: tuple[str, ...]
    ) -> LinearResponse:
        def device(values: FloatArray) -> Device:
            return device_at(self.device, condition, self.priors, values)

        changed = []
        free = np.flatnonzero(~held(names, condition) & (np.array(names) != ABSORPTION))
        for n in free.tolist():
            step = STEP * self.priors[n].spread * (np.arange(len(names)) == n)
            try:
                changed.append((device(values + step), step[n]))
            except FitError:
                # No device on this side, as for oxides of equal thickness: step to the other.
                changed.append((device(values - step), -step[n]))
        here = device(values)
        found = solve_response(
            here, level=level_of(condition), cells=self.cells, changed=changed,
            laid_for=device_at(self.device, condition),
        )  # fmt: skip
        light = condition.wavelength, here.operating_point.temperature
        stretch = stretch_at(self.priors, values)
        kx, ky = mixed(found.kx, found.ky, found.depths, *light, stretch)
        dkx, dky = np.zeros((2, len(names), *kx.shape))
        dkx[free], dky[free] = mixed(found.dkx, found.dky, found.depths, *light, stretch)
        if ABSORPTION in names:
            n = names.index(ABSORPTION)
            step = STEP * self.priors[n].spread
            two, one = (
                mixed(found.kx, found.ky, found.depths, *light, stretch + side * step)
                for side in (1, -1)
            )
            dkx[n], dky[n] = ((b - a) / (2 * step) for a, b in zip(one, two, strict=True))
        return LinearResponse(kx, ky, dkx, dky)


def level_of(condition: Condition) -> float:
    """Charge in every pixel about which a response is taken at a condition [e-]."""
    return LEVEL if condition.level is None else condition.level


def _lags(areas: FloatArray) -> FloatArray:
    """Areas by lag from (0, 0); the outermost lag lacks an edge and is left out."""
    middle = areas.shape[-1] // 2
    return areas[..., middle:-1, middle:-1]
