"""Error estimates of a distortion table: mesh, tracing of boundaries, and superposition.

Each estimate solves the same device in another way: on a coarser mesh, with a finer trace,
with several pixels filled at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from bfsensor.response.vertices import vertex_fractions
from bfsensor.simulate.boundaries import (
    COARSENESS,
    RATIO,
    find_boundaries,
)
from bfsensor.simulate.hole_layer import hole_layer_error
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics, Potential
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.table.levels import _workshop, solve_level
from bfsensor.table.table import DistortionTable
from bfsensor.table.table_plan import TablePlan
from bfsensor.typing import FloatArray

_CELLS = 16
"""Mesh cells a pixel for tracing and superposition.

Chosen: both compare solutions on the same mesh, so that its own error largely cancels.  Twice as
many raise the superposition error of itl_sta3800c (x pair at half full well) by 5 % of itself and
take 7 times as long."""

_PERIOD = 10
"""Period of the array in those solutions [pixel].

Chosen: images of the charges then lie 10 pixels away, in all compared solutions alike; twice the
period needs four times the nodes."""

_REACH = 2
"""Largest pixel offset at which shifts are compared for the error of superposition.

Chosen: shifts fall steeply with distance; with 3 that of itl_sta3800c falls by 2 % of itself."""

_VERTICES = 8
"""Vertices a side of a pixel in all estimates.

Chosen: twice as many lower the superposition error of itl_sta3800c by 4 % of itself and raise its
tracing error, a largest value, by 40 %, to 5e-5 um."""

_FINER = 4
"""Factor by which the steps of the finer trace are shorter.

Chosen: twice the factor raises the tracing error of itl_sta3800c, 4e-5 um, by 1 % of itself."""

NEAR_CHARGE = 2.0
"""Largest ratio of the charge of a table's level to that whose mesh error is asked for.

Chosen: from 26,000 to 100,000 e- the error of ITL's nearest areas, against 64 cells a pixel, changes by
up to 0.4 % of them; with 4, a table of such small charges alone would state the error of those."""

STAR = {
    (i, j): float(np.exp(-0.5 * (i * i + j * j)))
    for i in range(-_REACH, _REACH + 1)
    for j in range(-_REACH, _REACH + 1)
}
"""Charges of a star of sigma = 1 pixel, relative to its peak, by pixel offset (derived:
exp(-r^2 / 2))."""


def mesh_errors(plan: TablePlan, table: DistortionTable | None = None) -> dict[str, float]:
    """Estimate the mesh error of the nearest area changes, on an empty and a filled array.

    Half a full well is solved on the plan's mesh and on one with half as many cells; for an
    error of second order the finer result is off by a third of the difference.  On a background
    the shifts come from the difference of two charge clouds, and the error need not be smooth.

    Parameters
    ----------
    plan : TablePlan
        Plan of the table.
    table : DistortionTable, optional
        Table of the plan: its levels nearest to those charges are the finer results, which are
        then not solved again.

    Returns
    -------
    errors : dict of str to float
        ``mesh (i,j) [%]`` for the centre and the three nearest lags, and
        ``mesh (0,0) on a background [%]`` for a quarter of the full well in all pixels.
    """
    coarse = replace(plan, cells=plan.cells // 2)
    out = {}
    for background, label in ((0.0, ""), (plan.full_well / 4, " on a background")):
        charge, level = plan.full_well / 2, background
        held = None if table is None else _nearest_level(table, charge, background)
        if held is not None:
            charge, level = held
        changes = [
            _area_changes(coarse, charge, level),
            _area_changes(plan, charge, level, table if held is not None else None),
        ]
        lags = ((0, 0), (1, 0), (0, 1), (1, 1)) if background == 0 else ((0, 0),)
        for i, j in lags:
            rough, fine = (a[plan.reach + j, plan.reach + i] for a in changes)
            out[f"mesh ({i},{j}){label} [%]"] = float(
                100 * abs(fine - rough) / 3 / abs(fine)
            )
    return out


def _nearest_level(
    table: DistortionTable, charge: float, background: float
) -> tuple[float, float] | None:
    """Charge and background of a table's level near to what is asked; None without one."""
    known = [b for b in table.backgrounds if (b > 0) == (background > 0)]
    if not known:
        return None
    level = min(known, key=lambda b: abs(b - background))
    # Near the background nothing moves, and the relative error is that of the tracing.
    charges = [
        q for q in table.charges
        if abs(q - level) > charge / 4 and charge / NEAR_CHARGE <= q <= charge * NEAR_CHARGE
    ]  # fmt: skip
    if not charges:
        return None
    return float(min(charges, key=lambda q: abs(q - charge))), float(level)


