"""Error estimates of a distortion table: mesh, tracing of boundaries, and superposition.

Each estimate solves the same device in another way: on a coarser mesh, with a finer trace,
with several pixels filled at once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bfsensor.response.vertices import vertex_fractions
from bfsensor.simulate.boundaries import (
    COARSENESS,
    RATIO,
    PixelBoundaries,
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

STAR = {
    (i, j): float(np.exp(-0.5 * (i * i + j * j)))
    for i in range(-_REACH, _REACH + 1)
    for j in range(-_REACH, _REACH + 1)
}
"""Charges of a star of sigma = 1 pixel, relative to its peak, by pixel offset (derived:
exp(-r^2 / 2))."""


def mesh_errors(plan: TablePlan) -> dict[str, float]:
    """Estimate the mesh error of the nearest area changes, on an empty and a filled array.

    Half a full well is solved on the plan's mesh and on one with half as many cells; for an
    error of second order the finer result is off by a third of the difference.  On a background
    the shifts come from the difference of two charge clouds, and the error need not be smooth.

    Parameters
    ----------
    plan : TablePlan
        Plan of the table.

    Returns
    -------
    errors : dict of str to float
        ``mesh (i,j) [%]`` for the centre and the three nearest lags, and
        ``mesh (0,0) on a background [%]`` for a quarter of the full well in all pixels.
    """
    charge = plan.full_well / 2
    out = {}
    for background, label in ((0.0, ""), (plan.full_well / 4, " on a background")):
        changes = [
            _area_changes(replace(plan, cells=cells), charge, background)
            for cells in (plan.cells // 2, plan.cells)
        ]
        lags = ((0, 0), (1, 0), (0, 1), (1, 1)) if background == 0 else ((0, 0),)
        for i, j in lags:
            coarse, fine = (a[plan.reach + j, plan.reach + i] for a in changes)
            out[f"mesh ({i},{j}){label} [%]"] = float(
                100 * abs(fine - coarse) / 3 / abs(fine)
            )
    return out


def _area_changes(plan: TablePlan, charge: float, background: float) -> FloatArray:
    """Area changes [um^2] of one level at the top depth of a plan."""
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
    furthest = max(max(abs(i), abs(j)) for i, j in charges)
    singles: dict[float, tuple[FloatArray, ...]] = {}
    summed = tuple(np.zeros_like(a) for a in true)
    for (i, j), charge in charges.items():
        key = round(charge, 3)
        if key not in singles:
            alone: PixelBoundaries = find_boundaries(
                _solve(plan, {(0, 0): charge}, symmetric=True, background=background),
                depths,
                reach=_REACH + furthest,
            )
            singles[key] = alone.vertices(_VERTICES, fractions)
        for total, single in zip(summed, singles[key], strict=True):
            ny, nx = total.shape[1:3]
            total += single[
                :, furthest - j : furthest - j + ny, furthest - i : furthest - i + nx
            ]
    wrong = sum(float(np.sum((s - t) ** 2)) for s, t in zip(summed, true, strict=True))
    size = sum(float(np.sum(t**2)) for t in true)
    return float(np.sqrt(wrong / size))


def assess(plan: TablePlan) -> dict[str, float]:
    """Compute all error estimates of a plan, for the header of its table.

    Parameters
    ----------
    plan : TablePlan
        Plan of the table.

    Returns
    -------
    errors : dict of str to float
        Errors by name, with the unit in the name.
    """
    mesh = mesh_errors(plan)
    # The solver of the levels is cached; free its memory for the larger arrays that follow.
    _workshop.cache_clear()
    charge = 0.5 * plan.full_well
    star = {offset: charge * part for offset, part in STAR.items()}
    unit = solve_unit_cell(plan.device, 0.0, cells=_CELLS, refine_z=plan.refine_z)
    return {
        **mesh,
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
