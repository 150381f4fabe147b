"""The mesh of a device and its finite-volume coefficients.

A node-centred tensor mesh: nodes lie exactly on gate edges, channel-stop edges, oxide
and silicon surfaces, so that halving every interval shows a clean order.  In the taper
(the only sloped surfaces) permittivities and doping are averaged over sub-columns and
the gate is met at its true distance (Shortley & Weller 1938; symmetric form of Gibou et
al. 2002, J. Comput. Phys. 176, 205).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import DeviceError
from bfsensor.units import VACUUM_PERMITTIVITY

if TYPE_CHECKING:
    from bfsensor.device import Device

Side = Literal["mirror", "periodic"]

SILICON_CONSUMED = 4.0 / 9.0
"""Share of a grown oxide that lies below the silicon surface it was grown from.

Molar volumes of Si and SiO2 give 0.44 (Deal & Grove 1965, J. Appl. Phys. 36, 3770);
4/9 puts the gate of the published ITL device at its 0.5 um above the field-oxide top."""

_FINEST_Z = 0.05
_GROWTH_Z = 1.2
_COARSEST_Z = 5.0
_SAMPLES = 8
_STOP_WEIGHT = 1.8
_BARRIER_WEIGHT = 1.6


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
        Cells a pixel.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
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
        """Indices of the pixels that the domain holds, wholly or in part, along an axis."""
        nodes = self.x if axis == "x" else self.y
        pitch = self.pitch[0] if axis == "x" else self.pitch[1]
        first = int(np.floor(nodes[0] / pitch + 0.5 + 1e-9))
        side = self.side_x if axis == "x" else self.side_y
        if side == "periodic":
            count = round(self.period[0 if axis == "x" else 1] / pitch)
            return np.arange(first, first + count)
        last = int(np.ceil(nodes[-1] / pitch + 0.5 - 1e-9)) - 1
        return np.arange(first, last + 1)


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
        What to resolve: nodes fall on its gate edges, stops and surfaces.
    pixels : tuple of int
        Period in x and y [pixel].
    cells : int
        Cells a pixel in x and in y, even, at least 8.
    symmetric : bool
        Mirror planes through the centre (see ``centre``) and half a period from it, a
        quarter of the period; else the whole period with periodic sides and pixel (0, 0)
        in the middle.
    centre : tuple of {'pixel', 'edge'}
        Whether the mirror plane at the origin side goes through the centre of pixel 0
        or through its upper edge (for a pair of equal neighbours), in x and in y.
    refine_z : int
        How often every interval in z is halved.

    Returns
    -------
    Mesh

    Raises
    ------
    DeviceError
        ``cells`` or ``pixels`` do not fit the device or its symmetry.
    """
    if cells < 8 or cells % 2:
        raise DeviceError(
            f"cells = {cells} must be an even number of at least 8 cells a pixel"
        )
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
    inside = sorted(p for p in set(np.round(points, 9)) if 1e-6 < p < half - 1e-6)
    ends = [*inside, half]
    starts = [0.0, *inside]
    return [
        (end, weight if start >= fine_from - 1e-6 else 1.0)
        for start, end in zip(starts, ends, strict=True)
    ]


def _half_pixel_nodes(
    segments: list[tuple[float, float]], cells: int
) -> NDArray[np.float64]:
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


