r"""The field at the edge of the pixel array: strips, guard rings, undepleted silicon beyond.

Along an edge nothing changes, so two dimensions do: the distance :math:`x` from the end of
the array (pixels at :math:`x > 0`, strips at :math:`x < 0`) and the height :math:`z`.

The pixels themselves are not resolved.  A laterally averaged pixel responds to a change of the
field above it as a conducting plane does: the mean potential of the unit cell is
:math:`\bar\phi(z) = a + b z - N z^2 / 2 \epsilon` above its implants, and at the height
:math:`z_g` where it does not depend on the back bias the pixels hold it.  The field of an
edge varies over :math:`T / \pi` (80 um in 250 um of silicon), the structure of the pixels that
is left out over :math:`p / 2 \pi` (2 um).

In the bulk holes are in equilibrium with the back contact,
:math:`p = |N| e^{(V_b - \phi) / kT}`, so that silicon which the field does not deplete stays
neutral at the potential of the back, wherever that is.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import DeviceError
from bfsensor.simulate.discretise import carrier_region
from bfsensor.simulate.edge_system import (
    FINEST_X,
    FINEST_Z,
    FrontPlane,
    assemble,
    grade_nodes,
    relax_holes,
)
from bfsensor.simulate.mesh import Surfaces
from bfsensor.simulate.poisson import Potential
from bfsensor.simulate.unit_cell import solve_unit_cell
from bfsensor.typing import FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

if TYPE_CHECKING:
    from bfsensor.device.device import Device

_BIAS_STEP = 0.04
"""Step of the back bias over which the front plane is found, relative to the drop in the silicon.

Chosen: the mean potential of depleted silicon is linear in the back bias but for the wells, so that
twice as large a step finds the same plane up to their response of second order."""

_CELLS = 16
"""Mesh cells per pixel of the unit cells of which the front plane is found.

Chosen: the default of :func:`~bfsensor.simulate.mesh.make_mesh`; twice as many solve the wells more
finely, at some four times the time of a unit cell."""


@dataclass(frozen=True)
class EdgeField:
    """The potential around one edge of the array.

    Parameters
    ----------
    device : Device
        Device with the edge that was solved.
    front : FrontPlane
        Conducting plane that stands for the pixels.
    x : ndarray, shape (nx,)
        Distance from the end of the array [um], pixels at x > 0.
    z : ndarray, shape (nz,)
        Height above the gates [um].
    phi : ndarray, shape (nz, nx)
        Potential [V].
    neutral : ndarray of bool, shape (nz, nx)
        Whether free holes balance more than half of the background doping at a node.
    pitch : float
        Pixel pitch across the edge [um].
    pixels : int
        Number of pixels in the domain.  The domain ends in a mirror plane beyond the last pixel
        and in another beyond the last strip.
    steps : tuple of float
        Largest step [V] of each of Newton's iterations.
    """

    device: Device
    front: FrontPlane
    x: FloatArray
    z: FloatArray
    phi: FloatArray = field(repr=False)
    neutral: NDArray[np.bool_] = field(repr=False)
    pitch: float
    pixels: int
    steps: tuple[float, ...] = field(repr=False)


def front_plane(device: Device, *, charge: float = 0.0) -> FrontPlane:
    r"""Find the conducting plane that stands for the pixels of a uniform array.

    Two unit cells at slightly different back bias: their mean potentials
    :math:`a + b z - N z^2 / 2 \epsilon` meet at the plane.

    Parameters
    ----------
    device : Device
        Mirror-symmetric device; its edge, if it has one, is ignored.
    charge : float
        Electrons in every pixel [e-], 0 or more.

    Returns
    -------
    plane : FrontPlane
        Height and potential of the plane.

    Raises
    ------
    DeviceError
        The silicon above the pixels is not depleted.

    Examples
    --------
    >>> from bfsensor import Device
    >>> plane = front_plane(Device.load("itl_sta3800c"))
    >>> 0.0 < plane.height < 3.0
    True
    """
    plain = dataclasses.replace(device, edge=None)
    point = plain.operating_point
    (a1, b1), first = _mean_line(solve_unit_cell(plain, charge, cells=_CELLS))
    shift = _BIAS_STEP * (first - point.back_bias)
    other = dataclasses.replace(
        plain,
        operating_point=dataclasses.replace(point, back_bias=point.back_bias + shift),
    )
    (a2, b2), _ = _mean_line(solve_unit_cell(other, charge, cells=_CELLS))
    height = -(a2 - a1) / (b2 - b1)
    return FrontPlane(height, a1 + b1 * height + _parabola(plain, height))


def _parabola(device: Device, z: float | FloatArray) -> float:
    """Part of the potential [V] that the background doping makes."""
    permittivity = device.material.permittivity_silicon * VACUUM_PERMITTIVITY
    return -0.5 * device.silicon.background_doping / permittivity * z**2  # type: ignore


def _mean_line(unit: Potential) -> tuple[tuple[float, float], float]:
    """Line a + b z [V] of the mean potential less the doping's parabola; highest mean."""
    mesh = unit.mesh
    weights = [np.zeros(len(nodes)) for nodes in (mesh.y, mesh.x)]
    for weight, nodes in zip(weights, (mesh.y, mesh.x), strict=True):
        weight[1:] += np.diff(nodes)
        weight[:-1] += np.diff(nodes)
    mean = np.einsum("kji,j,i->k", unit.phi, *weights) / (
        weights[0].sum() * weights[1].sum()
    )
    above = mesh.z > carrier_region(unit.device) + 0.5
    z = mesh.z[above]
    line = mean[above] - _parabola(unit.device, z)
    b = (line[-1] - line[0]) / (z[-1] - z[0])
    return (float(line[0] - b * z[0]), float(b)), float(mean.max())


