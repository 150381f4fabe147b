"""Matching pursuit: choose the few nonparametric terms of a family that explain a fit's residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.detect.model_error import ACCURACY, charge
from bfsensor.diagnose.explain.terms import Family, Term
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

MOST_TERMS = 6
"""Largest number of terms of one family. Chosen, to be derived: twice as many fit finer detail, which
the select fold mostly refuses."""

SPANNED = 1e-3
"""Least part of a column's square that the fit's parameters do not span; columns below are no terms.
Chosen: such a column differs from a combination of parameters by 3 % of its norm; twice as large
removes the terms that are hardest to separate from gains and light."""

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


class Dictionary:
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
        self.x = np.empty(shape, np.float32 if large else np.float64)
        self.u = np.zeros((fit.basis.shape[1], shape[1]))
        raw = np.zeros(shape[1])
        basis, step = fit.basis[self.rows], CHUNK if large else max(shape[1], 1)
        for first in range(0, shape[1], step):
            own = slice(first, first + step)
            white = self._whitened(family.terms[own], [c for c, _ in there])
            self.x[:, own], self.u[:, own] = white, basis.T @ white
            raw[own] = (white**2).sum(0)
        if not large:
            used = np.nonzero(self.x.any(1))[0]
            self.x, self.rows = self.x[used], self.rows[used]
        free = raw - (self.u**2).sum(0)
        self.free = np.where(free > SPANNED * raw, free, 0.0)

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

    @property
    def critical(self) -> float:
        """Square of the deviate that noise gives the best of all terms with probability ALARM."""
        count = max(int((self.free > 0).sum()), self.family.tried, 1)
        return charge(1, count)

    def products(self, left: FloatArray) -> FloatArray:
        """Scalar products of all columns with whitened residuals."""
        return np.asarray(self.x.T @ left[self.rows].astype(self.x.dtype), float)

    def template(self, n: int) -> FloatArray:
        """Column with the fit's parameters projected out, rows of the priors included."""
        out = -self.fit.basis @ self.u[:, n]
        out[self.rows] += self.x[:, n]
        return np.asarray(out)

    def pursue(self, *, positive: bool = False) -> list[tuple[int, float]]:
        """Take the term of largest deviate, project it out of the others, and repeat."""
        b, free = self.products(self.fit.left), self.free.copy()
        first = free.copy()
        taken: list[FloatArray] = []
        path: list[tuple[int, float]] = []
        while len(path) < MOST_TERMS:
            # A term of which earlier ones span more than 98 % (chosen) would have a coefficient
            # dominated by their errors.
            open_ = (free > 0.02 * first) & (free > 0)
            z = np.where(open_, b / np.sqrt(np.where(open_, free, 1.0)), 0.0)
            size = z if positive else np.abs(z)
            n = self._farthest(size)
            if not len(size) or size[n] ** 2 < self.critical:
                break
            if path and size[n] < ACCURACY * abs(path[0][1]):
                break
            path.append((n, float(z[n])))
            new = self.x.T @ self.x[:, n] - self.u.T @ self.u[:, n]
            for old in taken:
                new = new - old * old[n]
            new = new / np.sqrt(free[n])
            taken.append(new)
            b = b - new * z[n]
            free = free - new**2
        return path

    def _farthest(self, size: FloatArray) -> int:
        """Index of the largest deviate, or of the best simple term if that explains as much."""
        if not len(size):
            return 0
        best = int(np.argmax(size))
        simple = np.where([t.simple for t in self.family.terms], size, 0.0)
        n = int(np.argmax(simple))
        return n if size[n] ** 2 > size[best] ** 2 - self._same(size[best]) else best

    def _same(self, z: float) -> float:
        """Difference of chi-squares that does not separate two terms, by chance or errors of columns."""
        return charge(1, 1) + (ACCURACY * z) ** 2

    def alike(self, n: int, *, positive: bool = False) -> tuple[tuple[Term, float], ...]:
        """Other terms that alone explain as much as a given one, with their coefficients."""
        b = self.products(self.fit.left)
        z = np.where(
            self.free > 0, b / np.sqrt(np.where(self.free > 0, self.free, 1.0)), 0.0
        )
        size = np.where((z > 0) | (not positive), np.abs(z), 0.0)
        close = size**2 > size[n] ** 2 - self._same(size[n])
        order = [int(m) for m in np.argsort(-size) if close[m] and m != n]
        return tuple(
            (self.family.terms[m], float(b[m] / self.free[m])) for m in order[:MOST_ALIKE]
        )

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
        path = self.pursue(positive=positive)
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
        score = sum(z * z - self.critical for _, z in path[:count])
        coefficients = np.linalg.lstsq(templates[:, :count], self.fit.left, rcond=None)[0]
        return Choice(
            self.family, tuple(self.family.terms[n] for n, _ in path[:count]),
            tuple(z for _, z in path[:count]), float(score), float(gain),
            templates[:, :count] @ coefficients, self.alike(path[0][0], positive=positive),
        )  # fmt: skip

    def gains(self) -> tuple[float, int]:
        """Decrease of the chi-square with all terms together, and the number of independent ones."""
        use = np.nonzero(self.free > 0)[0]
        if not len(use):
            return 0.0, 0
        templates = np.array([self.template(int(n)) for n in use]).T
        scaled = templates / np.sqrt((templates**2).sum(0))
        q, s, _ = np.linalg.svd(scaled, full_matrices=False)
        q = q[:, s > 1e-4 * s[0]]
        return float(((q.T @ self.fit.left) ** 2).sum()), q.shape[1]

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
