"""Pixel boundaries: the surfaces between the electrons of neighbouring wells.

Without diffusion an electron follows a field line, and the pixel boundary is where the
well that it reaches changes (a separatrix).  Forward traces are bisected at a height
just above the front structure; one backward trace from there, along which errors
shrink, passes every conversion depth.

Boundaries between columns are lines x(y) and those between rows lines y(x), each
continuous across the whole array: electrons on either side differ in the column (row)
that they reach, whatever the row (column).  Neighbouring pixels share these lines, so
their polygons tile the plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bfsensor._kernels import drift, line_sides
from bfsensor.device.depletion import find_depletion
from bfsensor.errors import ConvergenceError, DeviceError, TableError
from bfsensor.simulate import row_sheets
from bfsensor.simulate.field import Field, PathSteps
from bfsensor.simulate.line_points import LinePoints, line_points
from bfsensor.simulate.mesh import Surfaces
from bfsensor.simulate.poisson import Potential
from bfsensor.typing import FloatArray

SPLIT_HEIGHT = 4.0
"""Height above the highest silicon surface at which boundaries are bisected [um].

Below it field lines curve sharply towards the wells; above it they are smooth and rise steadily,
so that a backward trace is stable.  Chosen: at 8 um the boundaries at conversion depths up to
there would each be bisected, which costs more forward traces and finds the same lines within the
tracing error."""

RIDGE_MARGIN, RIDGE_CLEARANCE = 0.1, 1.5
"""Distances from the ridge of the potential over the channel stops [um].

Where the ridge comes nearer to :data:`SPLIT_HEIGHT` than the margin, boundaries are bisected at
the clearance above the ridge instead: traced up from below the ridge, single points of the ITL
device at -30 V were wrong by 0.9 um (``tests/simulate/test_boundaries.py``).  Chosen: with a margin
twice as large the change comes at a slightly higher back bias; with a clearance twice as large
more depths are bisected one by one."""

STEEP = 0.15
"""Smallest vertical field at the height of bisection, relative to the mean field above it.

Where it is weaker anywhere in the pixel, boundaries are bisected above the ridge instead.
Measured on the ITL device: at 0.05 of the mean field (-30 V) backward traces ran away from some
points, at 0.19 (-35 V) none did; the value lies between these."""

BRACKET = 0.05
"""Distance from the nominal edge at which the search for a boundary point begins, to either side [um].

Chosen: of 9 x 9 pixels around a charge of half a full well nine edges in ten shift by less (ITL 92 %,
E2V 87 %); for the others it is widened by twice its width at a time.  Twice as large costs one forward
trace more for each point."""

BISECTION = 1e-5
"""Width of the interval at which the bisection of a boundary point ends [um].

Derived: a thirtieth of the tracing error of 3e-4 um that is promised, so that it does not count."""

COARSENESS = 0.25
"""Step of the forward trace relative to the scale of the field, 0.3 um + 0.12 (z - 1 um).

Measured together with :data:`RATIO`: with steps a sixth as long vertices move by less than
3e-4 um (``tests/simulate/test_boundaries.py``)."""

RATIO = 0.10
"""Step of the backward trace relative to the height above the gates.

Measured together with :data:`COARSENESS`: with steps a sixth as long vertices move by less than
3e-4 um (``tests/simulate/test_boundaries.py``)."""

TURN = 0.3
"""Largest change of the unit vector along the drift within a step, for derivatives of boundaries.

A longer step may jump over a saddle of the potential, and the point then lies on another line
than its neighbours.  Chosen: at 0.6 a step may turn by 35 degrees instead of 17, and more single
points jump; paths then take fewer steps."""

_MAX_STEPS = 1000
"""Largest number of steps of a forward trace at the usual step; beyond it the point reached is its end.

Chosen: eight times the some 125 steps of a straight path of 100 um; the shipped devices need fewer than
200 anywhere.  Twice as many change only paths that are caught where the field is weak, as in an implant
that is not depleted, and these take twice as long."""

_CORNER_PASSES = 20
"""Largest number of passes in which corners and the lines across them are made consistent.

