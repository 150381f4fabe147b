"""The mesh of a device: nodes on its edges and surfaces, finest at the gates, graded in the bulk.

The mesh is node-centred and the product of nodes in x, y and z: nodes lie exactly on gate edges,
channel-stop edges, oxide and silicon surfaces, and halving every interval keeps them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.surfaces import Surfaces
from bfsensor.errors import DeviceError
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

Side = Literal["mirror", "periodic"]

MOST_CELLS = 128
"""Largest number of cells a pixel.  Chosen: responses converge with 48 to 64, and with 128 that of a
device takes 10 GB of memory (measured); with 256 it would take 80 GB."""

FINE_ABOVE = 0.4
"""Height above the highest silicon surface up to which planes are at their finest [um].

Chosen: twice as high adds 8 planes, and moves where the grading begins beyond the sheet of stored
electrons, which is some 0.1 um thick and 0.6 to 1.2 um above the gates."""

_FINEST_Z = 0.05
"""Distance of the finest planes [um].

Measured together with the next two: an implanted profile of 5 V is right to 4.2 mV, and four times
as good on a mesh halved (``tests/simulate/test_poisson.py``)."""

_GROWTH_Z = 1.2
"""Ratio of the distances of neighbouring planes above the finest ones.

Chosen: at 1.4 the grading takes half as many planes to reach the coarsest distance; the
measurement is that of ``_FINEST_Z``."""

_COARSEST_Z = 5.0
"""Largest distance of planes [um], in the bulk.

Chosen: there the potential is a parabola, which the second-order operator solves exactly; twice
as large, lateral fields of neighbouring pixels, which vary over some 10 um, are resolved less."""

_STOP_WEIGHT = 1.8
"""Cells per um across a channel stop relative to the channel.

Chosen: at twice the value up to twice as many cells lie in the stops, and those of the channel are
wider for it, as the number of cells is fixed."""

_BARRIER_WEIGHT = 1.6
"""Cells per um under a barrier gate relative to the collecting gates.

Chosen: at twice the value up to twice as many cells lie under the barrier, and those under the
collecting gates are wider for it, as the number of cells is fixed."""


LEAST = 0.02
"""Least length of the parts of a pixel [um]: edges in x or y that are nearer to one another share a
node, and those that are nearer to the pixel's centre or side have a node at this distance from it.

