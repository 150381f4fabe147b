"""Search for the few terms of a free-form model that explain what a fit leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from bfsensor.diagnose.detect.locate import ALARM
from bfsensor.diagnose.explain.terms import Family, Term
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

MOST_TERMS = 6
"""Terms of one family."""

ACCURACY = 0.02
"""Deviate, relative to the first term's, below which a term counts as what its column, which is
good to about a per cent, has left over."""

SPANNED = 1e-3
"""Part of a column's square that the fit's parameters must leave for it to be a term."""

SAME = 6.0
"""Increase of the chi-square up to which another term in the first one's place explains as much:
three in the logarithm of the likelihood."""

MOST_ALIKE = 3
"""Such terms that are told."""

VISIBLE = 0.05
"""Part of a template's square in the select fold from which on that fold judges."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Terms of a family that explain a remainder.

    Attributes
    ----------
    family : Family
    terms : tuple of Term
        Most important first.
    z : tuple of float
        Deviate of each, those before it taken off.
    score : float
        Decrease of the chi-square less what chance gives the best of as many terms.
    select : float
        Decrease of the chi-square of the select fold, coefficients from the others; nan where it
        does not see them.
    template : ndarray
        What they change together, whitened, the fit's parameters projected out.
    alike : tuple of (Term, float)
        Others that explain as much in the first one's place, with their coefficients there.
    """

    family: Family
    terms: tuple[Term, ...]
    z: tuple[float, ...]
    score: float
    select: float
    template: FloatArray
    alike: tuple[tuple[Term, float], ...] = ()


class Dictionary:
    """Columns of a family, whitened, and what the fit's parameters take of them.

    Parameters
    ----------
    family : Family
    fit : BaselineFit
        Whose remainder is to be explained.
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
                    # Where so much changes that spots have no shape it is no explanation.
                    found, usable[n] = None, False
                if found is not None:
                    columns[:, n] = found
            white = channel.whiten(columns)
            used = np.nonzero(white.any(1))[0]
            blocks.append(white[used])
            rows.append(int(start) + used)
        empty = np.zeros((0, len(family.terms)))
        self.x = np.concatenate([empty, *blocks]) * usable
        self.rows = np.concatenate([np.zeros(0, int), *rows])
        self.u = fit.basis[self.rows].T @ self.x
        raw = (self.x**2).sum(0)
        free = raw - (self.u**2).sum(0)
        self.free = np.where(free > SPANNED * raw, free, 0.0)

    @property
    def critical(self) -> float:
        """Square of the deviate that noise gives the best of all terms once in a hundred times."""
        count = max(int((self.free > 0).sum()), self.family.tried, 1)
        return float(chi2.isf(ALARM / count, 1))

    def products(self, left: FloatArray) -> FloatArray:
        """Of all columns with a remainder."""
        return np.asarray(self.x.T @ left[self.rows])

    def template(self, n: int) -> FloatArray:
        """Column, the fit's parameters projected out, priors' rows included."""
        out = -self.fit.basis @ self.u[:, n]
        out[self.rows] += self.x[:, n]
        return np.asarray(out)

    def pursue(self, *, positive: bool = False) -> list[tuple[int, float]]:
        """Take the farthest term, project it out of all, and so on: places and deviates."""
        b, free = self.products(self.fit.left), self.free.copy()
        first = free.copy()
        taken: list[FloatArray] = []
        path: list[tuple[int, float]] = []
        while len(path) < MOST_TERMS:
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
        """Place of the largest deviate; of a simple term's, if that explains as much."""
        if not len(size):
            return 0
        best = int(np.argmax(size))
        simple = np.where([t.simple for t in self.family.terms], size, 0.0)
        n = int(np.argmax(simple))
        return n if size[n] ** 2 > size[best] ** 2 - self._same(size[best]) else best

    def _same(self, z: float) -> float:
        """Difference of chi-squares that tells no two terms apart: by chance, or by inaccuracy."""
        return SAME + (ACCURACY * z) ** 2

    def alike(self, n: int, *, positive: bool = False) -> tuple[tuple[Term, float], ...]:
        """Other terms that explain as much alone as a term does, with their coefficients."""
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
        """Choose terms: as many of those that noise does not reach as the select fold agrees to."""
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
        """Decrease of the chi-square with all terms together, and how many are free."""
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
        """Decrease of the select fold's chi-square, coefficients from the others."""
        left = self.fit.left
        c = np.linalg.lstsq(templates[~own], left[~own], rcond=None)[0]
        after = left[own] - templates[own] @ c
        return float(left[own] @ left[own] - after @ after)