def solve_edge(
    device: Device,
    *,
    pixels: int | None = None,
    charge: float = 0.0,
    refine: int = 0,
    front: FrontPlane | None = None,
) -> EdgeField:
    r"""Solve Poisson's equation around the edge of a device.

    Finite volumes on a graded mesh, holes of the bulk by Newton's method, each step by a
    sparse factorisation.  Strips at a voltage hold it at the silicon surface (``oxide =
    'none'``) or behind their oxide; field-free strips have no normal field there.

    Parameters
    ----------
    device : Device
        Device that describes an edge.
    pixels : int, optional
        Pixels from the edge inward, at least 4; by default as many as six thicknesses hold, where
        the field of the edge has fallen to :math:`e^{-6 \pi}`, and at least 40.
    charge : float
        Electrons in every pixel [e-], 0 or more; unused where ``front`` is given.
    refine : int
        Number of times that every interval of the mesh is halved, 0 or more.
    front : FrontPlane, optional
        Conducting plane that stands for the pixels, by default found with :func:`front_plane`.

    Returns
    -------
    edge : EdgeField
        Potential between the last strip and the last pixel of the domain.

    Raises
    ------
    DeviceError
        The device has no edge, or one outside the validity of this model: see Notes.
    ConvergenceError
        Newton's method did not converge; the error holds its steps [V] as ``history``.

    Notes
    -----
    Valid where the pixels are depleted, with p-type bulk.  Refused: ripples; n-type bulk;
    a voltage below the back bias (a forward current); implants under a contact (they are
    neutral); a strip next to the array whose surface lies below the quasi-Fermi level of
    the holes in the channel stops, which would flow out of the array through it.  Electrons
    of strips are taken as drained, implants of strips as depleted of them.  Not modelled:
    the current that keeps undepleted silicon at the back bias, diffusion out of it, the
    corners of the array, the height of the surface (that of the field oxide is used for
    all strips).

    Examples
    --------
    >>> from bfsensor import Device
    >>> from bfsensor.device.parts import Edge, EdgeStrip
    >>> ring = Edge("x", (EdgeStrip(50.0, 20.0, "none"), EdgeStrip(200.0)))
    >>> device = dataclasses.replace(Device.load("itl_sta3800c"), edge=ring)
    >>> edge = solve_edge(device)
    >>> bool(edge.neutral.any()), bool(edge.neutral[:, edge.x > 0].any())
    (True, False)
    """
    _check(device, pixels, refine)
    assert device.edge is not None
    if front is None:
        front = front_plane(device, charge=charge)
    pitch = device.pixel.pitch_x if device.edge.side == "x" else device.pixel.pitch_y
    thickness = device.silicon.thickness
    if pixels is None:
        pixels = max(40, int(np.ceil(6 * thickness / pitch)))
    ends = -np.cumsum([0.0, *(strip.width for strip in device.edge.strips)])
    surface = Surfaces.of(device).silicon_stop
    heights = sorted({round(surface, 9), round(front.height, 9), thickness})
    x = grade_nodes([*ends[::-1], pixels * pitch], thickness, FINEST_X, refine)
    z = grade_nodes(heights, thickness, FINEST_Z, refine)
    system = assemble(device, front, x, z, ends, surface)
    phi, holes, steps = relax_holes(device, system)
    shape = (len(z), len(x))
    phi, free = phi.reshape(shape), system.free.reshape(shape)
    # Below the surface of the strips nothing is solved; the potential of the surface is
    # repeated there, so that an interpolation across it sees no field of its own.
    row = int(np.argmin(np.abs(z - surface)))
    phi[:row, x < 0] = phi[row, x < 0]
    edge = EdgeField(
        device, front, x, z, phi, (holes > 0.5 * system.acceptors).reshape(shape) & free,
        pitch, pixels, tuple(steps),
    )  # fmt: skip
    _check_front_holes(edge, ends, surface)
    return edge


