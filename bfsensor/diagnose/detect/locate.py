"""What is left, how unlikely that is, and where: chi-square and scans with one false-alarm rate."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.sparse import csr_array

from bfsensor.diagnose.detect.scan_templates import Template
from bfsensor.diagnose.detect.scans import DEVICE, make_templates
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.typing import FloatArray

DRAWS = 500
"""Draws of the noise that calibrate the family of all statistics."""

ALARM = 0.01
"""Family-wise probability below which a mismatch is called detected."""

FAMILY = "effect of the library"
"""Of findings by the library's own shapes: see :mod:`bfsensor.diagnose.detect.matched_filters`."""

HOPELESS = 2.3
"""Deviate below which a lone statistic is not below :data:`ALARM`: one-sided p = 0.0107."""

PARTS = 12
"""Most templates that a mismatch is taken apart into."""

FAINT = 0.2
"""Deviate, relative to the farthest, below which a part counts as what a template's shape,
chosen of a few, has left over."""

BLOCK = 4_000_000
"""Numbers of the templates that are put together at a time: 100 MB while they are."""

SMALLEST = 1e-30
"""Least probability that is told apart from zero: no tail is known farther out."""


@dataclass(frozen=True)
class Finding:
    """One statistic that stands out.

    Attributes
    ----------
    family, word : str
        Scan, or 'chi-square'; channel.
    z : float
        Standard deviations of the template; of a chi-square, as of a Gaussian of its p-value.
    p_value : float
        Family-wise: that noise gives any statistic as far out.
    where : dict
        What the template stands for.
    """

    family: str
    word: str
    z: float
    p_value: float
    where: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Known:
    """A shape that an effect of the library makes.

    Attributes
    ----------
    effect, word : str
        Its name, and the channel that it shows in most.
    weights : ndarray of float32, shape (n + priors,)
        Whitened, priors' rows last, what the fit's parameters span taken off; of unit length.
    signed : bool
        Whether its opposite may be as well.
    """

    effect: str
    word: str
    weights: NDArray[np.float32]
    signed: bool


@dataclass(frozen=True, eq=False)
class Mismatch:
    """All that a baseline leaves.

    Attributes
    ----------
    p_value : float
        Family-wise, of the farthest statistic.
    p_chi2, p_scans : float
        The same of the chi-squares alone and of the scans alone.
    findings : tuple of Finding
        Statistics below :data:`ALARM`, step-down, farthest first.
    chi2 : dict of str to (float, float)
        Chi-square and degrees of freedom by channel.
    parts : tuple of Finding
        The few templates that together make up what the scans find: each the farthest of what
        those before it leave.  The findings also hold their shadows.
    """

    p_value: float
    p_chi2: float
    p_scans: float
    findings: tuple[Finding, ...]
    chi2: dict[str, tuple[float, float]]
    parts: tuple[Finding, ...] = ()

    @property
    def detected(self) -> bool:
        """Whether anything stands out."""
        return self.p_value < ALARM


