"""Figures of electron paths to the wells: drift, diffusion, repulsion by stored charge.

They follow figure 6 of Lage, Bradshaw & Tyson (2017).  Axes are in um, x serial and y parallel,
z up from the gates; light comes from the top.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from bfsensor._kernels import drift
from bfsensor.direct.transport import Tracer, Transport
from bfsensor.errors import BFSensorError
from bfsensor.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    RED,
    central_pixel,
    electrons_text,
    import_matplotlib,
)
from bfsensor.simulate.field import Field
from bfsensor.simulate.poisson import Potential

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PATH_STEP = 0.25
"""Step of a drift path relative to the local scale.

Chosen: the step with which boundaries are traced; at twice as much paths have half as many
vertices."""

_MOST_STEPS = 3000
"""Largest number of steps of a drift path; a longer one is drawn up to there.

Chosen: paths of the LSST devices take 130; twice as many double the memory."""

_DRAWN = Transport(part=0.1, longest=0.5)
"""Transport in steps that are short enough to draw.

Chosen: with the default's longest step of 5 um a path would look like a polygon; at twice 0.5 um the
figure has half as many points."""

_SEED = 5417
"""Default seed of the random numbers (chosen: any number serves)."""


def draw_electron_paths(
    potential: Potential,
    ax: Axes,
    *,
    plane: Literal["x", "y"] = "x",
    paths: int = 8,
    height: float | None = None,
) -> None:
    """Draw drift paths, without diffusion, from the light side to the wells.

    Parameters
    ----------
    potential : Potential
        Solution; paths start in the plane of pixel (0, 0), 1 um below the back surface.
    ax : matplotlib.axes.Axes
        Axes to draw into; colours show in which undistorted pixel a path started.
    plane : {'x', 'y'}
        Plane that is drawn: along x (at y = 0) or along y (at x = 0).
    paths : int
        Number of paths a pixel, at least 1.
    height : float, optional
        Upper end of the view [um]; by default the back surface.

    Raises
    ------
    BFSensorError
        Matplotlib is missing, or ``plane`` is neither.

    Examples
    --------
    >>> from bfsensor import Device
    >>> from bfsensor.plots.style import new_figure
    >>> from bfsensor.simulate.unit_cell import solve_unit_cell
    >>> potential = solve_unit_cell(Device.load("itl_sta3800c"), 0.0, cells=8)
    >>> ax = new_figure(5.0, 8.0).add_subplot()
    >>> draw_electron_paths(potential, ax)
    >>> len(ax.collections[0].get_paths())
    8
    """
    import_matplotlib()
    from matplotlib.collections import LineCollection

    axis, pitch, reach = _plane(potential, plane)
    mesh = potential.mesh
    pixels = np.arange(0, reach + 1)
    # Starts avoid centres and edges of pixels, where a path may end on a saddle.
    fractions = (np.arange(paths) + 0.5) / paths - 0.5
    starts = np.zeros((len(pixels) * paths, 3))
    starts[:, axis] = ((pixels[:, None] + fractions) * pitch).ravel()
    starts[:, 2] = mesh.z[-1] - 1.0
    field = Field.of(potential)
    out = np.zeros((len(starts), _MOST_STEPS, 3))
    lengths = np.zeros(len(starts), np.int64)
    drift.trace_down(
        field.phi,
        field.x,
        field.y,
        field.z,
        starts,
        field.zone,
        _PATH_STEP,
        _MOST_STEPS,
        out,
        lengths,
    )
    lines, colours = [], []
    for start, path, length in zip(starts, out, lengths, strict=True):
        pixel = int(np.round(start[axis] / pitch))
        colour = (RED, BLUE, GREEN)[pixel % 3]
        line = path[:length][:, [axis, 2]]
        lines.append(line)
        colours.append(colour)
        if pixel > 0:
            lines.append(line * np.array([-1.0, 1.0]))
            colours.append(colour)
    ax.add_collection(LineCollection(lines, colors=colours, linewidths=0.7, zorder=2))

    _frame(potential, ax, plane, height)
    ax.set_title(f"Drift paths along {plane}, {_content(potential)}")


def draw_collected_paths(
    potential: Potential,
    ax: Axes,
    *,
    plane: Literal["x", "y"] = "x",
    paths: int = 24,
    height: float | None = None,
    transport: Transport | None = None,
    compare: Potential | None = None,
    seed: int = _SEED,
) -> None:
    """Draw electrons from the light side to the pixels that collect them.

    Parameters
    ----------
    potential : Potential
        Solution; electrons start in the plane of pixel (0, 0), 1 um below the back surface, and
        leave that plane as they diffuse, so that their projection is drawn.
    ax : matplotlib.axes.Axes
        Axes to draw into; colours show which pixel along the plane collects an electron.
    plane : {'x', 'y'}
        Plane that is drawn: along x (at y = 0) or along y (at x = 0).
    paths : int
        Number of electrons a pixel, at least 1.
    height : float, optional
        Upper end of the view [um]; by default the back surface.
    transport : Transport, optional
        Motion of the electrons; by default drift and the device's diffusion, in steps that are
        short enough to draw.
    compare : Potential, optional
        Another solution, in which the same electrons are traced with the same random numbers and
        drawn in grey.  Electrons that end in another pixel there, in x or in y, are drawn heavy
        and black and counted in the title.
    seed : int
        Seed of the random numbers.

    Raises
    ------
    BFSensorError
        Matplotlib is missing, or ``plane`` is neither.

    Examples
    --------
    >>> from bfsensor import Device
    >>> from bfsensor.plots.style import new_figure
    >>> from bfsensor.simulate.unit_cell import solve_unit_cell
    >>> potential = solve_unit_cell(Device.load("itl_sta3800c"), 0.0, cells=8)
    >>> ax = new_figure(5.0, 8.0).add_subplot()
    >>> draw_collected_paths(potential, ax, paths=8)
    >>> len(ax.collections[0].get_paths())
    8
    """
    import_matplotlib()
    from matplotlib.collections import LineCollection

    axis, pitch, reach = _plane(potential, plane)
    transport = transport or _DRAWN
    # Starts avoid centres and edges of pixels, where a path may end on a saddle.
    count = (2 * reach + 1) * paths
    places = ((np.arange(count) + 0.5) / paths - reach - 0.5) * pitch
    starts = np.zeros((count, 3))
    starts[:, axis] = places
    starts[:, 2] = potential.mesh.z[-1] - 1.0
    here = Tracer(potential).trace(starts, seed=seed, transport=transport, keep_paths=True)
    ends = here.pixels[:, axis]
    colours = [(RED, BLUE, GREEN)[abs(int(end)) % 3] for end in ends]
    widths = [0.7] * count
    what = "drift" if transport.diffusion == 0 else "drift and diffusion"
    title = f"{what} along {plane}, {_content(potential)}"
    own = np.round(places / pitch) == 0
    kept = int(np.count_nonzero(own & (ends == 0)))
    title += f"\n{kept} of {int(own.sum())} from above the centre collected there"
    lines = [path[:, [axis, 2]] for path in here.paths]
    order = np.arange(count)
    if compare is not None:
        there = Tracer(compare).trace(
            starts, seed=seed, transport=transport, keep_paths=True
        )
        behind = [path[:, [axis, 2]] for path in there.paths]
        ax.add_collection(LineCollection(behind, colors=GREY, linewidths=0.6, zorder=1.5))
        moved = (here.pixels != there.pixels).any(1)
        for n in np.nonzero(moved)[0]:
            colours[n], widths[n] = BLACK, 1.6
        order = np.argsort(moved, kind="stable")  # heavy lines are drawn last, on top
        title += f"\ngrey: {_content(compare)}; black: {int(moved.sum())} to another pixel"
    drawn = LineCollection(
        [lines[n] for n in order],
        colors=[colours[n] for n in order],
        linewidths=[widths[n] for n in order],
        zorder=2,
    )
    ax.add_collection(drawn)
    _frame(potential, ax, plane, height)
    ax.set_title(title, fontsize=10)


def _plane(potential: Potential, plane: str) -> tuple[int, float, int]:
    """Axis, pitch [um] and number of pixels shown on either side of the centre."""
    if plane not in ("x", "y"):
        raise BFSensorError(f"plane = {plane!r} must be 'x' or 'y'")
    axis = 0 if plane == "x" else 1
    pitch = potential.mesh.pitch[axis]
    reach = max(0, min(2, int((potential.mesh.period[axis] / pitch - 1) / 2)))
    return axis, pitch, reach


def _frame(potential: Potential, ax: Axes, plane: str, height: float | None) -> None:
    """Draw pixel edges; set limits and labels."""
    _, pitch, reach = _plane(potential, plane)
    for edge in np.arange(-reach, reach + 2) - 0.5:
        ax.axvline(edge * pitch, color=GREY, linewidth=0.8, linestyle="--", zorder=1)
    ax.set_xlim(-(reach + 0.55) * pitch, (reach + 0.55) * pitch)
    ax.set_ylim(0.0, potential.mesh.z[-1] if height is None else height)
    ax.set_xlabel(f"{plane}, {'serial' if plane == 'x' else 'parallel'} [µm]")
    ax.set_ylabel("z above the gates [µm]")


def _content(potential: Potential) -> str:
    """Charge of the central pixel, as text for a title."""
    charge = float(potential.charges[central_pixel(potential)])
    return f"{electrons_text(charge)} in the centre" if charge > 0 else "empty"