Chosen: the passes end before, when no corner moves by more than :data:`_CORNER_TOLERANCE`; twice as
many change only corners that had not settled, which are taken as they are."""

_CORNER_TOLERANCE = 1e-7
"""Largest move of a corner in the last pass [um].

Chosen: a hundredth of :data:`BISECTION`; at twice the value corners are uncertain by as much more,
far below the tracing error."""


@dataclass(frozen=True)
class PixelBoundaries:
    """Boundary lines around the pixels at offsets up to ``reach`` from pixel (0, 0).

    Parameters
    ----------
    depths : ndarray, shape (nd,)
        Heights above the gates [um] at which the lines were taken.
    pitch : tuple of float
        Pixel pitch [um].
    reach : int
        Offsets -reach..reach are bounded.
    columns : ndarray, shape (nd, 2 reach + 2, ns, 2)
        Points (x, y) of the lines between columns, ordered along y, the lowest line first.
    rows : ndarray, shape (nd, 2 reach + 2, ns, 2)
        Points (x, y) of the lines between rows, ordered along x.
    symmetric : bool
        Whether the lines were computed in one quadrant and mirrored.
    """

    depths: FloatArray
    pitch: tuple[float, float]
    reach: int
    columns: FloatArray
    rows: FloatArray
    symmetric: bool

    def vertices(
        self, vertices: int, fractions: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fit displacements of polygon vertices to the lines, keeping the area of every pixel.

        The vertices of a line are the least-squares polyline through it under the
        condition that the area between line and nominal edge is kept in each pixel.
        Areas then do not depend on the number of vertices, and where the boundary ends
        in a cusp at a corner the corner is the best common point of the four edges.

        Parameters
        ----------
        vertices : int
            Number of vertices on a side between the corners.
        fractions : ndarray, shape (vertices,)
            Nominal positions of the vertices along the side, 0 to 1, ascending
            (:func:`~bfsensor.response.vertices.vertex_fractions`).

        Returns
        -------
        corners : ndarray, shape (nd, 2 reach + 2, 2 reach + 2, 2)
            Displacements (dx, dy) [um] of the corners, rows then columns.
        horizontal : ndarray, shape (nd, 2 reach + 2, 2 reach + 1, vertices, 2)
            Displacements (dx, dy) [um] of the vertices on edges between rows.
        vertical : ndarray, shape (nd, 2 reach + 1, 2 reach + 2, vertices, 2)
            Displacements (dx, dy) [um] of the vertices on edges between columns.

        Raises
        ------
        ConvergenceError
            A line has no point on the side of some pixel.
        """
        n_pixels = 2 * self.reach + 1
        fit = _line_fit(n_pixels, vertices, tuple(fractions))
        grid_x = (np.arange(n_pixels + 1) - self.reach - 0.5) * self.pitch[0]
        grid_y = (np.arange(n_pixels + 1) - self.reach - 0.5) * self.pitch[1]
        nd, n_lines = self.rows.shape[:2]
        corners = np.zeros((nd, n_lines, n_lines, 2))
        z = self.depths
        horizontal = np.zeros((nd, n_lines, n_pixels, vertices, 2))
        vertical = np.zeros((nd, n_pixels, n_lines, vertices, 2))
        for d in range(nd):
            # A side is measured between its corners, which the lines across move in turn.
            for _ in range(_CORNER_PASSES):
                ends = grid_x + corners[d, :, :, 0]
                rows = fit.apply(self.rows[d], 0, ends, z[d]) - grid_y[:, None]
                horizontal[d, ..., 1] = _between(rows, vertices)
                ends = grid_y + corners[d, :, :, 1].T
                columns = fit.apply(self.columns[d], 1, ends, z[d]) - grid_x[:, None]
                vertical[d, ..., 0] = _between(columns, vertices).swapaxes(0, 1)
                new = np.stack(
                    [columns[:, :: vertices + 1].T, rows[:, :: vertices + 1]], axis=-1
                )
                moved = np.abs(new - corners[d]).max()
                corners[d] = new
                if moved < _CORNER_TOLERANCE:
                    break
            u = fractions[None, None, :]
            dx, dy = corners[d, :, :, 0], corners[d, :, :, 1]
            horizontal[d, ..., 0] = dx[:, :-1, None] * (1 - u) + dx[:, 1:, None] * u
            vertical[d, ..., 1] = dy[:-1, :, None] * (1 - u) + dy[1:, :, None] * u
        if self.symmetric:
            mirror_quadrant(corners, horizontal, vertical)
        return corners, horizontal, vertical