class Scanner:
    """Statistics of residuals: chi-squares by channel and normalised templates.

    Parameters
    ----------
    fit : BaselineFit
        Whose residuals; its parameters are projected out of every template.
    """

    def __init__(self, fit: BaselineFit) -> None:
        self.fit = fit
        self.templates: list[Template] = []
        self._blocks: list[csr_array] = []
        inside, norms = [], []
        for block, some in _stacked(make_templates(fit), len(fit.residuals)):
            within = block @ fit.basis[: len(fit.residuals)]
            raw = np.asarray((block * block).sum(1)).ravel()
            left = raw - (within**2).sum(1)
            # What the parameters take up to a ten-thousandth is no template; those of the device
            # are held by their card alone.
            device = np.array([t.word == DEVICE for t in some])
            keep = left > np.where(device, 1e-9, 1e-4) * raw
            kept = block if keep.all() else block[keep]
            self._blocks.append(kept)
            inside.append(within[keep])
            norms.append(np.sqrt(left[keep]))
            self.templates += _viewed(
                [t for t, k in zip(some, keep, strict=True) if k], kept
            )
        self._norm = np.concatenate(norms)
        self._inside = inside
        self.words = list(dict.fromkeys(c.word for c in fit.channels))
        self._masks = [fit.of(w) for w in self.words]
        counts = fit.chi2()
        self._dof = np.array([max(counts[w][1], 1e-9) for w in self.words])

    def templates_z(self, residuals: FloatArray) -> FloatArray:
        """Of residuals (..., n): the templates' amplitudes over their errors."""
        return np.asarray(self._product(residuals.T).T / self._norm)

    def _product(self, residuals: FloatArray) -> FloatArray:
        """Templates times residuals, shape (n, ...)."""
        return np.concatenate([block @ residuals for block in self._blocks])

    def correlations(self, n: int) -> FloatArray:
        """Of the amplitude of template ``n`` with those of all."""
        template = self.templates[n]
        shape = np.zeros(len(self.fit.residuals))
        shape[template.rows] = template.weights
        own = shape @ self.fit.basis[: len(shape)]
        product = self._product(shape) - np.concatenate([i @ own for i in self._inside])
        return np.asarray(product / (self._norm * self._norm[n]))

    def chi2_z(self, residuals: FloatArray) -> FloatArray:
        """Of residuals (..., n): Gaussian deviates of each word's chi-square (Wilson & Hilferty)."""
        squares = np.stack([(residuals[..., m] ** 2).sum(-1) for m in self._masks], axis=-1)
        d = self._dof
        return np.asarray((np.cbrt(squares / d) - (1 - 2 / (9 * d))) / np.sqrt(2 / (9 * d)))


def _stacked(
    templates: Iterable[Template], size: int
) -> Iterator[tuple[csr_array, list[Template]]]:
    """Templates as rows of sparse matrices of about :data:`BLOCK` numbers each.

    Maps of large sensors have tens of thousands of templates of thousands of rows: what makes
    a template is let go before the next are made.
    """
    some: list[Template] = []
    held = 0
    for template in templates:
        some.append(template)
        held += len(template.rows)
        if held > BLOCK:
            yield _as_matrix(some, size), some
            some, held = [], 0
    if some:
        yield _as_matrix(some, size), some


def _as_matrix(some: list[Template], size: int) -> csr_array:
    starts = np.concatenate([[0], np.cumsum([len(t.rows) for t in some])])
    columns = np.concatenate([t.rows for t in some]).astype(np.int32)
    weights = np.concatenate([t.weights for t in some])
    return csr_array((weights, columns, starts.astype(np.int32)), shape=(len(some), size))


def _viewed(some: list[Template], matrix: csr_array) -> list[Template]:
    """Templates whose numbers are the matrix's own."""
    parts = [slice(a, b) for a, b in pairwise(matrix.indptr)]
    return [
        replace(t, rows=matrix.indices[p], weights=matrix.data[p])
        for t, p in zip(some, parts, strict=True)
    ]


