"""The finite-volume operator of a device on a mesh.

In the taper of the field oxide (the only sloped surfaces) permittivities and doping are
averaged over sub-columns and the gate is met at its true distance (Shortley & Weller
1938; symmetric form of Gibou et al. 2002, J. Comput. Phys. 176, 205).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import DeviceError
from bfsensor.simulate.mesh import Mesh, Side, Surfaces
from bfsensor.typing import FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

if TYPE_CHECKING:
    from collections.abc import Callable

    from bfsensor.device.device import Device
    from bfsensor.device.parts import Implant

_SAMPLES = 8


@dataclass(frozen=True)
class Coefficients:
    """The finite-volume operator of a device on a mesh (see ``_kernels.relaxation``).

    Links are in electron per volt and um of row width, ``[kind, z, x]`` with one halo
    column on each side, ``silicon`` the silicon volume of a node per row width [um^2]
    likewise; ``source`` is the fixed charge plus what the conductors send [e-],
    ``[y, z, x]`` with halo.
    """

    mesh: Mesh
    cx: FloatArray
    cy: FloatArray
    cz: FloatArray
    cd: FloatArray
    kind: NDArray[np.int64]
    north: FloatArray
    south: FloatArray
    dy: FloatArray
    silicon: FloatArray
    n_front: int
    conductor: NDArray[np.bool_]
    source: FloatArray = field(repr=False)


def carrier_region(device: Device) -> float:
    """Height [um] up to which free carriers are in equilibrium with the front.

    The end of the deepest implant.  Holes of the channel stops are held there by a
    shallow ridge of the potential; beyond it lies the depleted bulk, whose potential
    falls towards the back contact and would fill with holes at the same quasi-Fermi
    level.  The solver checks that no density is cut off.
    """
    stop = device.channel_stop
    implants = [*device.channel.implants, *stop.implants]
    if stop.dots is not None:
        implants += stop.dots.implants
    surfaces = Surfaces.of(device)
    depth = max((implant.reach for implant in implants), default=1.0)
    return max(surfaces.silicon_channel, surfaces.silicon_stop) + depth


def dual_widths(
    nodes: FloatArray, side: Side, period: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Intervals left and right of every node, and the widths of the cells around them."""
    gaps = np.diff(nodes)
    if side == "mirror":
        left = np.concatenate([[0.0], gaps])
        right = np.concatenate([gaps, [0.0]])
    else:
        wrap = period - (nodes[-1] - nodes[0])
        left = np.concatenate([[wrap], gaps])
        right = np.concatenate([gaps, [wrap]])
    return left, right, 0.5 * (left + right)


