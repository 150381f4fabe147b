r"""Factors of a distortion table: weights of pixels times effective charges.

The table holds the shift :math:`D` of every vertex for one source charge :math:`Q` on a
uniform background :math:`B`.  It is approximated by four modes,

.. math:: D = (Q - B)\, \sum_m g_m(Q, B)\, K_m,

where :math:`g_1` is the response far from the source and the others are left out beyond
the nearest pixels.  The area of a neighbour is a small difference of large shifts, so that the other
modes are those that the areas of the nearest pixels ask for.  At the levels of the table that differ
from the background by 5,000 e- or more, the areas of the source and of its eight neighbours are those
of the table to 0.6 % (itl_sta3800c) and 0.9 % (e2v_ccd250), those two pixels away to 2.8 and 1.8 %,
with the effective charges of the level itself.
In an image every pixel has a charge and a background of its own, the
mean of its eight neighbours.  The shift of an edge is then the sum over pixels and modes of
:math:`K_m q_m` with effective charges

.. math:: q_m = \int_0^B g_m(b, b)\, db + (Q - B)\, g_m(Q, B):

a background that varies slowly acts with the differential response at its level, a pixel
that stands out of it with its own.  Uniform charge moves nothing, and a single pixel on a uniform
background moves the boundaries as in the table, but that it also changes the mean around its
neighbours, which a table does not know: with it the largest errors of a_10 and a_11 of e2v_ccd250 are
1.2 and 1.4 % on an empty background, and of a_10 6.5 % beside a pixel that holds 80,000 e- less than
all others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from bfsensor._kernels.charge import Response
from bfsensor._kernels.shifts import NEAR_MODES
from bfsensor.response.vertices import vertex_fractions
from bfsensor.sensor.edge_weights import join_sides
from bfsensor.table.interpolation import spline_weights
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

_CHARGE_STEP = 1000.0
"""Step in charge [e-] of the grid on which effective charges are interpolated linearly.

Chosen: with _BACKGROUND_STEP the error of an effective charge is 1.4 e- at most for the two LSST
devices, with twice the step 4.4 e-."""

_BACKGROUND_STEP = 2000.0
"""Step in background [e-] of that grid.

Chosen: twice the step raises the error of an effective charge from 1.4 to 5.9 e- at most."""

_LAYERS = 48
"""Heights of conversion, in equal steps of the logarithm, at which shifts are kept.

Chosen: half a step changes the shifts of the two LSST devices by 2.7 % of the largest one at most,
at 6 um above the gates; with twice as many by half of that, in twice the memory."""

_ENOUGH = 5000.0
"""Difference of charge and background [e-] from which all levels count alike where modes are chosen.

