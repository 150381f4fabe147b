"""Detection and location of a mismatch: chi-squares and scans with one family-wise error rate."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.sparse import csr_array

from bfsensor.diagnose.detect.scans import DEVICE, make_fitted_templates, make_templates
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.kinds.scan_templates import Template
from bfsensor.files import Cache
from bfsensor.typing import FloatArray

DRAWS = 500
"""Number of draws of noise that calibrate the largest of all statistics.  Chosen: 100 of them
lie in the tail beyond the 80 % quantile, whose scale is then good to 10 %; with 1000, to 7 %."""

ALARM = 0.01
"""Family-wise probability, under noise alone, below which a mismatch counts as detected.  Chosen as
the false-alarm rate that reports state; with 0.02 two in a hundred campaigns without any effect
would alarm (checked by ``python -m validation.location.diagnose_nulls``)."""

FAMILY = "effect of the library"
"""Family of findings by matched filters: see :mod:`bfsensor.diagnose.detect.matched_filters`."""

HOPELESS = 2.3
"""Deviate [standard deviations] below which no statistic can be a finding.  Derived: a single
Gaussian statistic there has the one-sided probability 0.0107, above :data:`ALARM`, and in
a family of several it is larger."""

PARTS = 12
"""Largest number of templates that a mismatch is decomposed into.  Chosen: twice as many would list
more of a mismatch that has more than 12 significant parts; detection does not depend on it."""

FAINT = 0.2
"""Deviate of a part, relative to the largest, below which the decomposition ends.  Chosen, to be
derived: a template of a wrong shape, picked among a few, leaves such a part over; with 0.4, a
second effect of a third of the first one's deviate would not be listed as a part."""

BLOCK = 4_000_000
"""Numbers in the templates that are combined into one sparse matrix.  Chosen: value and index take
12 bytes, so that 48 MB are held twice, 100 MB, while it is made; twice as many take 200 MB."""

SMALLEST = 1e-30
"""Smallest probability that is returned.  Chosen: an exponential tail is not known farther out;
with 2e-30 reports of very clear findings would say that."""


@dataclass(frozen=True)
class Finding:
    """One statistic that noise does not explain.

    Attributes
    ----------
    family, word : str
        Name of the scan, or 'chi-square'; name of the channel.
    z : float
        Amplitude of the template over its standard error; for a chi-square, the equivalent
        Gaussian deviate.
    p_value : float
        Family-wise probability that noise gives any remaining statistic as extreme, 0 to 1.
    where : dict
        Place that the template stands for: 'lags', 'level', 'x', 'y', 'amp', ...
    """

    family: str
    word: str
    z: float
    p_value: float
    where: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Known:
    """A matched filter: the template of an effect of the library.

    Attributes
    ----------
    effect, word : str
        Name of the effect, and of the channel in which most of the template's square lies.
    weights : ndarray of float32, shape (n + priors,)
        Whitened template of unit length, the fit's parameters projected out.
    signed : bool
        Whether the effect's amplitude may be negative: the statistic is then two-sided.
    """

    effect: str
    word: str
    weights: NDArray[np.float32]
    signed: bool


@dataclass(frozen=True, eq=False)
class Mismatch:
    """Comparison of a fit's residuals with noise.

    Attributes
    ----------
    p_value : float
        Family-wise probability of the most extreme statistic, 0 to 1.
    p_chi2, p_scans : float
        The same of the chi-squares alone and of the scans alone.
    findings : tuple of Finding
        Statistics with a family-wise probability below :data:`ALARM` by the step-down procedure,
        most extreme first.
    chi2 : dict of str to (float, float)
        Chi-square and degrees of freedom by channel.
    parts : tuple of Finding
        Decomposition of the scans' findings by matching pursuit: each part is the most extreme
        template of the residuals that those before it leave.  The findings also hold templates
        that are merely correlated with these.
    """

    p_value: float
    p_chi2: float
    p_scans: float
    findings: tuple[Finding, ...]
    chi2: dict[str, tuple[float, float]]
    parts: tuple[Finding, ...] = ()

    @property
    def detected(self) -> bool:
        """Whether noise alone gives anything as extreme with a probability below ALARM."""
        return self.p_value < ALARM


_fixed = Cache(most=1)
"""Templates of the last channels that were scanned: all fits of a diagnosis scan the same ones."""


