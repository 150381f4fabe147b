r"""A distortion table as weights times effective charges.

The table holds the shift :math:`D` of every vertex for one source charge :math:`Q` on a
uniform background :math:`B`.  It factors, to about half a per cent of the shift, into

.. math:: D = (Q - B)\, [g_1(Q, B)\, K_1 + g_2(Q, B)\, K_2],

where :math:`g_1` is the response far from the source and :math:`K_2` is left out beyond
the nearest pixels.  In an image every pixel has a charge and a background of its own, the
mean of its eight neighbours.  The shift of an edge is then the sum over pixels of
:math:`K_1 q_1 + K_2 q_2` with effective charges

.. math:: q_m = \int_0^B g_m(b, b)\, db + (Q - B)\, g_m(Q, B):

a background that varies slowly acts with the differential response at its level, a pixel
that stands out of it with its own.  For uniform charge nothing moves, for a single pixel
the table comes back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from bfsensor._kernels.charge import Response
from bfsensor.response.vertices import vertex_fractions
from bfsensor.sensor.edge_weights import join_sides
from bfsensor.table.interpolation import spline_weights
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

_CHARGE_STEP = 1000.0
_BACKGROUND_STEP = 2000.0
_LAYERS = 48


@dataclass(frozen=True)
class EffectiveCharge:
    """Weights of both modes and their effective charges.

    Attributes
    ----------
    first, second : pair of ndarray
        Vertical and horizontal sides by layer, shifts [pixel per electron].
    heights : ndarray
        Of the layers [um], equal steps of the logarithm.
    points : ndarray
        Nominal positions along a side, corners included.
    response : Response
        Effective charges on a grid of charge and background.
    residual : float
        Largest error of the factors at the table's own levels: of the mean normal shift of
        any edge, relative to the largest of its level.
    """

    first: tuple[FloatArray, FloatArray]
    second: tuple[FloatArray, FloatArray] | None
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
    bend: float = 0.0,
) -> EffectiveCharge:
    """Factor a table into weights and effective charges.

    Parameters
    ----------
    table : DistortionTable
        Any.
    linear : bool
        Keep the response of a small charge on an empty background for all charges.
    background : bool
        Let the background of a pixel count.
    top : bool
        Use the shifts of the highest depth for all heights.
    bend : float
        b [1/e-]: shifts grow by (1 + b Q / 2) besides; of a small charge on a background B by
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
    weight = np.abs(step).ravel()
    # What an edge gains is its mean normal shift.
    means = np.concatenate(
        [
            (s[..., n] @ lengths).reshape(*levels, s.shape[2], -1)
            for n, s in enumerate(sides)
        ],
        -1,
    )
    far = np.concatenate([_is_far(s.shape[3:5]) for s in sides])
    g1 = _leading(means[..., far].reshape(levels[0] * levels[1], -1), weight)
    scale = _at_zero(table, g1.reshape(levels))
    g1 = g1 / scale
    flat = means.reshape(len(g1), -1)
    if linear or len(g1) == 1:
        # The smallest charge on the lowest background speaks for all.
        modes = _Modes(np.ones_like(g1), np.zeros_like(g1), [s[0, 0] for s in sides], None)
    else:
        modes = _split(sides, flat, g1, weight)
    residual = _residual(flat, weight, modes, lengths)
    response = _grid(
        table, modes.g1.reshape(levels), modes.g2.reshape(levels), linear=linear,
        background=background, bend=bend,
    )  # fmt: skip
    z = table.depths[-1:] if top else table.depths
    heights = z
    if len(z) > 1:
        # A layer where light without wavelengths converts; above it nothing changes.
        heights = np.geomspace(z[0], min(z[-1], table.thickness - 1.0), _LAYERS)
    first = _to_layers(z, heights, modes.k1)
    second = None if modes.k2 is None else _to_layers(z, heights, modes.k2)
    return EffectiveCharge(first, second, heights, points, response, residual)


@dataclass(frozen=True)
class _Modes:
    """Amplitudes of both modes by level, and their patterns by side; no second of a linear table."""

    g1: FloatArray
    g2: FloatArray
    k1: list[FloatArray]
    k2: list[FloatArray] | None