Measured (itl_sta3800c, 16 cells, a channel stop that becomes narrower): with a part of 0.01 um linear
systems take twice as many iterations, with 0.00005 um 23 times as many, and a_10 is 18 % off.  Twice as
long, nodes may lie 0.04 um from an edge, an eighth of its uncertainty."""


@dataclass(frozen=True)
class Mesh:
    """Node positions and what lies beyond the outermost ones.

    Parameters
    ----------
    x, y, z : ndarray
        Node positions [um]; the centre of pixel (0, 0) is at x = y = 0, gates at z = 0.
    side_x, side_y : {'mirror', 'periodic'}
        Mirror: the first and last nodes lie on mirror planes (zero normal field).
        Periodic: the node after the last is the first.
    pitch : tuple of float
        Pixel pitch in x and y [um].
    cells : int
        Mesh cells per pixel in x and in y.

    Attributes
    ----------
    shape : tuple of int
        Number of nodes in z, y, x.
    period : tuple of float
        Distance after which the domain repeats, in x and y [um].
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    side_x: Side
    side_y: Side
    pitch: tuple[float, float]
    cells: int

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes in z, y, x."""
        return len(self.z), len(self.y), len(self.x)

    @property
    def period(self) -> tuple[float, float]:
        """Distance after which the domain repeats, in x and y [um]."""
        out = []
        for nodes, side, pitch in (
            (self.x, self.side_x, self.pitch[0]),
            (self.y, self.side_y, self.pitch[1]),
        ):
            span = nodes[-1] - nodes[0]
            if side == "mirror":
                out.append(2.0 * span)
            else:
                out.append(round((span + nodes[1] - nodes[0]) / pitch) * pitch)
        return out[0], out[1]

    def pixels(self, axis: Literal["x", "y"]) -> NDArray[np.int64]:
        """List the pixels that the domain holds, wholly or in part, along an axis.

        Parameters
        ----------
        axis : {'x', 'y'}
            Axis of the array.

        Returns
        -------
        indices : ndarray of int, shape (n,)
            Consecutive pixel numbers; 0 is the pixel around the origin.
        """
        nodes = self.x if axis == "x" else self.y
        pitch = self.pitch[0] if axis == "x" else self.pitch[1]
        first = int(np.floor(nodes[0] / pitch + 0.5 + 1e-9))
        side = self.side_x if axis == "x" else self.side_y
        if side == "periodic":
            count = round(self.period[0 if axis == "x" else 1] / pitch)
            return np.arange(first, first + count)
        last = int(np.ceil(nodes[-1] / pitch + 0.5 - 1e-9)) - 1
        return np.arange(first, last + 1)


def check_cells(cells: int, name: str = "cells") -> None:
    """Refuse a number of cells a pixel of which no mesh is made.

    Parameters
    ----------
    cells : int
        The number, even, from 8 to :data:`MOST_CELLS`.
    name : str
        Its name in the message.

    Raises
    ------
    DeviceError
        The number is another one.
    """
    if not 8 <= cells <= MOST_CELLS or cells % 2:
        raise DeviceError(
            f"{name} = {cells} must be an even number from 8 to {MOST_CELLS} cells a pixel"
        )


def make_mesh(
    device: Device,
    *,
    pixels: tuple[int, int] = (14, 14),
    cells: int = 16,
    symmetric: bool = True,
    centre: tuple[Literal["pixel", "edge"], Literal["pixel", "edge"]] = ("pixel", "pixel"),
    refine_z: int = 0,
) -> Mesh:
    """Lay a mesh over a periodic array of pixels.

    Parameters
    ----------
    device : Device
        Device to resolve: nodes fall on its gate edges, stops and surfaces.
    pixels : tuple of int
        Period in x and y [pixel], at least 1 each.
    cells : int
        Mesh cells per pixel in x and in y, even, at least 8.
    symmetric : bool
        Mirror planes through the centre (see ``centre``) and half a period from it, a
        quarter of the period; else the whole period with periodic sides and pixel (0, 0)
        in the middle.
    centre : tuple of {'pixel', 'edge'}
        Whether the mirror plane at the origin side goes through the centre of pixel 0
        or through its upper edge (for a pair of equal neighbours), in x and in y.
    refine_z : int
        Number of times that every interval in z is halved, 0 or more.

    Returns
    -------
    mesh : Mesh
        Nodes from the gates at z = 0 to the back surface.

    Raises
    ------
    DeviceError
        Mirror planes are asked for where the device has none, or ``cells`` is odd, below 8 or too
        few to resolve the parts of a pixel.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> mesh = make_mesh(Device.load("itl_sta3800c"), pixels=(2, 2), cells=8)
    >>> len(mesh.x), len(mesh.y), float(mesh.period[0])
    (9, 9, 20.0)
    """
    if symmetric and not device.is_mirror_symmetric:
        raise DeviceError(
            f"{device.name}: ripples, an edge or dots off centre leave no mirror planes; solve "
            "the whole period (symmetric=False)"
        )
    check_cells(cells)
    pitch = (device.pixel.pitch_x, device.pixel.pitch_y)
    axes = []
    for axis in (0, 1):
        half = _half_pixel_nodes(_segments(device, axis), cells // 2)
        if symmetric:
            start = 0.0 if centre[axis] == "pixel" else pitch[axis] / 2
            axes.append(
                _tile_nodes(
                    half, pitch[axis], start, start + pixels[axis] * pitch[axis] / 2
                )
            )
        else:
            start = -(pixels[axis] // 2 + 0.5) * pitch[axis]
            axes.append(
                _tile_nodes(half, pitch[axis], start, start + pixels[axis] * pitch[axis])[
                    :-1
                ]
            )
    side: Side = "mirror" if symmetric else "periodic"
    return Mesh(axes[0], axes[1], _z_nodes(device, refine_z), side, side, pitch, cells)


def part_ends(inner: Sequence[float], end: float, least: float = LEAST) -> list[int]:
    """Numbers of the edges between 0 and ``end`` that have a node of their own, ascending.

    Those nearer than ``least`` to one that is listed before have none.

    Examples
    --------
    >>> part_ends([3.9, 3.0, 3.91, 6.0], 5.0)
    [1, 0]
    """
    kept: list[int] = []
    for n, point in enumerate(inner):
        if 0.0 < point < end and all(abs(point - inner[k]) >= least for k in kept):
            kept.append(n)
    return sorted(kept, key=lambda n: inner[n])


def parted(points: Sequence[float], least: float = LEAST) -> FloatArray:
    """Ascending points, the inner ones moved so far that none is nearer than ``least`` to the next.

    Examples
    --------
    >>> parted([0.0, 3.9, 4.9999, 5.0]).tolist()
    [0.0, 3.9, 4.98, 5.0]
    """
    out = np.array(points, dtype=float)
    for n in range(len(out) - 2, 0, -1):
        out[n] = min(out[n], out[n + 1] - least)
    for n in range(1, len(out) - 1):
        out[n] = max(out[n], out[n - 1] + least)
    return out


def _segments(device: Device, axis: int) -> list[tuple[float, float]]:
    """Ends of the parts of half a pixel [um from its centre], each with its mesh weight.

    The stops (x) and the barrier (y), where free holes screen within a fraction of a
    micrometre, get finer cells than the channel, where the stored charge levels the field.
    """
    half = (device.pixel.pitch_x, device.pixel.pitch_y)[axis] / 2
    stop = device.channel_stop
    edge = half - stop.width / 2
    if axis == 0:
        fine_from, weight = (
            edge - max(device.gates.field_oxide_taper, stop.side_diffusion),
            _STOP_WEIGHT,
        )
        points = [edge, edge - device.gates.field_oxide_taper, edge - stop.side_diffusion]
    else:
        fine_from, weight = max(device.gates.edges_y(device.pixel.pitch_y)), _BARRIER_WEIGHT
        points = [fine_from]
        if stop.dots is not None:
            offset = abs(stop.dots.centre - half)
            points += [abs(offset - stop.dots.height / 2), offset + stop.dots.height / 2]
    points = [float(p) for p in np.round(points, 9)]
    nodes = parted([0.0, *(points[n] for n in part_ends(points, half)), half])
    return [
        (float(end), weight if start >= fine_from - 1e-6 else 1.0)
        for start, end in pairwise(nodes)
    ]


def _half_pixel_nodes(segments: list[tuple[float, float]], cells: int) -> FloatArray:
    """Nodes from the pixel centre to its edge, ``cells`` intervals, all segment ends hit.

    Built on a count that halving can reach, then halved, so that the meshes at ``cells``
    and twice ``cells`` nest from 8 intervals on.
    """
    base = cells
    while base % 2 == 0 and base // 2 >= max(8, len(segments)):
        base //= 2
    if base < len(segments):
        raise DeviceError(
            f"{2 * cells} cells a pixel cannot resolve the {len(segments)} parts of half a pixel"
        )
    ends = np.array([0.0, *(end for end, _ in segments)])
    lengths = np.diff(ends) * np.array([weight for _, weight in segments])
    counts = np.ones(len(lengths), int)
    while counts.sum() < base:
        counts[np.argmax(lengths / counts)] += 1
    nodes = [0.0]
    for a, b, n in zip(ends[:-1], ends[1:], counts, strict=True):
        nodes.extend(np.linspace(a, b, n + 1)[1:])
    out = np.array(nodes)
    while len(out) - 1 < cells:
        out = _halve(out)
    return out


def _halve(nodes: FloatArray) -> FloatArray:
    out = np.empty(2 * len(nodes) - 1)
    out[::2] = nodes
    out[1::2] = 0.5 * (nodes[1:] + nodes[:-1])
    return out


def _tile_nodes(half: FloatArray, pitch: float, start: float, stop: float) -> FloatArray:
    """Repeat the nodes of half a pixel, mirrored, from ``start`` to ``stop``."""
    whole = np.concatenate([-half[:0:-1], half[:-1]])
    n = round((stop - start) / pitch) + 2
    first = int(np.floor(start / pitch)) - 1
    nodes = np.concatenate([whole + m * pitch for m in range(first, first + n + 2)])
    return nodes[(nodes > start - 1e-9) & (nodes < stop + 1e-9)]


def _z_nodes(device: Device, refine: int) -> FloatArray:
    """Nodes from the gates to the back contact, fine at the surfaces and graded above."""
    surfaces = Surfaces.of(device)
    levels = sorted(
        {0.0, surfaces.gate_channel, surfaces.silicon_channel, surfaces.silicon_stop}
    )
    fine_end = levels[-1] + FINE_ABOVE
    nodes = [0.0]
    for a, b in zip(levels, [*levels[1:], fine_end], strict=True):
        if b - a < 1e-9:
            continue
        # Under the channel's gate there is only thick oxide of the stops: no need for detail.
        step = 2.5 * _FINEST_Z if b <= surfaces.gate_channel + 1e-9 else _FINEST_Z
        n = max(1, int(np.ceil((b - a) / step - 1e-9)))
        nodes.extend(np.linspace(a, b, n + 1)[1:])
    thickness = device.silicon.thickness
    steps = []
    step, z = _FINEST_Z, fine_end
    while z < thickness:
        step = min(step * _GROWTH_Z, _COARSEST_Z)
        steps.append(step)
        z += step
    scale = (thickness - fine_end) / sum(steps)
    out = np.array([*nodes, *(fine_end + np.cumsum(steps) * scale)])
    out[-1] = thickness
    for _ in range(refine):
        out = _halve(out)
    return out
