"""Nonparametric terms of a family that explain a fit's residuals, chosen by matching pursuit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
        blocks: list[FloatArray] = []
        usable = np.ones(len(family.terms), bool)
        rows: list[NDArray[np.int64]] = []
        for channel, start in zip(fit.channels, fit.starts, strict=False):
            if channel.word not in family.words:
                continue
            columns = np.zeros((len(channel), len(family.terms)))
            for n, term in enumerate(family.terms):
                try:
                    found = (term.rough or term.column)(channel)
                except ConvergenceError:
                    # A unit coefficient that destroys the spots' shapes makes no usable column.
                    found, usable[n] = None, False
                if found is not None:
                    columns[:, n] = found
            white = channel.whiten(columns)
            used = np.nonzero(white.any(1))[0]
            blocks.append(white[used])
            rows.append(int(start) + used)
        empty = np.zeros((0, len(family.terms)))
        self.rows = np.concatenate([np.zeros(0, int), *rows])
        x = np.concatenate([empty, *blocks]) * usable
        super().__init__(
            x, fit.basis[self.rows].T @ x, probability=ALARM, accuracy=ACCURACY,
            simple=np.array([t.simple for t in family.terms], bool), tried=family.tried,
        )  # fmt: skip

    def products(self, left: FloatArray) -> FloatArray:
        """Scalar products of all columns with whitened residuals."""
        return np.asarray(self.x.T @ left[self.rows])

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
