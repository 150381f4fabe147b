r"""Shifts of pixel boundaries near an edge, from the field lines of its field.

Without diffusion an electron follows a field line.  The line from the boundary between two
pixels, up through the silicon, is where electrons on either side part:

.. math:: x(z) = x_n + \int_{z_g}^{z} E_x / E_z \, dz' .
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline

from bfsensor.errors import DeviceError
from bfsensor.simulate.edge_field import EdgeField
from bfsensor.typing import FloatArray

_STEEP = 0.05
"""Step of a field line relative to the height above the front plane, and the shortest step [um].

Chosen: with ``solve_edge(refine=1)`` and these steps shifts are those of the exact field of a
voltage step to 0.5 % (``tests/simulate/test_edge_field.py``); steps twice as long have sixteen times
the error of the Runge-Kutta method, which is of fourth order."""

_LONGEST = 1.0 / 100
"""Longest step of a field line, relative to the height of the back above the front plane.

Chosen: twice as long a step has sixteen times the error of its Runge-Kutta method; it takes hold
from a height of a fifth of the silicon on."""

_FLATTEST = 10.0
"""Largest slope of a field line, sideways over upwards; a line that is flatter has met a strip.

Chosen: at twice the slope a line that turns towards a strip is followed a little further before it
is dropped; lines that reach the back surface are not concerned."""

_SEEDS, _ROUNDS = 65, 5
"""Lines that are tried in a round to find the outermost one, and rounds, each 64 times as fine.

