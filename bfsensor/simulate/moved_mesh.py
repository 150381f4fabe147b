"""The mesh of a device that differs a little: the same nodes, moved with surfaces and edges.

A mesh that is made for the other device may have another number of planes or cells, and a solution
on it jumps by the error of the mesh.  Differences between two devices on nodes that move with
surfaces and edges are free of that jump.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from bfsensor.errors import DeviceError
from bfsensor.simulate.mesh import FINE_ABOVE, LEAST, Mesh, Surfaces, part_ends, parted
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

_SAME = 1e-6
"""Distance below which two surfaces count as one [um].

Chosen: far above round-off and below any interval of a mesh; twice as large changes nothing."""


def move_mesh(mesh: Mesh, device: Device, moved: Device) -> Mesh:
    """Move the nodes of a device's mesh to where another device of the same kind needs them.

    Nodes on gates, channel stops, dots, oxide and silicon surfaces and the back stay on
    them; those between keep their place in proportion.  The end of the side diffusion moves
    none, for the doping goes to 0 there without a step.

    Parameters
    ----------
    mesh : Mesh
        Mesh of ``device``, from :func:`~bfsensor.simulate.mesh.make_mesh` or moved itself.
    device, moved : Device
        Device of the mesh, and device for which a mesh is wanted, of the same pitch and gates.

    Returns
    -------
    mesh : Mesh
        Mesh with the same number of nodes.

    Raises
    ------
    DeviceError
        The devices differ in pitch or number of gates, or two surfaces or edges change places.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> from bfsensor.simulate.mesh import make_mesh
    >>> device = Device.load("itl_sta3800c")
    >>> thicker = device.with_value("thickness", "105 um")
    >>> mesh = make_mesh(device, pixels=(1, 1), cells=8)
    >>> moved = move_mesh(mesh, device, thicker)
    >>> moved.shape == mesh.shape, float(moved.z[-1])
    (True, 105.0)
    """
    if (device.pixel, device.gates.phases) != (moved.pixel, moved.gates.phases):
        raise DeviceError(
            f"{moved.name}: a mesh moves between devices of one pitch and gate pattern only"
        )
    nodes = []
    for axis, old in ((0, mesh.x), (1, mesh.y)):
        pitch = mesh.pitch[axis]
        here, there = (_in_pixel(d, axis) for d in (device, moved))
        centre = pitch * np.round(old / pitch)
        offset = old - centre
        shifted = _follow(np.abs(offset), here, there, moved, "xy"[axis], LEAST)
        nodes.append(
            np.where(shifted == np.abs(offset), old, centre + np.sign(offset) * shifted)
        )
    z = _follow(mesh.z, _heights(device), _heights(moved), moved, "z", _SAME)
    z[-1] = moved.silicon.thickness
    return replace(mesh, x=nodes[0], y=nodes[1], z=z)


def _in_pixel(device: Device, axis: int) -> list[float]:
    """Distances from the pixel's centre [um] of stops, tapers, gates, dots and, last, of its side."""
    half = (device.pixel.pitch_x, device.pixel.pitch_y)[axis] / 2
    stop = device.channel_stop
    if axis == 0:
        edge = half - stop.width / 2
        return [edge, edge - device.gates.field_oxide_taper, half]
    points = [max(device.gates.edges_y(device.pixel.pitch_y))]
    if stop.dots is not None:
        offset = abs(stop.dots.centre - half)
        points += [abs(offset - stop.dots.height / 2), offset + stop.dots.height / 2]
    return [*points, half]


def _heights(device: Device) -> list[float]:
    """Heights above the gates [um] of the surfaces on which planes of the mesh lie."""
    surfaces = Surfaces.of(device)
    top = max(surfaces.silicon_channel, surfaces.silicon_stop)
    return [
        surfaces.gate_channel, surfaces.silicon_channel, surfaces.silicon_stop,
        top + FINE_ABOVE, device.silicon.thickness,
    ]  # fmt: skip


def _follow(
    nodes: FloatArray,
    here: list[float],
    there: list[float],
    moved: Device,
    axis: str,
    least: float,
) -> FloatArray:
    """Positions of nodes when points go from ``here`` to ``there``, linear between them and 0.

    The last point is the end.  Of others nearer to one another than ``least`` nodes follow the one
    that is listed first.
    """
    kept = part_ends(here[:-1], here[-1], least)
    old, new = ([0.0, *(p[n] for n in kept), p[-1]] for p in (here, there))
    if np.any(np.diff(new) <= 0):
        raise DeviceError(
            f"{moved.name}: along {axis} surfaces or edges at {np.round(new, 4).tolist()} um are not in "
            f"the order of those at {np.round(old, 4).tolist()} um that the mesh was laid for"
        )
    laid = parted(old, least)
    return nodes + np.interp(nodes, laid, parted(new, least) - laid)
