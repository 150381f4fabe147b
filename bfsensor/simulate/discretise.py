"""The finite-volume operator of a device on a mesh.

In the taper of the field oxide (the only sloped surfaces) permittivities and doping are
averaged over sub-columns and the gate is met at its true distance (Shortley & Weller
1938; symmetric form of Gibou et al. 2002, J. Comput. Phys. 176, 205).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import DeviceError
from bfsensor.simulate.mesh import Mesh, Side, Surfaces
from bfsensor.typing import FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

if TYPE_CHECKING:
    from bfsensor.device.device import Device
    from bfsensor.device.parts import BuriedChannel, ChannelStop, ChannelStopDots

_SAMPLES = 8
"""Number of sub-columns in each half gap between nodes, over which a cell is averaged.

Chosen: with twice as many, permittivities and doping in the taper of the field oxide and in the
side diffusion are averaged over steps half as wide; elsewhere nothing changes."""


@dataclass(frozen=True)
class Coefficients:
    """The finite-volume operator of a device on a mesh (see ``_kernels.relaxation``).

    Attributes
    ----------
    mesh : Mesh
        Mesh on which the device was integrated.
    cx, cy, cz, cd : ndarray, shape (kinds, nz, nx + 2)
        Links to the next node in x, between rows, to the next node in z, and to conductors
        [e-/V per um of row width], with one halo column on each side.
    kind : ndarray of int, shape (ny + 2,)
        Row kind of each row, the first index of the links.
    north, south : ndarray, shape (ny + 2,)
        Link factors to the rows at larger and at smaller y [1/um^2], 0 where there is none.
    dy : ndarray, shape (ny + 2,)
        Widths of the rows [um], 0 in the halo.
    silicon : ndarray, shape (kinds, nz, nx + 2)
        Silicon volume of a node per row width [um^2].
    n_front : int
        Number of planes from the gates up that may hold free carriers.
    conductor : ndarray of bool, shape (kinds, nz, nx + 2)
        Whether a node lies in a gate or at the back contact.
    source : ndarray, shape (ny + 2, nz, nx + 2)
        Fixed charge plus link times voltage of each conductor [e-].
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
        Mesh of the same device, from :func:`~bfsensor.simulate.mesh.make_mesh`.

    Returns
    -------
    coefficients : Coefficients
        Links, fixed charges and silicon volumes of the cells.

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
    section = _CrossSection.of(device, mesh)
    south_gap, north_gap, dy = dual_widths(mesh.y, mesh.side_y, mesh.period[1])
    conductor, free = section.conductor, ~section.conductor
    links = _integrate_cells(section)
    gate_links = _vertical_gate_links(section)
    _add_sloped_gate_links(section, gate_links)
    back_links = np.zeros_like(gate_links)
    back_links[-2] = np.where(free[-2], links.z[-2], 0.0)
    # What goes to a conductor is known there: it counts in the diagonal and in the source.
    cx = links.x * (free & np.roll(free, -1, axis=1))
    cy = links.y * free
    cz = links.z.copy()
    cz[:-1] *= free[1:] & free[:-1]
    cz[-1] = 0.0
    cd = gate_links + back_links
    cd[conductor] = 1.0

    source = _fixed_charge(section, links.silicon, dy)
    source[1:-1, :, 1:-1] *= free[None]
    gate = _gate_potential(device, mesh, south_gap, north_gap)
    _add_conductors(source, section, gate, gate_links, back_links, dy)

    return Coefficients(
        mesh=mesh,
        cx=_halo_x(cx, mesh.side_x, links=True),
        cy=_halo_x(cy, mesh.side_x),
        cz=_halo_x(cz, mesh.side_x),
        cd=_halo_x(cd, mesh.side_x),
        kind=np.zeros(len(mesh.y) + 2, np.int64),
        north=link_factors(north_gap, dy),
        south=link_factors(south_gap, dy),
        dy=np.concatenate([[0.0], dy, [0.0]]),
        silicon=_halo_x(links.silicon * free, mesh.side_x),
        n_front=int(np.searchsorted(mesh.z, carrier_region(device))) + 1,
        conductor=np.pad(conductor, ((0, 0), (1, 1)))[None],
        source=source,
    )