def _between(fitted: FloatArray, vertices: int) -> FloatArray:
    """The values of fitted lines at the vertices between the corners, pixel by pixel."""
    return fitted[:, :-1].reshape(len(fitted), -1, vertices + 1)[..., 1:]


def mirror_quadrant(
    corners: FloatArray,
    horizontal: FloatArray,
    vertical: FloatArray,
) -> None:
    """Copy the quadrant of positive offsets to the other three, in place.

    Arrays as :meth:`PixelBoundaries.vertices` gives them; what lies on an axis keeps its
    positive half.  Symmetry then holds bit for bit.
    """
    for a, along in ((corners, None), (horizontal, "x"), (vertical, "y")):
        vertex_x = a[..., ::-1, :] if along == "x" else a
        nx = a.shape[2] // 2
        a[:, :, :nx] = (vertex_x[:, :, ::-1] * np.array([-1.0, 1.0]))[:, :, :nx]
        if along == "x" and a.shape[2] % 2:
            middle = a[:, :, nx]
            half = middle.shape[-2] // 2
            middle[:, :, :half] = (middle[:, :, ::-1] * np.array([-1.0, 1.0]))[:, :, :half]
            if middle.shape[-2] % 2:
                middle[:, :, half, 0] = 0.0
        elif a.shape[2] % 2:
            a[:, :, nx, ..., 0] = 0.0
        vertex_y = a[..., ::-1, :] if along == "y" else a
        ny = a.shape[1] // 2
        a[:, :ny] = (vertex_y[:, ::-1] * np.array([1.0, -1.0]))[:, :ny]
        if along == "y" and a.shape[1] % 2:
            middle = a[:, ny]
            half = middle.shape[-2] // 2
            middle[:, :, :half] = (middle[:, :, ::-1] * np.array([1.0, -1.0]))[:, :, :half]
            if middle.shape[-2] % 2:
                middle[:, :, half, 1] = 0.0
        elif a.shape[1] % 2:
            a[:, ny, ..., 1] = 0.0


@dataclass(frozen=True)
class _LineFit:
    """Linear map from a line's values at quadrature points to its vertices."""

    points: FloatArray
    matrix: FloatArray

    def apply(
        self, lines: FloatArray, along: int, ends: FloatArray, z: float
    ) -> FloatArray:
        """Vertices of lines (n, points, 2) at height ``z``, (n, vertices); corners at ``ends``."""
        values = np.empty((len(lines), ends.shape[1] - 1, len(self.points)))
        # A line between rows jumps where it crosses a boundary between columns: only
        # points of this pixel count, the outermost one up to the corner.
        n, p = line_sides.values_on_sides(lines, along, ends, self.points, values)
        if n >= 0:
            raise ConvergenceError(
                f"a boundary between {('rows', 'columns')[along]} at z = {z:g} um has no point "
                f"on the side of a pixel, {'xy'[along]} from {ends[n, p]:.4g} to "
                f"{ends[n, p + 1]:.4g} um: boundaries fold (is the silicon hardly depleted, or a "
                "pixel near its full well?)"
            )
        return values.reshape(len(lines), -1) @ self.matrix.T


