"""A solved potential made ready for interpolation: padded on every side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bfsensor.simulate.mesh import Mesh, Surfaces
from bfsensor.simulate.poisson import Potential
from bfsensor.typing import FloatArray


@dataclass(frozen=True)
class Field:
    """A potential padded beyond the domain, as the kernels interpolate it.

    Parameters
    ----------
    phi : ndarray, shape (ny', nz', nx')
        Potential [V], [y, z, x].
    x, y, z : ndarray
        Positions of the nodes [um].
    zone : ndarray, shape (5,)
        Space in which an electron counts as collected [um]: pitch in x and y, half width and
        half height around a pixel's centre, and greatest height above the gates.
    """

    phi: FloatArray
    x: FloatArray
    y: FloatArray
    z: FloatArray
    zone: FloatArray

    @classmethod
    def of(cls, potential: Potential) -> Field:
        """Pad a potential by its symmetry in x and y and by extrapolation in z.

        Parameters
        ----------
        potential : Potential
            Solved potential.

        Returns
        -------
        field : Field
            The same potential with a pixel more on every side in x and y, and two planes more at
            either end in z.
        """
        mesh = potential.mesh
        phi = np.empty(padded_shape(mesh))
        x, y, z = pad(potential.phi, mesh, phi)
        device = potential.device
        surfaces = Surfaces.of(device)
        channel = mesh.pitch[0] / 2 - surfaces.stop_half_width - surfaces.taper
        collecting = max(device.gates.edges_y(mesh.pitch[1]))
        # The zone lies inside the well, a tenth off the borders of the channel and of the
        # collecting gates, so that no path that passes near a border ends too early.
        zone = np.array(
            [
                mesh.pitch[0],
                mesh.pitch[1],
                0.9 * channel,
                0.9 * collecting,
                surfaces.silicon_channel + 1.0,
            ]
        )
        return cls(phi, x, y, z, zone)


@dataclass(frozen=True)
class PathSteps:
    """Steps in which paths are followed, and how closely a boundary between them is found.

    Attributes
    ----------
    coarseness : float
        Step relative to the scale of the field.
    turn : float
        Largest change of the unit vector of direction within a step.
    precision : float
        Width of the interval at which the search for a boundary ends [um].
    most : int
        Steps after which a path ends where it is.
    """

    coarseness: float
    turn: float
    precision: float
    most: int


def padded_shape(mesh: Mesh) -> tuple[int, int, int]:
    """Shape (y, z, x) of a padded field."""
    counts = []
    for nodes, side in ((mesh.y, mesh.side_y), (mesh.x, mesh.side_x)):
        counts.append(len(_beyond(nodes, side, 0.0, mesh.cells)[2]))
    return counts[0], len(mesh.z) + 4, counts[1]


def pad(
    field: FloatArray, mesh: Mesh, out: NDArray[np.floating]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pad a field by its symmetry in x and y and by extrapolation in z.

    Parameters
    ----------
    field : ndarray, shape (nz, ny, nx)
        Values on the nodes of a mesh.
    mesh : Mesh
        The mesh.
    out : ndarray, shape :func:`padded_shape`
        Filled piece by piece, as touching new memory costs as much as the copy.

    Returns
    -------
    x, y, z : ndarray
        Positions of the padded nodes [um].
    """
    before_y, after_y, y = _beyond(mesh.y, mesh.side_y, mesh.period[1], mesh.cells)
    before_x, after_x, x = _beyond(mesh.x, mesh.side_x, mesh.period[0], mesh.cells)
    _, ny, nx = field.shape
    rows = slice(len(before_y), len(before_y) + ny)
    columns = slice(len(before_x), len(before_x) + nx)
    out[rows, 2:-2, columns] = np.moveaxis(field, 0, 1)
    whole = out[rows]
    whole[..., : columns.start] = whole[..., columns.start + before_x]
    whole[..., columns.stop :] = whole[..., columns.start + after_x]
    out[: rows.start] = whole[before_y]
    out[rows.stop :] = whole[after_y]
    return x, y, _extrapolate(out, mesh.z)


def _beyond(
    nodes: FloatArray, side: str, period: float, cells: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Nodes whose images lie before and after a domain, a pixel of each, and all positions."""
    count = len(nodes)
    if side == "mirror":
        width = min(cells, count - 1)
        before, after = np.arange(width, 0, -1), np.arange(count - 2, count - 2 - width, -1)
        low, high = 2 * nodes[0] - nodes[before], 2 * nodes[-1] - nodes[after]
    else:
        width = min(cells, count)
        before, after = np.arange(count - width, count), np.arange(width)
        low, high = nodes[before] - period, nodes[after] + period
    return before, after, np.concatenate([low, nodes, high])


def _extrapolate(phi: NDArray[np.floating], z: FloatArray) -> FloatArray:
    """Fill two planes at either end, from the parabola through the next three; all heights."""
    step0, step1 = z[1] - z[0], z[-1] - z[-2]
    low = [z[0] - 2 * step0, z[0] - step0]
    high = [z[-1] + step1, z[-1] + 2 * step1]
    for planes, target, nodes, first in (
        ((0, 1), low, z[:3], 2),
        ((-2, -1), high, z[-3:], -5),
    ):
        a, b, c = nodes
        one, two, three = (phi[:, first + n] for n in range(3))
        for plane, t in zip(planes, target, strict=True):
            phi[:, plane] = (
                one * (t - b) * (t - c) / ((a - b) * (a - c))
                + two * (t - a) * (t - c) / ((b - a) * (b - c))
                + three * (t - a) * (t - b) / ((c - a) * (c - b))
            )
    return np.array([*low, *z, *high])
