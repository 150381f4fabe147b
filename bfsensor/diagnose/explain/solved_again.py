"""Effects by a quantity of the device, solved at the value that a fit found, and fitted again."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TypeGuard

import numpy as np

from bfsensor.diagnose.data.channels import PER_ELECTRON
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.device_solver import COARSE, FINE, PHASES, DeviceSolver
from bfsensor.effects.changed_device import ChangedDevice, Moved, Quantity, Solution
from bfsensor.effects.effect import Effect
from bfsensor.errors import ConvergenceError, DeviceError

NEAR = 0.1
"""Part of a quantity's change within which a solution serves for its fitted value.  Chosen: the parabola
through nominal and solved value is then right to about 1 % of its own curvature; with 0.2, to 4 %, and
most values are solved for once instead of twice."""

MOST_SOLVED = 4
"""Largest number of solutions for one fit of a quantity.  Chosen: of those that settle, all settle in
three; with 8, fits that run to the end of a range take twice as long."""

SECONDS = 60.0
"""CPU seconds of solutions after which a search takes further quantities by their linear template, and a
note states it.  Chosen: some ten quantities at two back biases; twice as many make the longest searches
a minute longer."""


@dataclass(eq=False)
class Resolver:
    """Solves a baseline's device at fitted values of its quantities.

    Attributes
    ----------
    solver : DeviceSolver or None
        Of the baseline; None, or a quantity without solutions between its values: nothing is solved.
    notes : list of str
        Where values that have no solution are noted.
    """

    solver: DeviceSolver | None
    notes: list[str] = field(default_factory=list)
    spent: float = 0.0

    def acts(self, effect: Effect) -> TypeGuard[ChangedDevice]:
        """Whether the effect is a quantity of the device that can be solved for."""
        return (
            self.solver is not None
            and isinstance(effect, ChangedDevice)
            and effect.template.name != PHASES
        )

    def model(self, model: Model, n: int) -> Model:
        """Fit a model again, the device of its n-th effect solved at the fitted value, until it stays.

        Parameters
        ----------
        model : Model
            Any.
        n : int
            Number of an effect.

        Returns
        -------
        Model
            The same, if the effect is no quantity of the device, is solved there already, or has no
            solution there.
        """
        for _ in range(MOST_SOLVED):
            effect = model.effects[n]
            if not self.acts(effect) or self._is_near(effect):
                break
            if self.spent > SECONDS:
                self._note(
                    f"quantities of the device were solved for during {SECONDS:g} CPU seconds; further "
                    "ones were compared by their derivatives alone"
                )
                break
            again = self._solved(effect, COARSE, levels=False)
            if again is None:
                break
            model = _with(model, n, again)
        return model

    def settled(self, model: Model) -> Model:
        """Fit a model again, all quantities of the device solved on the mesh of the baseline.

        Their change with the level is solved too where recordings have several.
        """
        several = any(
            c.unit != PER_ELECTRON or len(np.unique(c.axes["level"])) > 1
            for c in model.fit.channels
            if c.word in ChangedDevice.touches
        )
        for n in range(len(model.effects)):
            model = self.model(model, n)
            effect = model.effects[n]
            if self.acts(effect) and effect.by:
                again = self._solved(effect, FINE, levels=several)
                model = model if again is None else _with(model, n, again)
        return model

    def _is_near(self, effect: ChangedDevice) -> bool:
        own: Quantity = effect.template
        if effect.by == 0.0:
            return True
        if own.solved is None:
            return False
        value = own.nominal + effect.by
        return abs(value - own.solved.value) <= NEAR * abs(effect.by)

    def _solved(self, effect: ChangedDevice, cells: int, *, levels: bool) -> Effect | None:
        """The effect with a template solved near its value; None if there is no such device."""
        own: Quantity = effect.template
        value = own.nominal + _rounded(effect.by)
        assert self.solver is not None
        begin = time.process_time()
        try:
            moved: Moved = self.solver.moved(own.name, value, cells=cells, levels=levels)
        except (DeviceError, ConvergenceError) as error:
            self._note(
                f"{effect.name}: not solved at {value:.3g}, taken by its derivative: {error}"
            )
            return None
        finally:
            self.spent += time.process_time() - begin
        family = replace(effect.of, template=own._replace(solved=Solution(value, moved)))
        return family(effect.values)

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def _with(model: Model, n: int, effect: Effect) -> Model:
    """Fit a model again with another n-th effect."""
    effects = list(model.effects)
    effects[n] = effect
    return model.with_effects(effects)


def _rounded(by: float) -> float:
    """A change to two digits: fits of other recordings then share its solution."""
    if by == 0.0:
        return by
    digits = 1 - int(np.floor(np.log10(abs(by))))
    return float(round(by, digits))
