"""Tests of physical constraints on boundary shifts, such as charge conservation, with their p-values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.fft import irfft2
from scipy.stats import chi2

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.explain.edge_terms import odd_terms
from bfsensor.diagnose.explain.pursuit import Dictionary
from bfsensor.diagnose.explain.terms import Family, Scene, Term, at_lags
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.response.edge_response import area_matrix
from bfsensor.typing import FloatArray

LOSS = 1e-8
"""Charge lost per stored electron [1/e-] of a coefficient of 1.  Defined: a unit."""

Test = Mapping[str, float]
"""Result of a test: 'p_value', and 'value', 'error', 'chi2', 'dof' where they are known."""


def test_constraints(model: Model, terms: Mapping[Term, float]) -> dict[str, Test]:
    """Test a nonparametric model of covariances or shifts for conservation, symmetry and decay.

    No constraint is imposed on the model; each is tested.

    Parameters
    ----------
    model : Model
        Model with the terms, fitted.
    terms : mapping of Term to float
        Terms with their coefficients.

    Returns
    -------
    dict of str to mapping
        By constraint: 'p_value' of the data if it holds; 'value' and 'error' of its violation
        where that is one number.

        - 'sum rule': charge lost per electron besides the shifts, or the sum of the added
          covariances of single lags over the root of their sum of squares.
        - 'even in x', 'even in y': shifts to one side, as a fraction of the baseline's, which
          only the skewness of spots constrains.
        - 'reciprocity': both together; the area change at a lag equals that at its opposite.
        - 'x and y alike': added shifts along x against those along y.
        - 'decay': power p of r^-p with which added area changes fall off; no p-value.
    """
    scene = Scene(model)
    words = {c.word for c in model.fit.channels}
    out: dict[str, Test] = {}
    if "flat_cov" in words:
        lags = {t: c for t, c in terms.items() if "lags" in t.where and "power" in t.where}
        found = _sum_over_lags(model, lags) if lags else _loss(scene)
        out |= {"sum rule": found} if found else {}
    if "spot" in words:
        odd = [t for t in odd_terms(scene) if t.where.get("shape") == "baseline"]
        both = {t.where["odd"]: t for t in odd}
        for axis in "xy":
            chosen = [t for t in terms if t.where.get("odd") == axis]
            if not chosen:
                out[f"even in {axis}"] = _amplitude(scene, both[axis], ("spot",))
        if any("odd" in t.where for t in terms):
            for axis in {t.where["odd"] for t in terms if "odd" in t.where}:
                out[f"even in {axis}"] = _fitted(
                    model, [t for t in terms if t.where.get("odd") == axis]
                )
        squares = [out[f"even in {a}"]["chi2"] for a in "xy"]
        dofs = [out[f"even in {a}"]["dof"] for a in "xy"]
        out["reciprocity"] = {"p_value": float(chi2.sf(sum(squares), sum(dofs)))}
    kernel = {t: c for t, c in terms.items() if "edges" in t.where and "odd" not in t.where}
    if kernel:
        a = np.sum([c * area_matrix(*t.where["edges"]) for t, c in kernel.items()], axis=0)
        out["x and y alike"] = _alike(model, kernel)
        if (decay := _decay(a)) is not None:
            out["decay"] = decay
    return out


def _amplitude(scene: Scene, term: Term, words: tuple[str, ...]) -> dict[str, float]:
    """Amplitude of one more term, and the p-value of its being 0."""
    d = Dictionary(Family("test", (term,), words), scene.model.fit)
    if not d.free[0] > 0:
        return {"p_value": 1.0, "chi2": 0.0, "dof": 0.0}
    b = float(d.products(scene.model.fit.left)[0])
    square = b * b / float(d.free[0])
    return {
        "p_value": float(chi2.sf(square, 1)), "value": b / float(d.free[0]),
        "error": float(d.free[0]) ** -0.5, "chi2": square, "dof": 1.0,
    }  # fmt: skip


def _fitted(model: Model, terms: list[Term]) -> dict[str, float]:
    """Test that given coefficients of a fit are 0."""
    names = list(model.fit.names)
    rows = [names.index(f"free {t.name}") for t in terms]
    values = model.fit.values[rows]
    square = float(
        values @ np.linalg.solve(model.fit.covariance[np.ix_(rows, rows)], values)
    )
    out = {
        "p_value": float(chi2.sf(square, len(rows))),
        "chi2": square,
        "dof": float(len(rows)),
    }
    if len(rows) == 1:
        out |= {"value": float(values[0]), "error": float(model.fit.errors[rows[0]])}
    return out


def _loss(scene: Scene) -> dict[str, float] | None:
    """Test for charge lost in proportion to the stored charge, by covariances alone."""

    def column(channel: Channel) -> FloatArray | None:
        if channel.word != "flat_cov" or channel.unit == PER_ELECTRON:
            return None
        x = channel.axes
        i, j = x["i"].astype(int), x["j"].astype(int)
        out = np.zeros(len(channel))
        for flats in scene.flats(channel):
            side = flats.c.shape[-1]
            response = irfft2(-LOSS * scene.responses(flats, 0), s=(side, side))
            c = response / flats.gain[:, None, None] ** 2
            out[flats.rows] = at_lags(c, flats.flat, i[flats.rows], j[flats.rows])
        return out

    found = _amplitude(scene, Term("loss", {}, column), ("flat_cov",))
    return found if found["dof"] else None


def _sum_over_lags(model: Model, terms: Mapping[Term, float]) -> dict[str, float]:
    """Test that the added covariances at 1e5 e- sum to 0 over lags and their reflections."""
    names = list(model.fit.names)
    rows, weights = [], []
    for term in terms:
        i, j = term.where["lags"][0]
        rows.append(names.index(f"free {term.name}"))
        weights.append((2.0 if i else 1.0) * (2.0 if j else 1.0))
    w, values = np.array(weights), model.fit.values[rows]
    error = float(np.sqrt(w @ model.fit.covariance[np.ix_(rows, rows)] @ w))
    total, size = float(w @ values), float(np.sqrt((w * values) @ (w * values)))
    square = (total / error) ** 2 if error > 0 else 0.0
    return {
        "p_value": float(chi2.sf(square, 1)), "value": total / size, "error": error / size,
        "chi2": square, "dof": 1.0,
    }  # fmt: skip


def _alike(model: Model, terms: Mapping[Term, float]) -> dict[str, float]:
    """Test that the fitted shifts are the same along x and along y."""
    names = list(model.fit.names)
    keys: dict[tuple[Any, ...], dict[int, float]] = {}
    for term in terms:
        if term.where["axis"] == "xy":
            continue
        key = tuple(term.where[k] for k in ("along", "across", "power"))
        sign = 1.0 if term.where["axis"] == "x" else -1.0
        keys.setdefault(key, {})[names.index(f"free {term.name}")] = sign
    rows = sorted({r for parts in keys.values() for r in parts})
    if not rows:
        return {"p_value": 1.0, "chi2": 0.0, "dof": 0.0}
    # Differences of x and y, edge by edge; an edge fitted along one axis only differs by itself.
    matrix = np.array([[parts.get(r, 0.0) for r in rows] for parts in keys.values()])
    difference = matrix @ model.fit.values[rows]
    covariance = matrix @ model.fit.covariance[np.ix_(rows, rows)] @ matrix.T
    square = float(difference @ np.linalg.solve(covariance, difference))
    return {
        "p_value": float(chi2.sf(square, len(keys))),
        "chi2": square,
        "dof": float(len(keys)),
    }


def _decay(a: FloatArray) -> dict[str, float] | None:
    """Power of the distance with which area changes fall off; None with fewer than three distances."""
    centre = a.shape[0] // 2
    y, x = np.indices(a.shape) - centre
    r = np.hypot(x, y)
    use = (np.abs(a) > 1e-3 * np.abs(a).max()) & (r > 0)
    if len(set(r[use].round(6))) < 3:
        return None
    line, residual, *_ = np.polyfit(np.log(r[use]), np.log(np.abs(a[use])), 1, full=True)
    scatter = np.sqrt(float(residual[0]) / max(use.sum() - 2, 1)) if len(residual) else 0.0
    error = scatter / np.sqrt(use.sum() * np.log(r[use]).var())
    return {"value": float(-line[0]), "error": float(error)}
