r"""The analytic second engine: a charged rectangle between two conducting planes.

The stored charge of a pixel is spread evenly over a rectangle of half sides a, b at height
:math:`z_q`, between an effective plane of the gates and the back surface, both conductors
(``charge_field``).  Electrons drift down in :math:`E_z(z)`, and a boundary whose fate is
sealed at height :math:`z_s` is displaced at the conversion depth z by

.. math:: D(z) = \int_{z_s}^{z} \frac{E_\perp(z')}{E_z(z')}\,dz'

per electron, in first order along the straight path.  Boundaries between rows are sealed
at :math:`z_{sh}`, those between columns at :math:`z_{sv}` (Astier & Regnault 2023).

The engine is linear in charge: one solution serves all.  It knows nothing of gates,
channel stops and holes but these two heights, and shares no code with the Poisson
solver, which it therefore checks; only the type of the result is the same.  A uniform
background displaces nothing here; in truth its mean field, :math:`n z_q / (\epsilon T)` for n
electrons/um^2 (0.008 V/um for 100,000 e- in 10 x 10 um at 0.5 um), weakens the drift field,
and stored charge changes the wells: heights fitted at one level of charge belong to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from bfsensor._kernels import image_charge as kernel
from bfsensor.errors import TableError
from bfsensor.simulate.boundaries import PixelBoundaries
from bfsensor.simulate.charge_field import (
    TOLERANCE,
    ImageCharge,
    farthest,
    image_series,
    sum_field,
)
from bfsensor.typing import FloatArray

SAMPLES = 48
"""Points of a boundary line per pixel, linear in between.

Measured: areas through these lines and their polygons are those of closed form to 2e-3
(``tests/simulate/test_image_charge.py``, ``test_vertices_keep_the_areas``)."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Gauss-Legendre points and weights of a panel as long as the field's scale.

Measured: shifts are those of an adaptive integral to 1e-8 (``tests/simulate/test_image_charge.py``,
``test_shifts_are_the_integral_of_the_field``)."""

_RAY_STEPS = 6
"""Number of Runge-Kutta steps in a panel.