class Scanner:
    """Statistics of residuals: chi-squares by channel and normalised templates.

    Parameters
    ----------
    fit : BaselineFit
        The fit whose residuals are scanned; its parameters are projected out of every template.

    Attributes
    ----------
    templates : list of Template
        All templates whose norm the fit's parameters leave.
    words : list of str
        Names of the channels.
    """

    def __init__(self, fit: BaselineFit) -> None:
        self.fit = fit
        self.templates: list[Template] = []
        self._blocks: list[csr_array] = []
        inside, norms = [], []
        size = len(fit.residuals)
        fixed = _fixed.get(
            tuple(fit.channels), lambda: list(_stacked(make_templates(fit.channels), size))
        )
        for block, some in chain(fixed, _stacked(make_fitted_templates(fit), size)):
            within = block @ fit.basis[: len(fit.residuals)]
            raw = np.asarray((block * block).sum(1)).ravel()
            left = raw - (within**2).sum(1)
            # A template of which the fit's parameters absorb all but 1e-4 (squared) has no power
            # left.  Along device parameters the prior alone leaves a part, which is small where
            # data constrain them: there the limit is that of rounding.
            device = np.array([t.word == DEVICE for t in some])
            keep = left > np.where(device, 1e-9, 1e-4) * raw
            kept = block if keep.all() else block[keep]
            self._blocks.append(kept)
            inside.append(within[keep])
            norms.append(np.sqrt(left[keep]))
            self.templates += [t for t, k in zip(some, keep, strict=True) if k]
        self._norm = np.concatenate(norms)
        self._inside = inside
        self.words = list(dict.fromkeys(c.word for c in fit.channels))
        self._masks = [fit.of(w) for w in self.words]
        counts = fit.chi2()
        self._dof = np.array([max(counts[w][1], 1e-9) for w in self.words])

    def templates_z(self, residuals: FloatArray) -> FloatArray:
        """Amplitudes of all templates over their errors, from residuals of shape (..., n)."""
        return np.asarray(self._product(residuals.T).T / self._norm)

    def _product(self, residuals: FloatArray) -> FloatArray:
        """Templates times residuals, shape (n, ...)."""
        return np.concatenate([block @ residuals for block in self._blocks])

    def correlations(self, n: int) -> FloatArray:
        """Correlation of the amplitude of template ``n`` with those of all templates, under noise."""
        template = self.templates[n]
        shape = np.zeros(len(self.fit.residuals))
        shape[template.rows] = template.weights
        own = shape @ self.fit.basis[: len(shape)]
        product = self._product(shape) - np.concatenate([i @ own for i in self._inside])
        return np.asarray(product / (self._norm * self._norm[n]))

    def chi2_z(self, residuals: FloatArray) -> FloatArray:
        """Gaussian deviates of each channel's chi-square, from residuals of shape (..., n).

        Wilson & Hilferty 1931, PNAS 17, 684: the cube root of a chi-square over its d degrees
        of freedom is nearly Gaussian, with mean 1 - 2 / (9 d) and variance 2 / (9 d).
        """
        squares = np.stack([(residuals[..., m] ** 2).sum(-1) for m in self._masks], axis=-1)
        d = self._dof
        return np.asarray((np.cbrt(squares / d) - (1 - 2 / (9 * d))) / np.sqrt(2 / (9 * d)))


def _stacked(
    templates: Iterable[Template], size: int
) -> Iterator[tuple[csr_array, list[Template]]]:
    """Combine templates into sparse matrices, a template per row, of about BLOCK numbers each.

    Maps of large sensors have tens of thousands of templates of thousands of values: the memory
    of one block is released before the next is made.
    """
    some: list[Template] = []
    held = 0
    for template in templates:
        some.append(template)
        held += len(template.rows)
        if held > BLOCK:
            yield _viewed(some, size)
            some, held = [], 0
    if some:
        yield _viewed(some, size)


def _viewed(some: list[Template], size: int) -> tuple[csr_array, list[Template]]:
    """Matrix of templates, a template per row, and templates that share its memory."""
    starts = np.concatenate([[0], np.cumsum([len(t.rows) for t in some])])
    columns = np.concatenate([t.rows for t in some]).astype(np.int32)
    weights = np.concatenate([t.weights for t in some])
    matrix = csr_array((weights, columns, starts.astype(np.int32)), shape=(len(some), size))
    parts = [slice(a, b) for a, b in pairwise(matrix.indptr)]
    return matrix, [
        replace(t, rows=matrix.indices[p], weights=matrix.data[p])
        for t, p in zip(some, parts, strict=True)
    ]


