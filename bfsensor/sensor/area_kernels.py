r"""Areas of pixels as convolutions of the charge with kernels.

Every vertex moves in proportion to the effective charges :math:`q` around it, and the area
of a polygon is quadratic in its vertices, so that

.. math:: A = 1 + a \cdot q + \sum_k \lambda_k (w_k \cdot q)^2

with kernels :math:`a` and :math:`w_k` over the pixels around.  The eigenvalues
:math:`\lambda_k` fall steeply, so that a few convolutions suffice for the charges of an image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bfsensor._kernels.shifts import Edges
from bfsensor.typing import FloatArray


@dataclass(frozen=True)
class AreaKernels:
    """Kernels of the areas, by row and column of the source, pixel (0, 0) in the middle.

    Attributes
    ----------
    linear : pair of ndarray, shape (rows, columns)
        Linear kernels a of both modes [1/e-]; the second is empty where there is one mode.
    values : ndarray, shape (kernels,)
        Eigenvalues lambda, sorted by falling size [1/e-^2].
    squares : pair of ndarray, shape (kernels, rows, columns)
        Kernels w of both modes, unit vectors.
    """

    linear: tuple[FloatArray, FloatArray]
    values: FloatArray
    squares: tuple[FloatArray, FloatArray]


def area_kernels(edges: Edges) -> AreaKernels:
    """Compute the kernels for light that converts in the topmost layer.

    Parameters
    ----------
    edges : Edges
        Packed shifts of a sensor.

    Returns
    -------
    AreaKernels
    """
    q, points = edges.reach, len(edges.points)
    widths = [2 * q + 3] + ([5] if edges.modes == 2 else [])
    sizes = [w * w for w in widths]
    moves = np.zeros((2, 4 * points, sum(sizes)))
    nominal = np.zeros((2, 4 * points))
    t = edges.points
    # Bottom, right, top, left: side, offset of the line, direction around the pixel.
    around = (
        (1, 0, 1, (t - 0.5, 0 * t - 0.5)), (0, 1, 1, (0 * t + 0.5, t - 0.5)),
        (1, 1, -1, (t - 0.5, 0 * t + 0.5)), (0, 0, -1, (0 * t - 0.5, t - 0.5)),
    )  # fmt: skip
    for n, (side, line, way, at) in enumerate(around):
        place = slice(n * points, (n + 1) * points)
        nominal[:, place] = np.array(at)[:, ::way]
        first = 0
        for mode, width in enumerate(widths):
            weights = _block(edges, side, mode)
            reach = q if mode == 0 else 1
            rows, columns = weights.shape[2:]
            spread = np.zeros((2, points, width, width))
            # Windows of horizontal edges begin one row lower, of vertical one column.
            j = width // 2 - reach - (side == 1) + (line if side == 1 else 0)
            i = width // 2 - reach - (side == 0) + (line if side == 0 else 0)
            spread[:, :, j : j + rows, i : i + columns] = weights
            flat = spread.reshape(2, points, -1)[:, ::way]
            # Normal is x for vertical edges, y for horizontal ones.
            moves[0, place, first : first + sizes[mode]] = flat[side]
            moves[1, place, first : first + sizes[mode]] = flat[1 - side]
            first += sizes[mode]
    # The shoelace formula: x_n (y_n+1 - y_n-1) / 2 summed over the vertices.
    ahead = np.roll(np.eye(4 * points), 1, axis=1)
    cross = 0.5 * (ahead - ahead.T)
    linear = moves[0].T @ cross @ nominal[1] + moves[1].T @ cross.T @ nominal[0]
    square = moves[0].T @ cross @ moves[1]
    values, vectors = np.linalg.eigh(0.5 * (square + square.T))
    order = np.argsort(-np.abs(values))
    vectors = vectors[:, order].T

    def shape(a: FloatArray) -> tuple[FloatArray, FloatArray]:
        parts = [a[..., : sizes[0]].reshape(*a.shape[:-1], widths[0], widths[0])]
        if edges.modes == 2:
            parts.append(a[..., sizes[0] :].reshape(*a.shape[:-1], 5, 5))
        else:
            parts.append(np.zeros((*a.shape[:-1], 0, 0)))
        return parts[0], parts[1]

    return AreaKernels(shape(linear), values[order], shape(vectors))


def _block(edges: Edges, side: int, mode: int) -> FloatArray:
    """Weights of the topmost layer, (component, point, row, column), without the padding."""
    reach, lanes = (edges.reach, edges.lanes) if mode == 0 else (1, 8)
    rows, columns = 2 * reach + 1 + side, 2 * reach + 2 - side
    size = 2 * len(edges.points) * rows * lanes
    start = int(edges.starts[2 * mode + side]) + (edges.layers - 1) * size
    block = edges.weights[start : start + size]
    return block.reshape(2, len(edges.points), rows, lanes)[..., :columns].astype(float)
