"""Figures of a solved device: potentials and carriers under the gates, and all pages of a device.

They follow figures 6 and 7 of Lage, Bradshaw & Tyson (2017).  Axes are in um, x serial and
y parallel, z up from the gates; light comes from the top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from bfsensor.direct.transport import Transport
from bfsensor.plots.paths import draw_collected_paths, draw_electron_paths
from bfsensor.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    PURPLE,
    RED,
    SHOWN_CHARGE,
    central_pixel,
    electrons_text,
    import_matplotlib,
    new_figure,
)
from bfsensor.simulate.mesh import Surfaces, make_mesh
from bfsensor.simulate.poisson import Electrostatics, Potential
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from bfsensor.device.device import Device

ELECTRON_COLOUR, HOLE_COLOUR, DOPANT_COLOUR = BLUE, RED, GREEN

_GATE_COLOUR, _OXIDE_COLOUR = "#8C8C8C", "#DDDDDD"
_GATE_DEPTH = 0.25
"""Depth below z = 0 to which gates are drawn [um].

Chosen: room for their voltages; twice as much takes that from the silicon."""

_REACH = 1.5
"""Half the width of a cross section [pixel].

Chosen: the central pixel and both neighbours; twice as much shows two more on either side."""

_FAINTEST = 1e2
"""Density of carriers below which a cross section is left white [1/um^3].

