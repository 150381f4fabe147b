"""Means of separable shapes on the sensor over a map's columns, rows and blocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.map_channels import block_side
from bfsensor.typing import FloatArray


class Places(NamedTuple):
    """Places of a map's values on the sensor.

    Attributes
    ----------
    column, row, block : ndarray of int
        Indices of the values that are means of columns, of rows and of blocks.
    x, y : ndarray of int
        Sensor columns and rows of the former two [pixel].
    across, down : ndarray of int
        Column and row of each block, counted in blocks.
    side : int
        Side of a block [pixel].
    """

    column: NDArray[np.int64]
    row: NDArray[np.int64]
    block: NDArray[np.int64]
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    across: NDArray[np.int64]
    down: NDArray[np.int64]
    side: int

    @classmethod
    def of(cls, axes: Mapping[str, NDArray], shape: tuple[int, int]) -> Places:
        """Find the places from a channel's axes 'what', 'x' and 'y' and the sensor's shape."""
        column, row, block = (
            np.nonzero(axes["what"] == k)[0] for k in ("column", "row", "block")
        )
        side = block_side(shape)
        across, down = (((axes[k][block] + 0.5) / side).astype(int) for k in "xy")
        x, y = axes["x"][column].astype(int), axes["y"][row].astype(int)
        return cls(column, row, block, x, y, across, down, side)

    def product(self, along_x: FloatArray, along_y: FloatArray, size: int) -> FloatArray:
        """Means of a function of x, shape (nx,), times one of y, shape (ny,): ``size`` values.

        Examples
        --------
        >>> axes = {"what": np.array(["column", "row", "block"]),
        ...         "x": np.array([3, -1, 0.5]), "y": np.array([-1, 5, 0.5])}
        >>> Places.of(axes, (32, 32)).product(np.arange(32.0), np.ones(32), 3)
        array([ 3. , 15.5,  0.5])
        """
        across, down = (
            u[: len(u) // self.side * self.side].reshape(-1, self.side).mean(1)
            for u in (along_x, along_y)
        )
        out = np.zeros(size)
        out[self.column] = along_x[self.x] * along_y.mean()
        out[self.row] = along_y[self.y] * along_x.mean()
        out[self.block] = across[self.across] * down[self.down]
        return out
