"""Effects by a quantity of the device, solved at the value that a fit found, and fitted again."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeGuard

import numpy as np

from bfsensor.diagnose.data.channels import PER_ELECTRON
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.device_solver import COARSE, FINE, PHASES, DeviceSolver
from bfsensor.effects.changed_device import (
    ChangedDevice,
    Moved,
    Quantity,
    Solution,
    add_edges,
)
from bfsensor.effects.effect import Effect, Shot
from bfsensor.errors import ConvergenceError, DeviceError

NEAR = 0.1
"""Part of a quantity's change within which a solution serves for its fitted value.  Chosen: the parabola
through nominal and solved value is then right to about 1 % of its own curvature; with 0.2, to 4 %, and
most values are solved for once instead of twice."""

MOST_SOLVED = 4
"""Largest number of solutions for one fit of a quantity.  Chosen: of those that settle, all settle in
three; with 8, fits that run to the end of a range take twice as long."""

PARTS = (1.0, 0.5, 0.25)
"""Parts of the way from the last solution to the fitted quantities that are tried until one is a device.
Chosen: a derivative of a sensor near its depletion voltage leads to twice the change; with a fourth
part, a quantity that has no solution takes a third longer."""

WORSE = 20.0
"""Chi-square above that of the best quantity so far from which a quantity is not solved for once more.
Chosen: further solutions of concealed quantities gained 5 to 10, and classes are tied up to 12; with
twice as much, each search solves for one quantity less."""

SECONDS = 60.0
"""CPU seconds of solutions after which a search takes further quantities by their linear template, and a
note states it.  Chosen: some ten solutions at two back biases; twice as many make the longest searches
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

    def model(self, model: Model, n: int, best: float = np.inf) -> Model:
        """Fit a model again, the device solved at its n-th effect and fitted quantities, until it stays.

        Parameters
        ----------
        model : Model
            Any.
        n : int
            Number of an effect.
        best : float
            Chi-square of another explanation: fits that are worse by :data:`WORSE` are left.

        Returns
        -------
        Model
            The same, if the effect is no quantity of the device, is solved there already, or has no
            solution there.
        """
        for _ in range(MOST_SOLVED):
            effect = model.effects[n]
            if not self.acts(effect) or _is_near(effect):
                break
            if self.spent > SECONDS:
                self._note(
                    f"quantities of the device were solved for during {SECONDS:g} CPU seconds; further "
                    "ones were compared by their derivatives alone"
                )
                break
            again = self._solved(model, n, COARSE, levels=False)
            if again is None:
                break
            model = _with(model, n, again)
            if model.fit.total > best + WORSE:
                break
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
                again = self._solved(model, n, FINE, levels=several)
                model = model if again is None else _with(model, n, again)
                self._note_far(model.effects[n])
        return model

    def _note_far(self, effect: Effect) -> None:
        """Note a fitted value that is far from where the device was solved."""
        if self.acts(effect) and (solved := last_solved(effect)) is not None:
            own: Quantity = effect.template
            self._note(
                f"{effect.name}: the fitted value {own.nominal + effect.by:.3g} is extrapolated from a "
                f"solution at {solved:.3g}"
            )

    def _solved(
        self, model: Model, n: int, cells: int, *, levels: bool
    ) -> ChangedDevice | None:
        """The n-th effect solved near its value, all fitted quantities at theirs; None if it cannot be.

        Where there is no such device, it is solved on the way from the last solution to it.
        """
        effect = model.effects[n]
        assert self.acts(effect) and self.solver is not None
        own: Quantity = effect.template
        units = model.predictor.baseline.units
        goal = {q: p for q, p in model.fit.pulls.items() if q in units}
        first: Mapping[str, float] = effect.solved_beside or {}
        start = 0.0
        if own.solved is not None and own.solved.pulls is not None:
            start = own.solved.value - own.nominal
        begin, failed = time.process_time(), ""
        try:
            for part in PARTS:
                by = _rounded(start + part * (effect.by - start))
                pulls = {
                    q: first.get(q, 0.0) + part * (p - first.get(q, 0.0))
                    for q, p in goal.items()
                }
                try:
                    moved = self._moved(model, n, by, pulls, cells, levels)
                except (DeviceError, ConvergenceError) as error:
                    failed = failed or f"not solved at {own.nominal + by:.3g}: {error}"
                    continue
                solved = Solution(own.nominal + by, moved, pulls)
                family = replace(effect.of, template=own._replace(solved=solved))
                again = family(effect.values)
                assert isinstance(again, ChangedDevice)
                return again
        finally:
            self.spent += time.process_time() - begin
        self._note(f"{effect.name}: taken by its derivative, {failed}")
        return None

    def _moved(
        self,
        model: Model,
        n: int,
        by: float,
        pulls: Mapping[str, float],
        cells: int,
        levels: bool,
    ) -> Moved:
        """Change of the shifts by the n-th effect, as large as ``by``, beside other quantities.

        What the model has without it, the derivatives by these quantities and other effects, is taken
        off the solution.
        """
        effect = model.effects[n]
        assert self.acts(effect) and self.solver is not None
        own: Quantity = effect.template
        others = [e for k, e in enumerate(model.effects) if k != n and self.acts(e)]
        baseline = model.predictor.baseline
        change = {q: p * baseline.spread[q] for q, p in pulls.items()}
        values = {q: baseline.nominal[q] + more for q, more in change.items()}
        for one in others:
            of = one.template
            values[of.name] = values.get(of.name, of.nominal) + one.by
        value = values.pop(own.name, own.nominal) + by
        moved = self.solver.moved(
            own.name, value, cells=cells, levels=levels, beside=values
        )
        edges = []
        for key, kept in moved.edges:
            for q, more in change.items():
                kept = add_edges(kept, baseline.derivative(q, key), -more)
            shot = Shot("flat", 0, 0.0, *key, baseline.temperature)
            for one in others:
                nothing = np.zeros_like(kept[0]), np.zeros_like(kept[1])
                kept = add_edges(kept, one.moved(nothing, shot), -1.0)
            edges.append((key, kept))
        return moved._replace(edges=tuple(edges))

    def _note(self, text: str) -> None:
        if text not in self.notes:
            self.notes.append(text)


def last_solved(effect: Effect) -> float | None:
    """Value that the device was solved at, where the fitted value is extrapolated from it; else None."""
    if not isinstance(effect, ChangedDevice) or effect.template.name == PHASES:
        return None
    if effect.solved_beside is None or _is_near(effect):
        return None
    return float(effect.template.solved.value)


def _is_near(effect: ChangedDevice) -> bool:
    """Whether the device was solved at a quantity's fitted value, or so near that it serves for it."""
    own: Quantity = effect.template
    if effect.by == 0.0:
        return True
    if own.solved is None or own.solved.pulls is None:
        return False
    value = own.nominal + effect.by
    return abs(value - own.solved.value) <= NEAR * abs(effect.by)


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