def _area_changes(
    plan: TablePlan, charge: float, background: float, table: DistortionTable | None = None
) -> FloatArray:
    """Area changes [um^2] of one level at the top depth of a plan, solved or from its table."""
    if table is not None:
        return table.area_changes(
            charge=charge, background=background, depth=plan.depths[-1]
        )
    one = replace(
        plan,
        charges=(charge,),
        backgrounds=(background,),
        depths=plan.depths[-1:],
        vertices=_VERTICES,
    )
    level = solve_level(one, charge, background)
    table = DistortionTable(
        charges=np.array([charge]),
        backgrounds=np.array([background]),
        depths=np.array(one.depths),
        pitch=(plan.device.pixel.pitch_x, plan.device.pixel.pitch_y),
        thickness=plan.device.silicon.thickness,
        vertices=_VERTICES,
        reach=plan.reach,
        corners=level.corners[None, None],
        horizontal=level.horizontal[None, None],
        vertical=level.vertical[None, None],
    )
    return table.area_changes(charge=charge, background=background, depth=one.depths[0])


def tracing_error(plan: TablePlan) -> float:
    """Estimate the error of the traced boundaries by steps a quarter as long.

    Parameters
    ----------
    plan : TablePlan
        Plan of the table.

    Returns
    -------
    error : float
        Largest difference of the displacement of a vertex within one pixel of the source [um].
    """
    potential = _solve(plan, {(0, 0): max(plan.charges) / 2}, symmetric=True)
    fractions = vertex_fractions(_VERTICES)
    depths = np.array(plan.depths[1:] if len(plan.depths) > 1 else plan.depths)
    usual = find_boundaries(potential, depths, reach=1)
    finer = find_boundaries(
        potential, depths, reach=1, coarseness=COARSENESS / _FINER, ratio=RATIO / _FINER
    )
    return max(
        float(np.abs(a - b).max())
        for a, b in zip(
            usual.vertices(_VERTICES, fractions),
            finer.vertices(_VERTICES, fractions),
            strict=True,
        )
    )


def _solve(
    plan: TablePlan,
    charges: dict[tuple[int, int], float],
    *,
    symmetric: bool,
    background: float = 0.0,
) -> Potential:
    """Solve a pattern of charges [e-] by pixel offset; all other pixels hold the background."""
    mesh = make_mesh(
        plan.device, pixels=(_PERIOD, _PERIOD), cells=_CELLS, symmetric=symmetric
    )
    solver = Electrostatics(plan.device, mesh)
    start = tile(solve_unit_cell(plan.device, background, cells=_CELLS), mesh)
    pattern = np.full(solver.pixel_shape, background)
    columns, rows = list(mesh.pixels("x")), list(mesh.pixels("y"))
    for (i, j), charge in charges.items():
        if i in columns and j in rows:
            pattern[rows.index(j), columns.index(i)] = charge
    return solver.solve(pattern, start=start)


