"""The linear system of an edge field, and the holes of the bulk in it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import splu

from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

if TYPE_CHECKING:
    from bfsensor.device.device import Device

TOLERANCE = 1e-7
"""Largest last step of Newton's method [V].

Chosen: steps shrink quadratically near the solution, so that the error left is far smaller; at
twice the value at most one step less is made."""

FINEST_X = 0.2
"""Interval of the mesh in x at the ends of strips [um].

Chosen: a jump of voltage is misplaced by half of it; twice as large, by 0.2 um, which is the
error of first order in ``tests/simulate/test_edge_field.py``."""

FINEST_Z = 0.1
"""Interval of the mesh in z at the surface and at the front plane [um].

Chosen: implants are integrated over the cells, so that their dose is kept on any mesh; twice as
large, the depth of a dose is resolved half as well."""

_GROWTH = 1.15
"""Ratio of neighbouring intervals of the mesh, away from its finest places.

Chosen: with intervals that grow twice as much (1.3) the mesh has about half as many nodes, and
the error of its interpolation between them grows with the difference of neighbours."""

_COARSEST = 1.0 / 50
"""Longest interval of the mesh relative to the thickness.

Chosen: the field of an edge varies over the thickness / pi, some 16 such intervals; twice as long,
the error of second order is four times as large in the bulk."""

_MAX_NEWTON = 200
"""Largest number of Newton steps; beyond it a ConvergenceError is raised.

