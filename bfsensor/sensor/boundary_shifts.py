"""Shifts of boundaries for the engine: from a table, and from effects."""

from __future__ import annotations

from typing import Any

from bfsensor._kernels.shifts import Edges
from bfsensor.sensor.applied_effects import AppliedEffects
from bfsensor.sensor.charge_response import EffectiveCharge, factor_table
from bfsensor.sensor.edge_weights import make_edges, transpose_sides
from bfsensor.sensor.effect_edges import REACH, EdgeChange, change_sides
from bfsensor.table.table import DistortionTable


def make_shifts(
    table: DistortionTable,
    *,
    charge_response: bool,
    background: bool,
    depth: bool,
    strength: float,
    transpose: bool,
    reach: int,
    applied: AppliedEffects | None = None,
) -> tuple[EffectiveCharge, Edges]:
    """Factor a table, and pack its shifts with what effects make of them.

    Parameters
    ----------
    table : DistortionTable
        Keeps what is made of it alone: factoring it takes 0.3 s.
    charge_response, background, depth, strength, transpose
        As for :class:`bfsensor.BrighterFatterSensor`.
    reach : int
        Sources up to so many pixels away; all of the table's give way to effects that reach
        farther.
    applied : AppliedEffects, optional
        Their bend and what they do to edges.

    Returns
    -------
    EffectiveCharge, Edges
    """
    kept: dict[Any, Any] = table.__dict__.setdefault("_kept_factors", {})
    bend = 0.0 if applied is None else applied.law.bend
    whole = charge_response, background, depth
    # Of many bends and changes none is likely to come again: they are not kept.
    factors = kept.get(whole) if not bend else None
    if factors is None:
        factors = factor_table(
            table, linear=not charge_response, background=background, top=not depth,
            bend=bend,
        )  # fmt: skip
        if not bend:
            kept[whole] = factors
    change = EdgeChange()
    if applied is not None:
        change = applied.change_of_edges(factors.first, factors.points)
    key = (*whole, strength, transpose, reach)
    if change.is_none() and key in kept:
        return factors, kept[key]
    if reach == table.reach:
        reach = max(reach, min(change.reach, REACH))
    modes = []
    for number, sides in enumerate((factors.first, factors.second)):
        if sides is None:
            continue
        if not change.is_none():
            # What is added to shifts is in proportion to the first mode's charge.
            own = change._replace(added=None) if number else change
            sides = change_sides(sides, factors.points, own, reach)
        turned = transpose_sides(*sides) if transpose else sides
        modes.append((strength * turned[0], strength * turned[1]))
    edges = make_edges(
        modes[0], modes[1] if len(modes) > 1 else None, factors.points, factors.heights,
        reach,
    )  # fmt: skip
    # A bend leaves the shifts of the factors as they are.
    if change.is_none():
        kept[key] = edges
    return factors, edges