class Locator:
    """Compares statistics of residuals with those of noise, which is drawn once.

    The noise is drawn through the fit's own linear model.  Statistics are the chi-squares
    (one-sided), the templates (two-sided) and, with :meth:`with_library`, matched filters of
    known effects.  In a channel with thousands of templates the largest of them is farther out by
    noise than in one with a few.  Each deviate z is therefore put on the scale of the largest in
    its family (the chi-squares, one channel's templates, or one effect's filters): (z - z_0) / s,
    minus the logarithm of the probability of a tail exp(-(z - z_0) / s) up to a constant, with z_0
    the 80 % quantile of the largest and s their mean excess over it.  The largest of all then
    gives family-wise p-values by the step-down procedure: each finding is compared with the
    largest of the statistics that remain.  Beyond the draws an exponential tail of the largest is
    assumed, which lies above a Gaussian's.

    Parameters
    ----------
    fit : BaselineFit
        Residuals, and the linear model through which noise is drawn.
    seed : int
        Seed of the draws.
    draws : int
        Number of draws, at least some tens.

    References
    ----------
    Westfall & Young 1993, Resampling-Based Multiple Testing (step-down maximum).
    """

    def __init__(self, fit: BaselineFit, *, seed: int = 1, draws: int = DRAWS) -> None:
        self.scanner = Scanner(fit)
        self.library: tuple[Known, ...] = ()
        self._chi = len(self.scanner.words)
        self._seed, self._count = seed, draws
        rng = np.random.default_rng(seed)
        # One row per statistic, chi-squares first.
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
        """Copy that includes matched filters of known effects, with the same draws of noise."""
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
        """Deviate above which a single statistic raises an alarm, by family.

        Returns
        -------
        alarms : dict of str to float
            Deviates [standard deviations] of 'chi-square', of the templates of each channel by
            its name, and of the filters of each effect by its name.
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
        """Find the statistics of residuals that noise does not explain.

        Parameters
        ----------
        residuals : ndarray, shape (n + priors,), optional
            Whitened residuals, the fit's parameters projected out; by default the fit's own.
            The rows of the priors are needed for matched filters only.

        Returns
        -------
        Mismatch
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
        """Decompose by orthogonal matching pursuit: the largest template, subtracted, and so on."""
        z = signed.copy()
        scans = slice(self._chi, self._chi + len(z))
        critical = float(np.quantile(self._maxima[1], 1 - 2 * ALARM))
        # Variance that each template has outside of those taken.  Chosen, to be derived: one with
        # less than 2 % left is the same shape; with 4 %, fewer neighbours of a part could be parts.
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
        """Findings by the step-down procedure, each compared with the largest of those remaining."""
        # Statistics below HOPELESS cannot be findings: they are left out of the sorting.
        ranks = np.where(observed > HOPELESS, ranks, -np.inf)
        count = int((observed > HOPELESS).sum())
        order = np.argsort(-ranks, kind="stable")
        rest = self._drawn[np.sort(order[count:])].max(0, initial=-np.inf)
        # For each statistic in turn, the draws' maxima over it and all that are less extreme.
        left = np.maximum.accumulate(
            np.concatenate([rest[None], self._drawn[order[:count]][::-1]])
        )[:0:-1]
        findings: list[Finding] = []
        largest = 0.0
        for n, maxima in zip(order[:count], left, strict=True):
            # Step-down p-values do not decrease (Westfall & Young).
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
    """Put drawn deviates, in place, on the scale of their family's largest; its zero and scale.

    Chosen, to be derived: the tail begins at the 80 % quantile, with 100 of 500 draws; a tail from
    the 60 % quantile has twice as many draws but is less exponential.
    """
    zero, scale = np.zeros(len(drawn)), np.ones(len(drawn))
    for rows in families:
        largest = drawn[rows].max(0)
        zero[rows] = threshold = np.quantile(largest, 0.8)
        excess = largest[largest > threshold] - threshold
        # Values of which the fit's parameters take all have no scatter.
        scale[rows] = excess.mean() if excess.size else 1.0
    drawn -= zero[:, None].astype(np.float32)
    drawn /= scale[:, None].astype(np.float32)
    return zero, scale


def locate_mismatch(fit: BaselineFit, *, seed: int = 1, draws: int = DRAWS) -> Mismatch:
    """Find the statistics of a fit's residuals that noise does not explain.

    Parameters
    ----------
    fit : BaselineFit
        The fit.
    seed : int
        Seed of the draws of noise.
    draws : int
        Number of draws.

    Returns
    -------
    Mismatch
    """
    return Locator(fit, seed=seed, draws=draws).locate()


def tail_probability(value: float, maxima: FloatArray) -> float:
    """Probability that a maximum reaches a value, from drawn maxima.

    From ten draws beyond the value on it is their fraction, ``(k + 1) / (n + 1)``; farther out
    an exponential tail is fitted to the excesses over the 80 % quantile.

    Parameters
    ----------
    value : float
        Observed maximum.
    maxima : ndarray, shape (n,)
        Maxima of n draws of noise; n at least some tens.

    Returns
    -------
    probability : float
        Between :data:`SMALLEST` and 1.

    Examples
    --------
    >>> maxima = np.random.default_rng(7).exponential(size=500)
    >>> 0.005 < tail_probability(5.0, maxima) < 0.010, tail_probability(0.0, maxima)
    (True, 1.0)
    """
    above = int((maxima >= value).sum())
    if above >= 10:
        return (above + 1) / (len(maxima) + 1)
    # Maxima of Gaussians have tails lighter than an exponential, which thus errs upwards.
    threshold = float(np.quantile(maxima, 0.8))
    excess = maxima[maxima > threshold] - threshold
    return max(0.2 * float(np.exp(-(value - threshold) / excess.mean())), SMALLEST)