Derived: 250 um / 64^5 = 2e-7 um, far below the error of a field line."""


@dataclass(frozen=True)
class EdgeShift:
    """Shifts of the boundaries between pixels against their distance from the edge.

    Attributes
    ----------
    side : {'x', 'y'}
        Axis along which the distance from the edge is counted.
    pitch : float
        Pixel pitch along that axis [um].
    depths : ndarray, shape (nd,)
        Conversion depths as heights above the gates [um].
    shifts : ndarray, shape (nd, n + 1)
        Shifts of the boundaries at 0, 1, ..., n pixels from the end of the array [um], positive
        away from the edge.  The first boundary divides the last pixel from the strips.

    Notes
    -----
    An electron found at a boundary was set free at the boundary plus the shift: in units of
    pixels the shift is what must be added to a measured position, as in the templates of
    DECam.  A star appears displaced by its opposite.
    """

    side: str
    pitch: float
    depths: FloatArray
    shifts: FloatArray
    shadowed: int
    """Number of pixels at the edge that no electron reaches; their boundaries lie together."""

    @property
    def distances(self) -> FloatArray:
        """Distance of the boundaries from the end of the array [um]."""
        return np.asarray(np.arange(self.shifts.shape[1]) * self.pitch, float)

    @property
    def pixel_shifts(self) -> FloatArray:
        """Shifts [pixel], shape (nd, n + 1)."""
        return self.shifts / self.pitch

    @property
    def area_changes(self) -> FloatArray:
        """Relative change of the areas of the pixels, shape (nd, n): what a flat shows."""
        return np.diff(self.shifts, axis=1) / self.pitch


def trace_edge(edge: EdgeField, depths: ArrayLike) -> EdgeShift:
    """Trace the boundaries of the pixels near an edge.

    Parameters
    ----------
    edge : EdgeField
        Solution of :func:`~bfsensor.simulate.edge_field.solve_edge`.
    depths : array_like, shape (nd,)
        Conversion depths as heights above the gates [um], ascending, above the front plane and
        up to the back surface.

    Returns
    -------
    shift : EdgeShift
        Shifts of all boundaries of the domain at every depth.

    Raises
    ------
    DeviceError
        A depth lies outside the silicon or depths do not ascend; the silicon above the pixels is
        not depleted; no electron from the back surface reaches a pixel.

    Examples
    --------
    >>> import dataclasses
    >>> from bfsensor import Device
    >>> from bfsensor.device.parts import Edge, EdgeStrip
    >>> from bfsensor.simulate.edge_field import solve_edge
    >>> ring = Edge("x", (EdgeStrip(50.0, 20.0, "none"), EdgeStrip(200.0)))
    >>> device = dataclasses.replace(Device.load("itl_sta3800c"), edge=ring)
    >>> shift = trace_edge(solve_edge(device), [50.0, 100.0])
    >>> bool(shift.shifts[1, 2] > 1.0), bool(abs(shift.shifts[1, 40]) < 0.01)
    (True, True)
    """
    levels: FloatArray = np.array(depths, dtype=np.float64, ndmin=1)
    low, high = edge.front.height, float(edge.z[-1])
    if np.any(np.diff(levels) <= 0):
        raise DeviceError(f"conversion depths {levels.tolist()} um must ascend")
    if levels[0] <= low or levels[-1] > high + 1e-9:
        outside = levels[0] if levels[0] <= low else levels[-1]
        raise DeviceError(
            f"conversion depth {outside:g} um must lie in the silicon, above the front plane at "
            f"{low:.3g} um and up to {high:g} um (back surface)"
        )
    if np.any(edge.neutral[:, edge.x >= 0]):
        raise DeviceError(
            f"{edge.device.name}: edge: silicon above the pixels is not depleted up to "
            f"{edge.x[np.nonzero(edge.neutral.any(axis=0))[0].max()]:.3g} um from the edge: "
            "electrons set free there diffuse, and boundaries are not defined"
        )
    slopes = _Slopes(edge)
    starts: FloatArray = edge.pitch * np.arange(edge.pixels + 1.0)
    first, outer = _outermost(edge, slopes, levels)
    shadowed = int(np.searchsorted(starts, first)) - 1
    traced = _trace_up(slopes, starts[shadowed + 1 :], levels, low, high)
    lines = np.concatenate(
        [np.repeat(outer[:, None], shadowed + 1, axis=1), traced], axis=1
    )
    return EdgeShift(
        edge.device.edge.side if edge.device.edge else "x", edge.pitch, levels,
        lines - starts, shadowed,
    )  # fmt: skip


class _Slopes:
    """Gradient of an edge's potential above the front plane, interpolated bilinearly."""

    def __init__(self, edge: EdgeField) -> None:
        first = int(np.argmin(np.abs(edge.z - edge.front.height)))
        self.x, self.z = edge.x, edge.z[first:]
        phi = edge.phi[first:]
        # Electrons rise up the potential gradient; down means falling phi with z.
        self.along_x = np.gradient(phi, self.x, axis=1, edge_order=2)
        self.along_z = np.gradient(phi, self.z, axis=0, edge_order=2)
        # The pixels are at one potential, and the plane's end is a corner.
        self.along_x[0, self.x >= 0] = 0.0

    def __call__(self, x: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradient of the potential [V/um] at points; beyond the mesh that of its border."""
        i = np.clip(np.searchsorted(self.x, x) - 1, 0, len(self.x) - 2)
        k = np.clip(np.searchsorted(self.z, z) - 1, 0, len(self.z) - 2)
        u = np.clip((x - self.x[i]) / (self.x[i + 1] - self.x[i]), 0.0, 1.0)
        v = np.clip((z - self.z[k]) / (self.z[k + 1] - self.z[k]), 0.0, 1.0)
        out = []
        for a in (self.along_x, self.along_z):
            low = a[k, i] * (1 - u) + a[k, i + 1] * u
            high = a[k + 1, i] * (1 - u) + a[k + 1, i + 1] * u
            out.append(low * (1 - v) + high * v)
        return out[0], out[1]


def _trace_up(
    slopes: _Slopes,
    starts: FloatArray,
    levels: FloatArray,
    low: float,
    high: float,
) -> FloatArray:
    """Positions x of field lines from the front plane at all levels; nan where they turn back."""
    heights = [low]
    while heights[-1] < high:
        step = max(_STEEP, _STEEP * (heights[-1] - low))
        heights.append(heights[-1] + min(step, _LONGEST * (high - low)))
    heights[-1] = high
    x = starts.copy()
    turned = np.zeros(len(x), bool)

    def slope(x: FloatArray, z: float) -> FloatArray:
        gx, gz = slopes(x, np.full_like(x, z))
        flat = gz > -np.abs(gx) / _FLATTEST
        np.logical_or(turned, flat | (gz >= 0), out=turned)
        return np.divide(gx, gz, out=np.zeros_like(gx), where=~turned)

    path, tangents = [x], [slope(x, low)]
    for z, after in pairwise(heights):
        h = after - z
        a = tangents[-1]
        b = slope(x + 0.5 * h * a, z + 0.5 * h)
        c = slope(x + 0.5 * h * b, z + 0.5 * h)
        d = slope(x + h * c, after)
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
        path.append(x)
        tangents.append(slope(x, after))
    out = CubicHermiteSpline(heights, np.array(path), np.array(tangents))(levels)
    out[:, turned] = np.nan
    return np.asarray(out)


def _outermost(
    edge: EdgeField, slopes: _Slopes, levels: FloatArray
) -> tuple[float, FloatArray]:
    """Start of the outermost line that reaches the back surface, and its positions at all levels.

    Lines from nearer to the edge end in the strips, or on them where the strips repel electrons.
    """
    low, high = edge.front.height, float(edge.z[-1])
    left, right = 0.0, float(edge.x[-1])
    line = np.zeros(0)
    for _ in range(_ROUNDS):
        seeds = np.linspace(left, right, _SEEDS)[1:]
        lines = _trace_up(slopes, seeds, levels, low, high)
        failed = np.flatnonzero(np.isnan(lines[0]))
        first = int(failed[-1]) + 1 if len(failed) else 0
        if first == len(seeds):
            raise DeviceError(
                f"{edge.device.name}: edge: no electron from the back surface reaches the pixels "
                f"up to {right:.4g} um from the edge"
            )
        left = float(seeds[first - 1]) if first else left
        right, line = float(seeds[first]), lines[:, first]
    return right, line