Chosen: without it the tails of the clouds would fill the figure; at twice as much clouds are drawn
a little smaller."""


def draw_potential_profiles(
    potential: Potential,
    axes: NDArray[Any] | Sequence[Sequence[Axes]],
    *,
    empty: Potential | None = None,
    height: float = 4.0,
) -> None:
    """Draw potential and charge density against z under the gates of pixel (0, 0).

    Parameters
    ----------
    potential : Potential
        Solution with charge in pixel (0, 0).
    axes : array of matplotlib.axes.Axes, shape (2, 3)
        Axes to draw into.  Upper row: potentials [V], with an inset to the full thickness;
        lower row: densities of dopants, holes and electrons [1/um^3], positive for positive
        charge.  Columns: centre of the collecting gate, of the channel stop beside it, of the
        barrier gate.
    empty : Potential, optional
        Solution of the same device without stored charge, drawn dashed under the collecting gate.
    height : float
        Upper end of z [um], above 0.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.

    Examples
    --------
    >>> from bfsensor import Device
    >>> potential = solve_unit_cell(Device.load("itl_sta3800c"), 50000.0, cells=8)
    >>> figure = new_figure(13.0, 7.5)
    >>> draw_potential_profiles(potential, figure.subplots(2, 3))
    >>> [ax.get_title() for ax in figure.axes[:3]]
    ['collecting gate, +2 V', 'channel stop', 'barrier gate, -8 V']
    """
    import_matplotlib()
    mesh, point = potential.mesh, potential.device.operating_point
    half_x, half_y = mesh.pitch[0] / 2, mesh.pitch[1] / 2
    places = (
        (f"collecting gate, {point.gate_high:+g} V", 0.0, 0.0, half_x),
        ("channel stop", half_x, 0.0, 0.0),
        (f"barrier gate, {point.gate_low:+g} V", 0.0, half_y, half_x),
    )
    surfaces = Surfaces.of(potential.device)
    for column, (name, x, y, distance) in enumerate(places):
        above, below = axes[0][column], axes[1][column]
        gate = float(surfaces.gate(np.array([distance]))[0])
        silicon = float(surfaces.silicon(np.array([distance]))[0])
        for ax in (above, below):
            ax.axvspan(0.0, gate, color=_GATE_COLOUR, linewidth=0)
            ax.axvspan(gate, silicon, color=_OXIDE_COLOUR, linewidth=0)
            ax.set_xlim(0.0, height)
            ax.set_xlabel("z above the gates [µm]")
        above.set_title(name)
        solutions = [potential, *([empty] if empty is not None and column == 0 else [])]
        _draw_potentials(above, solutions, (x, y), gate, height)
        _draw_densities(below, potential, (x, y), np.linspace(silicon, height, 401))


def _draw_potentials(
    ax: Axes,
    solutions: Sequence[Potential],
    place: tuple[float, float],
    gate: float,
    height: float,
) -> None:
    """Draw the potential above a place (x, y), charged and perhaps empty, with an inset."""
    mesh = solutions[0].mesh
    charge = float(solutions[0].charges[central_pixel(solutions[0])])
    styles = ((electrons_text(charge), "-", BLACK), ("empty", "--", PURPLE))
    ax.set_ylabel("potential [V]")
    full = ax.inset_axes((0.6, 0.62, 0.38, 0.3))
    profiles = []
    for solved, (label, style, colour) in zip(solutions, styles, strict=False):
        phi = solved.phi[:, _node(solved, 1, place[1]), _node(solved, 0, place[0])]
        shown = (mesh.z >= gate - 1e-9) & (mesh.z <= 1.1 * height)
        ax.plot(mesh.z[shown], phi[shown], style, color=colour, linewidth=1.5, label=label)
        full.plot(mesh.z, phi, style, color=colour, linewidth=1.0)
        profiles.append(phi[(mesh.z >= gate - 1e-9) & (mesh.z <= height)])
    low, top = float(profiles[0].min()), max(float(one.max()) for one in profiles)
    # Room above the curve for the inset.
    ax.set_ylim(low - 0.08 * (top - low), top + 0.9 * (top - low))
    full.set_xlim(0.0, mesh.z[-1])
    full.tick_params(labelsize=7)
    full.set_title("to the back surface", fontsize=8, pad=3)
    if len(solutions) > 1:
        ax.legend(loc="upper left", bbox_to_anchor=(0.17, 1.0), fontsize=8, frameon=False)


def _draw_densities(
    ax: Axes, potential: Potential, place: tuple[float, float], heights: FloatArray
) -> None:
    """Draw dopants at the given heights [um], holes and electrons above a place (x, y)."""
    device = potential.device
    ax.set_ylabel("charge density [e/µm³]")
    z, holes, electrons = _carrier_profiles(potential, *place)
    dopants = _dopant_density(device, Surfaces.of(device), *place, heights)
    ax.fill_between(heights, 0.0, dopants, color=DOPANT_COLOUR, alpha=0.25, linewidth=0)
    ax.plot(heights, dopants, color=DOPANT_COLOUR, linewidth=1.3, label="dopants")
    ax.plot(z, holes, color=HOLE_COLOUR, linewidth=1.5, label="holes")
    ax.plot(z, -electrons, color=ELECTRON_COLOUR, linewidth=1.5, label="electrons")
    ax.axhline(0.0, color=BLACK, linewidth=0.6)
    # Decades, linear within 1000: inversion layers are far denser than stored charge.
    ax.set_yscale("symlog", linthresh=1e3, linscale=0.5)
    decades = [10.0**power for power in range(3, 8)]
    ax.set_yticks([-d for d in reversed(decades)] + [0.0, *decades])
    ax.minorticks_off()
    largest = max(float(np.abs(a).max()) for a in (dopants, holes, electrons))
    ax.set_ylim(-2.5 * largest, 2.5 * largest)
    ax.legend(loc="lower right", fontsize=8, frameon=False)


def draw_charge_cross_sections(
    potential: Potential, fig: Figure, *, height: float = 4.0
) -> None:
    """Draw free carriers and potential in the x-z and y-z planes through pixel (0, 0).

    Parameters
    ----------
    potential : Potential
        Solution with charge in pixel (0, 0).
    fig : matplotlib.figure.Figure
        Empty figure to draw into; it receives three panels (x-z under the collecting gate, x-z
        under the barrier gate, y-z along the channel) and two colour bars.  Holes are red,
        electrons blue; gates dark, oxide light grey.
    height : float
        Upper end of z [um], above 0.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.

    Examples
    --------
    >>> from bfsensor import Device
    >>> potential = solve_unit_cell(Device.load("itl_sta3800c"), 50000.0, cells=8)
    >>> figure = new_figure(11.0, 10.0)
    >>> draw_charge_cross_sections(potential, figure)
    >>> len(figure.axes)
    5
    """
    import_matplotlib()
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    mesh, point = potential.mesh, potential.device.operating_point
    densities = [_density(potential, c) for c in (potential.holes, potential.electrons)]
    colours = ("Reds", "Blues")
    scales = [
        LogNorm(_FAINTEST, max(float(density.max()), 10 * _FAINTEST))
        for density in densities
    ]
    axes = list(fig.subplots(3, 1))
    half_y = mesh.pitch[1] / 2
    panels = (
        (0, 0.0, f"x-z at y = 0: collecting gate, {point.gate_high:+g} V"),
        (0, half_y, f"x-z at y = {half_y:g} µm: barrier gate, {point.gate_low:+g} V"),
        (1, 0.0, "y-z at x = 0: along the channel"),
    )
    for ax, (axis, position, title) in zip(axes, panels, strict=True):
        plane = _Plane.of(potential, axis, position)
        for density, scale, colour in zip(densities, scales, colours, strict=True):
            _draw_carriers(ax, plane, density, scale, colour)
        _draw_front(ax, plane)
        _draw_equipotentials(ax, plane, height)
        if axis == 1:
            _draw_gates(ax, plane)
        ax.set_xlim(-plane.extent, plane.extent)
        ax.set_ylim(-_GATE_DEPTH, height)
        ax.set_xlabel(f"{'xy'[axis]}, {'serial' if axis == 0 else 'parallel'} [µm]")
        ax.set_ylabel("z [µm]")
        ax.set_title(title)
    for scale, colour, name in zip(scales, colours, ("holes", "electrons"), strict=True):
        shades = ScalarMappable(scale, colour)
        fig.colorbar(shades, ax=axes, shrink=0.6, pad=0.01, label=f"{name} [µm⁻³]")


@dataclass(frozen=True)
class _Plane:
    """A vertical plane through a solution, continued by symmetry to both sides.

    Attributes
    ----------
    potential : Potential
        The solution.
    axis : int
        Horizontal axis of the plane: 0 for x-z, 1 for y-z.
    node : int
        Index of the mesh node on the other axis at which the plane lies.
    along, order : ndarray
        Positions of the plane's nodes [um], and their indices in the mesh.
    extent : float
        Half the width of the plane [um].
    """

    potential: Potential
    axis: int
    node: int
    along: FloatArray
    order: NDArray[np.int64]
    extent: float

    @classmethod
    def of(cls, potential: Potential, axis: int, position: float) -> _Plane:
        """Make the plane at a position [um] on the other axis."""
        extent = _REACH * potential.mesh.pitch[axis]
        along, order = _unfolded_nodes(potential, axis, extent)
        node = _node(potential, 1 - axis, position)
        return cls(potential, axis, node, along, order, extent)

    @property
    def pitch(self) -> float:
        """Pixel pitch in the plane [um]."""
        return self.potential.mesh.pitch[self.axis]

    def cut(self, values: FloatArray) -> FloatArray:
        """Values at the plane's nodes, [z, along]."""
        plane = values[:, self.node, :] if self.axis == 0 else values[:, :, self.node]
        return plane[:, self.order]

    def surfaces(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return fine positions along the plane, and heights of gate and silicon there [um]."""
        fine = np.linspace(-self.extent, self.extent, 1201)
        if self.axis == 0:
            distance = self.pitch / 2 - np.abs(
                fine - self.pitch * np.round(fine / self.pitch)
            )
        else:
            distance = np.full(fine.shape, self.potential.mesh.pitch[0] / 2)
        surfaces = Surfaces.of(self.potential.device)
        return fine, surfaces.gate(distance), surfaces.silicon(distance)


def _draw_carriers(
    ax: Axes, plane: _Plane, density: FloatArray, scale: Normalize, colours: str
) -> None:
    """Draw a density of carriers, white below ``_FAINTEST``."""
    values = plane.cut(density)
    ax.pcolormesh(
        plane.along, plane.potential.mesh.z[: len(density)],
        np.ma.masked_less(values, _FAINTEST), norm=scale, cmap=colours,
        shading="nearest", rasterized=True, zorder=1,
    )  # fmt: skip


def _draw_front(ax: Axes, plane: _Plane) -> None:
    """Draw gates and oxide."""
    fine, gate, silicon = plane.surfaces()
    ax.fill_between(fine, -_GATE_DEPTH, gate, color=_GATE_COLOUR, linewidth=0, zorder=3)
    ax.fill_between(fine, gate, silicon, color=_OXIDE_COLOUR, linewidth=0, zorder=3)
    ax.plot(fine, gate, color=BLACK, linewidth=0.8, zorder=4)
    ax.plot(fine, silicon, color=BLACK, linewidth=0.8, zorder=4)


def _draw_equipotentials(ax: Axes, plane: _Plane, height: float) -> None:
    """Draw lines of equal potential in the silicon, about ten, and label them."""
    z = plane.potential.mesh.z
    fine, _, silicon = plane.surfaces()
    shown = z <= 1.2 * height
    surface = np.interp(plane.along, fine, silicon)
    phi = np.ma.masked_where(
        z[shown, None] < surface[None, :] - 1e-6, plane.cut(plane.potential.phi)[shown]
    )
    inside = phi.compressed()
    step = _round_step((inside.max() - inside.min()) / 10)
    levels = (
        np.arange(np.floor(inside.min() / step), np.ceil(inside.max() / step) + 1) * step
    )
    lines = ax.contour(
        plane.along, z[shown], phi, levels=levels, colors="#444444", linewidths=0.6,
        linestyles="solid", zorder=2,
    )  # fmt: skip
    segments = [line for group in lines.allsegs for line in group if len(line)]
    places = _label_places(segments, plane, height)
    if places:
        ax.clabel(lines, manual=places, fontsize=7, fmt="%g V")


def _label_places(
    segments: Sequence[FloatArray], plane: _Plane, height: float
) -> list[tuple[float, float]]:
    """Choose label positions at the tops of lines, at a distance from each other."""
    fine, _, silicon = plane.surfaces()
    tops = [line[np.argmax(line[:, 1])] for line in segments]
    places: list[tuple[float, float]] = []
    for a, z in sorted(map(tuple, tops), key=lambda top: -top[1]):
        visible = (
            abs(a) < 0.9 * plane.extent
            # Lines crowd at the edges of gates: no labels there.
            and np.interp(a, fine, silicon) + 0.06 * height < z < height - 0.2
        )
        if visible and all(
            abs(a - b) > 0.2 * plane.pitch or q - z > 0.06 * height for b, q in places
        ):
            places.append((a, z))
    return places


def _draw_gates(ax: Axes, plane: _Plane) -> None:
    """Draw the ends of the gates in a y-z plane, and write their voltages into them."""
    device, pitch = plane.potential.device, plane.pitch
    point = device.operating_point
    top = plane.surfaces()[1][0]
    for m in range(-2, 3):
        for edge in device.gates.edges_y(pitch):
            ax.plot(
                [edge + m * pitch] * 2, [-_GATE_DEPTH, top], color="white", linewidth=1.5,
                zorder=5,
            )  # fmt: skip
        if abs(m) <= _REACH - 0.5:
            _write_in_gate(ax, m * pitch, top, f"{point.gate_high:+g} V")
        if abs(m + 0.5) < _REACH:
            _write_in_gate(ax, (m + 0.5) * pitch, top, f"{point.gate_low:+g} V")


def figure_for_device(device: Device) -> dict[str, Figure]:
    """Solve a device with an empty and with a filled pixel, and draw both.

    Parameters
    ----------
    device : Device
        Any device; it is solved on a period of 4 pixels with 16 cells a pixel, pixel (0, 0) once
        empty and once with :data:`~bfsensor.plots.style.SHOWN_CHARGE`.

    Returns
    -------
    figures : dict of str to matplotlib.figure.Figure
        ``profiles`` (potentials and densities), ``sections`` (planes), ``paths`` (drift without
        diffusion) and ``diffusion`` (drift, drift with diffusion, the same above a full pixel),
        each to be written with ``savefig``.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    ConvergenceError, DeviceError
        The device cannot be solved with that charge.
    """
    # Before the solution, which takes seconds, because matplotlib may be missing.
    profiles = new_figure(13.0, 7.5)
    mesh = make_mesh(device, pixels=(4, 4), cells=16)
    solver = Electrostatics(device, mesh)
    unit = solve_unit_cell(device, 0.0, cells=16)
    empty = solver.solve(0.0, start=tile(unit, mesh))
    charges = np.zeros(solver.pixel_shape)
    charges[central_pixel(empty)] = SHOWN_CHARGE
    filled = solver.solve(charges, start=empty.phi)

    draw_potential_profiles(filled, profiles.subplots(2, 3), empty=empty)
    sections = new_figure(11.0, 10.0)
    draw_charge_cross_sections(filled, sections)
    paths = new_figure(12.0, 13.0)
    axes = paths.subplots(3, 2)
    # The lowest 12 um once more, empty and filled, because the paths are curved there.
    for row, (solved, height) in enumerate(((filled, None), (empty, 12.0), (filled, 12.0))):
        draw_electron_paths(solved, axes[row, 0], plane="x", paths=16, height=height)
        draw_electron_paths(solved, axes[row, 1], plane="y", paths=16, height=height)
    diffusion = _diffusion_page(empty, filled)
    return {
        "profiles": profiles,
        "sections": sections,
        "paths": paths,
        "diffusion": diffusion,
    }


def _diffusion_page(empty: Potential, filled: Potential) -> Figure:
    """Page of paths by drift, diffusion and repulsion, over the thickness and near the wells."""
    figure = new_figure(14.0, 13.5)
    axes = figure.subplots(3, 3)
    still = Transport(diffusion=0.0)
    planes: tuple[Literal["x", "y"], ...] = ("x", "x", "y")
    for row, plane, height in zip(axes, planes, (None, 12.0, 12.0), strict=True):
        draw_collected_paths(empty, row[0], plane=plane, height=height, transport=still)
        draw_collected_paths(empty, row[1], plane=plane, height=height)
        draw_collected_paths(filled, row[2], plane=plane, height=height, compare=empty)
    return figure


def _write_in_gate(ax: Axes, position: float, top: float, text: str) -> None:
    """Write a text into the gate at a position [um]."""
    ax.text(
        position, 0.5 * (top - _GATE_DEPTH), text, ha="center", va="center", fontsize=8,
        color="white", zorder=6,
    )  # fmt: skip


def _node(potential: Potential, axis: int, position: float) -> int:
    """Find the node nearest to a position [um] along x (0) or y (1)."""
    nodes = potential.mesh.x if axis == 0 else potential.mesh.y
    return int(np.argmin(np.abs(nodes - position)))


def _unfolded_nodes(
    potential: Potential, axis: int, extent: float
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Node positions [um] just beyond -extent to extent, and their indices in the mesh."""
    mesh = potential.mesh
    nodes, side = ((mesh.x, mesh.side_x), (mesh.y, mesh.side_y))[axis]
    index = np.arange(len(nodes))
    if side == "mirror":
        mirrored = 2 * nodes[0] - nodes[:0:-1]
        nodes, index = (
            np.concatenate([mirrored, nodes]),
            np.concatenate([index[:0:-1], index]),
        )
    period = mesh.period[axis]
    # The last node of an unfolded mirror domain is the first of its next period.
    if side == "mirror":
        nodes, index = nodes[:-1], index[:-1]
    nodes = np.concatenate([nodes + m * period for m in (-2, -1, 0, 1, 2)])
    index = np.tile(index, 5)
    inside = np.nonzero(np.abs(nodes) <= extent + 1e-9)[0]
    keep = slice(max(inside[0] - 1, 0), inside[-1] + 2)
    return nodes[keep], index[keep]


def _density(potential: Potential, carriers: FloatArray) -> FloatArray:
    """Carriers per um^3 of silicon, zero outside it."""
    out = np.zeros_like(carriers)
    return np.divide(carriers, potential.silicon, out=out, where=potential.silicon > 0)


def _carrier_profiles(
    potential: Potential, x: float, y: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights [um], hole and electron densities of a column of nodes in the silicon."""
    j, i = _node(potential, 1, y), _node(potential, 0, x)
    silicon = potential.silicon[:, j, i] > 0
    z = potential.mesh.z[: len(silicon)][silicon]
    holes = _density(potential, potential.holes)[silicon, j, i]
    electrons = _density(potential, potential.electrons)[silicon, j, i]
    return z, holes, electrons


def _dopant_density(
    device: Device, surfaces: Surfaces, x: float, y: float, z: FloatArray
) -> FloatArray:
    """Fixed charge [e/um^3] at heights z [um] of a column, without charge at the interface."""
    pitch_x, pitch_y = device.pixel.pitch_x, device.pixel.pitch_y
    distance = np.array([pitch_x / 2 - abs(x - pitch_x * round(x / pitch_x))])
    depth = np.maximum(z - surfaces.silicon(distance)[0], 0.0)
    stop = device.channel_stop
    parts = [(1.0 - surfaces.ramp(distance, surfaces.side_diffusion)[0], stop.implants)]
    if surfaces.ramp(distance, surfaces.taper)[0] >= 1.0:
        parts.append((1.0, device.channel.implants))
    if stop.dots is not None:
        offset = y - (stop.dots.centre - pitch_y / 2)
        if abs(offset - pitch_y * round(offset / pitch_y)) < stop.dots.height / 2:
            parts.append((parts[0][0], stop.dots.implants))
    total = np.full(z.shape, device.silicon.background_doping)
    for ripple in device.silicon.ripples:
        total = total * ripple.factor(np.array([x]), np.array([y]))
    for share, implants in parts:
        for implant in implants:
            total = total + share * implant.density(depth)
    return total


def _round_step(step: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(step))
    return float(power * next(m for m in (1.0, 2.0, 5.0, 10.0) if m * power >= step))
