"""Nonparametric terms of boundary shifts: single edges, which conserve charge as pixels share them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.fft import irfft2

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.explain.terms import SCALE, Family, Scene, Term, at_lags
from bfsensor.diagnose.model.flat_predictions import transform_areas
from bfsensor.response.edge_response import area_matrix
from bfsensor.typing import Edges, FloatArray

REACH = 3
"""Largest lag of the added area changes [pixel]: a window of 7 x 7 pixels. Chosen, to be derived:
twice as large has 3.5 times as many edges to search, and so a higher threshold for each."""

ODD_REACH = 2
"""Largest lag of odd shifts [pixel], which only spots constrain.  Chosen, to be derived: twice as large
adds edges that the few pixels of a spot hardly distinguish."""

POWERS = (0, 1)
"""Powers of the charge that shifts per electron go with. Chosen: a shift proportional to the charge,
and its first correction; a third power makes the search half as long again."""

UNIT = 1e-8
"""Shift per electron [pixel/e-] of a coefficient of 1; at 1e5 e- for the power 1.  Defined: the unit of
the coefficients in report.json."""

Edge = tuple[str, int, int]
"""Axis that an edge moves along, and its distance [pixel] from the charge along it (0: the nearest
edge, half a pixel away) and across it."""


def edge_names(reach: int = REACH) -> list[Edge]:
    """Edges in the window of ``reach`` pixels, one of each set that reflections in x and y make."""
    return [
        (axis, along, across)
        for axis in "xy" for along in range(reach) for across in range(reach + 1)
    ]  # fmt: skip


def shifts_of(edge: Edge, shape: tuple[int, int], *, odd: str = "") -> Edges:
    """Kernels of one edge and its reflections, all shifted by :data:`UNIT`.

    Parameters
    ----------
    edge : tuple
        Edge, see :data:`Edge`; shifts away from the charge are positive.
    shape : tuple of int
        Shape of the kernels, odd sides.
    odd : str
        '' for shifts that mirror each other on both sides of the charge; 'x' or 'y' for shifts
        in the same direction on both sides along that axis.  Edges that move along the other
        axis then change sign from one side to the other.

    Returns
    -------
    kx, ky : ndarray
        Shifts of right and upper edges [pixel/e-].
    """
    axis, along, across = edge
    kernels = np.zeros((2, *shape))
    centre = shape[0] // 2
    for side in (1, -1):
        for over in (1, -1):
            # The right edge of pixel n is the left one of n + 1.
            place = along if side > 0 else -along - 1
            sign = float(side)
            if odd:
                sign = 1.0 if odd == axis else float(side * over)
            if odd and odd != axis and across == 0:
                continue
            y, x = (over * across, place) if axis == "x" else (place, over * across)
            kernels["xy".index(axis)][centre + y, centre + x] = sign * UNIT
    return kernels[0], kernels[1]


def kernel_families(scene: Scene, *, spots: bool) -> list[Family]:
    """Families of even shifts, where there are covariances, and of odd ones, where spots stand out."""
    baseline = scene.model.predictor.baseline
    shape = next(iter(baseline.edges.values()))[0].shape
    words = {c.word for c in scene.model.fit.channels}
    out = []
    if "flat_cov" in words:
        terms = tuple(_terms(scene, shape))
        out.append(Family("boundary shifts", terms, ("flat_cov",)))
    if "spot" in words and spots:
        odd = tuple(odd_terms(scene))
        out.append(Family("odd boundary shifts", odd, ("spot",)))
    return out


def _terms(scene: Scene, shape: tuple[int, int]) -> Iterator[Term]:
    """Single edges of either axis, and of both axes alike, by power of the charge."""
    flats = [c for c in scene.model.fit.channels if c.word == "flat_cov"]
    # a_ij measured at one level say nothing of a power of the charge.
    levels = {float(v) for c in flats for v in np.unique(c.axes["level"])}
    for p in POWERS if len(levels) > 1 else POWERS[:1]:
        for axis, along, across in edge_names():
            edges = shifts_of((axis, along, across), shape)
            where = _where(axis, along, across, p)
            yield _kernel_term(scene, where, edges, p)
        for _, along, across in [e for e in edge_names() if e[0] == "x"]:
            pair = [shifts_of((axis, along, across), shape) for axis in "xy"]
            edges = pair[0][0] + pair[1][0], pair[0][1] + pair[1][1]
            yield _kernel_term(scene, _where("xy", along, across, p), edges, p)


def odd_terms(scene: Scene) -> Iterator[Term]:
    """Odd shifts: the size of the baseline's own, and single edges near the charge."""
    baseline = scene.model.predictor.baseline
    kx, ky = next(iter(baseline.edges.values()))
    for axis, k in (("x", kx), ("y", ky)):
        own = np.abs(k), np.zeros_like(k)
        edges = own if axis == "x" else own[::-1]
        where = {"odd": axis, "axis": axis, "shape": "baseline", "power": 0}
        # Spots constrain the shape of odd shifts weakly, so the baseline's shape is preferred where it
        # explains as much.
        yield replace(_kernel_term(scene, where, edges, 0), simple=True)
        for edge in edge_names(ODD_REACH):
            if edge[2] >= ODD_REACH:
                continue
            edges = shifts_of(edge, kx.shape, odd=axis)
            if any(np.any(e) for e in edges):
                yield _kernel_term(scene, {**_where(*edge, 0), "odd": axis}, edges, 0)


