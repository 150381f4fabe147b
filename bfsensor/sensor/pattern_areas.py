"""Areas of pixels under fixed shifts of their boundaries: tree rings and maps."""

from __future__ import annotations

import math

import numpy as np

from bfsensor._kernels.areas import pixel_areas, times_ring_areas
from bfsensor._kernels.photons import Pattern
from bfsensor._kernels.shifts import MODES, Charges, Edges
from bfsensor.typing import FloatArray

_RING_AREA = 1e-6
"""Largest error of an area [nominal area] by two points a side; above it polygons are drawn.  Chosen: a
hundredth of the photon noise of 1e8 electrons; rings of 0.26 pixel a period of 47 leave 4e-8."""

_FROM_CENTRE = 30.0
"""Distance from the rings' centre [pixel] from which a pixel's area follows from the mean shifts of its
sides; nearer ones are drawn as polygons.  Derived: with the shift g by radius the stretches across and
along the rings vary together within a pixel by g' g'' / (12 distance), 5e-7 for rings of 0.26 pixel a
period of 47; at twice the distance half of that."""


def times_pattern_areas(pattern: Pattern, edges: Edges, out: FloatArray) -> None:
    """Multiply areas by those that fixed shifts give the pixels, for light at the back surface.

    Parameters
    ----------
    pattern : Pattern
        Rings and maps, in pixels from the lower left corner of the image.
    edges : Edges
        The sensor's edges, of which the points along them are used.
    out : ndarray, shape (ny, nx)
        Areas [nominal area], changed in place.
    """
    if not any(p.size > 0 for p in (pattern.rings, pattern.map_x, pattern.edge_x)):
        return
    if (
        pattern.map_x.size
        or pattern.edge_x.size
        or _quadrature_error(pattern) >= _RING_AREA
    ):
        out *= _polygons(pattern, edges, out.shape)
        return
    # At the centre itself a shift has no direction: the pixels around it are drawn as polygons.
    ny, nx = out.shape
    x0, x1 = _near(pattern.ring_x, nx)
    y0, y1 = _near(pattern.ring_y, ny)
    around = out[y0:y1, x0:x1].copy()
    times_ring_areas(pattern, out)
    if around.size:
        moved = pattern._replace(ring_x=pattern.ring_x - x0, ring_y=pattern.ring_y - y0)
        out[y0:y1, x0:x1] = around * _polygons(moved, edges, around.shape)


def _near(centre: float, size: int) -> tuple[int, int]:
    """Range of the pixels of a row or column that may be near the rings' centre."""
    low = min(max(centre - _FROM_CENTRE, 0.0), float(size))
    high = min(max(centre + _FROM_CENTRE, 0.0), float(size))
    return math.floor(low), math.ceil(high)


def _polygons(pattern: Pattern, edges: Edges, shape: tuple[int, ...]) -> FloatArray:
    """Areas of an image without charge, each of a polygon."""
    out = np.empty(shape)
    none = np.zeros(0, np.float32)
    charges = Charges(
        none, none, 1, 0, shape[1], shape[0], none, none, np.zeros(0, np.int64)
    )
    zero = np.zeros(MODES, np.float32)
    pixel_areas(edges, charges, pattern, False, zero, 0, shape[0], out)
    return out


def _quadrature_error(pattern: Pattern) -> float:
    """Error of a pixel's area by two points of Gauss a side: 1/4320 of the fourth derivative."""
    a_pixel = max(round(1.0 / pattern.ring_step), 1)
    changes = np.diff(pattern.rings[:-2:a_pixel], 4)
    return 2.0 * float(np.abs(changes).max(initial=0.0)) / 4320.0
