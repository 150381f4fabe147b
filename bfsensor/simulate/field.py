"""A solved potential made ready for interpolation: padded on every side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bfsensor.simulate.mesh import Surfaces
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
        phi = np.moveaxis(potential.phi, 0, 1)
        phi, y = _pad(phi, mesh.y, 0, mesh.side_y, mesh.period[1], mesh.cells)
        phi, x = _pad(phi, mesh.x, 2, mesh.side_x, mesh.period[0], mesh.cells)
        phi, z = _pad_z(phi, mesh.z)
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
        return cls(np.ascontiguousarray(phi), x, y, z, zone)


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


def _pad(
    phi: FloatArray,
    nodes: FloatArray,
    axis: int,
    side: str,
    period: float,
    cells: int,
) -> tuple[FloatArray, FloatArray]:
    count = len(nodes)
    if side == "mirror":
        width = min(cells, count - 1)
        before, after = np.arange(width, 0, -1), np.arange(count - 2, count - 2 - width, -1)
        low, high = 2 * nodes[0] - nodes[before], 2 * nodes[-1] - nodes[after]
    else:
        width = min(cells, count)
        before, after = np.arange(count - width, count), np.arange(width)
        low, high = nodes[before] - period, nodes[after] + period
    order = np.concatenate([before, np.arange(count), after])
    return np.take(phi, order, axis=axis), np.concatenate([low, nodes, high])


def _pad_z(phi: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two planes more at either end, from the parabola through the last three."""

    def beyond(target: float, nodes: FloatArray, values: FloatArray) -> FloatArray:
        a, b, c = nodes
        return (
            values[:, 0] * (target - b) * (target - c) / ((a - b) * (a - c))
            + values[:, 1] * (target - a) * (target - c) / ((b - a) * (b - c))
            + values[:, 2] * (target - a) * (target - b) / ((c - a) * (c - b))
        )

    step0, step1 = z[1] - z[0], z[-1] - z[-2]
    low = [z[0] - 2 * step0, z[0] - step0]
    high = [z[-1] + step1, z[-1] + 2 * step1]
    first = [beyond(t, z[:3], phi[:, :3]) for t in low]
    last = [beyond(t, z[-3:], phi[:, -3:]) for t in high]
    padded = np.concatenate([np.stack(first, 1), phi, np.stack(last, 1)], axis=1)
    return padded, np.array([*low, *z, *high])