def discretise(device: Device, mesh: Mesh) -> Coefficients:
    """Integrate the device over the cells of a mesh.

    Parameters
    ----------
    device : Device
        Geometry, doping and voltages.
    mesh : Mesh
        From :func:`make_mesh` for the same device.

    Returns
    -------
    Coefficients

    Raises
    ------
    DeviceError
        The device has an edge.
    """
    if device.edge is not None:
        raise DeviceError(
            f"{device.name}: edge: a periodic array of pixels has none; strips beyond the last pixel "
            "are solved by bfsensor.simulate.edge_field.solve_edge"
        )
    surfaces = Surfaces.of(device)
    material = device.material
    eps_si = material.permittivity_silicon * VACUUM_PERMITTIVITY
    eps_ox = material.permittivity_oxide * VACUUM_PERMITTIVITY
    nz, ny, nx = mesh.shape
    z = mesh.z
    z_lower = np.concatenate([[z[0]], 0.5 * (z[1:] + z[:-1])])
    z_upper = np.concatenate([0.5 * (z[1:] + z[:-1]), [z[-1]]])
    left, right, _ = dual_widths(mesh.x, mesh.side_x, mesh.period[0])
    south_gap, north_gap, dy = dual_widths(mesh.y, mesh.side_y, mesh.period[1])

    # Sub-columns right and left of every node, each standing for an equal part of half a gap.
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    columns = []
    for gaps, sign in ((left, -1.0), (right, 1.0)):
        for s in steps:
            columns.append((mesh.x + sign * 0.5 * s * gaps, 0.5 * gaps / _SAMPLES))

    def distance(x: FloatArray) -> FloatArray:
        pitch = mesh.pitch[0]
        return pitch / 2 - np.abs(x - pitch * np.round(x / pitch))

    def flux_capacity(zz: FloatArray, d: FloatArray) -> FloatArray:
        gate, surface = surfaces.gate(d), surfaces.silicon(d)
        return eps_ox * (np.clip(zz, gate, surface) - gate) + eps_si * np.maximum(
            zz - surface, 0.0
        )

    def resistance(zz: FloatArray, d: FloatArray) -> FloatArray:
        gate, surface = surfaces.gate(d), surfaces.silicon(d)
        return (np.clip(zz, gate, surface) - gate) / eps_ox + np.maximum(
            zz - surface, 0.0
        ) / eps_si

    d_node = distance(mesh.x)
    inside_gate = z[:, None] <= surfaces.gate(d_node)[None, :] + 1e-9
    conductor = inside_gate.copy()
    conductor[-1] = True
    free = ~conductor

    cx = np.zeros((nz, nx))
    cy = np.zeros((nz, nx))
    cz = np.zeros((nz, nx))
    silicon = np.zeros((nz, nx))
    for x, width in columns:
        d = distance(x)
        cy += width * (
            flux_capacity(z_upper[:, None], d) - flux_capacity(z_lower[:, None], d)
        )
        step = resistance(z[1:, None], d) - resistance(z[:-1, None], d)
        # A sub-column that lies in the gate at both nodes conducts like the oxide above it.
        cz[:-1] += width / np.maximum(step, (z[1:] - z[:-1])[:, None] / eps_si)
        surface = surfaces.silicon(d)
        silicon += width * (
            np.maximum(z_upper[:, None], surface) - np.maximum(z_lower[:, None], surface)
        )
    for s in (np.arange(2 * _SAMPLES) + 0.5) / (2 * _SAMPLES):
        d = distance(mesh.x + s * right)
        share = flux_capacity(z_upper[:, None], d) - flux_capacity(z_lower[:, None], d)
        cx += share / (2 * _SAMPLES) / np.where(right > 0, right, np.inf)

    gate_links = np.zeros((nz, nx))
    # Links down to the gate in the same column, at the true distance of its face.
    above = free[1:] & conductor[:-1]
    gate_height = surfaces.gate(d_node)[None, :]
    reach = resistance(z[1:, None], d_node) - resistance(
        np.broadcast_to(gate_height, (1, nx)), d_node
    )
    dx = 0.5 * (left + right)
    gate_links[1:] += np.where(above, dx / np.maximum(reach, 1e-3 / eps_ox), 0.0)
    # Links sideways into the gate where its face slopes.
    for shift, gaps in ((1, right), (-1, left)):
        neighbour = np.roll(inside_gate, -shift, axis=1)
        meets = free & neighbour & (gaps > 0)[None, :]
        for k, i in zip(*np.nonzero(meets), strict=True):
            path = mesh.x[i] + shift * gaps[i] * np.linspace(0, 1, 201)
            hit = np.nonzero(surfaces.gate(distance(path)) >= z[k] - 1e-12)[0]
            part = max(hit[0] / 200 if len(hit) else 1.0, 0.05)
            middle = distance(np.array([mesh.x[i] + shift * gaps[i] * part / 2]))
            share = flux_capacity(z_upper[k], middle) - flux_capacity(z_lower[k], middle)
            gate_links[k, i] += share[0] / (gaps[i] * part)
    back_links = np.zeros((nz, nx))
    back_links[-2] = np.where(free[-2], cz[-2], 0.0)

    cx *= free & np.roll(free, -1, axis=1)
    cy *= free
    cz[:-1] *= free[1:] & free[:-1]
    cz[-1] = 0.0
    cd = gate_links + back_links
    cd[conductor] = 1.0

    n_front = int(np.searchsorted(z, carrier_region(device))) + 1
    fixed = _fixed_charge(
        device, mesh, surfaces, columns, distance, z_lower, z_upper, silicon, dy
    )
    fixed[1:-1, :, 1:-1] *= free[None]

    # Right-hand side: fixed charge, and what the conductors send through their links.
    point = device.operating_point
    gate = _gate_potential(device, mesh, south_gap, north_gap)
    source = fixed
    source[1:-1, :, 1:-1] += dy[:, None, None] * (
        gate[:, None, None] * gate_links[None] + point.back_bias * back_links[None]
    )
    source[1:-1, :, 1:-1][:, inside_gate] = (dy * gate)[:, None]
    source[1:-1, -1, 1:-1] = dy[:, None] * point.back_bias

    return Coefficients(
        mesh=mesh,
        cx=_halo_x(cx, mesh.side_x, links=True),
        cy=_halo_x(cy, mesh.side_x),
        cz=_halo_x(cz, mesh.side_x),
        cd=_halo_x(cd, mesh.side_x),
        kind=np.zeros(ny + 2, np.int64),
        north=link_factors(north_gap, dy),
        south=link_factors(south_gap, dy),
        dy=np.concatenate([[0.0], dy, [0.0]]),
        silicon=_halo_x(silicon * free, mesh.side_x),
        n_front=n_front,
        conductor=np.pad(conductor, ((0, 0), (1, 1)))[None],
        source=source,
    )


def _halo_x(a: FloatArray, side: Side, *, links: bool = False) -> FloatArray:
    """Add the halo columns (periodic images, or nothing) and the axis of row kinds."""
    out = np.zeros((1, a.shape[0], a.shape[1] + 2))
    out[0, :, 1:-1] = a
    if side == "periodic":
        out[0, :, 0] = a[:, -1]
        out[0, :, -1] = a[:, 0]
    elif links:
        out[0, :, -2] = 0.0
    return out