@dataclass(frozen=True)
class _CrossSection:
    """The x-z plane that all rows of a mesh share: cells, surfaces and permittivities.

    Attributes
    ----------
    left, right : ndarray, shape (nx,)
        Intervals beside every node [um].
    z_lower, z_upper : ndarray, shape (nz,)
        Ends of the cells [um].
    columns : list of (ndarray, ndarray)
        Sub-columns right and left of every node, each standing for an equal part of half a
        gap: their places and widths [um].
    silicon, oxide : float
        Permittivities [e-/(V um)].
    """

    device: Device
    mesh: Mesh
    surfaces: Surfaces
    left: FloatArray
    right: FloatArray
    z_lower: FloatArray
    z_upper: FloatArray
    columns: list[tuple[FloatArray, FloatArray]]
    silicon: float
    oxide: float

    @classmethod
    def of(cls, device: Device, mesh: Mesh) -> _CrossSection:
        """Lay the cells of a device's mesh."""
        z = mesh.z
        left, right, _ = dual_widths(mesh.x, mesh.side_x, mesh.period[0])
        middle = 0.5 * (z[1:] + z[:-1])
        columns = [
            (mesh.x + sign * 0.5 * s * gaps, 0.5 * gaps / _SAMPLES)
            for gaps, sign in ((left, -1.0), (right, 1.0))
            for s in (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        ]
        return cls(
            device, mesh, Surfaces.of(device), left, right, np.concatenate([[z[0]], middle]),
            np.concatenate([middle, [z[-1]]]), columns,
            silicon=device.material.permittivity_silicon * VACUUM_PERMITTIVITY,
            oxide=device.material.permittivity_oxide * VACUUM_PERMITTIVITY,
        )  # fmt: skip

    @cached_property
    def inside_gate(self) -> NDArray[np.bool_]:
        """Nodes in the gates, shape (nz, nx)."""
        gate = self.surfaces.gate(self.distance(self.mesh.x))
        return np.asarray(self.mesh.z[:, None] <= gate[None, :] + 1e-9)

    @cached_property
    def conductor(self) -> NDArray[np.bool_]:
        """Nodes in the gates and at the back contact, shape (nz, nx)."""
        out = self.inside_gate.copy()
        out[-1] = True
        return out

    def distance(self, x: FloatArray) -> FloatArray:
        """Distance from the nearest boundary between columns [um]."""
        pitch = self.mesh.pitch[0]
        return pitch / 2 - np.abs(x - pitch * np.round(x / pitch))

    def flux_capacity(self, z: FloatArray, d: FloatArray) -> FloatArray:
        """Integrate the permittivity from the gate up to z, at distances from the boundary."""
        gate, surface = self.surfaces.gate(d), self.surfaces.silicon(d)
        return self.oxide * (np.clip(z, gate, surface) - gate) + self.silicon * np.maximum(
            z - surface, 0.0
        )

    def cell_capacity(self, d: FloatArray) -> FloatArray:
        """Integrate the permittivity over the height of every cell."""
        return self.flux_capacity(self.z_upper[:, None], d) - self.flux_capacity(
            self.z_lower[:, None], d
        )

    def resistance(self, z: FloatArray, d: FloatArray) -> FloatArray:
        """Integrate the inverse permittivity from the gate up to z."""
        gate, surface = self.surfaces.gate(d), self.surfaces.silicon(d)
        return (np.clip(z, gate, surface) - gate) / self.oxide + np.maximum(
            z - surface, 0.0
        ) / self.silicon


@dataclass(frozen=True)
class _Links:
    """Links to the next node in x, to rows in y and up in z, and silicon of every node."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    silicon: FloatArray


def _integrate_cells(section: _CrossSection) -> _Links:
    """Average the permittivities over sub-columns, as if no node were a conductor."""
    z, right = section.mesh.z, section.right
    cx, cy, cz, silicon = np.zeros((4, *section.conductor.shape))
    for x, width in section.columns:
        d = section.distance(x)
        cy += width * section.cell_capacity(d)
        step = section.resistance(z[1:, None], d) - section.resistance(z[:-1, None], d)
        # A sub-column that lies in the gate at both nodes conducts like the oxide above it.
        cz[:-1] += width / np.maximum(step, (z[1:] - z[:-1])[:, None] / section.silicon)
        surface = section.surfaces.silicon(d)
        silicon += width * (
            np.maximum(section.z_upper[:, None], surface)
            - np.maximum(section.z_lower[:, None], surface)
        )
    for s in (np.arange(2 * _SAMPLES) + 0.5) / (2 * _SAMPLES):
        share = section.cell_capacity(section.distance(section.mesh.x + s * right))
        cx += share / (2 * _SAMPLES) / np.where(right > 0, right, np.inf)
    return _Links(cx, cy, cz, silicon)


def _vertical_gate_links(section: _CrossSection) -> FloatArray:
    """Links down to the gate in the same column, at the true distance of its face."""
    z, conductor = section.mesh.z, section.conductor
    d = section.distance(section.mesh.x)
    height = section.surfaces.gate(d)[None, :]
    reach = section.resistance(z[1:, None], d) - section.resistance(height, d)
    above = ~conductor[1:] & conductor[:-1]
    dx = 0.5 * (section.left + section.right)
    out = np.zeros(conductor.shape)
    out[1:] += np.where(above, dx / np.maximum(reach, 1e-3 / section.oxide), 0.0)
    return out


def _add_sloped_gate_links(section: _CrossSection, gate_links: FloatArray) -> None:
    """Add the links sideways into the gate where its face slopes, in place."""
    mesh, free = section.mesh, ~section.conductor
    for shift, gaps in ((1, section.right), (-1, section.left)):
        neighbour = np.roll(section.inside_gate, -shift, axis=1)
        meets = free & neighbour & (gaps > 0)[None, :]
        for k, i in zip(*np.nonzero(meets), strict=True):
            path = mesh.x[i] + shift * gaps[i] * np.linspace(0, 1, 201)
            gate = section.surfaces.gate(section.distance(path))
            hit = np.nonzero(gate >= mesh.z[k] - 1e-12)[0]
            # The link grows as the inverse distance: it is kept below 20 times that of the gap.
            part = max(hit[0] / 200 if len(hit) else 1.0, 0.05)
            middle = section.distance(np.array([mesh.x[i] + shift * gaps[i] * part / 2]))
            share = section.flux_capacity(
                section.z_upper[k], middle
            ) - section.flux_capacity(section.z_lower[k], middle)
            gate_links[k, i] += share[0] / (gaps[i] * part)


def _add_conductors(
    source: FloatArray,
    section: _CrossSection,
    gate: FloatArray,
    gate_links: FloatArray,
    back_links: FloatArray,
    dy: FloatArray,
) -> None:
    """Add what conductors send through their links, and their potentials, in place.

    ``gate``: voltage of each row [V].
    """
    back = section.device.operating_point.back_bias
    source[1:-1, :, 1:-1] += dy[:, None, None] * (
        gate[:, None, None] * gate_links[None] + back * back_links[None]
    )
    source[1:-1, :, 1:-1][:, section.inside_gate] = (dy * gate)[:, None]
    source[1:-1, -1, 1:-1] = dy[:, None] * back


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
    section: _CrossSection, silicon: FloatArray, dy: FloatArray
) -> FloatArray:
    """Dopants and surface charge of every node [e-], ``[y, z, x]`` with halo."""
    device, mesh, surfaces = section.device, section.mesh, section.surfaces
    nz, ny, nx = mesh.shape
    channel, stop = device.channel, device.channel_stop
    rows = np.zeros((nz, nx))
    dots = np.zeros((nz, nx))
    for x, width in section.columns:
        d = section.distance(x)
        surface = surfaces.silicon(d)
        in_stop = 1.0 - surfaces.ramp(d, surfaces.side_diffusion)
        in_channel = (surfaces.ramp(d, surfaces.taper) >= 1.0).astype(float)
        rows += _dose(section, channel, surface) * (width * in_channel)
        rows += _dose(section, stop, surface) * (width * in_stop)
        if stop.dots is not None:
            dots += _dose(section, stop.dots, surface) * (width * in_stop)

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


def _dose(
    section: _CrossSection, doped: BuriedChannel | ChannelStop | ChannelStopDots,
    surface: FloatArray,
) -> FloatArray:  # fmt: skip
    """Charge of implants and surface in every cell below one place of each node [e-/um^2].

    ``surface``: height of the silicon there, shape (nx,) [um].
    """
    z = section.mesh.z
    # Pixels are alike: each height is computed once.
    surface, column = np.unique(surface, return_inverse=True)
    total = np.zeros((len(z), len(surface)))
    for implant in doped.implants:
        total += implant.cumulative(
            np.maximum(section.z_upper[:, None] - surface, 0.0)
        ) - implant.cumulative(np.maximum(section.z_lower[:, None] - surface, 0.0))
    if doped.surface_charge:
        # Shared between the two nodes around the surface, so that its height counts.
        cell = np.clip(np.searchsorted(z, surface, side="right") - 1, 0, len(z) - 2)
        part = (surface - z[cell]) / (z[cell + 1] - z[cell])
        part = np.where(np.abs(part) < 1e-9, 0.0, part)
        here = np.arange(len(surface))
        np.add.at(total, (cell, here), doped.surface_charge * (1 - part))
        np.add.at(total, (cell + 1, here), doped.surface_charge * part)
    return np.asarray(total[:, column])


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