def _split(
    sides: list[FloatArray], flat: FloatArray, g1: FloatArray, weight: FloatArray
) -> _Modes:
    """Add to the far response a second mode, of the nearest edges, that it leaves over."""
    rest = flat - np.outer(g1, _project(flat, g1, weight))
    g2 = _leading(rest, weight)
    g2 = g2 / np.sqrt(np.average(g2**2, weights=weight))
    # The second mode is what the first cannot say where charge and background are 0.
    basis = np.stack([g1, g2], 1)
    k1, k2 = [], []
    for s in sides:
        data = s.reshape(len(g1), -1)
        both = _project(data, basis, weight)
        alone = _project(data, g1, weight)
        near = np.broadcast_to(
            _is_near(s.shape[3:5])[None, :, :, None, None], s.shape[2:]
        ).ravel()
        k1.append(np.where(near, both[0], alone).reshape(s.shape[2:]))
        k2.append(np.where(near, both[1], 0.0).reshape(s.shape[2:]))
    return _Modes(g1, g2, k1, k2)


def _to_layers(
    z: FloatArray, heights: FloatArray, sides: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
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
    rows, columns = _offsets(shape)
    return (np.maximum(rows, columns) > 1.9).ravel()


def _is_near(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Edges in whose window of sources within one pixel the source lies."""
    rows, columns = _offsets(shape)
    return (rows < 1.9) & (columns < 1.9)


def _leading(rows: FloatArray, weight: FloatArray) -> FloatArray:
    """Amplitude by row of the leading pattern; rows of no weight are projected on it."""
    if rows.shape[1] == 0:
        return np.ones(len(rows))
    pattern = np.linalg.svd(rows * weight[:, None], full_matrices=False)[2][0]
    return np.asarray(rows @ pattern)


def _project(rows: FloatArray, basis: FloatArray, weight: FloatArray) -> FloatArray:
    """Least-squares patterns of the amplitudes ``basis``."""
    b = basis * (weight[:, None] if basis.ndim == 2 else weight)
    if basis.ndim == 1:
        return np.asarray(b @ (rows * weight[:, None]) / (b @ b))
    return np.asarray(np.linalg.lstsq(b, rows * weight[:, None], rcond=None)[0])


def _at_zero(table: DistortionTable, g: FloatArray) -> float:
    wq = spline_weights(table.charges, float(table.charges[0]))
    wb = spline_weights(table.backgrounds, float(table.backgrounds[0]))
    return float(wq @ g @ wb)


def _residual(
    flat: FloatArray, weight: FloatArray, modes: _Modes, lengths: FloatArray
) -> float:
    """Largest error of the modes at the table's levels, relative to each level's largest shift."""

    def mean(k: list[FloatArray]) -> FloatArray:
        parts = [(s[..., n] @ lengths).reshape(s.shape[0], -1) for n, s in enumerate(k)]
        return np.concatenate(parts, -1).ravel()

    model = np.outer(modes.g1, mean(modes.k1))
    if modes.k2 is not None:
        model += np.outer(modes.g2, mean(modes.k2))
    size = np.abs(flat).max(1)
    good = (weight > 0) & (size > 0)
    return float((np.abs(flat - model).max(1)[good] / size[good]).max())


def _grid(
    table: DistortionTable,
    g1: FloatArray,
    g2: FloatArray,
    *,
    linear: bool,
    background: bool,
    bend: float,
) -> Response:
    """Effective charges on equal steps of charge and background."""
    if (linear or len(table.charges) == 1) and not bend:
        empty = np.zeros((0, 0), np.float32)
        return Response(empty, empty, 1.0, 1.0, np.inf, np.inf)
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
    for g in (g1, g2):
        if background:
            response = wq @ g @ wb.T
            diagonal = np.einsum("nq,qb,nb->n", fq, g, fb)
            if bend:
                # So that of a linear response Q (1 + bend Q / 2) is left.
                response = response * (1 + 0.5 * bend * (q[:, None] + b))
                diagonal = diagonal * (1 + bend * fine)
            steps = 125.0 * (diagonal[1:] + diagonal[:-1])
            integral = np.interp(b, fine, np.concatenate([[0.0], np.cumsum(steps)]))
            grids.append(integral + (q[:, None] - b) * response)
        else:
            alone = wq @ g @ wb[0]
            if bend:
                alone = alone * (1 + 0.5 * bend * q)
            grids.append(np.repeat((q * alone)[:, None], len(b), 1))
    return Response(
        grids[0].astype(np.float32),
        grids[1].astype(np.float32),
        _CHARGE_STEP,
        _BACKGROUND_STEP,
        float(top / _CHARGE_STEP),
        float(table.backgrounds[-1] / _BACKGROUND_STEP),
    )
