"""Symmetries of deviating a_ij, which separate physics of the silicon from that of the readout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.detect.locate import ALARM
from bfsensor.typing import FloatArray

CHANCE = 0.05
"""Probability above which lags are said to agree with the baseline.  Chosen: between it and the alarm's
0.01 nothing is said; with 0.1, of agreeing axes one in ten is not called so."""

NEAREST = 2
"""Largest lag of the sum over all lags [pixel].  Chosen: farther ones add more noise than signal; with
4, the error of the sum doubles."""


@dataclass(frozen=True)
class Symmetry:
    """Deviations of measured a_ij from a baseline, by axis, in sum, and between back biases.

    Attributes
    ----------
    rows, columns : float
        Probability that noise gives the deviations of lags (i, 0), along which pixels are read one after
        the other, and of lags (0, j).
    total : float
        Probability that noise gives the sum of the deviations over the nearest lags, 0 where silicon
        redistributes area; nan without (0, 0).
    alike, scaled : float
        Chi-square of the differences of deviations between back biases, if they are equal, and if
        they are in proportion to the response; nan at one back bias.
    """

    rows: float
    columns: float
    total: float = np.nan
    alike: float = np.nan
    scaled: float = np.nan

    @property
    def verdict(self) -> str:
        """'readout', 'silicon' or 'open'."""
        if self.rows < ALARM and self.columns > CHANCE:
            return "readout"
        both = self.rows < ALARM and self.columns < ALARM
        kept = not self.total < ALARM
        return "silicon" if both and kept else "open"

    def said(self) -> str:
        """One sentence for a report."""
        parts = [
            f"lags along rows {_agrees(self.rows)}",
            f"lags along columns {_agrees(self.columns)}",
        ]
        if np.isfinite(self.total):
            kept = "is not kept" if self.total < ALARM else "is kept"
            parts.append(f"the sum over the nearest lags {kept} (p {self.total:.2g})")
        if np.isfinite(self.alike):
            parts.append(
                "between back biases the deviations are equal with a chi-square of "
                f"{self.alike:.3g}, in proportion to the response with {self.scaled:.3g}"
            )
        ends = {
            "readout": "as of the readout, which acts along rows alone",
            "silicon": "as of the silicon, which acts along both axes and conserves area",
            "open": "which does not decide between silicon and readout",
        }
        return f"silicon or readout: {'; '.join(parts)}: {ends[self.verdict]}"


def _agrees(p: float) -> str:
    if p < ALARM:
        return f"deviate (p {p:.2g})"
    return f"{'agree' if p > CHANCE else 'may deviate'} (p {p:.2g})"


def find_symmetry(
    channels: Sequence[Channel], left: Sequence[FloatArray], predicted: Sequence[FloatArray]
) -> Symmetry | None:
    """Find the symmetries of the deviations of a_ij.

    Parameters
    ----------
    channels : sequence of Channel
        Channels of a fit.
    left, predicted : sequence of ndarray
        Measured less predicted values of each, and the predicted ones, in its unit.

    Returns
    -------
    Symmetry or None
        None without a table of a_ij that has lags along both axes.

    Examples
    --------
    >>> from bfsensor.diagnose.data.channels import Channel
    >>> i, j = np.array([[0, 1, 2, 0, 0], [0, 0, 0, 1, 2]])
    >>> axes = {"i": i, "j": j, "table": 0 * i, "back_bias": -50.0 + 0.0 * i}
    >>> blocks = tuple(np.full((5, 1, 1), 1e-18))
    >>> a = Channel("flat_cov", np.zeros(5), blocks, axes, "1/e-")
    >>> deferred = np.array([0.0, 9e-9, 6e-9, 0.0, 5e-10])
    >>> find_symmetry([a], [deferred], [1e-7 * (i + j < 2)]).verdict
    'readout'
    """
    mine = [
        n for n, c in enumerate(channels) if c.word == "flat_cov" and c.unit == PER_ELECTRON
    ]
    if not mine:
        return None
    axes = {
        k: np.concatenate([np.asarray(channels[n].axes[k], float) for n in mine])
        for k in ("i", "j", "table", "back_bias")
    }
    r = np.concatenate([left[n] for n in mine])
    a = np.concatenate([predicted[n] for n in mine])
    s = np.concatenate([channels[n].errors for n in mine])
    i, j = axes["i"], axes["j"]
    rows, columns = (i > 0) & (j == 0), (i == 0) & (j > 0)
    if not (rows.any() and columns.any()):
        return None
    p_rows, p_columns = (
        float(chi2.sf(np.sum((r[k] / s[k]) ** 2), k.sum())) for k in (rows, columns)
    )
    total = np.nan
    tables = np.unique(axes["table"])
    near = (i <= NEAREST) & (j <= NEAREST)
    if np.sum((i == 0) & (j == 0)) == len(tables):
        # A quadrant's lag stands for its mirror images as well.
        weight = np.where(i > 0, 2, 1) * np.where(j > 0, 2, 1) * near
        sums = [float((weight * r)[axes["table"] == t].sum()) for t in tables]
        variances = [float(((weight * s) ** 2)[axes["table"] == t].sum()) for t in tables]
        square = np.sum(np.square(sums) / np.array(variances))
        total = float(chi2.sf(square, len(tables)))
    alike, scaled = _between(r, s, a, axes, near)
    return Symmetry(p_rows, p_columns, total, alike, scaled)


def _between(
    r: FloatArray,
    s: FloatArray,
    a: FloatArray,
    axes: dict[str, FloatArray],
    near: NDArray[np.bool_],
) -> tuple[float, float]:
    """Chi-squares of differences between the two outermost back biases; nan at one of them."""
    biases = np.unique(axes["back_bias"][np.isfinite(axes["back_bias"])])
    if len(biases) < 2:
        return np.nan, np.nan
    places: dict[tuple[float, float], dict[float, list[int]]] = {}
    for n in np.flatnonzero(near & ~((axes["i"] == 0) & (axes["j"] == 0))):
        if axes["back_bias"][n] in (biases[0], biases[-1]):
            key = axes["i"][n], axes["j"][n]
            places.setdefault(key, {}).setdefault(axes["back_bias"][n], []).append(int(n))
    alike, scaled = 0.0, 0.0
    for there in places.values():
        if len(there) < 2:
            continue
        (r1, v1, a1), (r2, v2, a2) = (
            (r[n].mean(), np.square(s[n]).sum() / len(n) ** 2, a[n].mean())
            for n in there.values()
        )
        alike += (r1 - r2) ** 2 / (v1 + v2)
        ratio = a2 / a1 if a1 else 1.0
        scaled += (ratio * r1 - r2) ** 2 / (ratio**2 * v1 + v2)
    return float(alike), float(scaled)