def superposition_error(
    plan: TablePlan, charges: dict[tuple[int, int], float], background: float = 0.0
) -> float:
    """Estimate the relative error of adding the shifts by single pixels.

    Parameters
    ----------
    plan : TablePlan
        Plan of the table; gives device and top depth.
    charges : dict of (int, int) to float
        Charges by pixel offset [e-].
    background : float
        Charge of all other pixels [e-].

    Returns
    -------
    error : float
        Root mean square, over all vertices up to two pixels away, of the difference between the
        sum of single shifts (each at its own charge) and the true shift, divided by the root
        mean square of the true shift.
    """
    depths = np.array(plan.depths[-1:])
    fractions = vertex_fractions(_VERTICES)
    even = all(
        charges.get((-i, -j), 0) == q and charges.get((i, -j), 0) == q
        for (i, j), q in charges.items()
    )
    lines = find_boundaries(
        _solve(plan, charges, symmetric=even, background=background), depths, reach=_REACH
    )
    true = lines.vertices(_VERTICES, fractions)
    summed = tuple(np.zeros_like(a) for a in true)
    alone = _singles(plan, charges.values(), background)
    for (i, j), charge in charges.items():
        for total, single in zip(summed, alone[charge], strict=True):
            ny, nx = total.shape[1:3]
            total += single[:, _REACH - j : _REACH - j + ny, _REACH - i : _REACH - i + nx]
    wrong = sum(float(np.sum((s - t) ** 2)) for s, t in zip(summed, true, strict=True))
    size = sum(float(np.sum(t**2)) for t in true)
    return float(np.sqrt(wrong / size))


def _singles(
    plan: TablePlan, charges: Iterable[float], background: float
) -> dict[float, tuple[FloatArray, ...]]:
    """Displacements by single pixels of given charges.

    More than three are interpolated: a displacement over its charge above the background changes
    slowly with the charge, so that the parabola through the smallest, the largest and the one
    nearest to their mean is within 1.2 % (root mean square, ITL, the star's charges), by which the
    error of superposition of a star moves by 2 % of itself.
    """
    wanted = sorted(set(charges))
    middle = min(wanted, key=lambda q: abs(q - 0.5 * (wanted[0] + wanted[-1])))
    nodes = sorted({wanted[0], middle, wanted[-1]}) if len(wanted) > 3 else wanted
    known = {q: _single(plan, q, background) for q in nodes}
    out = dict(known)
    for q in wanted:
        if q in known:
            continue
        parts = []
        for n, held in known.items():
            weight = np.prod([(q - m) / (n - m) for m in nodes if m != n])
            parts.append([weight * (q - background) / (n - background) * a for a in held])
        out[q] = tuple(np.sum(arrays, axis=0) for arrays in zip(*parts, strict=True))
    return out


@lru_cache(maxsize=16)
def _single(plan: TablePlan, charge: float, background: float) -> tuple[FloatArray, ...]:
    """Displacements at the top depth by one pixel alone, up to twice :data:`_REACH` away."""
    alone = find_boundaries(
        _solve(plan, {(0, 0): charge}, symmetric=True, background=background),
        np.array(plan.depths[-1:]),
        reach=2 * _REACH,
    )
    return alone.vertices(_VERTICES, vertex_fractions(_VERTICES))


def assess(plan: TablePlan, table: DistortionTable | None = None) -> dict[str, float]:
    """Compute all error estimates of a plan, for the header of its table.

    Parameters
    ----------
    plan : TablePlan
        Plan of the table.
    table : DistortionTable, optional
        Table of the plan, for :func:`mesh_errors`.

    Returns
    -------
    errors : dict of str to float
        Errors by name, with the unit in the name.
    """
    mesh = mesh_errors(plan, table)
    return {**mesh, **assess_sums(plan)}


def assess_sums(plan: TablePlan) -> dict[str, float]:
    """Compute the error estimates that need no table: hole layer, tracing, superposition."""
    # The solver of the levels is cached; free its memory for the larger arrays that follow.
    _workshop.cache_clear()
    charge = 0.5 * plan.full_well
    star = {offset: charge * part for offset, part in STAR.items()}
    unit = solve_unit_cell(plan.device, 0.0, cells=_CELLS, refine_z=plan.refine_z)
    return {
        "hole layer [V]": hole_layer_error(unit),
        "tracing [um]": tracing_error(plan),
        "superposition, x pair at half full well [%]": 100
        * superposition_error(plan, {(0, 0): charge, (1, 0): charge}),
        "superposition, y pair at half full well [%]": 100
        * superposition_error(plan, {(0, 0): charge, (0, 1): charge}),
        "superposition, star at half full well [%]": 100 * superposition_error(plan, star),
        "superposition, star on a quarter full well [%]": 100
        * superposition_error(
            plan, {o: 0.5 * charge + q for o, q in star.items()}, background=0.5 * charge
        ),
    }