Chosen: damped steps move by a few kT / q at a time where holes spread, each of which costs one
factorisation; twice as many only make a failure take twice as long."""


@dataclass(frozen=True)
class FrontPlane:
    """The conducting plane that stands for the pixels.

    Attributes
    ----------
    height : float
        Above the gates [um].
    potential : float
        [V]; the mean potential of the pixels, continued to that height.
    """

    height: float
    potential: float


def grade_nodes(
    ends: list[float], thickness: float, finest: float, refine: int
) -> FloatArray:
    """Graded nodes that pass through all ends, finest at each of them but the last."""
    coarsest = _COARSEST * thickness
    out = [float(ends[0])]
    for n, (a, b) in enumerate(pairwise(ends)):
        both = n < len(ends) - 2
        length = b - a
        half = length / 2 if both else length
        steps: list[float] = []
        step = min(finest, half)
        while sum(steps) < half - 1e-12:
            steps.append(step)
            step = min(_GROWTH * step, coarsest)
        graded = np.cumsum(steps) * (half / sum(steps))
        if both:
            graded = np.concatenate([graded, length - graded[-2::-1], [length]])
        out.extend(a + graded)
        out[-1] = float(b)
    nodes = np.array(out)
    for _ in range(refine):
        nodes = np.sort(np.concatenate([nodes, 0.5 * (nodes[1:] + nodes[:-1])]))
    return nodes


@dataclass(frozen=True)
class System:
    """The linear system of an edge per um along it; arrays are flat over (z, x).

    Attributes
    ----------
    matrix : sparse matrix
        Links between nodes [e-/(V um)].
    charge : ndarray
        Fixed charge of dopants, and of gates through their oxide [e-/um].
    held : ndarray
        Potentials of the nodes that are conductors [V], 0 elsewhere.
    free : ndarray of bool
        Whether the potential of a node is unknown.
    acceptors : ndarray
        Acceptors of the background doping in each cell [e-/um], above 0 in p-type silicon.
    """

    matrix: csc_matrix
    charge: FloatArray
    held: FloatArray
    free: NDArray[np.bool_]
    acceptors: FloatArray


def assemble(
    device: Device,
    front: FrontPlane,
    x: FloatArray,
    z: FloatArray,
    ends: FloatArray,
    surface: float,
) -> System:
    """Assemble links, charges and conductors of an edge; ``ends`` [um] are those of its strips.

    Each interval in x lies above one strip or above the pixels, and adds half of itself to the
    nodes on either side.
    """
    assert device.edge is not None
    nz, nx = len(z), len(x)
    eps_si = device.material.permittivity_silicon * VACUUM_PERMITTIVITY
    eps_ox = device.material.permittivity_oxide * VACUUM_PERMITTIVITY
    oxide = {"gate": device.gates.gate_oxide, "field": device.gates.field_oxide}
    bias = device.operating_point.back_bias
    lower = np.concatenate([[z[0]], 0.5 * (z[1:] + z[:-1])])
    upper = np.concatenate([0.5 * (z[1:] + z[:-1]), [z[-1]]])
    row = int(np.argmin(np.abs(z - surface)))
    across, along = np.zeros((nz, nx - 1)), np.zeros((nz - 1, nx))
    volume, charge, to_gate = np.zeros((3, nz, nx))
    held = np.full((nz, nx), np.nan)
    held[-1] = bias
    widths = np.diff(x)
    middle = 0.5 * (x[1:] + x[:-1])
    strips = np.searchsorted(-ends, -middle, side="right") - 1  # -1: pixels
    for i, (width, k) in enumerate(zip(widths, strips, strict=True)):
        strip = device.edge.strips[k] if k >= 0 else None
        floor = z[0] if strip is None else surface
        height = np.maximum(upper, floor) - np.maximum(lower, floor)
        across[:, i] = eps_si * height / width
        solid = z[:-1] >= floor - 1e-9
        for node in (i, i + 1):
            along[:, node] += np.where(solid, eps_si * 0.5 * width / np.diff(z), 0.0)
            volume[:, node] += 0.5 * width * height
            if strip is None:
                held[z <= front.height + 1e-9, node] = front.potential
                continue
            for implant in strip.implants:
                dose = implant.cumulative(np.maximum(upper, surface) - surface)
                dose = dose - implant.cumulative(np.maximum(lower, surface) - surface)
                charge[:, node] += 0.5 * width * dose
            if strip.voltage is None:
                continue
            if strip.oxide == "none":
                held[row, node] = strip.voltage
            else:
                link = 0.5 * width * eps_ox / oxide[strip.oxide]
                to_gate[row, node] += link
                charge[row, node] += link * strip.voltage
    acceptors = -device.silicon.background_doping * volume
    # Nodes in the oxide under the strips have no volume: a fixed potential keeps the matrix
    # regular.
    held[(volume == 0) & np.isnan(held)] = bias
    free = np.isnan(held).ravel()
    return System(
        matrix=_link_nodes(across, along, to_gate),
        charge=(charge - acceptors).ravel(),
        held=np.nan_to_num(held).ravel(),
        free=free,
        acceptors=acceptors.ravel(),
    )


def _link_nodes(across: FloatArray, along: FloatArray, to_gate: FloatArray) -> csc_matrix:
    """Matrix of links to the next node in x and in z, and from single nodes to a gate."""
    number = np.arange(to_gate.size).reshape(to_gate.shape)
    one = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    two = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    link = np.concatenate([across.ravel(), along.ravel()])
    return coo_matrix(
        (
            np.concatenate([link, link, -link, -link, to_gate.ravel()]),
            (
                np.concatenate([one, two, one, two, number.ravel()]),
                np.concatenate([one, two, two, one, number.ravel()]),
            ),
        ),
        shape=(number.size, number.size),
    ).tocsc()


def relax_holes(
    device: Device, system: System
) -> tuple[FloatArray, FloatArray, list[float]]:
    """Solve for the potential [V] and the holes [e-/um] of all nodes; returns Newton's steps too."""
    kt = device.material.thermal_voltage(device.operating_point.temperature)
    bias = device.operating_point.back_bias
    free = system.free
    inner = system.matrix[free][:, free].tocsc()
    source = system.charge[free] - (system.matrix[free][:, ~free] @ system.held[~free])
    acceptors = system.acceptors[free]
    has_holes = bool(np.any(acceptors > 0))
    phi = splu(inner).solve(source)
    holes = np.zeros_like(phi)
    steps: list[float] = []
    if has_holes and phi.min() < bias:
        phi = np.maximum(phi, bias)
        while not steps or steps[-1] > TOLERANCE:
            if len(steps) == _MAX_NEWTON:
                raise ConvergenceError(
                    f"{device.name}: the field of the edge did not settle in {_MAX_NEWTON} steps "
                    f"(last {steps[-1]:.2g} V)", steps,
                )  # fmt: skip
            holes = acceptors * np.exp(np.minimum((bias - phi) / kt, 60.0))
            residual = source + holes - inner @ phi
            step = splu((inner + diags(holes / kt)).tocsc()).solve(residual)
            # Holes grow exponentially as the potential falls: not further than linearly.
            near = phi + step < bias + 2 * kt
            damped = -kt * np.log1p(np.maximum(-step, 0.0) / kt)
            step = np.where(near & (step < 0) & (phi < bias + 4 * kt), damped, step)
            floor = np.where(phi > bias, bias - phi, -np.inf)
            step = np.maximum(step, floor)
            steps.append(float(np.abs(step).max()))
            phi = phi + step
        holes = acceptors * np.exp((bias - phi) / kt)
    out, out_holes = system.held.copy(), np.zeros(len(system.held))
    out[free], out_holes[free] = phi, holes
    return out, out_holes, steps
