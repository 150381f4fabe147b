"""Vertices of the polygons that stand for pixel boundaries: positions and displacements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bfsensor.typing import FloatArray


def vertex_fractions(vertices: int) -> FloatArray:
    """Compute the nominal positions of the vertices along a side, denser at the middle.

    Equal steps of the angle seen from the pixel centre, as in GalSim's tables, so that a
    table can be exported without resampling.

    Parameters
    ----------
    vertices : int
        Number of vertices between the corners, 1 or more.

    Returns
    -------
    fractions : ndarray, shape (vertices,)
        Positions as fractions of the side, 0 to 1, ascending; corners are not included.

    Examples
    --------
    >>> vertex_fractions(1)
    array([0.5])
    """
    angle = -np.pi / 4 + (np.arange(vertices) + 1) * np.pi / (2 * (vertices + 1))
    return np.asarray((np.tan(angle) + 1) / 2)


@dataclass(frozen=True)
class Displacements:
    """Displacements (dx, dy) [um] of corners and side vertices at one point of a table.

    Parameters
    ----------
    corners : ndarray, shape (2 reach + 2, 2 reach + 2, 2)
        Displacements of the corners, [row, column].
    horizontal : ndarray, shape (2 reach + 2, 2 reach + 1, vertices, 2)
        Displacements of the vertices on edges between rows.
    vertical : ndarray, shape (2 reach + 1, 2 reach + 2, vertices, 2)
        Displacements of the vertices on edges between columns.
    """

    corners: FloatArray
    horizontal: FloatArray
    vertical: FloatArray


def nominal_positions(
    pitch: tuple[float, float], reach: int, fractions: FloatArray
) -> Displacements:
    """Positions (x, y) [um] of the vertices of undistorted pixels around (0, 0)."""
    n = 2 * reach + 1
    x = (np.arange(n + 1) - reach - 0.5) * pitch[0]
    y = (np.arange(n + 1) - reach - 0.5) * pitch[1]
    corners = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)
    along_x = (x[:-1, None] + fractions * pitch[0])[None]
    along_y = (y[:-1, None] + fractions * pitch[1])[:, None]
    horizontal = np.stack(np.broadcast_arrays(along_x, y[:, None, None]), -1)
    vertical = np.stack(np.broadcast_arrays(x[None, :, None], along_y), -1)
    return Displacements(corners, horizontal, vertical)