def _check(device: Device, pixels: int | None, refine: int) -> None:
    name, edge = device.name, device.edge
    if edge is None or not edge.strips:
        raise DeviceError(f"{name}: edge: there are no strips beyond the last pixel")
    if pixels is not None and pixels < 4:
        raise DeviceError(f"pixels = {pixels} from the edge inward must be at least 4")
    if refine < 0:
        raise DeviceError(f"refine = {refine} must not be negative")
    if device.silicon.ripples:
        raise DeviceError(
            f"{name}: silicon.ripple: ripples and an edge are not solved together"
        )
    if device.silicon.background_doping > 0:
        raise DeviceError(
            f"{name}: silicon: background_doping = {1e12 * device.silicon.background_doping:g} "
            "cm-3 is n-type; edges are solved in p-type silicon"
        )
    back = device.operating_point.back_bias
    for k, strip in enumerate(edge.strips):
        where = f"{name}: edge.strip[{k}]"
        if strip.voltage is not None and strip.voltage < back:
            raise DeviceError(
                f"{where}: voltage = '{strip.voltage:g} V' must not be below back_bias = "
                f"'{back:g} V': the bulk would conduct"
            )
        if strip.voltage is not None and strip.oxide == "none" and strip.implants:
            raise DeviceError(
                f"{where}: oxide = 'none' with a voltage is a contact, which leaves its "
                "implants neutral; give none"
            )
        for implant in strip.implants:
            if implant.reach > 0.5 * device.silicon.thickness:
                raise DeviceError(
                    f"{where}: an implant that ends {implant.reach:g} um deep is not one of "
                    "the front surface"
                )


def _check_front_holes(edge: EdgeField, ends: FloatArray, surface: float) -> None:
    """Refuse a first strip into which the holes of the channel stops would flow."""
    device = edge.device
    level = device.operating_point.hole_quasi_fermi_level
    row = int(np.argmin(np.abs(edge.z - surface)))
    lowest = float(edge.phi[row, (edge.x < 0) & (edge.x >= ends[1] - 1e-9)].min())
    if lowest < level:
        raise DeviceError(
            f"{device.name}: edge.strip[0]: its surface falls to {lowest:.3g} V, below the "
            f"holes of the channel stops at hole_quasi_fermi_level = '{level:g} V': they would "
            "flow out of the array; a strip at a higher voltage must come first"
        )
