"""Derivatives of pixel boundaries with respect to a small change of the potential.

The field lines of a boundary are followed once, with the linearised equations of their
deviations: as exact as differences of boundaries traced again, at a tenth of the cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bfsensor._kernels import path_changes
from bfsensor.simulate.boundaries import (
    COARSENESS,
    RATIO,
    TURN,
    Feet,
    PixelBoundaries,
    unfold,
)
from bfsensor.simulate.field import Field, pad
from bfsensor.simulate.poisson import Potential
from bfsensor.simulate.tangent import PotentialChange
from bfsensor.typing import FloatArray

GROWTH = 1e3
"""Growth of a deviation from a boundary at which the descent of a field line ends.

Derived: what the change of the potential does further down counts with the inverse of the growth,
here 1e-3 and less of its size at the start."""

EARLY = 30.0
"""Growth of a deviation at which a first, early value of the shift is noted.

Derived: what happens further down counts with at most 1/30, so that the shift is known to some
per cent there, before the path comes near a saddle of the potential."""

JUMP = 0.5
"""Largest change of a shift between :data:`EARLY` and :data:`GROWTH` that is believed.

It is relative to the early value of the point or to the median size along its line, whichever is
larger; beyond it a step has passed a saddle, which makes deviations of any size, and the early
value is taken.  Chosen: the change that is expected is some 3 %; at 1.0 points whose shift comes
out twice as large, or as 0, would be kept."""

_MAX_STEPS = 3000
"""Largest number of steps down a field line; beyond it the last value found is returned.

Chosen: as for the traces of :mod:`bfsensor.simulate.boundaries`, which a path of 100 um needs
some 125 of; twice as many change only paths that are caught where the field is weak."""


def boundary_changes(
    potential: Potential,
    lines: PixelBoundaries,
    feet: Sequence[Feet],
    changes: Sequence[PotentialChange],
    deeper: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Differentiate the points of boundary lines by quantities of the device.

    A unit below is that of the quantity by which a change was differentiated.

    Parameters
    ----------
    potential : Potential
        Solution in which the lines were found.
    lines : PixelBoundaries
        Lines from :func:`~bfsensor.simulate.boundaries.find_boundaries`, called with ``turn=TURN``.
    feet : sequence of Feet
        The list that was passed to that call as ``feet``.
    changes : sequence of PotentialChange
        Derivatives of the potential, from :meth:`~bfsensor.simulate.tangent.Tangent.change`.
    deeper : ndarray, shape (changes, nd), optional
        Derivatives of the conversion depths themselves [um per unit]; by default depths stay.

    Returns
    -------
    columns, rows : ndarray, shape (changes, nd, lines, seeds, 2)
        Derivatives (x, y) of the points [um per unit], at depths that move by ``deeper``.
    """
    field = Field.of(potential)
    order, made = _on_nodes(potential, field, changes)
    nd, n = len(lines.depths), len(changes)
    given = np.zeros((n, nd)) if deeper is None else deeper
    out = []
    for foot in feet:
        shape = foot.below[0][0].shape[:2]
        moved = np.zeros((*shape, nd, n, 2))
        for seeds, reached in foot.below:
            flat = np.ascontiguousarray(seeds.reshape(-1, 3))
            first, early = np.zeros((2, len(flat), n))
            path_changes.boundary_changes(
                field.phi, made, field.x, field.y, field.z, flat, foot.axis, field.zone,
                COARSENESS, TURN, _MAX_STEPS, EARLY, GROWTH,
                early, first,
            )  # fmt: skip
            median = np.median(np.abs(early.reshape(*shape, n)), axis=1, keepdims=True)
            usual = np.broadcast_to(median, (*shape, n)).reshape(-1, n)
            jumps = np.abs(first - early) > JUMP * np.maximum(np.abs(early), usual)
            first = np.where(jumps, early, first)
            depths = lines.depths[reached]
            up = np.zeros((len(flat), len(depths), n, 2))
            slopes = np.zeros((len(flat), len(depths), 2))
            path_changes.trace_changes_up(
                field.phi, made, field.x, field.y, field.z, flat, first, foot.axis, depths,
                RATIO, up, slopes,
            )  # fmt: skip
            up = up[:, :, np.argsort(order)]
            up += slopes[:, :, None, :] * given[:, reached].T[None, :, :, None]
            moved[:, :, reached] = up.reshape(*shape, len(depths), n, 2)
        # Axes to (changes, nd, lines, seeds, 2).
        ordered = np.moveaxis(moved, (3, 2), (0, 1))
        ordered = foot.points.spread(ordered, 1 - foot.axis)
        if lines.symmetric:
            ordered = np.stack([unfold(one, foot.axis) for one in ordered])
        out.append(ordered)
    return out[0], out[1]


def _on_nodes(
    potential: Potential, field: Field, changes: Sequence[PotentialChange]
) -> tuple[list[int], path_changes.Changes]:
    """Order in which the changes are passed to the kernels (nodes that stay first), and arrays."""
    still = [n for n, c in enumerate(changes) if not c.moves]
    moving = [n for n, c in enumerate(changes) if c.moves]
    # Single precision would err by 0.1 % in the response two pixels away.
    held = np.empty((*field.phi.shape, len(still)))
    for k, n in enumerate(still):
        pad(changes[n].at_nodes, potential.mesh, held[..., k])
    steps = np.array([changes[n].step for n in moving])
    mesh = potential.mesh
    moved = np.empty((len(moving), *field.phi.shape))
    nodes = []
    for k, (n, step) in enumerate(zip(moving, steps, strict=True)):
        vx, vy, vz = changes[n].velocity
        there = replace(
            mesh, x=mesh.x + step * vx, y=mesh.y + step * vy, z=mesh.z + step * vz
        )
        phi = potential.phi + step * changes[n].at_nodes
        nodes.append(pad(phi, there, moved[k]))
    positions = (
        np.array(one) if nodes else np.zeros((0, 0))
        for one in (zip(*nodes, strict=True) if nodes else [()] * 3)
    )
    return still + moving, path_changes.Changes(held, moved, *positions, steps)