@lru_cache(maxsize=8)
def _line_fit(n_pixels: int, vertices: int, fractions: tuple[float, ...]) -> _LineFit:
    """Build the constrained least-squares map (Gauss-Legendre points in every interval)."""
    knots = np.array([0.0, *fractions, 1.0])
    per_interval = max(2, int(np.ceil(64 / (vertices + 1))))
    node, weight = np.polynomial.legendre.leggauss(per_interval)
    points, weights = [], []
    for a, b in pairwise(knots):
        points.append(a + 0.5 * (node + 1) * (b - a))
        weights.append(0.5 * weight * (b - a))
    points_, weights_ = np.concatenate(points), np.concatenate(weights)
    n_knots = n_pixels * (vertices + 1) + 1
    n_points = len(points_)
    basis = np.zeros((n_pixels * n_points, n_knots))
    for p in range(n_pixels):
        interval = np.clip(np.searchsorted(knots, points_) - 1, 0, vertices)
        t = (points_ - knots[interval]) / (knots[interval + 1] - knots[interval])
        rows = p * n_points + np.arange(n_points)
        basis[rows, p * (vertices + 1) + interval] = 1 - t
        basis[rows, p * (vertices + 1) + interval + 1] = t
    w = np.tile(weights_, n_pixels)
    mass = basis.T @ (w[:, None] * basis)
    load = basis.T * w
    integral = np.zeros((n_pixels, n_pixels * n_points))
    for p in range(n_pixels):
        integral[p, p * n_points : (p + 1) * n_points] = weights_
    constraint = integral @ basis
    kkt = np.block([[mass, constraint.T], [constraint, np.zeros((n_pixels, n_pixels))]])
    solution = np.linalg.solve(kkt, np.vstack([load, integral]))
    return _LineFit(points_, solution[:n_knots])


@dataclass(frozen=True)
class Feet:
    """Bisected points of the boundary lines across one axis, the start of their derivatives.

    On a mirror-symmetric domain these are the lines of one quadrant.

    Attributes
    ----------
    axis : int
        0: lines between columns, 1: between rows.
    below : tuple of (ndarray, ndarray)
        For each height of bisection the points (x, y, z) of the boundary [um], shape (lines,
        seeds, 3), and a mask of the conversion depths that were reached from them.
    points : LinePoints
        The points along the lines that were traced, and those on which lines are given.
    """

    axis: int
    below: tuple[tuple[FloatArray, NDArray[np.bool_]], ...]
    points: LinePoints