def _where(axis: str, along: int, across: int, p: int) -> dict[str, Any]:
    return {"axis": axis, "along": along + 0.5, "across": across, "power": p}


def _kernel_term(scene: Scene, where: Mapping[str, Any], edges: Edges, p: int) -> Term:
    odd = f", odd in {where['odd']}" if "odd" in where else ""
    if where.get("shape") == "baseline":
        name = f"shifts of the baseline along {where['axis']}{odd}"
    else:
        name = (
            f"edges along {where['axis']} at ({where['along']:g}, {where['across']}) x Q^{p + 1}"
            f"{odd}"
        )
    told = {**where, "edges": edges}
    return Term(
        name, told, partial(_column, scene, edges, p), partial(_rough, scene, edges, p)
    )


def _column(scene: Scene, edges: Edges, p: int, channel: Channel) -> FloatArray | None:
    """Change of the full prediction for a coefficient of 1, spots included."""
    if channel.word not in ("flat_cov", "spot"):
        return None
    predictor = scene.model.predictor
    if p == 0:
        more = predictor.with_shifts(edges)
    else:
        slopes = edges[0] / SCALE, edges[1] / SCALE
        more = predictor.with_shifts((np.zeros_like(edges[0]),) * 2, slopes)
    point = scene.model.fit.values[: len(predictor.names)]
    return np.asarray(more.predict(channel, point) - scene.here(channel))


def _rough(scene: Scene, edges: Edges, p: int, channel: Channel) -> FloatArray | None:
    """Change of flats to first order in the shifts, which is fast; of spots by the full prediction."""
    if channel.word != "flat_cov" or channel.unit == PER_ELECTRON:
        return _column(scene, edges, p, channel)
    x = channel.axes
    i, j = x["i"].astype(int), x["j"].astype(int)
    out = np.zeros(len(channel))
    a = area_matrix(*edges)
    baseline = scene.model.predictor.baseline
    for flats in scene.flats(channel):
        response = scene.responses(flats, p) / SCALE**p
        scale = baseline.scale_at(baseline.nearest(flats.condition))
        side = flats.c.shape[-1]
        changed = scale * transform_areas(a, side) * response
        c = irfft2(changed, s=(side, side)) / flats.gain[:, None, None] ** 2
        out[flats.rows] = at_lags(c, flats.flat, i[flats.rows], j[flats.rows])
    return out
