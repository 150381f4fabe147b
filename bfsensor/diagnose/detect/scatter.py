"""The scatter of values that a candidate explains, weighed before the candidate is fitted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect
from bfsensor.errors import FitError
from bfsensor.inference.random_effects import likeliest
from bfsensor.typing import FloatArray

MOST = 2000
"""Largest number of modes of a candidate that is weighed by scatter.

Chosen: their eigenvectors take 3 CPU s, and a fit has as many columns more; twice as many take 22 CPU
s for each starting point."""


class Scatter(NamedTuple):
    """Whitened modes of one effect, a fit's parameters projected out.

    Attributes
    ----------
    sizes : ndarray, shape (m,)
        Squares of the modes' singular values.
    shapes : ndarray, shape (m, m)
        Their right singular vectors, in columns.
    blocks : list of (int, ndarray)
        Index of a channel's first value, and its rows of its own modes, not projected.
    """

    sizes: FloatArray
    shapes: FloatArray
    blocks: list[tuple[int, FloatArray]]

    def likeliest(self, *projected: FloatArray) -> tuple[float, float]:
        """Gain and factor of :func:`bfsensor.inference.random_effects.likeliest`.

        ``projected`` are residuals, linear and quadratic template, the fit's parameters projected
        out, so that the modes need not be.
        """
        along = np.array([
            np.concatenate([v[start : start + len(own)] @ own for start, own in self.blocks])
            for v in projected
        ])  # fmt: skip
        products = np.array(projected) @ np.array(projected).T
        return likeliest(self.sizes, along @ self.shapes, products)


def scatter_of(
    predictor: Predictor, fit: BaselineFit, effect: Effect, values: FloatArray
) -> Scatter:
    """Modes of one effect in the channels whose scatter constrains it.

    Parameters
    ----------
    predictor : Predictor
        Predicts the channels; its effects are replaced by ``effect`` alone.
    fit : BaselineFit
        Fit whose parameters are projected out.
    effect : Effect
        With a variance parameter (``scatters`` not empty).
    values : ndarray, shape (p,)
        Non-linear parameters of ``predictor``.

    Raises
    ------
    FitError
        A channel has more than :data:`MOST` modes.
    """
    alone = predictor.with_effects((effect,), values)
    point = alone.start
    blocks = []
    for channel, start in zip(fit.channels, fit.starts, strict=False):
        if channel.word in effect.scatters:
            own = alone.modes(channel, point)
            if own.shape[1] > MOST:
                raise FitError(
                    f"{effect.name} has {own.shape[1]} independent changes in {channel.word}; at most "
                    f"{MOST} are weighed"
                )
            blocks.append((int(start), channel.whiten(own)))
    if not blocks:
        return Scatter(np.zeros(0), np.zeros((0, 0)), [])
    gram = block_diag(*(own.T @ own for _, own in blocks))
    spanned = np.concatenate(
        [fit.basis[start : start + len(own)].T @ own for start, own in blocks], axis=1
    )
    sizes, shapes = np.linalg.eigh(gram - spanned.T @ spanned)
    return Scatter(np.maximum(sizes, 0.0), shapes, blocks)
