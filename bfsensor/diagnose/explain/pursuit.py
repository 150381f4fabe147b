"""Nonparametric terms of a family that explain a fit's residuals, chosen by matching pursuit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.detect.locate import ALARM
from bfsensor.diagnose.detect.model_error import ACCURACY
from bfsensor.diagnose.explain.terms import Family, Term
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.errors import ConvergenceError
from bfsensor.inference.pursuit import Pursuit
from bfsensor.typing import FloatArray

MOST_ALIKE = 3
"""Largest number of terms that are listed as explaining as much.  Chosen: length of the report only."""

VISIBLE = 0.05
"""Least part of the first template's square in the select fold for that fold to decide how many terms
are kept. Chosen, to be derived: below it noise would decide; twice as large, more choices go
unchecked."""

LARGE = 50_000_000
"""Number of values (of all terms) above which a dictionary holds them in single precision, half of the
memory.  Chosen: 400 MB, which sensors of 1024 x 1024 pixels stay below; single precision changes a
deviate by 1e-5 of itself at most."""

CHUNK = 1024
"""Number of terms that are whitened at a time in a large dictionary.  Chosen: of 20,000 values they take
160 MB in double precision; with 2048, twice as much and no less time."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Terms of a family that explain a fit's residuals.

    Attributes
    ----------
    family : Family
        Family that the terms were chosen from.
    terms : tuple of Term
        Chosen terms, the most significant first.
    z : tuple of float
        Deviate [standard deviations] of each term, the terms before it projected out.
    score : float
        Decrease of the chi-square less what chance gives the best of as many terms.
    select : float
        Decrease of the select fold's chi-square, with coefficients from the other folds; nan
        where that fold does not constrain the terms.
    template : ndarray
        Whitened change by all terms together, the fit's parameters projected out.
    alike : tuple of (Term, float)
        Terms that explain as much in the first one's place, with their coefficients there.
    """

    family: Family
    terms: tuple[Term, ...]
    z: tuple[float, ...]
    score: float
    select: float
    template: FloatArray
    alike: tuple[tuple[Term, float], ...] = ()


class Dictionary(Pursuit):
    """Whitened columns of a family's terms, and their projections onto the fit's parameters.

    Parameters
    ----------
    family : Family
        Terms to choose from.
    fit : BaselineFit
        Fit whose residuals are to be explained.
    """

    def __init__(self, family: Family, fit: BaselineFit) -> None:
        self.family, self.fit = family, fit
        there = [
            (c, int(start)) for c, start in zip(fit.channels, fit.starts, strict=False)
            if c.word in family.words
        ]  # fmt: skip
        rows = [start + np.arange(len(c)) for c, start in there]
        self.rows = np.concatenate([np.zeros(0, int), *rows])
        shape = len(self.rows), len(family.terms)
        large = shape[0] * shape[1] > LARGE
        x = np.empty(shape, np.float32 if large else np.float64)
        u = np.zeros((fit.basis.shape[1], shape[1]))
        squares = np.zeros(shape[1])
        basis, step = fit.basis[self.rows], CHUNK if large else max(shape[1], 1)
        for first in range(0, shape[1], step):
            own = slice(first, first + step)
            white = self._whitened(family.terms[own], [c for c, _ in there])
            x[:, own], u[:, own] = white, basis.T @ white
            squares[own] = (white**2).sum(0)
        if not large:
            used = np.nonzero(x.any(1))[0]
            x, self.rows = x[used], self.rows[used]
        super().__init__(
            x, u, squares=squares, probability=ALARM, accuracy=ACCURACY,
            simple=np.array([t.simple for t in family.terms], bool), tried=family.tried,
        )  # fmt: skip

    @staticmethod
    def _whitened(terms: Sequence[Term], channels: Sequence[Channel]) -> FloatArray:
        """Whitened columns of terms in channels, one below the other; 0 where a term is not usable."""
        usable = np.ones(len(terms), bool)
        blocks: list[FloatArray] = [np.zeros((0, len(terms)))]
        for channel in channels:
            columns = np.zeros((len(channel), len(terms)))
            for n, term in enumerate(terms):
                try:
                    found = (term.rough or term.column)(channel)
                except ConvergenceError:
                    # A unit coefficient that destroys the spots' shapes makes no usable column.
                    found, usable[n] = None, False
                if found is not None:
                    columns[:, n] = found
            blocks.append(channel.whiten(columns))
        return np.concatenate(blocks) * usable

    def products(self, left: FloatArray) -> FloatArray:
        """Scalar products of all columns with whitened residuals."""
        return np.asarray(self.x.T @ left[self.rows].astype(self.x.dtype), float)

    def template(self, n: int) -> FloatArray:
        """Column with the fit's parameters projected out, rows of the priors included."""
        out = -self.fit.basis @ self.u[:, n]
        out[self.rows] += self.x[:, n]
        return np.asarray(out)

    def choose(self, *, positive: bool = False) -> Choice | None:
        """Choose the terms beyond noise, as many as lower the select fold's chi-square most.

        Parameters
        ----------
        positive : bool
            Whether coefficients must be positive.

        Returns
        -------
        Choice or None
            None where no term is beyond noise, or the select fold's chi-square would rise.
        """
        products = self.products(self.fit.left)
        path = self.pursue(products, positive=positive)
        if not path:
            return None
        templates = np.array([self.template(n) for n, _ in path]).T
        own = self._select
        count, gain = len(path), np.nan
        square = (templates**2).sum(0)
        seen = (templates[own] ** 2).sum(0)
        if seen[0] > VISIBLE * square[0]:
            gains = [self._gain(templates[:, : k + 1], own) for k in range(len(path))]
            count = int(np.argmax(gains)) + 1
            gain = gains[count - 1]
            if gain < 0:
                return None
        alike = self.alike(path[0][0], products, positive=positive)
        score = sum(z * z - self.critical for _, z in path[:count])
        coefficients = np.linalg.lstsq(templates[:, :count], self.fit.left, rcond=None)[0]
        return Choice(
            self.family, tuple(self.family.terms[n] for n, _ in path[:count]),
            tuple(z for _, z in path[:count]), float(score), float(gain),
            templates[:, :count] @ coefficients,
            tuple((self.family.terms[m], c) for m, c in alike[:MOST_ALIKE]),
        )  # fmt: skip

    @property
    def _select(self) -> NDArray[np.bool_]:
        out = np.zeros(len(self.fit.left), bool)
        for channel, start in zip(self.fit.channels, self.fit.starts, strict=False):
            out[start : start + len(channel)] = channel.fold == "select"
        return out

    def _gain(self, templates: FloatArray, own: NDArray[np.bool_]) -> float:
        """Decrease of the select fold's chi-square, with coefficients from the other folds."""
        left = self.fit.left
        c = np.linalg.lstsq(templates[~own], left[~own], rcond=None)[0]
        after = left[own] - templates[own] @ c
        return float(left[own] @ left[own] - after @ after)