Chosen: below it a table's own noise is a larger part of its shifts, and counts less; the lowest levels
of the two LSST devices lie above.  At twice the value the largest error of their nearest areas
is 1.02 %, here 0.91 %."""


@dataclass(frozen=True)
class EffectiveCharge:
    """Weights of all modes and their effective charges.

    Attributes
    ----------
    modes : tuple of pairs of ndarray
        Shifts [pixel per electron] of vertical and of horizontal sides, by layer, of the first mode and
        of those of the nearest pixels; a linear table has the first one only.
    heights : ndarray
        Heights of the layers [um], in equal steps of the logarithm.
    points : ndarray
        Nominal positions along a side, corners included.
    response : Response
        Effective charges on a grid of charge and background.
    residual : float
        Largest error of the factors at the table's own levels: error of the mean normal shift of
        an edge, relative to the largest such shift of its level.
    """

    modes: tuple[tuple[FloatArray, FloatArray], ...]
    heights: FloatArray
    points: FloatArray
    response: Response
    residual: float


def factor_table(
    table: DistortionTable,
    *,
    linear: bool = False,
    background: bool = True,
    top: bool = False,
    growth: float = 0.0,
) -> EffectiveCharge:
    """Factor a table into weights and effective charges.

    Parameters
    ----------
    table : DistortionTable
        Any.
    linear : bool
        Take the response of a small charge on an empty background for all charges.
    background : bool
        Let the response depend on the background of a pixel.
    top : bool
        Use the shifts of the highest depth for all heights.
    growth : float
        Further growth b of the response with charge [1/e-]: shifts by one charge on an empty
        background are multiplied by (1 + b Q / 2), those by a small charge on a background B by
        (1 + b B).

    Returns
    -------
    EffectiveCharge
    """
    pitch = np.array(table.pitch)
    responses = table._responses
    sides = [s / pitch for s in join_sides(responses[0], responses[1], responses[2])]
    points = np.concatenate([[0.0], vertex_fractions(table.vertices), [1.0]])
    lengths = np.zeros(len(points))
    lengths[1:] += np.diff(points) / 2
    lengths[:-1] += np.diff(points) / 2
    if top:
        sides = [s[:, :, -1:] for s in sides]
    levels = sides[0].shape[:2]
    step = table.charges[:, None] - table.backgrounds
    weight = np.minimum(np.abs(step).ravel() / _ENOUGH, 1.0)
    # The area that an edge gains is its mean normal shift times its length.
    means = [
        (s[..., n] @ lengths).reshape(len(weight), *s.shape[2:5])
        for n, s in enumerate(sides)
    ]
    far = np.concatenate([m[..., _is_far(m.shape[2:])] for m in means], -1)
    g1 = _leading(far.reshape(len(weight), -1), weight)
    scale = _at_zero(table, g1.reshape(levels))
    g1 = g1 / scale
    flat = np.concatenate([m.reshape(len(g1), -1) for m in means], -1)
    if linear or len(g1) == 1:
        # The response of the smallest charge on the lowest background holds for all.
        modes = _Modes(np.ones((len(g1), 1)), ([s[0, 0] for s in sides],))
    else:
        modes = _split(sides, _near_areas(means), g1, weight)
    residual = _residual(flat, weight, modes, lengths)
    amplitudes = np.zeros((len(g1), 1 + NEAR_MODES))
    amplitudes[:, : modes.amplitudes.shape[1]] = modes.amplitudes
    response = _grid(
        table,
        amplitudes.T.reshape(-1, *levels),
        linear=linear,
        background=background,
        growth=growth,
    )
    z = table.depths[-1:] if top else table.depths
    heights = z
    if len(z) > 1:
        # The last layer lies where light without wavelengths converts, 1 um below the back
        # surface; above it shifts hardly change.
        heights = np.geomspace(z[0], min(z[-1], table.thickness - 1.0), _LAYERS)
    packed = tuple(_to_layers(z, heights, sides) for sides in modes.patterns)
    return EffectiveCharge(packed, heights, points, response, residual)


@dataclass(frozen=True)
class _Modes:
    """Amplitudes [level, mode], and the patterns of each mode by side."""

    amplitudes: FloatArray
    patterns: tuple[list[FloatArray], ...]


def _near_areas(means: list[FloatArray]) -> FloatArray:
    """Area changes, to first order, of the source and its eight neighbours [level, depth and pixel].

    ``means``: mean normal shifts of sides [level, depth, row, column], which areas are differences of.
    Each is relative to its mean size over the levels at its depth, so that a small neighbour counts
    as much as the source.
    """
    upright, flat = means
    areas = np.diff(upright, axis=3) + np.diff(flat, axis=2)
    middle = areas.shape[2] // 2
    near = slice(max(middle - 1, 0), middle + 2)
    areas = areas[:, :, near, near]
    size = np.abs(areas).mean(0)
    scaled = np.divide(areas, size, out=np.zeros_like(areas), where=size > 0)
    return np.asarray(scaled.reshape(len(areas), -1))


def _split(
    sides: list[FloatArray], areas: FloatArray, g1: FloatArray, weight: FloatArray
) -> _Modes:
    """Split the response into the mode of far edges, and further modes of the edges beside the source.

    ``areas`` are those of :func:`_near_areas`.
    """
    count = len(g1)
    # Singular vectors of the areas less those by the far mode, largest first.
    rest = areas - np.outer(g1, _project(areas, g1[:, None], weight))
    patterns = np.linalg.svd(rest * weight[:, None], full_matrices=False)[2][:NEAR_MODES]
    more = np.zeros((count, NEAR_MODES))
    more[:, : len(patterns)] = rest @ patterns.T
    # Kernels bound shifts by the largest range of all modes, which that of the first shall be.  Tables
    # of few levels have fewer modes; what round-off leaves is none.
    size = 2.0 * np.abs(more).max(0)
    more = np.where(size > 1e-9, more / np.maximum(size, 1e-9), 0.0)
    basis = np.concatenate([g1[:, None], more], 1)
    out = []
    for s in sides:
        data = s.reshape(count, -1)
        near = _is_near(s.shape[3:5])[None, :, :, None, None]
        inside = np.broadcast_to(near, s.shape[2:]).ravel()
        own = np.zeros((basis.shape[1], data.shape[1]))
        own[:1] = _project(data, g1[:, None], weight)
        own[:, inside] = _project(data[:, inside], basis, weight)
        out.append(own.reshape(-1, *s.shape[2:]))
    return _Modes(basis, tuple([k[m] for k in out] for m in range(basis.shape[1])))


def _to_layers(
    z: FloatArray, heights: FloatArray, sides: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Interpolate sides from the table's depths to the heights of the layers."""
    if len(z) == 1:
        return sides[0], sides[1]
    out = [PchipInterpolator(np.log(z), s, axis=0)(np.log(heights)) for s in sides]
    return out[0], out[1]