def _halve(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.empty(2 * len(nodes) - 1)
    out[::2] = nodes
    out[1::2] = 0.5 * (nodes[1:] + nodes[:-1])
    return out


def _tile_nodes(
    half: NDArray[np.float64], pitch: float, start: float, stop: float
) -> NDArray[np.float64]:
    """Repeat the nodes of half a pixel, mirrored, from ``start`` to ``stop``."""
    whole = np.concatenate([-half[:0:-1], half[:-1]])
    n = round((stop - start) / pitch) + 2
    first = int(np.floor(start / pitch)) - 1
    nodes = np.concatenate([whole + m * pitch for m in range(first, first + n + 2)])
    return nodes[(nodes > start - 1e-9) & (nodes < stop + 1e-9)]


def _z_nodes(device: Device, refine: int) -> NDArray[np.float64]:
    """Nodes from the gates to the back contact, fine at the surfaces and graded above."""
    surfaces = Surfaces.of(device)
    levels = sorted(
        {0.0, surfaces.gate_channel, surfaces.silicon_channel, surfaces.silicon_stop}
    )
    fine_end = levels[-1] + 0.4
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


@dataclass(frozen=True)
class Surfaces:
    """Heights of gate and silicon in the channel and in the channel stop [um].

    The field oxide has its top at z = 0; a share :data:`SILICON_CONSUMED` of what it is
    thicker than the gate oxide lies below the silicon surface of the channel.
    """

    gate_channel: float
    silicon_channel: float
    silicon_stop: float
    stop_half_width: float
    taper: float
    side_diffusion: float

    @classmethod
    def of(cls, device: Device) -> Surfaces:
        """Take the surfaces from a device."""
        gates, stop = device.gates, device.channel_stop
        gate = (1.0 - SILICON_CONSUMED) * (gates.field_oxide - gates.gate_oxide)
        gate = max(gate, 0.0)
        return cls(
            gate,
            gate + gates.gate_oxide,
            gates.field_oxide,
            stop.width / 2,
            gates.field_oxide_taper,
            stop.side_diffusion,
        )

    def ramp(self, distance: NDArray[np.float64], width: float) -> NDArray[np.float64]:
        """Rise from 0 in the channel stop to 1 in the channel, against distance from the edge."""
        beyond = distance - self.stop_half_width
        if width <= 0:
            return np.where(beyond > 0, 1.0, 0.0)
        return np.clip(beyond / width, 0.0, 1.0)

    def gate(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of the gate's lower face [um]."""
        return self.gate_channel * self.ramp(distance, self.taper)

    def silicon(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Height of the silicon surface [um]."""
        return self.silicon_stop + (self.silicon_channel - self.silicon_stop) * self.ramp(
            distance, self.taper
        )


@dataclass(frozen=True)
class Coefficients:
    """The finite-volume operator of a device on a mesh (see ``_kernels.relaxation``).

    Links are in electron per volt and um of row width, ``[kind, z, x]`` with one halo
    column on each side, ``silicon`` the silicon volume of a node per row width [um^2]
    likewise; ``source`` is the fixed charge plus what the conductors send [e-],
    ``[y, z, x]`` with halo.
    """

    mesh: Mesh
    cx: NDArray[np.float64]
    cy: NDArray[np.float64]
    cz: NDArray[np.float64]
    cd: NDArray[np.float64]
    kind: NDArray[np.int64]
    north: NDArray[np.float64]
    south: NDArray[np.float64]
    dy: NDArray[np.float64]
    silicon: NDArray[np.float64]
    n_front: int
    conductor: NDArray[np.bool_]
    source: NDArray[np.float64] = field(repr=False)


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
    nodes: NDArray[np.float64], side: Side, period: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
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
    """
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

    def distance(x: NDArray[np.float64]) -> NDArray[np.float64]:
        pitch = mesh.pitch[0]
        return pitch / 2 - np.abs(x - pitch * np.round(x / pitch))

    def flux_capacity(
        zz: NDArray[np.float64], d: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        gate, surface = surfaces.gate(d), surfaces.silicon(d)
        return eps_ox * (np.clip(zz, gate, surface) - gate) + eps_si * np.maximum(
            zz - surface, 0.0
        )

    def resistance(zz: NDArray[np.float64], d: NDArray[np.float64]) -> NDArray[np.float64]:
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


def _halo_x(
    a: NDArray[np.float64], side: Side, *, links: bool = False
) -> NDArray[np.float64]:
    """Add the halo columns (periodic images, or nothing) and the axis of row kinds."""
    out = np.zeros((1, a.shape[0], a.shape[1] + 2))
    out[0, :, 1:-1] = a
    if side == "periodic":
        out[0, :, 0] = a[:, -1]
        out[0, :, -1] = a[:, 0]
    elif links:
        out[0, :, -2] = 0.0
    return out


def link_factors(gaps: NDArray[np.float64], dy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Link factor to the next row per row width, zero where there is none; with halo."""
    out = np.zeros(len(gaps) + 2)
    np.divide(1.0, gaps * dy, out=out[1:-1], where=gaps > 0)
    return out


def _gate_potential(
    device: Device,
    mesh: Mesh,
    south_gap: NDArray[np.float64],
    north_gap: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Gate voltage averaged over the width of each row [V]."""
    pitch = mesh.pitch[1]
    collecting = max(device.gates.edges_y(pitch))
    point = device.operating_point

    def voltage(y: NDArray[np.float64]) -> NDArray[np.float64]:
        offset = np.abs(y - pitch * np.round(y / pitch))
        return np.where(offset < collecting, point.gate_high, point.gate_low)

    below, above = voltage(mesh.y - 0.25 * south_gap), voltage(mesh.y + 0.25 * north_gap)
    return (south_gap * below + north_gap * above) / (south_gap + north_gap)


def _fixed_charge(
    device: Device,
    mesh: Mesh,
    surfaces: Surfaces,
    columns: list[tuple[NDArray[np.float64], NDArray[np.float64]]],
    distance,
    z_lower: NDArray[np.float64],
    z_upper: NDArray[np.float64],
    silicon: NDArray[np.float64],
    dy: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Dopants and surface charge of every node [e-], ``[y, z, x]`` with halo."""
    nz, ny, nx = mesh.shape
    channel, stop = device.channel, device.channel_stop
    rows = np.zeros((nz, nx))
    dots = np.zeros((nz, nx))

    def dose(implants, surface_charge, x_surface, weight):
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


def _ripple(device: Device, mesh: Mesh, row: int) -> NDArray[np.float64] | float:
    """Relative background doping of the nodes of a row."""
    factor: NDArray[np.float64] | float = 1.0
    for ripple in device.silicon.ripples:
        factor = factor * ripple.factor(mesh.x, np.full_like(mesh.x, mesh.y[row]))
    return factor


def _dot_share(device: Device, mesh: Mesh) -> NDArray[np.float64]:
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
