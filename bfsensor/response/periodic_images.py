"""Removal of a charged pixel's periodic images from the displacements of pixel boundaries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bfsensor.response.vertices import nominal_positions
from bfsensor.simulate.far_field import FarField
from bfsensor.typing import FloatArray

PERIOD = 12
"""Period of the domain [pixel]; the far field of the images is subtracted (``far_field``).

Chosen: at 20 pixels a_ij differ by at most 0.5 % to lag 2 and 2 % to lag 4
(``tests/response/test_edge_response.py``); twice the period needs four times the mesh."""

SAMPLES = 24
"""Points of a boundary line per pixel.

Chosen: vertices are fitted so that they keep the area under the line through these points; twice
as many cost twice the traces of field lines."""


@dataclass(frozen=True)
class Images:
    """Shifts by the periodic images of a unit dipole, and the model that fixes its amplitude.

    Attributes
    ----------
    shifts : list of (ndarray, ndarray, ndarray) or None
        Shifts of corners, horizontal and vertical edges by the images, for each depth; None at a
        depth at which the far field moves nothing.
    models : list of (ndarray, ndarray) or None
        Shifts across vertical and horizontal edges by dipole and images together, for each depth.
    near : tuple of ndarray of bool
        Vertices of vertical and horizontal edges within 1.5 pixels of the axis through the charge,
        to which the amplitude is fitted.
    """

    shifts: list[tuple[FloatArray, ...] | None]
    models: list[tuple[FloatArray, ...] | None]
    near: tuple[NDArray[np.bool_], ...]

    @classmethod
    def of(
        cls,
        far: FarField,
        reach: int,
        pitch: tuple[float, float],
        period: tuple[float, float],
        fractions: FloatArray,
    ) -> Images:
        """Sum the images of a far field at the vertices of a neighbourhood."""
        at = nominal_positions(pitch, reach, fractions)
        near = (
            np.abs(at.vertical[..., 1]) < 1.5 * pitch[1],
            np.abs(at.horizontal[..., 0]) < 1.5 * pitch[0],
        )
        count = len(far.depths)
        shifts: list[tuple[FloatArray, ...] | None] = [None] * count
        models: list[tuple[FloatArray, ...] | None] = [None] * count
        some = [d for d in range(count) if far.shifts[d].max() > 0]
        places = (at.corners, at.horizontal, at.vertical)
        together = np.concatenate([p.reshape(-1, 2) for p in places])
        ends = np.cumsum([p.size // 2 for p in places])[:-1]
        for d, found in zip(some, far.of_images(together, some, period), strict=True):
            images = tuple(
                part.reshape(p.shape)
                for part, p in zip(np.split(found, ends), places, strict=True)
            )
            shifts[d] = images
            models[d] = (
                (far.vectors(at.vertical, d) + images[2])[..., 0],
                (far.vectors(at.horizontal, d) + images[1])[..., 1],
            )
        return cls(shifts, models, near)

    def taken_off(
        self, moved: tuple[FloatArray, ...]
    ) -> tuple[tuple[FloatArray, ...], float]:
        """Displacements without the images, and the images' largest share of the outermost corner.

        The result is linear in the displacements.
        """
        corners, horizontal, vertical = (a.copy() for a in moved)
        share = 0.0
        for d, (images, models) in enumerate(zip(self.shifts, self.models, strict=True)):
            if images is None or models is None:
                continue
            amplitudes = []
            for model, data, facing, near in (
                (models[0], vertical[d, ..., 0], (slice(None), [0, -1]), self.near[0]),
                (models[1], horizontal[d, ..., 1], ([0, -1], slice(None)), self.near[1]),
            ):
                use = near[facing]
                amplitudes.append(
                    (model[facing][use] @ data[facing][use])
                    / (model[facing][use] @ model[facing][use])
                )
            amplitude = float(np.mean(amplitudes))
            for a, shift in zip(
                (corners[d], horizontal[d], vertical[d]), images, strict=True
            ):
                a -= amplitude * shift
            share = max(
                share,
                float(
                    np.abs(amplitude * images[0][-1, -1]).max()
                    / np.abs(moved[0][d, -1, -1]).max()
                ),
            )
        return (corners, horizontal, vertical), share
