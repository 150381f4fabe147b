"""Effects of a device in which one quantity has another value, in the unit of that quantity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bfsensor.effects.effect import Layout, Shot
from bfsensor.effects.family import TemplateEffect
from bfsensor.typing import Edges, FloatArray

Key = tuple[float, float]
Held = tuple[tuple[Key, Edges], ...]
"""Shifts by condition: ((wavelength [nm], back bias [V]), (kx, ky))."""


class QuadraticTemplate(NamedTuple):
    """Derivative of the shifts by the charge at a level [e-], and half of the second derivative."""

    level: float
    slopes: Held
    bends: Held


class Moved(NamedTuple):
    """Change of the shifts [pixel/e-] by the physics, with its temperature [per K] and charge terms."""

    edges: Held
    warming: Held = ()
    temperature: float = np.nan
    bent: QuadraticTemplate | None = None


class Solution(NamedTuple):
    """A value of a quantity at which the device was solved, and the change of the shifts there.

    Attributes
    ----------
    value : float
        In the unit of device files.
    moved : Moved
        Change of the shifts; with ``pulls`` less what these quantities change by their derivatives.
    pulls : mapping of str to float, optional
        Other quantities of the solved device, less their nominal values, over their spreads; by
        default all are nominal.
    """

    value: float
    moved: Moved
    pulls: Mapping[str, float] | None = None


class Quantity(NamedTuple):
    """One quantity of a device: its nominal value, and how the boundary shifts change with it.

    Attributes
    ----------
    name : str
        Dotted name in the device file.
    nominal, spread : float
        Nominal value and standard deviation of its prior, or a typical change where it has none.
    slopes : tuple of ((float, float), (ndarray, ndarray))
        Wavelength [nm] and back bias [V], and there the derivative of the shifts (kx, ky)
        [pixel/e- per unit], arrays with odd sides; empty where none was calculated.
    solved : Solution, optional
        Solution at another value, which the template reproduces.
    """

    name: str
    nominal: float
    spread: float
    slopes: Held = ()
    solved: Solution | None = None


class ChangedDevice(TemplateEffect):
    """Boundary shifts of a device with another value of one quantity, the effect's only parameter.

    The shifts are those of the derivative at the nominal value; with a solution at another value,
    the parabola through both that has this derivative; without a derivative, the straight line.
    """

    stage = "collect"
    touches = ("flat_cov", "spot")

    @property
    def by(self) -> float:
        """Difference from the nominal value, in the unit of the quantity."""
        own: Quantity = self.template
        return float(next(iter(self.values.values())) - own.nominal)

    @property
    def solved_beside(self) -> Mapping[str, float] | None:
        """Other quantities of the solved device, by their pulls; None where all are nominal."""
        own: Quantity = self.template
        return None if own.solved is None else own.solved.pulls

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        del layout
        return self.moved((kx, ky), shot)

    def moved(self, edges: Edges, shot: Shot) -> Edges:
        """Shifts [pixel/e-] with the change by the effect."""
        own: Quantity = self.template
        by = self.by
        if by == 0.0:
            return edges
        moved = edges
        part = 0.0
        if own.solved is not None:
            there, solution = own.solved.value - own.nominal, own.solved.moved
            part = (by / there) ** 2 if own.slopes else by / there
            moved = add_edges(moved, nearest_edges(solution.edges, shot), part)
            by -= part * there
        if own.slopes:
            moved = add_edges(moved, nearest_edges(own.slopes, shot), by)
        return moved

    def level_response(
        self, shot: Shot, layout: Layout
    ) -> tuple[float, Edges, Edges] | None:
        del layout
        own: Quantity = self.template
        if own.solved is None:
            return None
        share = self.by / (own.solved.value - own.nominal)
        return level_response(own.solved.moved.bent, share, shot)


def level_response(
    template: QuadraticTemplate | None, strength: float, shot: Shot
) -> tuple[float, Edges, Edges] | None:
    """Response by level times ``strength``; None without a template or at strength 0."""
    if template is None or strength == 0.0:
        return None
    (sx, sy), (bx, by) = (nearest_edges(h, shot) for h in (template.slopes, template.bends))
    return template.level, (strength * sx, strength * sy), (strength * bx, strength * by)


def nearest_value(held: Sequence[tuple[Key, Any]], shot: Shot) -> Any:
    """Value held for the nearest back bias, and among those for the nearest wavelength."""
    return min(
        held,
        key=lambda s: (abs(s[0][1] - shot.back_bias), abs(s[0][0] - shot.wavelength)),
    )[1]


def nearest_edges(held: Held, shot: Shot) -> Edges:
    """Shifts held for the nearest back bias, and among those for the nearest wavelength."""
    found: Edges = nearest_value(held, shot)
    return found


def add_edges(edges: Edges, more: Edges, factor: float) -> Edges:
    """Add ``factor`` times other shifts, padded with 0 to the same reach."""
    moved = []
    for shifts, slope in zip(edges, more, strict=True):
        reach = max(len(shifts), len(slope)) // 2
        wide, slope = (np.pad(a, reach - len(a) // 2) for a in (shifts, slope))
        moved.append(wide + factor * slope)
    return moved[0], moved[1]