class Locator:
    """Judges residuals against noise that is drawn once.

    The noise is drawn through the fit's own linear model.  Statistics are the chi-squares
    (one-sided), the templates (two-sided) and, with :meth:`with_library`, the shapes of known
    effects.  So that thousands of templates of one channel do not hide another's few, deviates
    are put on the scale of the largest that noise gives in the same family, the chi-squares, one
    channel's templates or one effect's shapes: the logarithm of its tail's probability.  The
    largest of all then gives family-wise p-values, step-down (Westfall & Young 1993): what has
    been found no longer hides what is next.  Beyond the draws an exponential tail of the largest
    deviates is taken.

    Parameters
    ----------
    fit : BaselineFit
        Residuals and what was fitted.
    seed : int
        Of the draws.
    draws : int
        How many.
    """

    def __init__(self, fit: BaselineFit, *, seed: int = 1, draws: int = DRAWS) -> None:
        self.scanner = Scanner(fit)
        self.library: tuple[Known, ...] = ()
        self._chi = len(self.scanner.words)
        self._seed, self._count = seed, draws
        rng = np.random.default_rng(seed)
        # One row a statistic, chi-squares first.
        self._drawn = np.empty((self._chi + len(self.scanner.templates), draws), np.float32)
        for start in range(0, draws, 50):
            noise = fit.draw(rng, min(50, draws - start))
            columns = slice(start, start + len(noise))
            self._drawn[: self._chi, columns] = self.scanner.chi2_z(noise).T
            self._drawn[self._chi :, columns] = np.abs(self.scanner.templates_z(noise)).T
        words = np.array([t.word for t in self.scanner.templates])
        families = [np.arange(self._chi)] + [
            self._chi + np.nonzero(words == w)[0] for w in dict.fromkeys(words)
        ]
        self._zero, self._scale = _ranked(self._drawn, families)
        parts = self._drawn[: self._chi], self._drawn[self._chi :]
        self._maxima = [p.max(0).astype(float) for p in parts]

    def with_library(self, library: Sequence[Known]) -> Locator:
        """Copy that judges shapes of known effects as well, by the same draws."""
        out = copy.copy(self)
        if not library:
            return out
        out.library = tuple(library)
        fit, shapes = self.scanner.fit, np.array([k.weights for k in library])
        rng = np.random.default_rng(self._seed)
        drawn = np.empty((len(library), self._count), np.float32)
        for start in range(0, self._count, 50):
            noise = fit.draw_all(rng, min(50, self._count - start)).astype(np.float32)
            drawn[:, start : start + len(noise)] = shapes @ noise.T
        signed = np.array([k.signed for k in library])
        drawn[signed] = np.abs(drawn[signed])
        names = np.array([k.effect for k in library])
        zero, scale = _ranked(
            drawn, [np.nonzero(names == n)[0] for n in dict.fromkeys(names)]
        )
        out._drawn = np.concatenate([self._drawn, drawn])
        out._zero = np.concatenate([self._zero, zero])
        out._scale = np.concatenate([self._scale, scale])
        out._maxima = [*self._maxima, drawn.max(0).astype(float)]
        return out

    def alarms(self) -> dict[str, float]:
        """Deviate from which a statistic alone is an alarm, by family.

        Families are the chi-squares, the templates of each channel, by its word, and the shapes
        of each effect.
        """
        maxima = np.max(self._maxima, axis=0)
        rank = float(brentq(
            lambda r: tail_probability(r, maxima) - ALARM, maxima.min(), 9 * maxima.max(), xtol=1e-3
        ))  # fmt: skip
        names = ["chi-square"] * self._chi
        names += [t.word for t in self.scanner.templates] + [k.effect for k in self.library]
        first = {name: n for n, name in reversed(list(enumerate(names)))}
        return {n: float(self._zero[k] + rank * self._scale[k]) for n, k in first.items()}

    def locate(self, residuals: FloatArray | None = None) -> Mismatch:
        """Find what of residuals noise does not explain.

        Parameters
        ----------
        residuals : ndarray, shape (n + priors,), optional
            Whitened, what was fitted taken off, by default the fit's; priors' rows are needed
            for shapes of effects only.
        """
        fit = self.scanner.fit
        given = residuals
        residuals = fit.residuals if given is None else given[: len(fit.residuals)]
        signed = self.scanner.templates_z(residuals)
        chi2, scans = self.scanner.chi2_z(residuals), np.abs(signed)
        maxima = np.max(self._maxima, axis=0)
        left = fit.left if given is None else given
        known = np.array([float(k.weights @ left) for k in self.library])
        shown = [
            abs(z) if k.signed else z for k, z in zip(self.library, known, strict=True)
        ]
        observed = np.concatenate([chi2, scans, shown])
        ranks = (observed - self._zero) / self._scale
        parts = np.split(ranks, [self._chi, self._chi + len(scans)])
        best = [float(p.max(initial=-np.inf)) for p in parts]
        squares = [
            float(residuals[fit.of(w)] @ residuals[fit.of(w)]) for w in self.scanner.words
        ]
        dofs = [d for _, d in fit.chi2().values()]
        return Mismatch(
            p_value=tail_probability(max(best), maxima),
            p_chi2=tail_probability(best[0], self._maxima[0]),
            p_scans=tail_probability(best[1], self._maxima[1]),
            findings=tuple(self._step_down(observed, ranks, np.append(signed, known))),
            chi2=dict(
                zip(self.scanner.words, zip(squares, dofs, strict=True), strict=True)
            ),
            parts=tuple(self._pursue(signed)),
        )

    def _pursue(self, signed: FloatArray) -> list[Finding]:
        """Take the farthest template, take off what it explains, and so on (matching pursuit)."""
        z = signed.copy()
        scans = slice(self._chi, self._chi + len(z))
        critical = float(np.quantile(self._maxima[1], 1 - 2 * ALARM))
        # What is left of each template's variance, and directions taken so far.
        free = np.ones(len(z))
        taken: list[FloatArray] = []
        parts: list[Finding] = []
        while len(parts) < PARTS:
            open_ = free > 0.02
            normed = np.where(open_, z / np.sqrt(np.maximum(free, 0.02)), 0.0)
            ranks = (np.abs(normed) - self._zero[scans]) / self._scale[scans]
            n = int(np.argmax(np.where(ranks > critical, np.abs(normed), 0.0)))
            p = tail_probability(float(ranks[n]), self._maxima[1])
            if p >= ALARM or (parts and abs(normed[n]) < FAINT * abs(parts[0].z)):
                break
            template = self.scanner.templates[n]
            parts.append(
                Finding(
                    template.family,
                    template.word,
                    float(normed[n]),
                    p,
                    dict(template.where),
                )
            )
            # Gram-Schmidt among templates: covariance of each with what is new in this one.
            new = self.scanner.correlations(n)
            for old in taken:
                new = new - old * old[n]
            new = new / np.sqrt(free[n])
            taken.append(new)
            z = z - new * normed[n]
            free = free - new**2
        return parts

    def _step_down(
        self,
        observed: FloatArray,
        ranks: FloatArray,
        signed: FloatArray,
    ) -> list[Finding]:
        """Farthest first, each held against those that are left."""
        # Below HOPELESS a single statistic would not be found, whatever the family's size.
        ranks = np.where(observed > HOPELESS, ranks, -np.inf)
        count = int((observed > HOPELESS).sum())
        order = np.argsort(-ranks, kind="stable")
        rest = self._drawn[np.sort(order[count:])].max(0, initial=-np.inf)
        # Of what is left after each: maxima from the least to the farthest.
        left = np.maximum.accumulate(
            np.concatenate([rest[None], self._drawn[order[:count]][::-1]])
        )[:0:-1]
        findings: list[Finding] = []
        largest = 0.0
        for n, maxima in zip(order[:count], left, strict=True):
            p = max(largest, tail_probability(float(ranks[n]), maxima.astype(float)))
            if p >= ALARM:
                break
            largest = p
            if n < self._chi:
                word = self.scanner.words[n]
                findings.append(Finding("chi-square", word, float(observed[n]), p))
                continue
            z = float(signed[n - self._chi])
            if n < self._chi + len(self.scanner.templates):
                template = self.scanner.templates[n - self._chi]
                findings.append(
                    Finding(template.family, template.word, z, p, dict(template.where))
                )
            else:
                known = self.library[n - self._chi - len(self.scanner.templates)]
                findings.append(Finding(FAMILY, known.word, z, p, {"effect": known.effect}))
        return findings


