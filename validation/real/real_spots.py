r"""Spots on four segments of one ITL sensor: which differs, and whether its gain explains that.

``SHARED/recordings/ucd_bf_kernel/spot_size_vs_flux_ITL029.csv`` (BF_Kernel repository @ d4bfd70,
STA3800C-029): mean widths at five fluxes on each of four segments, without printed errors.  Widths
grow as :math:`\sigma(F) = \sigma_0 (1 + b F)`.  A wrong gain of a segment scales its F, and so
b in x and in y alike: *gain alone* is :math:`b_{x,s} = g_s B_x, b_{y,s} = g_s B_y`.

Errors are of the scatter about the straight lines, pooled over segments, x and y each; what x and y
share in one image is kept as a correlation, what segments share at one flux parts none of them.
They have few degrees of freedom: p-values are of draws that repeat the whole analysis, scatter and
largest of the segments included.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

Values = NDArray[np.float64]
PER = 1e6
"""Electrons in a spot that slopes are quoted for."""


@dataclass(frozen=True)
class Growth:
    """Growth of the spots by segment.

    Attributes
    ----------
    segments : tuple of str
    fluxes : ndarray, shape (n, m)
        Total electrons of a spot, in :data:`PER`.
    slopes : ndarray, shape (n, 2)
        Relative growth in x and y.
    leverage : ndarray, shape (n,)
        Error of a slope for a relative scatter of 1.
    scatter : ndarray, shape (2, 2)
        Covariance of the relative scatter of the widths in x and y.
    widths : ndarray, shape (n, 2)
        Without charge [pixel].
    """

    segments: tuple[str, ...]
    fluxes: Values
    slopes: Values
    leverage: Values
    scatter: Values
    widths: Values

    @property
    def errors(self) -> Values:
        """Standard errors of the slopes."""
        return self.leverage[:, None] * np.sqrt(np.diag(self.scatter))


def read_spots(path: Path) -> tuple[tuple[str, ...], Values, Values]:
    """Segments, fluxes (n, m) and widths (n, m, 2) before any correction."""
    table = Table.read(path, format="ascii.csv")
    table = table[table["state"] == "uncorrected"]
    names = tuple(dict.fromkeys(str(v) for v in table["segment"]))
    own = [table[table["segment"] == n] for n in names]
    fluxes = np.array([t["total_e"] for t in own], float) / PER
    widths = np.array([
        np.stack([t["sigma_x_pix"], t["sigma_y_pix"]], axis=1) for t in own
    ])  # fmt: skip
    return names, fluxes, widths


def fit_growth(
    names: tuple[str, ...], fluxes: Values, widths: Values, *, shared: bool = True
) -> Growth:
    """Straight lines by segment and axis, and the scatter about all of them.

    Segments were exposed together: what their widths share at a flux (focus, a bent law) moves
    all slopes alike and does not part segments.  ``shared``: it is taken off before scatter is
    measured, else it counts as scatter of each.
    """
    slopes, starts, leverage, left = [], [], [], []
    for f, w in zip(fluxes, widths, strict=True):
        design = np.stack([np.ones_like(f), f], axis=1)
        fit = np.linalg.lstsq(design, w, rcond=None)[0]
        slopes.append(fit[1] / fit[0])
        starts.append(fit[0])
        leverage.append(1 / np.sqrt(((f - f.mean()) ** 2).sum()))
        left.append((w - design @ fit) / fit[0])
    residuals = np.array(left)
    free = (len(names) - 1) * (fluxes.shape[1] - 2)
    if shared:
        residuals -= residuals.mean(0)
    else:
        free = len(names) * (fluxes.shape[1] - 2)
    scatter = np.einsum("nmi,nmj->ij", residuals, residuals) / free
    return Growth(
        names, fluxes, np.array(slopes), np.array(leverage), scatter, np.array(starts)
    )


def chi2_of_gain(growth: Growth, among: NDArray[np.bool_]) -> tuple[float, float]:
    """Chi-square of one ratio of the slopes in y and x for some segments, and that ratio."""
    inverse = np.linalg.inv(growth.scatter)

    def of(angle: float) -> float:
        along = np.array([np.cos(angle), np.sin(angle)])
        total = 0.0
        for b, lever in zip(growth.slopes[among], growth.leverage[among], strict=True):
            gain = (along @ inverse @ b) / (along @ inverse @ along)
            off = b - gain * along
            total += float(off @ inverse @ off) / lever**2
        return total

    best = minimize_scalar(
        of, bounds=(0.05, 1.5), method="bounded", options={"xatol": 1e-6}
    )
    return float(best.fun), float(np.tan(best.x))


@dataclass(frozen=True)
class Single:
    """What is said of the segments.

    Attributes
    ----------
    chi2_same : float
        One growth in x and one in y for all, gains as given.
    chi2_gain : float
        Gains free; ratio of the axes common.
    chi2_but : ndarray, shape (n,)
        Gains free, that segment's ratio free as well.
    decrease : ndarray, shape (n,)
        ``chi2_gain`` less ``chi2_but``: how far a segment stands out beyond its gain.
    p_gain, p_single : float
        Of ``chi2_gain``, and of the largest decrease of all segments, by draws of gain alone.
    p_others : float
        Of the chi-square that is left of the other segments.
    """

    chi2_same: float
    chi2_gain: float
    chi2_but: Values
    decrease: Values
    p_gain: float
    p_single: float
    p_others: float


def chi2_of_same(growth: Growth) -> float:
    """Chi-square of one slope in x and one in y for all."""
    inverse = np.linalg.inv(growth.scatter)
    weight = growth.leverage**-2
    mean = (weight[:, None] * growth.slopes).sum(0) / weight.sum()
    off = growth.slopes - mean
    return float(np.einsum("n,ni,ij,nj", weight, off, inverse, off))


def single_out(
    growth: Growth, *, shared: bool = True, seed: int = 6821, draws: int = 4000
) -> Single:
    """Find the segment that gain alone explains least, and how often noise gives one as far."""

    def statistics(g: Growth) -> tuple[float, Values]:
        every = np.ones(len(g.segments), bool)
        whole = chi2_of_gain(g, every)[0]
        but = []
        for n in range(len(g.segments)):
            others = every.copy()
            others[n] = False
            but.append(chi2_of_gain(g, others)[0])
        return whole, np.array(but)

    whole, but = statistics(growth)
    ratio = chi2_of_gain(growth, np.ones(len(growth.segments), bool))[1]
    inverse = np.linalg.inv(growth.scatter)
    along = np.array([1.0, ratio])
    gains = growth.slopes @ inverse @ along / (along @ inverse @ along)
    truth = gains[:, None] * along
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(growth.scatter)
    singled = int(np.argmin(but))
    counts = np.zeros(3)
    for _ in range(draws):
        noise = rng.standard_normal((*growth.fluxes.shape, 2)) @ root.T
        widths = 1 + truth[:, None] * growth.fluxes[..., None] + noise
        drawn_whole, drawn = statistics(
            fit_growth(growth.segments, growth.fluxes, widths, shared=shared)
        )
        counts += (
            drawn_whole >= whole,
            (drawn_whole - drawn).max() >= whole - but[singled],
            drawn[singled] >= but[singled],
        )
    p = (counts + 1) / (draws + 1)
    return Single(
        chi2_of_same(growth), whole, but, whole - but, float(p[0]), float(p[1]), float(p[2])
    )
