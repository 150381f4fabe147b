"""The response about one device as its solution and the linearised system have it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import Prior
from bfsensor.errors import FitError
from bfsensor.fit.device_at import device_at
from bfsensor.fit.predictors import PredictedEdges, held
from bfsensor.response.edge_response import area_matrix, mixed, solve_response
from bfsensor.typing import FloatArray

STEP = 1e-4
"""Over which a device is differentiated [spread]."""


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """Shifts [pixel/e-], areas [1/e-], [j, i], and their derivatives by the parameters."""

    kx: FloatArray
    ky: FloatArray
    dkx: FloatArray
    dky: FloatArray

    @property
    def areas(self) -> FloatArray:
        """a_ij [1/e-]."""
        return _lags(area_matrix(self.kx, self.ky))

    @property
    def jacobian(self) -> FloatArray:
        """Of the areas, by parameter."""
        return _lags(area_matrix(self.dkx, self.dky))


@dataclass(frozen=True, eq=False)
class LinearEmulator:
    """Responses straight in the parameters about some values, by condition.

    Attributes
    ----------
    parameters : tuple of str
        Dotted names.
    values : ndarray, shape (p,)
        About which they are straight [internal units].
    responses : dict
        Response there, by condition.
    """

    parameters: tuple[str, ...]
    values: FloatArray
    responses: dict[Condition, LinearResponse]

    def predict(self, values: FloatArray, condition: Condition) -> PredictedEdges:
        """Response at parameters and a condition, one of those that it was made for."""
        found = self.responses.get(condition)
        if found is None:
            raise FitError(f"no response was solved at {condition}")
        by = np.where(held(self.parameters, condition), 0.0, values - self.values)
        return LinearResponse(
            found.kx + np.tensordot(by, found.dkx, 1),
            found.ky + np.tensordot(by, found.dky, 1),
            found.dkx, found.dky,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Linearise:
    """Solves a device at values of its parameters, with all derivatives.

    Attributes
    ----------
    device : Device
        About which the fit is; its mesh is moved with the parameters.
    priors : tuple of Prior
        Free parameters that move the response.
    conditions : tuple of Condition
        All that will be asked for.
    cells : int
        Of the mesh, a pixel.
    progress : callable, optional
        Called with (solved, in all).

    Notes
    -----
    At 24 parameters some 13 CPU s a condition on 16 cells.  8 cells are too few.  There a_10 of the
    ITL device rises as the channel stop is made narrower, and falls on 16; derivatives of the
    E2V device are wrong by 13 % and more, on 16 by 0.3 %, against solutions of its neighbours.
    """

    device: Device
    priors: tuple[Prior, ...]
    conditions: tuple[Condition, ...]
    cells: int = 16
    progress: Callable[[int, int], None] | None = None

    def __call__(self, values: FloatArray) -> LinearEmulator:
        """Solve at values [internal units], shape (p,)."""
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

        changed, free = [], np.flatnonzero(~held(names, condition))
        for n in free.tolist():
            step = STEP * self.priors[n].spread * (np.arange(len(names)) == n)
            try:
                changed.append((device(values + step), step[n]))
            except FitError:
                # At the end of what can be, such as oxides of equal thickness.
                changed.append((device(values - step), -step[n]))
        here = device(values)
        found = solve_response(
            here, cells=self.cells, changed=changed,
            laid_for=device_at(self.device, condition),
        )  # fmt: skip
        at = condition.wavelength, here.operating_point.temperature
        kx, ky = found.edges(*at)
        dkx, dky = np.zeros((2, len(names), *kx.shape))
        dkx[free], dky[free] = mixed(found.dkx, found.dky, found.depths, *at)
        return LinearResponse(kx, ky, dkx, dky)


def _lags(areas: FloatArray) -> FloatArray:
    """Areas by lag from (0, 0), as far as they are complete."""
    middle = areas.shape[-1] // 2
    return areas[..., middle:-1, middle:-1]