def _ranked(
    drawn: NDArray[np.float32], families: Iterable[NDArray[np.int64]]
) -> tuple[FloatArray, FloatArray]:
    """Put drawn deviates, in place, on the scale of their family's largest; zero and scale."""
    zero, scale = np.zeros(len(drawn)), np.ones(len(drawn))
    for rows in families:
        largest = drawn[rows].max(0)
        zero[rows] = threshold = np.quantile(largest, 0.8)
        scale[rows] = (largest[largest > threshold] - threshold).mean()
    drawn -= zero[:, None].astype(np.float32)
    drawn /= scale[:, None].astype(np.float32)
    return zero, scale


def locate_mismatch(fit: BaselineFit, *, seed: int = 1, draws: int = DRAWS) -> Mismatch:
    """Find what of a fit's residuals noise does not explain: :class:`Locator`, once."""
    return Locator(fit, seed=seed, draws=draws).locate()


def tail_probability(value: float, maxima: FloatArray) -> float:
    """Probability that a maximum is as large, from drawn ones; beyond them by an exponential tail."""
    above = int((maxima >= value).sum())
    if above >= 10:
        return (above + 1) / (len(maxima) + 1)
    # Maxima of Gaussians have tails lighter than an exponential, which thus errs upwards.
    threshold = float(np.quantile(maxima, 0.8))
    excess = maxima[maxima > threshold] - threshold
    return max(0.2 * float(np.exp(-(value - threshold) / excess.mean())), SMALLEST)