def _offsets(shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Distances [pixel] of edges from the source, by row and column."""
    return (
        np.abs(np.arange(shape[0]) - (shape[0] - 1) / 2)[:, None],
        np.abs(np.arange(shape[1]) - (shape[1] - 1) / 2)[None],
    )


def _is_far(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Edges that lie 2 pixels or more from the source, where the response has one pattern."""
    rows, columns = _offsets(shape)
    return np.maximum(rows, columns) > 1.9


def _is_near(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Edges whose window of sources within one pixel holds the source."""
    rows, columns = _offsets(shape)
    return (rows < 1.9) & (columns < 1.9)


def _leading(rows: FloatArray, weight: FloatArray) -> FloatArray:
    """Amplitudes, by row, of the leading pattern of the weighted rows; 1 if there are no columns."""
    if rows.shape[1] == 0:
        return np.ones(len(rows))
    pattern = np.linalg.svd(rows * weight[:, None], full_matrices=False)[2][0]
    return np.asarray(rows @ pattern)


def _project(rows: FloatArray, basis: FloatArray, weight: FloatArray) -> FloatArray:
    """Patterns that fit the rows best, by least squares, with the amplitudes ``basis`` [row, mode]."""
    w = weight[:, None]
    return np.asarray(np.linalg.lstsq(basis * w, rows * w, rcond=None)[0])


def _at_zero(table: DistortionTable, g: FloatArray) -> float:
    """Amplitude at the table's lowest charge and background."""
    wq = spline_weights(table.charges, float(table.charges[0]))
    wb = spline_weights(table.backgrounds, float(table.backgrounds[0]))
    return float(wq @ g @ wb)


def _residual(
    flat: FloatArray, weight: FloatArray, modes: _Modes, lengths: FloatArray
) -> float:
    """Largest error of the modes at the table's levels, relative to the largest shift of each."""

    def mean(k: list[FloatArray]) -> FloatArray:
        parts = [(s[..., n] @ lengths).reshape(s.shape[0], -1) for n, s in enumerate(k)]
        return np.concatenate(parts, -1).ravel()

    model = modes.amplitudes @ np.array([mean(k) for k in modes.patterns])
    size = np.abs(flat).max(1)
    good = (weight > 0) & (size > 0)
    return float((np.abs(flat - model).max(1)[good] / size[good]).max())


def _grid(
    table: DistortionTable,
    amplitudes: FloatArray,
    *,
    linear: bool,
    background: bool,
    growth: float,
) -> Response:
    """Effective charges on equal steps of charge and background; ``amplitudes`` [mode, Q, B]."""
    if (linear or len(table.charges) == 1) and not growth:
        empty = np.zeros((0, 0), np.float32)
        near = np.zeros((0, 0, NEAR_MODES), np.float32)
        return Response(empty, near, 1.0, 1.0, np.inf, np.inf)
    last = table.charges[-1]
    top = last
    if np.isfinite(table.full_well) and table.full_well > last:
        # Up to the full well the response of the last level is held.
        top = table.full_well
    q = np.arange(0.0, np.ceil(top / _CHARGE_STEP) + 1.0) * _CHARGE_STEP
    b = np.arange(0.0, np.ceil(table.backgrounds[-1] / _BACKGROUND_STEP) + 1.0)
    b *= _BACKGROUND_STEP
    if len(b) < 2:
        b = np.array([0.0, _BACKGROUND_STEP])
    wq = np.array([spline_weights(table.charges, min(x, last)) for x in q])
    wb = np.array(
        [spline_weights(table.backgrounds, min(x, table.backgrounds[-1])) for x in b]
    )
    fine = np.arange(0.0, b[-1] + 1.0, 250.0)
    fq = np.array([spline_weights(table.charges, min(x, last)) for x in fine])
    fb = np.array(
        [spline_weights(table.backgrounds, min(x, table.backgrounds[-1])) for x in fine]
    )
    grids = []
    for g in amplitudes:
        if background:
            response = wq @ g @ wb.T
            diagonal = np.einsum("nq,qb,nb->n", fq, g, fb)
            if growth:
                # A linear response then has the effective charge Q (1 + growth Q / 2) on any
                # background.
                response = response * (1 + 0.5 * growth * (q[:, None] + b))
                diagonal = diagonal * (1 + growth * fine)
            steps = 125.0 * (diagonal[1:] + diagonal[:-1])
            integral = np.interp(b, fine, np.concatenate([[0.0], np.cumsum(steps)]))
            grids.append(integral + (q[:, None] - b) * response)
        else:
            alone = wq @ g @ wb[0]
            if growth:
                alone = alone * (1 + 0.5 * growth * q)
            grids.append(np.repeat((q * alone)[:, None], len(b), 1))
    return Response(
        grids[0].astype(np.float32),
        np.ascontiguousarray(np.stack(grids[1:], -1), np.float32),
        _CHARGE_STEP,
        _BACKGROUND_STEP,
        float(top / _CHARGE_STEP),
        float(table.backgrounds[-1] / _BACKGROUND_STEP),
    )
