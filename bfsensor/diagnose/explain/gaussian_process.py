"""Gaussian process over lag and level, for covariances of flats that follow no simple law."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.explain.pursuit import Choice, Dictionary
from bfsensor.diagnose.explain.terms import SINGLE, Family, Scene, Term, lag_family
from bfsensor.typing import FloatArray

KNOTS = 5
"""Number of levels at which the process has values, evenly spaced in the logarithm; linear in the
logarithm between them. Chosen: twice as many follow finer changes with level than :data:`RANGES`
allow."""

UNIT = 1e-3
"""Covariance over the level [e-^2/e-] of a coefficient of 1. Defined: a unit, which no result depends
on."""

SIZES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Standard deviations that are tried for the process [:data:`UNIT`]. Chosen, to be
derived: steps of a factor of 3; a process beyond either end is given the size of that end."""

RANGES = ((0.01, 1.0), (0.01, 3.0), (1.5, 1.0), (1.5, 3.0))
"""Correlation lengths that are tried: in lags [pixel] (0.01: lags are independent), and in the natural
logarithm of the level.  Chosen, to be derived: longer ones make the process smoother in lag or level."""


def process_choice(scene: Scene) -> Choice | None:
    """Choose size and correlation lengths by their marginal likelihood; the mean becomes one term.

    What the fit's parameters can change is projected out first, so that the process does not
    compete with them.  The score is twice the logarithm of the likelihood ratio to no process.

    Returns
    -------
    Choice or None
        The term; None where there are no covariances of flats, or noise explains them as well.
    """
    lags = lag_family(scene)
    if lags is None or lags.group == SINGLE:
        return None
    places = sorted({t.where["lags"][0] for t in lags.terms})
    channels = [c for c in scene.model.fit.channels if c.word == "flat_cov"]
    levels = np.concatenate([_level(scene, c) for c in channels])
    knots = np.linspace(np.log(levels.min()), np.log(levels.max()), KNOTS)
    terms = tuple(_terms(scene, places, knots))
    d = Dictionary(Family("process", terms, ("flat_cov",)), scene.model.fit)
    a = d.x.T @ d.x - d.u.T @ d.u
    b = d.products(scene.model.fit.left)
    distance = np.array(
        [[np.hypot(p[0] - q[0], p[1] - q[1]) for q in places] for p in places]
    )
    steps = np.abs(knots[:, None] - knots)
    best: tuple[float, FloatArray] | None = None
    for near, wide in RANGES:
        shape = np.kron(
            np.exp(-0.5 * (distance / near) ** 2), np.exp(-0.5 * (steps / wide) ** 2)
        )
        root = np.linalg.cholesky(shape + 1e-6 * np.eye(len(shape)))
        values, vectors = np.linalg.eigh(root.T @ a @ root)
        turned = vectors.T @ (root.T @ b)
        for size in SIZES:
            spread = 1 + size**2 * np.maximum(values, 0)
            score = float((size**2 * turned**2 / spread).sum() - np.log(spread).sum())
            if best is None or score > best[0]:
                mean = root @ (vectors @ (size**2 * turned / spread))
                best = score, mean
    if best is None or best[0] < d.critical:
        return None
    score, mean = best
    template = np.sum([m * d.template(n) for n, m in enumerate(mean) if m], axis=0)
    length = float(template @ template)
    if not length:
        return None
    grid = mean.reshape(len(places), KNOTS)
    farthest = np.argsort(-np.abs(grid).max(1))
    largest = np.abs(grid).max()
    told = [places[n] for n in farthest if np.abs(grid[n]).max() > 0.3 * largest]

    column = partial(_summed, mean, terms)
    where = {"lags": told, "levels": np.exp(knots).tolist(), "values": grid.tolist()}
    term = Term("smooth change of covariances", where, column)
    whole = Family("smooth covariances over lag and level", (term,), ("flat_cov",))
    chosen = Dictionary(whole, scene.model.fit).choose()
    if chosen is None:
        return None
    return Choice(
        whole, (term,), chosen.z, score - d.critical, chosen.select, chosen.template
    )


def _summed(mean: FloatArray, terms: Sequence[Term], channel: Channel) -> FloatArray | None:
    """Change by all terms with their coefficients."""
    if channel.word != "flat_cov":
        return None
    parts = [m * t.column(channel) for m, t in zip(mean, terms, strict=True) if m]
    return np.asarray(np.sum(parts, axis=0))


def _level(scene: Scene, channel: Channel) -> FloatArray:
    x = channel.axes
    return np.asarray(scene.gains[x["amp"].astype(int)] * x["level"])


def _terms(
    scene: Scene, places: list[tuple[int, int]], knots: FloatArray
) -> Iterator[Term]:
    for lag in places:
        for k in range(len(knots)):
            yield Term(f"{lag} {k}", {"lags": [lag]}, partial(_hat, scene, knots, lag, k))


def _hat(
    scene: Scene, knots: FloatArray, lag: tuple[int, int], k: int, channel: Channel
) -> FloatArray | None:
    """Change at one lag that falls linearly from one knot of the level to its neighbours."""
    if channel.word != "flat_cov":
        return None
    x = channel.axes
    level = _level(scene, channel)
    hat = np.interp(np.log(level), knots, np.eye(len(knots))[k])
    gain = scene.gains[x["amp"].astype(int)]
    here = (x["i"] == lag[0]) & (x["j"] == lag[1])
    return np.where(here, UNIT * level * hat / gain**2, 0.0)
