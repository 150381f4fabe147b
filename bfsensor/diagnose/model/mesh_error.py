"""Errors of solutions by their mesh, as free parameters of a device's baseline.

Shifts on one mesh differ from those on another by a common part, from the cloud of stored electrons,
and by more at the edges beside the charge.  Each part is a parameter, the relative error of its
shifts, so that a difference that the mesh explains is not taken for physics.
"""

from __future__ import annotations

import numpy as np

from bfsensor.typing import Edges, FloatArray

FINEST = 48
"""Mesh cells per pixel of a nominal device's shifts.  Measured at a level of 40,000 e- against 64 cells:
a_00, a_10, a_01 are off by -0.3, -0.4, -0.2 % (itl_sta3800c) and 0.3, -0.5, 0.9 % (e2v_ccd250), with 32
by 0.4, 0.0, 0.7 % and 0.1, -3.1, 1.4 %.  With 96 a solution takes some 30 CPU seconds for 7."""

COARSER = 4.0
"""Factor by which differences between 16 and 32 cells exceed those beyond 32.  Derived: errors of the
second order, of which halved cells leave a quarter; with 8, shifts of the edges beside the charge
of e2v_ccd250 would be off by more than their stated error in y (0.6 % on 48 cells, stated 1.0 %)."""

NEAREST_X, NEAREST_Y, CORNERS, FAR = (
    f"mesh.{part}" for part in ("nearest_x", "nearest_y", "corners", "far")
)
"""Names of the parameters: edges beside the charge in x and in y, edges next to these, all others."""

MESH = NEAREST_X, NEAREST_Y, CORNERS, FAR
"""All names."""


def part_of(edges: Edges, name: str) -> Edges:
    """Shifts of the edges that share an error, 0 at all others.

    Parameters
    ----------
    edges : tuple of ndarray, shape (2 n + 1, 2 n + 1)
        Shifts of right and upper edges, the charged pixel in the middle.
    name : str
        One of :data:`MESH`.

    Returns
    -------
    kx, ky : ndarray

    Examples
    --------
    >>> ones = np.ones((5, 5))
    >>> [int(np.sum(part_of((ones, ones), name))) for name in MESH]
    [2, 2, 8, 38]
    """
    n = len(edges[0]) // 2
    at = np.arange(-n, n + 1)
    across, along = np.meshgrid(np.abs(at + 0.5), np.abs(at))
    beside = across < 1
    parts = {
        NEAREST_X: (beside & (along == 0), False), NEAREST_Y: (False, beside & (along == 0)),
        CORNERS: (beside & (along == 1),) * 2, FAR: (~beside | (along > 1),) * 2,
    }  # fmt: skip
    of_x, of_y = parts[name]
    return np.where(of_x, edges[0], 0.0), np.where(np.transpose(of_y), edges[1], 0.0)


def in_proportion(change: Edges, here: Edges, there: Edges) -> Edges:
    """Change of the shifts of one condition, carried to another in proportion to the shifts.

    Measured on itl_sta3800c and e2v_ccd250, from their own to a back bias of 15 V less: what 48 cells
    change over 32, carried, leaves shifts wrong by at most 0.04 and 0.3 %, where the change itself is
    1 %; the relative change from 15,000 to 65,000 e- differs by at most 0.6 % of the shifts.

    Parameters
    ----------
    change : tuple of ndarray, shape (2 n + 1, 2 n + 1)
        Change of the shifts of right and upper edges at the first condition.
    here, there : tuple of ndarray, shape (2 n + 1, 2 n + 1)
        Shifts at the first and at the second condition.

    Returns
    -------
    kx, ky : ndarray, shape (2 n + 1, 2 n + 1)
        Change at the second: each of :data:`MESH` times the factor by which its shifts are larger.

    Examples
    --------
    >>> ones = np.ones((5, 5))
    >>> kx, _ = in_proportion((ones, ones), (ones, ones), (2 * ones, 2 * ones))
    >>> float(kx.min()), float(kx.max())
    (2.0, 2.0)
    """
    kx, ky = np.zeros_like(change[0]), np.zeros_like(change[1])
    for name in MESH:
        one, two, by = (np.array(part_of(e, name)) for e in (here, there, change))
        if (size := np.vdot(one, one)) > 0:
            more = np.vdot(one, two) / size * by
            kx, ky = kx + more[0], ky + more[1]
    return kx, ky


def mesh_errors(coarse: Edges, fine: Edges, finest: Edges) -> dict[str, float]:
    """Relative errors of the shifts of the finest mesh, from two coarser ones.

    Parameters
    ----------
    coarse, fine, finest : tuple of ndarray
        Shifts on 16, 32 and :data:`FINEST` cells.

    Returns
    -------
    dict of str to float
        Standard deviation by name: the larger of the change from the second to the third mesh and
        of that from the first to the second over :data:`COARSER`.  Parts without shifts have none.
    """

    def size(name: str, kx: FloatArray, ky: FloatArray) -> float:
        return float(np.linalg.norm(part_of((kx, ky), name)))

    first = [a - b for a, b in zip(fine, coarse, strict=True)]
    second = [a - b for a, b in zip(finest, fine, strict=True)]
    return {
        name: max(size(name, *second), size(name, *first) / COARSER) / whole
        for name in MESH
        if (whole := size(name, *finest)) > 0
    }
