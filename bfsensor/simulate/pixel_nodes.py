"""Pixels that the nodes of a mesh belong to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor.simulate.mesh import Mesh
from bfsensor.typing import FloatArray


class PixelNodes:
    """Pixels that the nodes of a mesh belong to.

    Parameters
    ----------
    mesh : Mesh
        Mesh of the array.

    Attributes
    ----------
    x, y : ndarray of int
        Pixel of every node along an axis, with halo; -1 on borders.
    share_x, share_y : ndarray
        Part of each pixel, along an axis, that lies inside the domain.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.x, self.share_x = _pixel_of_node(
            mesh.x, mesh.pitch[0], mesh.pixels("x"), mesh.side_x
        )
        self.y, self.share_y = _pixel_of_node(
            mesh.y, mesh.pitch[1], mesh.pixels("y"), mesh.side_y
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of pixels of the domain in y and in x."""
        return len(self.share_y), len(self.share_x)


def _pixel_of_node(
    nodes: FloatArray, pitch: float, pixels: NDArray[np.int64], side: str
) -> tuple[NDArray[np.int64], FloatArray]:
    """Pixel number of every node (with halo; -1 on borders) and each pixel's share inside."""
    offset = nodes / pitch + 0.5
    border = np.abs(offset - np.round(offset)) < 1e-6
    index = np.where(border, -1, np.floor(offset).astype(np.int64) - pixels[0])
    if side == "periodic":
        share = np.ones(len(pixels))
    else:
        low = np.maximum(nodes[0], (pixels - 0.5) * pitch)
        high = np.minimum(nodes[-1], (pixels + 0.5) * pitch)
        share = (high - low) / pitch
    return np.concatenate([[-1], index, [-1]]), share
