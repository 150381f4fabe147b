"""Figures of distortion tables: pixel boundaries, areas, response against charge and depth.

With the figures of solved devices (:mod:`bfsensor.plots.device`, :mod:`bfsensor.plots.paths`),
which can be imported from here too, they follow figures 6 to 9 of Lage, Bradshaw & Tyson (2017).
Axes are in um, x serial and y parallel.

Figures need matplotlib (``pip install 'bfsensor[plots]'``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bfsensor.errors import TableError
from bfsensor.plots.device import (
    draw_charge_cross_sections,
    draw_potential_profiles,
    figure_for_device,
)
from bfsensor.plots.paths import draw_collected_paths, draw_electron_paths
from bfsensor.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    SHOWN_CHARGE,
    electrons_text,
    import_matplotlib,
    new_figure,
)
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bfsensor.table.table import DistortionTable

__all__ = [
    "GALSIM_DEPTH_SCALE",
    "SHOWN_CHARGE",
    "draw_area_changes",
    "draw_charge_cross_sections",
    "draw_collected_paths",
    "draw_depth_response",
    "draw_electron_paths",
    "draw_pixel_boundaries",
    "draw_potential_profiles",
    "draw_response",
    "figure_for_device",
    "figure_for_table",
]

GALSIM_DEPTH_SCALE = 12.0
"""Scale [um] of GalSim's tanh for the response against conversion depth: published, in its
Silicon.cpp."""

_NEAREST = (
    ("(0, 0)", 0, 0, BLACK, "o"),
    ("(1, 0) along x", 1, 0, ORANGE, "s"),
    ("(0, 1) along y", 0, 1, BLUE, "^"),
    ("(1, 1)", 1, 1, GREEN, "D"),
)
"""Label, offset in x, offset in y, colour and marker of the pixels that are drawn.