def find_boundaries(
    potential: Potential,
    depths: ArrayLike,
    *,
    reach: int = 4,
    samples: int = 24,
    coarseness: float = COARSENESS,
    ratio: float = RATIO,
    precision: float = BISECTION,
    turn: float = drift.ANY_TURN,
    feet: list[Feet] | None = None,
) -> PixelBoundaries:
    """Trace the boundaries of the pixels around pixel (0, 0).

    Parameters
    ----------
    potential : Potential
        Solved on a domain that holds the pixels up to ``reach`` and half a pixel more.
    depths : array_like, shape (nd,)
        Conversion depths as heights above the gates [um], ascending, in the silicon above the
        stored charge (:func:`lowest_depth`).
    reach : int
        Largest pixel offset, 0 or more.
    samples : int
        Points of a line per pixel, denser towards the corners; of those between columns at most
        :data:`~bfsensor.simulate.line_points.SMOOTH_POINTS` are traced.
    coarseness, ratio : float
        Relative steps of the forward and backward traces (:data:`COARSENESS`, :data:`RATIO`);
        the defaults give a tracing error below 3e-4 um.
    precision : float
        Width [um] of the interval at which the bisection ends; differences between devices need a
        finer one than the default.
    turn : float
        Largest change of the unit vector of direction within a step of the forward traces; by
        default any.  Derivatives need :data:`TURN`: a step over a saddle of the potential makes
        single points jump.
    feet : list, optional
        Filled with two :class:`Feet`, the bisected points of the lines between columns and of
        those between rows; :func:`~bfsensor.simulate.boundary_tangent.boundary_changes` needs them.

    Returns
    -------
    boundaries : PixelBoundaries
        Lines between columns and between rows at every depth.

    Raises
    ------
    TableError
        A depth lies outside the silicon, depths do not ascend, the domain is too small for
        ``reach``, or the mirror planes do not pass through the centre of pixel (0, 0).
    DeviceError
        The silicon is not depleted up to its back surface.
    ConvergenceError
        A boundary was not found, because a well no longer holds its charge.

    Examples
    --------
    >>> from bfsensor.device.device import Device
    >>> from bfsensor.simulate.unit_cell import solve_unit_cell
    >>> empty = solve_unit_cell(Device.load("itl_sta3800c"), 0.0, cells=8)
    >>> find_boundaries(empty, [0.1])
    Traceback (most recent call last):
        ...
    bfsensor.errors.TableError: conversion depth 0.1 um must lie in the silicon, ...
    """
    mesh = potential.mesh
    levels: FloatArray = np.array(depths, dtype=np.float64, ndmin=1)
    surfaces = Surfaces.of(potential.device)
    lowest = lowest_depth(potential)
    if np.any(np.diff(levels) <= 0):
        raise TableError(f"conversion depths {levels.tolist()} um must ascend")
    if levels[0] < lowest - 1e-9 or levels[-1] > mesh.z[-1] + 1e-9:
        raise TableError(
            f"conversion depth {levels[0] if levels[0] < lowest else levels[-1]:g} um must lie in "
            f"the silicon, from {lowest:.3g} um (where charge is stored) to {mesh.z[-1]:g} um "
            "(back surface)"
        )
    field = Field.of(potential)
    symmetric = mesh.side_x == "mirror" and mesh.side_y == "mirror"
    if symmetric and (abs(mesh.x[0]) > 1e-9 or abs(mesh.y[0]) > 1e-9):
        raise TableError(
            "boundaries need the mirror planes through the centre of pixel (0, 0)"
        )
    split = _split_height(potential, surfaces)
    most = round(_MAX_STEPS * COARSENESS / coarseness)
    steps = PathSteps(coarseness, turn, precision, most)
    lines = []
    for axis in (0, 1):
        pitch, along = mesh.pitch[axis], mesh.pitch[1 - axis]
        first = 0 if symmetric else -reach - 1
        edges = np.array((np.arange(first, reach + 1) + 0.5) * pitch, np.float64)
        points = line_points(reach, along, samples, symmetric=symmetric, smooth=axis == 0)
        seeds = points.traced
        half_period = mesh.period[axis] / 2
        if (
            edges[-1] + pitch / 2 > half_period + 1e-9
            or seeds[-1] > mesh.period[1 - axis] / 2
        ):
            raise TableError(
                f"reach = {reach} pixels does not fit a period of {mesh.period[0]:g} x "
                f"{mesh.period[1]:g} um"
            )
        traced, below = _trace_lines(field, axis, edges, seeds, levels, split, ratio, steps)
        lines.append(points.spread(traced, 1 - axis))
        if feet is not None:
            feet.append(Feet(axis, below, points))
    columns, rows = lines
    if symmetric:
        columns, rows = unfold(columns, 0), unfold(rows, 1)
    return PixelBoundaries(levels, mesh.pitch, reach, columns, rows, symmetric)


def _split_height(potential: Potential, surfaces: Surfaces) -> float:
    """Height [um] above which field lines rise steadily everywhere.

    Below the ridge of the potential over the stops, which rises as the back bias falls,
    electrons move up first, and a backward trace runs away.
    """
    split = max(surfaces.silicon_channel, surfaces.silicon_stop) + SPLIT_HEIGHT
    z = potential.mesh.z
    rises = np.diff(potential.phi, axis=0).max(axis=(1, 2)) >= 0
    if rises[-1]:
        device = potential.device
        need = find_depletion(device).full_depletion_voltage
        raise DeviceError(
            f"{device.name}: back_bias = {device.operating_point.back_bias:g} V does not deplete the "
            f"silicon up to its back surface, which takes about {need:.3g} V (lower the back bias, the "
            "background doping or the thickness)"
        )
    ridge = float(z[np.flatnonzero(rises)[-1] + 1])
    above = int(np.searchsorted(z, split))
    mean, gap = potential.phi[above].mean() - potential.phi[-1].mean(), z[-1] - z[above]
    weakest = -np.diff(potential.phi[above - 1 : above + 1], axis=0).max()
    weak = weakest / (z[above] - z[above - 1]) < STEEP * mean / gap
    if ridge + RIDGE_MARGIN > split or weak:
        split = ridge + RIDGE_CLEARANCE
    return split


