"""Free-form model of the boundaries' shifts: charge is conserved, for neighbours share edges."""

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
"""Largest lag [pixel] of the area changes: a window of 7 x 7."""

ODD_REACH = 2
"""The same of odd shifts, of which spots alone know."""

POWERS = (0, 1)
"""Of the charge that a shift per electron goes with."""

UNIT = 1e-8
"""Shift per electron [pixel/e-] of a coefficient of 1; at 1e5 e- for the power 1."""

Edge = tuple[str, int, int]
"""Axis that the edge moves along, distance along it (0: the near edge) and across it."""


def edge_names(reach: int = REACH) -> list[Edge]:
    """Edges in the window, up to reflections of it in x and y."""
    return [
        (axis, along, across)
        for axis in "xy" for along in range(reach) for across in range(reach + 1)
    ]  # fmt: skip


def shifts_of(edge: Edge, shape: tuple[int, int], *, odd: str = "") -> Edges:
    """Shifts of one edge and of its reflections by :data:`UNIT`.

    Parameters
    ----------
    edge : tuple
        Which, see :data:`Edge`; away from the charge is positive.
    shape : tuple of int
        Of the kernels, odd sides.
    odd : str
        Axis ('x' or 'y') along which the two sides move alike (x) rather than apart; what
        moves along the other axis changes its sign across.
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
    """Shifts that are even in x and in y; odd ones, where spots stand out."""
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
    """Single edges; both axes alike; by power of the charge."""
    for p in POWERS:
        for axis, along, across in edge_names():
            edges = shifts_of((axis, along, across), shape)
            where = _where(axis, along, across, p)
            yield _kernel_term(scene, where, edges, p)
        for _, along, across in [e for e in edge_names() if e[0] == "x"]:
            pair = [shifts_of((axis, along, across), shape) for axis in "xy"]
            edges = pair[0][0] + pair[1][0], pair[0][1] + pair[1][1]
            yield _kernel_term(scene, _where("xy", along, across, p), edges, p)


def odd_terms(scene: Scene) -> Iterator[Term]:
    """Shifts to one side: those of the baseline, and of single edges near the charge."""
    baseline = scene.model.predictor.baseline
    kx, ky = next(iter(baseline.edges.values()))
    for axis, k in (("x", kx), ("y", ky)):
        own = np.abs(k), np.zeros_like(k)
        edges = own if axis == "x" else own[::-1]
        where = {"odd": axis, "axis": axis, "shape": "baseline", "power": 0}
        # What spots tell of a shape of its own is little: the baseline's, if that does.
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
    """By a step as large as what shows: through the whole prediction, spots too."""
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
    """Of flats, to first order in the shifts; of spots in full."""
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
