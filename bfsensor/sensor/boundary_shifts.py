"""Shifts of pixel boundaries as the kernels take them, from a table and from effects."""

from __future__ import annotations

from typing import Any

from bfsensor._kernels.shifts import Edges
from bfsensor.sensor.applied_effects import AppliedEffects
from bfsensor.sensor.charge_response import EffectiveCharge, factor_table
from bfsensor.sensor.edge_weights import make_edges, transpose_sides
from bfsensor.sensor.effect_edges import REACH, EdgeChange, change_sides
from bfsensor.table.table import DistortionTable

_KEPT = 4
"""Number of packed shifts that are kept with a table, by strength, orientation and reach.

Chosen: each takes 4.7 MB and is packed in 25 ms; twice as many keep twice the memory and spare that
time where sensors of more strengths take turns."""


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
    """Factor a table, and pack its shifts for the kernels, changed by effects.

    Parameters
    ----------
    table : DistortionTable
        Any; its factors are cached in it, because factoring takes 0.3 s, and so are the last
        :data:`_KEPT` packed shifts.
    charge_response, background, depth, transpose : bool
        Switches of :class:`bfsensor.BrighterFatterSensor`.
    strength : float
        Factor on all shifts.
    reach : int
        Largest distance of a source from an edge [pixel]; where it is the table's own, effects
        that reach farther extend it.
    applied : AppliedEffects, optional
        Effects that change the growth of shifts with charge, or the shifts of edges.

    Returns
    -------
    charges : EffectiveCharge
        Weights and effective charges of the table.
    edges : Edges
        The weights, changed by effects and packed for the kernels.
    """
    kept: dict[Any, EffectiveCharge] = table.__dict__.setdefault("_kept_factors", {})
    packed: dict[Any, Edges] = table.__dict__.setdefault("_kept_edges", {})
    bend = 0.0 if applied is None else applied.law.bend
    whole = charge_response, background, depth
    # Effects take many values, each once (a fit): only results without effects are cached.
    factors = kept.get(whole) if not bend else None
    if factors is None:
        factors = factor_table(
            table, linear=not charge_response, background=background, top=not depth,
            growth=bend,
        )  # fmt: skip
        if not bend:
            kept[whole] = factors
    change = EdgeChange()
    if applied is not None:
        change = applied.change_of_edges(factors.modes[0], factors.points)
    key = (*whole, strength, transpose, reach)
    if change.is_none() and (found := packed.pop(key, None)) is not None:
        packed[key] = found  # last in the order, as the one used last
        return factors, found
    if reach == table.reach:
        reach = max(reach, min(change.reach, REACH))
    modes = []
    for number, sides in enumerate(factors.modes):
        if not change.is_none():
            # Effects add shifts in proportion to the charge, which the first mode carries.
            own = change._replace(added=None) if number else change
            sides = change_sides(sides, factors.points, own, reach)
        turned = transpose_sides(*sides) if transpose else sides
        modes.append((strength * turned[0], strength * turned[1]))
    edges = make_edges(modes, factors.points, factors.heights, reach)
    # Growth with charge changes the effective charges only, not the edges.
    if change.is_none():
        packed[key] = edges
        for oldest in list(packed)[:-_KEPT]:
            packed.pop(oldest, None)
    return factors, edges