def lowest_depth(potential: Potential) -> float:
    """Height above the gates [um] where charge is stored, below which nothing moves.

    The mean height of the electrons; without any, of the potential's maximum.
    """
    if potential.electrons.sum() > 0:
        z = potential.mesh.z[: potential.electrons.shape[0]]
        return float(
            np.tensordot(z, potential.electrons.sum(axis=(1, 2)), 1)
            / potential.electrons.sum()
        )
    return float(potential.mesh.z[np.argmax(potential.phi.max(axis=(1, 2)))])


def _trace_lines(
    field: Field,
    axis: int,
    edges: FloatArray,
    along: FloatArray,
    depths: FloatArray,
    split: float,
    ratio: float,
    steps: PathSteps,
) -> tuple[FloatArray, tuple[tuple[FloatArray, NDArray[np.bool_]], ...]]:
    """Points of the lines across ``axis`` at every depth, (nd, lines, seeds, 2), and their feet."""
    shape = (len(edges), len(along))
    out = np.zeros((len(depths), *shape, 2))
    high = depths >= split
    heights = np.array([*([split] if high.any() else []), *depths[~high]])
    seeds = np.zeros((len(heights), *shape, 3))
    seeds[..., axis] = edges[:, None]
    seeds[..., 1 - axis] = along
    seeds[..., 2] = heights[:, None, None]
    found = np.full(seeds.shape[:-1], np.nan)
    if axis == 1:
        _fall_to_sheets(field, edges, seeds, split, steps, found)
    _bisect(field, axis, seeds, found, steps)
    seeds[..., axis] = found
    feet = []
    for z, points in zip(heights, seeds, strict=True):
        reached = high if z == split else depths == z
        feet.append((points, reached))
        if z < split:
            out[reached] = points[..., :2]
            continue
        traced = np.zeros((points[..., 0].size, int(high.sum()), 2))
        drift.trace_up(
            field.phi, field.x, field.y, field.z, points.reshape(-1, 3), depths[high], ratio,
            traced,
        )  # fmt: skip
        out[high] = np.moveaxis(traced.reshape(*shape, -1, 2), 2, 0)
    return out, tuple(feet)


def _fall_to_sheets(
    field: Field,
    edges: FloatArray,
    seeds: FloatArray,
    split: float,
    steps: PathSteps,
    found: FloatArray,
) -> None:
    """Find points of lines between rows, (heights, lines, seeds), from their sheets lower down."""
    sheet = row_sheets.sheet_height(field, edges[-1], split - SPLIT_HEIGHT, split)
    above = seeds[:, 0, 0, 2] > sheet
    if not above.any():
        return
    landings = row_sheets.fall(field, seeds[above], sheet, steps)
    together = np.concatenate(list(landings), axis=1)
    sheets = row_sheets.find_sheets(field, edges, together, sheet, BRACKET, steps)
    found[above] = [
        row_sheets.meet(field, sheets, *one, steps)
        for one in zip(seeds[above], landings, strict=True)
    ]


def _bisect(
    field: Field, axis: int, seeds: FloatArray, found: FloatArray, steps: PathSteps
) -> None:
    """Bisect the points that are not found yet."""
    missing = np.isnan(found)
    points = seeds[missing]
    position = np.zeros(len(points))
    near = np.full(len(points), BRACKET)
    failed = drift.bisect_edge(
        field.phi, field.x, field.y, field.z, points, axis, points[:, axis].copy(), -near, near,
        steps.precision, field.zone, steps.coarseness, steps.most, position, steps.turn,
    )  # fmt: skip
    if failed:
        x, y, z = points[np.argmax(np.isnan(position))]
        more = " or more" if failed == drift.MOST_FAILED else ""
        raise ConvergenceError(
            f"{failed}{more} of {found.size} boundary points, the first near x = {x:g}, y = {y:g}, "
            f"z = {z:g} um, were not found: no well on one side (is a pixel near its full well?)",
            [],
        )
    found[missing] = position


def unfold(lines: FloatArray, axis: int) -> FloatArray:
    """Mirror the lines of a quadrant to the whole neighbourhood."""
    flip_across = np.array([-1.0, 1.0]) if axis == 0 else np.array([1.0, -1.0])
    full = np.concatenate([lines[:, ::-1] * flip_across, lines], axis=1)
    reverse = full[:, :, ::-1] * -flip_across
    return np.concatenate([reverse, full], axis=2)