def link_factors(gaps: FloatArray, dy: FloatArray) -> FloatArray:
    """Link factor to the next row per row width, zero where there is none; with halo."""
    out = np.zeros(len(gaps) + 2)
    np.divide(1.0, gaps * dy, out=out[1:-1], where=gaps > 0)
    return out


def _gate_potential(
    device: Device,
    mesh: Mesh,
    south_gap: FloatArray,
    north_gap: FloatArray,
) -> FloatArray:
    """Gate voltage averaged over the width of each row [V]."""
    pitch = mesh.pitch[1]
    collecting = max(device.gates.edges_y(pitch))
    point = device.operating_point

    def voltage(y: FloatArray) -> FloatArray:
        offset = np.abs(y - pitch * np.round(y / pitch))
        return np.where(offset < collecting, point.gate_high, point.gate_low)

    below, above = voltage(mesh.y - 0.25 * south_gap), voltage(mesh.y + 0.25 * north_gap)
    return (south_gap * below + north_gap * above) / (south_gap + north_gap)


def _fixed_charge(
    device: Device,
    mesh: Mesh,
    surfaces: Surfaces,
    columns: list[tuple[FloatArray, FloatArray]],
    distance: Callable[[FloatArray], FloatArray],
    z_lower: FloatArray,
    z_upper: FloatArray,
    silicon: FloatArray,
    dy: FloatArray,
) -> FloatArray:
    """Dopants and surface charge of every node [e-], ``[y, z, x]`` with halo."""
    nz, ny, nx = mesh.shape
    channel, stop = device.channel, device.channel_stop
    rows = np.zeros((nz, nx))
    dots = np.zeros((nz, nx))

    def dose(
        implants: tuple[Implant, ...],
        surface_charge: float,
        x_surface: FloatArray,
        weight: FloatArray,
    ) -> FloatArray:
        total = np.zeros((nz, nx))
        for implant in implants:
            total += implant.cumulative(
                np.maximum(z_upper[:, None] - x_surface, 0.0)
            ) - implant.cumulative(np.maximum(z_lower[:, None] - x_surface, 0.0))
        if surface_charge:
            # Shared between the two nodes around the surface, so that its height counts.
            cell = np.clip(np.searchsorted(mesh.z, x_surface, side="right") - 1, 0, nz - 2)
            part = (x_surface - mesh.z[cell]) / (mesh.z[cell + 1] - mesh.z[cell])
            part = np.where(np.abs(part) < 1e-9, 0.0, part)
            here = np.arange(nx)
            np.add.at(total, (cell, here), surface_charge * (1 - part))
            np.add.at(total, (cell + 1, here), surface_charge * part)
        return total * weight

    for x, width in columns:
        d = distance(x)
        surface = surfaces.silicon(d)
        in_stop = 1.0 - surfaces.ramp(d, surfaces.side_diffusion)
        in_channel = (surfaces.ramp(d, surfaces.taper) >= 1.0).astype(float)
        rows += dose(channel.implants, channel.surface_charge, surface, width * in_channel)
        rows += dose(stop.implants, stop.surface_charge, surface, width * in_stop)
        if stop.dots is not None:
            dots += dose(
                stop.dots.implants, stop.dots.surface_charge, surface, width * in_stop
            )

    out = np.zeros((ny + 2, nz, nx + 2))
    background = device.silicon.background_doping
    for j in range(ny):
        out[j + 1, :, 1:-1] = (rows + background * silicon * _ripple(device, mesh, j)) * dy[
            j
        ]
    if stop.dots is not None:
        share = _dot_share(device, mesh)
        out[1:-1, :, 1:-1] += dots[None] * (share * dy)[:, None, None]
    return out


def _ripple(device: Device, mesh: Mesh, row: int) -> FloatArray | float:
    """Relative background doping of the nodes of a row."""
    factor: FloatArray | float = 1.0
    for ripple in device.silicon.ripples:
        factor = factor * ripple.factor(mesh.x, np.full_like(mesh.x, mesh.y[row]))
    return factor


def _dot_share(device: Device, mesh: Mesh) -> FloatArray:
    """Share of each row's width that lies within the channel-stop dots."""
    dots = device.channel_stop.dots
    assert dots is not None  # the caller asked
    pitch = mesh.pitch[1]
    south, north, dy = dual_widths(mesh.y, mesh.side_y, mesh.period[1])
    offset = dots.centre - pitch / 2
    total = np.zeros(len(mesh.y))
    for s in (np.arange(32) + 0.5) / 32:
        for gaps, sign in ((south, -1.0), (north, 1.0)):
            y = mesh.y + sign * 0.5 * s * gaps - offset
            inside = np.abs(y - pitch * np.round(y / pitch)) < dots.height / 2
            total += inside * 0.5 * gaps / 32
    return total / dy
