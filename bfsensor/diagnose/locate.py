"""What is left, how unlikely that is, and where: chi-square and scans with one false-alarm rate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from bfsensor.diagnose.mismatch import BaselineFit
from bfsensor.diagnose.scans import Template, make_templates

DRAWS = 500
"""Draws of the noise that calibrate the family of all statistics."""

ALARM = 0.01
"""Family-wise probability below which a mismatch is called detected."""

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
    """

    p_value: float
    p_chi2: float
    p_scans: float
    findings: tuple[Finding, ...]
    chi2: dict[str, tuple[float, float]]

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
        templates = make_templates(fit)
        n = len(fit.residuals)
        rows = np.concatenate([np.full(len(t.rows), k) for k, t in enumerate(templates)])
        columns = np.concatenate([t.rows for t in templates])
        weights = np.concatenate([t.weights for t in templates])
        matrix = csr_array((weights, (rows, columns)), shape=(len(templates), n))
        raw = np.sqrt(np.asarray((matrix * matrix).sum(1)).ravel())
        inside = matrix @ fit.basis[:n]
        left = raw**2 - (inside**2).sum(1)
        # What the parameters take up to a ten-thousandth is no template.
        keep = left > 1e-4 * raw**2
        self.templates: list[Template] = [
            t for t, k in zip(templates, keep, strict=True) if k
        ]
        self._matrix = matrix[keep]
        self._norm = np.sqrt(left[keep])
        self.words = list(dict.fromkeys(c.word for c in fit.channels))
        self._masks = [fit.of(w) for w in self.words]
        counts = fit.chi2()
        self._dof = np.array([max(counts[w][1], 1e-9) for w in self.words])

    def templates_z(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of residuals (..., n): the templates' amplitudes over their errors."""
        return np.asarray((self._matrix @ residuals.T).T / self._norm)

    def chi2_z(self, residuals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of residuals (..., n): Gaussian deviates of each word's chi-square (Wilson & Hilferty)."""
        squares = np.stack([(residuals[..., m] ** 2).sum(-1) for m in self._masks], axis=-1)
        d = self._dof
        return np.asarray((np.cbrt(squares / d) - (1 - 2 / (9 * d))) / np.sqrt(2 / (9 * d)))


def locate_mismatch(fit: BaselineFit, *, seed: int = 1, draws: int = DRAWS) -> Mismatch:
    """Find what of the residuals noise does not explain.

    The noise is drawn through the fit's own linear model; the largest of all statistics,
    chi-squares (one-sided) and templates (two-sided) on one scale of deviates, gives
    family-wise p-values, step-down (Westfall & Young 1993): what has been found no longer
    hides what is next.  Beyond the draws an exponential tail of the largest deviates is taken.

    Parameters
    ----------
    fit : BaselineFit
        Residuals and what was fitted.
    seed : int
        Of the draws.
    draws : int
        How many.

    Returns
    -------
    Mismatch
    """
    scanner = Scanner(fit)
    rng = np.random.default_rng(seed)
    seen_t = np.abs(scanner.templates_z(fit.residuals))
    seen_c = scanner.chi2_z(fit.residuals)
    null_t, null_c = [], []
    for start in range(0, draws, 50):
        noise = fit.draw(rng, min(50, draws - start))
        null_t.append(np.abs(scanner.templates_z(noise)))
        null_c.append(scanner.chi2_z(noise))
    drawn_t, drawn_c = np.concatenate(null_t), np.concatenate(null_c)
    observed = np.concatenate([seen_c, seen_t])
    drawn = np.concatenate([drawn_c, drawn_t], axis=1)
    chi = len(seen_c)
    findings = _step_down(scanner, observed, drawn, chi)
    return Mismatch(
        p_value=_family(observed, drawn),
        p_chi2=_family(observed[:chi], drawn[:, :chi]),
        p_scans=_family(observed[chi:], drawn[:, chi:]),
        findings=tuple(findings),
        chi2=fit.chi2(),
    )


def _family(observed: NDArray[np.float64], drawn: NDArray[np.float64]) -> float:
    return tail_probability(float(observed.max()), drawn.max(1))


def tail_probability(value: float, maxima: NDArray[np.float64]) -> float:
    """Probability that a maximum is as large, from drawn ones; beyond them by an exponential tail."""
    above = int((maxima >= value).sum())
    if above >= 10:
        return (above + 1) / (len(maxima) + 1)
    # Maxima of Gaussians have tails lighter than an exponential, which thus errs upwards.
    threshold = float(np.quantile(maxima, 0.8))
    excess = maxima[maxima > threshold] - threshold
    return max(0.2 * float(np.exp(-(value - threshold) / excess.mean())), SMALLEST)


def _step_down(
    scanner: Scanner, observed: NDArray[np.float64], drawn: NDArray[np.float64], chi: int
) -> list[Finding]:
    """Farthest first, each held against those that are left."""
    order = np.argsort(-observed)
    # Of what is left after each: maxima from the least to the farthest.
    sorted_draws = drawn[:, order]
    left = np.maximum.accumulate(sorted_draws[:, ::-1], axis=1)[:, ::-1]
    signed = scanner.templates_z(scanner.fit.residuals)
    findings: list[Finding] = []
    largest = 0.0
    for count, n in enumerate(order):
        p = max(largest, tail_probability(float(observed[n]), left[:, count]))
        if p >= ALARM:
            break
        largest = p
        if n < chi:
            findings.append(Finding("chi-square", scanner.words[n], float(observed[n]), p))
        else:
            template = scanner.templates[n - chi]
            z = float(signed[n - chi])
            findings.append(
                Finding(template.family, template.word, z, p, dict(template.where))
            )
    return findings