Measured: rays that shift by up to 0.7 um are within 2e-6 um of an adaptive integral
(``tests/simulate/test_image_charge.py``, ``test_rays_follow_the_whole_field``)."""


def _panels(model: ImageCharge, seal: float, depths: FloatArray) -> FloatArray:
    """Heights between which the field along a path is close to a polynomial of low degree.

    The field's scale is the distance to the rectangle, which grows with height.
    """
    gap = min(
        model.pitch_x / 2 - model.half_width_x, model.pitch_y / 2 - model.half_width_y
    )
    scale = np.hypot(seal - model.charge_height, gap)
    top = float(depths[-1])
    count = int(np.ceil(np.log2(max(top - seal, 0.0) / scale + 1)))
    breaks = [*depths, *(seal + scale * (2.0 ** np.arange(count) - 1))]
    if isinstance(model.drift_field, tuple):
        breaks += [height for height, _ in model.drift_field]
    inside = np.array(breaks)
    return np.unique([seal, *inside[(inside > seal) & (inside <= top)]])


def _shifts(
    model: ImageCharge,
    places: FloatArray,
    axis: int,
    depths: FloatArray,
    tolerance: float,
) -> FloatArray:
    """Shift of boundaries across ``axis``, (nd, n) [um per electron], first order.

    ``places`` are points (u, v), (n, 2), u along the axis and v along the boundary, or edges
    (u, lowest v, highest v), (n, 3), over which the mean is taken.  Depths ascend.  Below
    the sealed height nothing moves.
    """
    seal = model.row_height if axis else model.column_height
    panels = _panels(model, seal, depths)
    steps = np.zeros((len(depths), len(places)))
    if len(panels) > 1:
        length = 0.5 * np.diff(panels)
        middle = 0.5 * (panels[1:] + panels[:-1])
        nodes = (middle[:, None] + length[:, None] * _NODES).ravel()
        weights = (
            (length[:, None] * _WEIGHTS).ravel() * model.unit_field / model.drift_at(nodes)
        )
        series = image_series(model, farthest(places, model), tolerance)
        half = np.array([model.half_width_x, model.half_width_y])[:: 1 - 2 * axis]
        add = kernel.add_edge_shifts if places.shape[1] == 3 else kernel.add_point_shifts
        add(
            places, nodes - model.plane_height, weights, np.searchsorted(depths, nodes),
            series.heights, series.signs, half.copy(), series.tail, steps,
        )  # fmt: skip
    return np.cumsum(steps, axis=0)


def _check_request(model: ImageCharge, depths: ArrayLike, reach: int) -> FloatArray:
    levels = np.asarray(depths, float)
    bad = levels[~((levels > 0) & (levels <= model.thickness))]
    if bad.size or not levels.size:
        given = f"{bad.flat[0]:g} um" if bad.size else "(none given)"
        raise TableError(
            f"conversion depth {given} must be above 0 um, the gates, and at most "
            f"{model.thickness:g} um, the back surface"
        )
    if int(reach) != reach or reach < 0:
        raise TableError(f"reach = {reach} must be a whole number of pixels from 0")
    return levels


@dataclass(frozen=True)
class EdgeShifts:
    """Mean outward shift of the four edges of every pixel, over the pitch [1/e-].

    Attributes
    ----------
    north, east, south, west : ndarray, shape (..., 2 reach + 1, 2 reach + 1)
        ``east[..., j + reach, i + reach]`` of the pixel at offset i in x and j in y, positive
        where it gains: north is the edge at larger y, east that at larger x.  Leading axes
        are those of the depths.
    """

    north: FloatArray
    east: FloatArray
    south: FloatArray
    west: FloatArray

    @property
    def area_changes(self) -> FloatArray:
        """Relative area change per electron, the sum of the four."""
        return self.north + self.south + (self.east + self.west)


def edge_shifts(
    model: ImageCharge, *, depth: ArrayLike, reach: int = 8, tolerance: float = TOLERANCE
) -> EdgeShifts:
    """Compute the mean shift of the edges of all pixels around one that holds an electron.

    Parameters
    ----------
    model : ImageCharge
        Parameters of the charge, the planes and the drift field.
    depth : array_like, any shape
        Conversion depths as heights above the gates [um], above 0 and up to the thickness; at or
        below their sealed height boundaries do not move.
    reach : int
        Largest pixel offset, 0 or more.
    tolerance : float
        Largest error of the image series [V/um per electron], above 0.

    Returns
    -------
    shifts : EdgeShifts
        Outward shifts; neighbours share their edges and mirrored pixels are equal, bit for bit.

    Raises
    ------
    TableError
        A depth lies outside the silicon, ``reach`` is not a whole number from 0, or the tolerance
        is not reached.

    References
    ----------
    Astier & Regnault 2023, A&A 670, A118.

    Examples
    --------
    >>> shifts = edge_shifts(ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0), depth=95.0, reach=1)
    >>> bool(shifts.north[1, 1] < shifts.east[1, 1] < 0 < shifts.south[2, 1])
    True
    """
    levels = _check_request(model, depth, reach)
    ascending, place = np.unique(levels, return_inverse=True)
    outward = []
    n = int(reach) + 1
    for axis in (0, 1):
        across, along = (model.pitch_x, model.pitch_y)[:: 1 - 2 * axis]
        edges = np.zeros((n, n, 3))  # by pixel along the line, then line
        edges[..., 0] = (np.arange(n) + 0.5) * across
        edges[..., 1] = ((np.arange(n) - 0.5) * along)[:, None]
        edges[..., 2] = ((np.arange(n) + 0.5) * along)[:, None]
        found = _shifts(model, edges.reshape(-1, 3), axis, ascending, tolerance)
        outer = found.reshape(len(ascending), n, n) / across
        # From the quadrant to all pixels: the line below a pixel is the one above the last.
        inner = np.concatenate([outer[..., :1], -outer[..., :-1]], axis=2)
        both = np.concatenate([inner[..., :0:-1], outer], axis=2)
        outward.append(np.concatenate([both[:, :0:-1], both], axis=1)[place.ravel()])
    shape = (*levels.shape, 2 * n - 1, 2 * n - 1)
    east = outward[0].reshape(shape)
    north = np.swapaxes(outward[1].reshape(shape), -1, -2)
    return EdgeShifts(north, east, north[..., ::-1, :], east[..., ::-1])


def area_changes(
    model: ImageCharge, *, depth: ArrayLike, reach: int = 8, tolerance: float = TOLERANCE
) -> FloatArray:
    """Compute the relative area change of every pixel per electron in the central one.

    In first order, the coefficients of Astier & Regnault (2023); flats have
    C_ij = a_ij mean^2 in the lowest order.

    Parameters
    ----------
    model : ImageCharge
        Parameters of the charge, the planes and the drift field.
    depth : array_like, any shape
        Conversion depths as heights above the gates [um], above 0 and up to the thickness.
    reach : int
        Largest pixel offset, 0 or more.
    tolerance : float
        Largest error of the image series [V/um per electron], above 0.

    Returns
    -------
    changes : ndarray, shape (..., 2 reach + 1, 2 reach + 1)
        ``changes[..., j + reach, i + reach]`` [1/e-] at lag i in x and j in y.

    Raises
    ------
    TableError
        A depth lies outside the silicon, ``reach`` is not a whole number from 0, or the tolerance
        is not reached.

    References
    ----------
    Astier & Regnault 2023, A&A 670, A118.

    Examples
    --------
    >>> a = area_changes(ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0), depth=100.0, reach=40)
    >>> bool(abs(a.sum() / a[40, 40]) < 1e-5)
    True
    """
    return edge_shifts(model, depth=depth, reach=reach, tolerance=tolerance).area_changes


# -- boundary lines ----------------------------------------------------------------------


def displace_boundaries(
    model: ImageCharge,
    depths: ArrayLike,
    *,
    charge: float,
    reach: int = 4,
    samples: int = SAMPLES,
    tolerance: float = TOLERANCE,
) -> PixelBoundaries:
    """Displace the boundaries of the pixels around a charge, in first order.

    Parameters
    ----------
    model : ImageCharge
        Parameters of the charge, the planes and the drift field.
    depths : array_like, shape (nd,)
        Conversion depths as heights above the gates [um], ascending, above 0 and up to the
        thickness.
    charge : float
        Charge of the central pixel in excess of all others [e-], finite.
    reach : int
        Largest pixel offset, 0 or more.
    samples : int
        Points of a line per pixel, even, denser towards the corners.
    tolerance : float
        Largest error of the image series [V/um per electron], above 0.

    Returns
    -------
    boundaries : PixelBoundaries
        Lines as of the Poisson solver, mirror-symmetric bit for bit; shifts are linear in charge.

    Raises
    ------
    TableError
        A depth lies outside the silicon, depths do not ascend, or ``reach``, ``charge`` or
        ``samples`` is not allowed.

    Examples
    --------
    >>> model = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0)
    >>> lines = displace_boundaries(model, [20.0, 100.0], charge=1e5, reach=1)
    >>> lines.columns.shape
    (2, 4, 148, 2)
    """
    levels, seeds = _check_lines(model, depths, charge, reach, samples)
    lines = []
    for axis in (0, 1):
        start = _line_points(model, axis, seeds, reach)
        places = np.ascontiguousarray(start.reshape(-1, 2)[:, :: 1 - 2 * axis])
        shifts = _shifts(model, places, axis, levels, tolerance)
        moved = np.repeat(start[None], len(levels), axis=0)
        moved[..., axis] += charge * shifts.reshape(moved.shape[:-1])
        lines.append(_mirror(moved, axis))
    pitch = (model.pitch_x, model.pitch_y)
    return PixelBoundaries(levels, pitch, int(reach), lines[0], lines[1], True)


def trace_boundaries(
    model: ImageCharge,
    depths: ArrayLike,
    *,
    charge: float,
    reach: int = 4,
    samples: int = SAMPLES,
    tolerance: float = TOLERANCE,
) -> PixelBoundaries:
    """Trace the boundaries along the field lines of charge and drift field together.

    The lines are those of :func:`displace_boundaries` to all orders in the charge: paths curve,
    and the charge changes the drift field along them.  The difference grows as the charge
    squared.

    Parameters
    ----------
    model : ImageCharge
        Parameters of the charge, the planes and the drift field.
    depths : array_like, shape (nd,)
        Conversion depths as heights above the gates [um], ascending, above 0 and up to the
        thickness.
    charge : float
        Charge of the central pixel in excess of all others [e-], finite.
    reach : int
        Largest pixel offset, 0 or more.
    samples : int
        Points of a line per pixel, even, denser towards the corners.
    tolerance : float
        Largest error of the image series [V/um per electron], above 0.

    Returns
    -------
    boundaries : PixelBoundaries
        Lines as of the Poisson solver, mirror-symmetric bit for bit.

    Raises
    ------
    TableError
        A parameter is not allowed, as in :func:`displace_boundaries`, or the charge reverses the
        drift field somewhere.

    Examples
    --------
    >>> model = ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0)
    >>> traced, moved = (
    ...     find(model, [20.0, 100.0], charge=1e3, reach=0)
    ...     for find in (trace_boundaries, displace_boundaries)
    ... )
    >>> bool(np.abs(traced.columns - moved.columns)[..., 0].max() < 1e-3)
    True
    """
    levels, seeds = _check_lines(model, depths, charge, reach, samples)
    lines = []
    for axis in (0, 1):
        start = _line_points(model, axis, seeds, reach)
        traced = _trace(model, start.reshape(-1, 2), axis, levels, charge, tolerance)
        lines.append(_mirror(traced.reshape(len(levels), *start.shape), axis))
    pitch = (model.pitch_x, model.pitch_y)
    return PixelBoundaries(levels, pitch, int(reach), lines[0], lines[1], True)


def _trace(
    model: ImageCharge,
    start: FloatArray,
    axis: int,
    depths: FloatArray,
    charge: float,
    tolerance: float,
) -> FloatArray:
    """Follow field lines up from the sealed height (fourth-order Runge-Kutta in height)."""
    seal = model.row_height if axis else model.column_height
    panels = _panels(model, seal, depths)
    series = image_series(model, farthest(start, model) + model.pitch_x, tolerance)

    def slope(at: FloatArray, z: float) -> FloatArray:
        points = np.column_stack([at, np.full(len(at), z)])
        field = charge * sum_field(model, points, series)
        along = model.drift_at(z) + field[:, 2]
        if not np.all(along > 0):
            raise TableError(
                f"charge = {charge:g} e- turns the drift field round at z = {z:g} um: no "
                "electron passes"
            )
        return field[:, :2] / along[:, None]

    at = start.copy()
    out = np.repeat(start[None], len(depths), axis=0)
    for low, high in pairwise(panels):
        step = (high - low) / _RAY_STEPS
        for z in low + step * np.arange(_RAY_STEPS):
            first = slope(at, z)
            second = slope(at + 0.5 * step * first, z + 0.5 * step)
            third = slope(at + 0.5 * step * second, z + 0.5 * step)
            fourth = slope(at + step * third, z + step)
            at = at + step / 6 * (first + 2 * second + 2 * third + fourth)
        out[depths >= high] = at
    return out


def _check_lines(
    model: ImageCharge, depths: ArrayLike, charge: float, reach: int, samples: int
) -> tuple[FloatArray, FloatArray]:
    """Depths, and positions along a line in pitches: Chebyshev points in every pixel."""
    levels = np.atleast_1d(_check_request(model, depths, reach))
    if levels.ndim != 1 or np.any(np.diff(levels) <= 0):
        raise TableError(f"conversion depths {levels.tolist()} um must ascend")
    if not np.isfinite(charge):
        raise TableError(f"charge = {charge} e- must be finite")
    if int(samples) != samples or samples < 2 or samples % 2:
        raise TableError(f"samples = {samples} must be an even whole number from 2")
    cheb = -0.5 * np.cos(np.pi * (np.arange(samples) + 0.5) / samples)
    pixels = np.arange(reach + 1)
    # A little of the next pixel, for the corner that moves outward.
    beyond = reach + 0.5 + np.array([0.1, 0.2])
    seeds = np.concatenate([(pixels[:, None] + cheb).ravel(), beyond])
    return levels, seeds[seeds > 0]


def _line_points(
    model: ImageCharge, axis: int, seeds: FloatArray, reach: int
) -> FloatArray:
    """Nominal points (x, y) of the lines at positive offsets, (lines, seeds, 2)."""
    pitch = np.array([model.pitch_x, model.pitch_y])
    points = np.zeros((reach + 1, len(seeds), 2))
    points[..., axis] = (np.arange(reach + 1) + 0.5)[:, None] * pitch[axis]
    points[..., 1 - axis] = seeds * pitch[1 - axis]
    return points


def _mirror(lines: FloatArray, axis: int) -> FloatArray:
    """Mirror the lines of a quadrant to all four."""
    flip = np.array([-1.0, 1.0]) if axis == 0 else np.array([1.0, -1.0])
    both = np.concatenate([lines[:, ::-1] * flip, lines], axis=1)
    return np.concatenate([both[:, :, ::-1] * -flip, both], axis=2)
