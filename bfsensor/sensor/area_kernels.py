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
from numpy.typing import NDArray

from bfsensor._kernels.areas import charge_ranges, convolved_areas
from bfsensor._kernels.shifts import MODES, NEAR_MODES, Charges, Edges
from bfsensor.typing import FloatArray

_LARGE = 512 * 512
"""Number of pixels from which areas are summed in single precision.

Chosen: double precision takes twice as long and gains 1e-7 of an area; twice as large keeps it for
images up to 724 pixels wide."""

_SMALL_AREA = 2e-8
"""Largest contribution to an area [nominal area] for which a kernel is left out.

Chosen: below the resolution of single precision, 6e-8; twice as large leaves out kernels that are
still below it."""


@dataclass(frozen=True)
class AreaKernels:
    """Kernels of the areas, by row and column of the source, pixel (0, 0) in the middle.

    Attributes
    ----------
    linear : pair of ndarray, shape (rows, columns)
        Linear kernels a [1/e-] of the first mode, and (modes, 5, 5) of the others, if there are any.
    values : ndarray, shape (kernels,)
        Eigenvalues lambda, sorted by falling size [1/e-^2].
    squares : pair of ndarray, shapes (kernels, rows, columns) and (kernels, modes, 5, 5)
        Kernels w of the first mode and of the others, unit vectors.
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
    widths = [2 * q + 3] + [5] * (edges.modes - 1)
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
        first = a[..., : sizes[0]].reshape(*a.shape[:-1], widths[0], widths[0])
        return first, a[..., sizes[0] :].reshape(*a.shape[:-1], edges.modes - 1, 5, 5)

    return AreaKernels(shape(linear), values[order], shape(vectors))


def _block(edges: Edges, side: int, mode: int) -> FloatArray:
    """Weights of the topmost layer, (component, point, row, column), without the padding."""
    reach, lanes = (edges.reach, edges.lanes) if mode == 0 else (1, 16)
    rows, columns = 2 * reach + 1 + side, 2 * reach + 2 - side
    size = 2 * len(edges.points) * rows * lanes
    start = int(edges.starts[2 * (mode > 0) + side]) + (edges.layers - 1) * size
    block = edges.weights[start : start + size].reshape(2, len(edges.points), rows, lanes)
    # The modes of the nearest pixels lie side by side.
    places = np.arange(columns) if mode == 0 else mode - 1 + NEAR_MODES * np.arange(columns)
    return block[..., places].astype(float)


class Convolution:
    """Areas by convolution, with as many kernels as matter for the charges of an image.

    Parameters
    ----------
    kernels : AreaKernels
        Kernels of the sensor.
    charges : Charges
        Effective charges of the image.
    outside : float
        Effective charge beyond the image [e-]; nan where that of the image is mirrored there.
    """

    def __init__(self, kernels: AreaKernels, charges: Charges, outside: float) -> None:
        self._charges = charges
        self._lows, highs = np.empty((2, MODES), np.float32)
        charge_ranges(charges, self._lows, highs)
        low = self._lows[0]
        inner = highs - self._lows
        self._planes = np.zeros((NEAR_MODES, 0), np.float32)
        ny, nx = charges.ny, charges.nx
        # Single precision is good to 1e-7 and twice as fast; small images, where the time hardly
        # matters, are summed in double precision as GalSim's are.
        kind = np.float64 if ny * nx < _LARGE else np.float32
        self._sums = np.empty((9, 16), kind)
        # Beyond the image there may be no charge, so that pixels near its border see a larger spread
        # of charge and may need more kernels.
        reach = kernels.linear[0].shape[0] // 2
        y0, x0 = min(reach, ny), min(reach, nx)
        y1, x1 = max(ny - reach, y0), max(nx - reach, x0)
        outer = inner
        if not np.isnan(outside):
            above = float(low) - outside
            most = float(inner.max())
            outer = np.full_like(inner, max(most, abs(above), above + most))
        self._parts = [
            (_chosen(kernels, spread, kind), area)
            for spread, area in (
                (inner, (y0, y1, x0, x1)), (outer, (0, y0, 0, nx)), (outer, (y1, ny, 0, nx)),
                (outer, (y0, y1, 0, x0)), (outer, (y0, y1, x1, nx)),
            )
        ]  # fmt: skip

    def write(self, first_row: int, out: FloatArray) -> None:
        """Write the areas [nominal area] of some rows to ``out``, shape (rows, nx)."""
        for (first, near, values), (bottom, top, left, right) in self._parts:
            begin, end = max(bottom, first_row), min(top, first_row + len(out))
            if begin < end:
                size = (end - begin + 6) * self._charges.stride
                if near.shape[1] and self._planes.shape[1] < size:
                    self._planes = np.zeros((NEAR_MODES, size), np.float32)
                convolved_areas(
                    self._charges, self._planes, first, near, values, self._lows, begin, end,
                    left, right, self._sums, first_row, out,
                )  # fmt: skip


def _chosen(
    kernels: AreaKernels, spreads: NDArray[np.float32], kind: type[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.floating], FloatArray]:
    """Kernels of all modes that matter for spreads of charge by mode, and their factors, by eight."""
    first, near = ((part**2).sum((-2, -1)) for part in kernels.squares)
    shares = np.column_stack([first, near])
    largest = shares @ (0.5 * spreads[: shares.shape[1]].astype(float)) ** 2
    large = np.flatnonzero(np.abs(kernels.values) * largest > _SMALL_AREA)
    count = int(large[-1]) + 1 if large.size else 0
    first, near = (
        _by_eight([linear[None], squares[:count]]).astype(kind)
        for linear, squares in zip(kernels.linear, kernels.squares, strict=True)
    )
    values = _by_eight([np.zeros((1, 1, 1)), kernels.values[:count, None, None]])
    return first, near, values[:, 0, 0]


def _by_eight(kernels: list[FloatArray]) -> FloatArray:
    """Order kernels [kernel, ..., row, column] as [eight kernels, ..., row, column, kernel], with 0."""
    flat = np.concatenate(kernels)
    groups = -(-len(flat) // 8)
    full = np.zeros((8 * groups, *flat.shape[1:]))
    full[: len(flat)] = flat
    shaped = full.reshape(groups, 8, *flat.shape[1:])
    return np.ascontiguousarray(np.moveaxis(shaped, 1, -1))