Chosen: the source and its nearest neighbours, whose areas change most."""

_LINE_STYLES: tuple[Any, ...] = ("-", "--", "-.", ":")


def draw_pixel_boundaries(
    table: DistortionTable,
    ax: Axes,
    *,
    charge: float,
    background: float = 0.0,
    depth: float,
    reach: int = 2,
    exaggerate: float = 1.0,
) -> None:
    """Draw the distorted pixels around a charged one, with their areas.

    Parameters
    ----------
    table : DistortionTable
        The table.
    ax : matplotlib.axes.Axes
        Axes to draw into; x and y are positions [um] relative to the centre of the charged pixel.
    charge, background : float
        Charge of pixel (0, 0) and of all others [e-], within the table.
    depth : float
        Conversion depth [um above the gates], within the table.
    reach : int
        Largest pixel offset that is drawn, at most that of the table.
    exaggerate : float
        Factor on the drawn displacements, stated in the title; the areas are not exaggerated.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    TableError
        A charge, background, depth or reach that the table does not hold.

    Examples
    --------
    >>> from bfsensor import DistortionTable
    >>> from bfsensor.plots.style import new_figure
    >>> ax = new_figure(5.0, 5.0).add_subplot()
    >>> table = DistortionTable.load("itl_sta3800c")
    >>> draw_pixel_boundaries(table, ax, charge=80000.0, depth=95.0, exaggerate=5.0)
    >>> len(ax.texts)
    25
    """
    import_matplotlib()
    from matplotlib.collections import LineCollection, PolyCollection

    areas = table.areas(charge=charge, background=background, depth=depth)
    middle = areas.shape[0] // 2
    reach = min(reach, middle)
    pitch = np.array(table.pitch)
    half = reach + 0.5
    ticks = np.arange(-reach, reach + 2) - 0.5
    grid = [
        [(t * pitch[0], -half * pitch[1]), (t * pitch[0], half * pitch[1])] for t in ticks
    ]
    grid += [
        [(-half * pitch[0], t * pitch[1]), (half * pitch[0], t * pitch[1])] for t in ticks
    ]
    ax.add_collection(LineCollection(grid, colors=GREY, linewidths=1.0, zorder=1))

    polygons, colours = [], []
    for j in range(-reach, reach + 1):
        for i in range(-reach, reach + 1):
            nominal = _nominal_polygon(table, i, j)
            distorted = table.polygon(
                i, j, charge=charge, background=background, depth=depth
            )
            polygons.append(nominal + exaggerate * (distorted - nominal))
            colours.append("#FBE3CF" if (i, j) == (0, 0) else "none")
            ax.text(
                i * pitch[0], j * pitch[1], f"{areas[middle + j, middle + i]:.2f}",
                ha="center", va="center", fontsize=9, color=BLACK, zorder=4,
            )  # fmt: skip
    ax.add_collection(
        PolyCollection(
            polygons, facecolors=colours, edgecolors=BLUE, linewidths=1.2, zorder=2
        )
    )
    title = f"Pixel boundaries and areas [µm²]: {electrons_text(charge)} in the centre\n"
    title += f"background {electrons_text(background)}, conversion depth {depth:.4g} µm"
    if exaggerate != 1.0:
        title += f", displacements × {exaggerate:g}"
    ax.set_title(title)
    margin = half + 0.12
    ax.set_xlim(-margin * pitch[0], margin * pitch[0])
    ax.set_ylim(-margin * pitch[1], margin * pitch[1])
    ax.set_aspect("equal")
    ax.set_xticks(np.arange(-reach, reach + 1) * pitch[0])
    ax.set_yticks(np.arange(-reach, reach + 1) * pitch[1])
    ax.set_xlabel("x, serial [µm]")
    ax.set_ylabel("y, parallel [µm]")


def draw_response(table: DistortionTable, ax: Axes, *, depth: float) -> None:
    """Draw the area change per charge of the centre and its neighbours, against charge.

    The lines of a linear brighter-fatter effect are horizontal; their slope shows how much weaker
    the effect becomes as the cloud of stored electrons grows.

    Parameters
    ----------
    table : DistortionTable
        The table; its levels of source charge are marked.
    ax : matplotlib.axes.Axes
        Axes to draw into; x is the source charge [10^3 e-], y the area change [um^2] for each
        10^5 e- by which the source exceeds the background.
    depth : float
        Conversion depth [um above the gates], within the table.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    TableError
        The depth is outside the table.

    Examples
    --------
    >>> from bfsensor import DistortionTable
    >>> from bfsensor.plots.style import new_figure
    >>> ax = new_figure(5.0, 5.0).add_subplot()
    >>> draw_response(DistortionTable.load("itl_sta3800c"), ax, depth=95.0)
    >>> ax.get_xlabel()
    'source charge [10³ e⁻]'
    """
    import_matplotlib()
    from matplotlib.lines import Line2D

    nominal = table.pitch[0] * table.pitch[1]
    backgrounds = np.asarray(table.backgrounds)
    for number, background in enumerate(backgrounds):
        charges = np.asarray(table.charges)
        charges = charges[np.abs(charges - background) > 1.0]
        changes = np.array(
            [
                table.areas(charge=q, background=background, depth=depth) - nominal
                for q in charges
            ]
        )
        if not len(charges):
            continue
        middle = changes.shape[1] // 2
        excess = (charges - background) / 1e5
        for _, i, j, colour, marker in _NEAREST:
            ax.plot(
                charges / 1e3, changes[:, middle + j, middle + i] / excess, color=colour,
                marker=marker, markersize=4, linewidth=1.3,
                linestyle=_LINE_STYLES[number % len(_LINE_STYLES)],
            )  # fmt: skip
    ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=0)
    ax.set_xlabel("source charge [10³ e⁻]")
    ax.set_ylabel("area change per 10⁵ e⁻ [µm²]")
    ax.set_title(f"Response against source charge, conversion depth {depth:.4g} µm")
    handles = [
        Line2D([], [], color=c, marker=m, markersize=4, label=n)
        for n, _, _, c, m in _NEAREST
    ]
    if len(backgrounds) > 1:
        handles += [
            Line2D(
                [],
                [],
                color=GREY,
                linestyle=_LINE_STYLES[n % len(_LINE_STYLES)],
                label=electrons_text(b),
            )
            for n, b in enumerate(backgrounds)
        ]
    legend = ax.legend(
        handles=handles, ncols=2, loc="upper center", fontsize=8, frameon=False,
        title="pixel · background of the other pixels" if len(backgrounds) > 1 else "pixel",
        title_fontsize=8,
    )  # fmt: skip
    # Room for the legend above the data, whatever the size of the axes.
    share = legend.get_window_extent().height / ax.get_window_extent().height
    share = min(1.2 * share + 0.03, 0.6)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + share / (1.0 - share) * (high - low))


def draw_depth_response(table: DistortionTable, ax: Axes, *, charge: float) -> None:
    """Draw the central area change against conversion depth, relative to the light side.

    Parameters
    ----------
    table : DistortionTable
        The table; its first background is taken.
    ax : matplotlib.axes.Axes
        Axes to draw into; x is the conversion depth [um above the gates], y the ratio to the
        level farthest from the gates.
    charge : float
        Source charge [e-], within the table.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    TableError
        The charge is outside the table, or it changes no area.

    Notes
    -----
    GalSim scales one table by ``tanh(z / 12 um)``, an empirical function, drawn for comparison.

    Examples
    --------
    >>> from bfsensor import DistortionTable
    >>> from bfsensor.plots.style import new_figure
    >>> ax = new_figure(5.0, 5.0).add_subplot()
    >>> draw_depth_response(DistortionTable.load("itl_sta3800c"), ax, charge=80000.0)
    >>> ax.get_xlabel()
    'conversion depth above the gates [µm]'
    """
    import_matplotlib()
    nominal = table.pitch[0] * table.pitch[1]
    depths = np.asarray(table.depths, float)
    background = float(table.backgrounds[0])

    def central_change(depth: float) -> float:
        areas = table.areas(charge=charge, background=background, depth=depth)
        middle = areas.shape[0] // 2
        return float(areas[middle, middle] - nominal)

    changes = np.array([central_change(z) for z in depths])
    if changes[-1] == 0.0:
        raise TableError(
            f"charge = {charge:g} e- on a background of {background:g} e- changes no area: "
            "no response to draw against depth"
        )
    between = np.linspace(depths[0], depths[-1], 101)
    if len(depths) > 1:
        curve = np.array([central_change(z) for z in between]) / changes[-1]
        ax.plot(between, curve, color=BLUE, linewidth=1.5, label="table, interpolated")
    ax.plot(
        depths, changes / changes[-1], "o", color=BLUE, markersize=5, label="table, levels"
    )
    heights = np.linspace(0.0, depths[-1], 201)
    ax.plot(
        heights, np.tanh(heights / GALSIM_DEPTH_SCALE), "--", color=ORANGE, linewidth=1.5,
        label=f"GalSim: tanh(z / {GALSIM_DEPTH_SCALE:g} µm)",
    )  # fmt: skip
    ax.set_xlim(0.0, 1.02 * depths[-1])
    ax.set_ylim(0.0, 1.1 * max(1.0, float((changes / changes[-1]).max())))
    ax.set_xlabel("conversion depth above the gates [µm]")
    ax.set_ylabel(f"central area change, relative to {depths[-1]:.4g} µm")
    ax.set_title(f"Response against conversion depth, {electrons_text(charge)}")
    ax.legend(loc="lower right", fontsize=9, frameon=False)


def draw_area_changes(
    table: DistortionTable,
    ax: Axes,
    *,
    charge: float,
    background: float = 0.0,
    depth: float,
) -> None:
    """Draw the area changes of all pixels of a table as a map with numbers.

    Parameters
    ----------
    table : DistortionTable
        The table.
    ax : matplotlib.axes.Axes
        Axes to draw into; x and y are pixel offsets.  Numbers are in 10^-3 um^2; colours are
        logarithmic in the change.
    charge, background : float
        Charge of pixel (0, 0) and of all others [e-], within the table.
    depth : float
        Conversion depth [um above the gates], within the table.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.
    TableError
        A charge, background or depth outside the table.

    Examples
    --------
    >>> from bfsensor import DistortionTable
    >>> from bfsensor.plots.style import new_figure
    >>> ax = new_figure(5.0, 5.0).add_subplot()
    >>> draw_area_changes(DistortionTable.load("itl_sta3800c"), ax, charge=80000.0, depth=95.0)
    >>> len(ax.texts)
    81
    """
    import_matplotlib()
    from matplotlib.colors import SymLogNorm

    nominal = table.pitch[0] * table.pitch[1]
    changes = 1e3 * (
        table.areas(charge=charge, background=background, depth=depth) - nominal
    )
    reach = changes.shape[0] // 2
    largest = max(float(np.abs(changes).max()), 1e-6)
    norm = SymLogNorm(linthresh=largest / 1e4, vmin=-largest, vmax=largest)
    image = ax.imshow(
        changes, origin="lower", cmap="PuOr", norm=norm,
        extent=(-reach - 0.5, reach + 0.5, -reach - 0.5, reach + 0.5),
    )  # fmt: skip
    size = 8.5 if reach <= 3 else 7.0
    for j in range(-reach, reach + 1):
        for i in range(-reach, reach + 1):
            value = changes[reach + j, reach + i]
            red, green, blue, _ = image.cmap(norm(value))
            dark = 0.3 * red + 0.6 * green + 0.1 * blue < 0.5
            ax.text(
                i, j, _three_digits(value), ha="center", va="center", fontsize=size,
                color="white" if dark else BLACK,
            )  # fmt: skip
    ax.set_xticks(range(-reach, reach + 1))
    ax.set_yticks(range(-reach, reach + 1))
    ax.set_xlabel("offset in x, serial [pixel]")
    ax.set_ylabel("offset in y, parallel [pixel]")
    ax.set_title(
        f"Area changes [10⁻³ µm²] of {electrons_text(charge)}\n"
        f"background {electrons_text(background)}, conversion depth {depth:.4g} µm"
    )


def figure_for_table(table: DistortionTable) -> Figure:
    """Draw a table on one page: boundaries, response, depth, area changes.

    Parameters
    ----------
    table : DistortionTable
        The table; it is drawn at :data:`SHOWN_CHARGE` or its highest charge if that is lower, on
        its lowest background and at its depth farthest from the gates.

    Returns
    -------
    figure : matplotlib.figure.Figure
        Not attached to any window; write it with ``savefig``.

    Raises
    ------
    BFSensorError
        Matplotlib is missing.

    Examples
    --------
    >>> from bfsensor import DistortionTable
    >>> len(figure_for_table(DistortionTable.load("itl_sta3800c")).axes)
    4
    """
    figure = new_figure(13.0, 12.0)
    axes = figure.subplots(2, 2)
    background = float(table.backgrounds[0])
    depth = float(table.depths[-1])
    charge = min(SHOWN_CHARGE, float(table.charges[-1]))
    if charge == background:
        charge = float(table.charges[0])
    draw_pixel_boundaries(
        table, axes[0, 0], charge=charge, background=background, depth=depth, exaggerate=5.0
    )
    draw_response(table, axes[0, 1], depth=depth)
    draw_depth_response(table, axes[1, 0], charge=charge)
    draw_area_changes(table, axes[1, 1], charge=charge, background=background, depth=depth)
    return figure


def _nominal_polygon(table: DistortionTable, i: int, j: int) -> FloatArray:
    """Vertices of an undistorted pixel [um], in the order of ``table.polygon``."""
    at = table.nominal()
    row, column = table.reach + j, table.reach + i
    outline = np.concatenate(
        [
            at.corners[row, [column]], at.horizontal[row, column],
            at.corners[row, [column + 1]], at.vertical[row, column + 1],
            at.corners[row + 1, [column + 1]], at.horizontal[row + 1, column, ::-1],
            at.corners[row + 1, [column]], at.vertical[row, column, ::-1],
        ]
    )  # fmt: skip
    # Vertices of a pixel are counted from the middle of its left side.
    return np.roll(outline, table.vertices // 2, axis=0)


def _three_digits(value: float) -> str:
    """Write a number with sign, three significant digits and no exponent."""
    if value == 0.0:
        return "0"
    decimals = max(0, 2 - int(np.floor(np.log10(abs(value)))))
    return f"{value:+.{min(decimals, 3)}f}"
