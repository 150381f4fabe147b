"""Templates of scans: patterns in one channel's values, whitened like its residuals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array

from bfsensor.diagnose.data.channels import Channel, Common, join_common
from bfsensor.diagnose.data.exposure_info import NUMBERS, condition_at, label_of
from bfsensor.typing import FloatArray

TOGETHER = 300_000
"""Numbers in the patterns that are whitened at a time.  Chosen: they take about 10 MB; twice as
many take 20 MB and no less time."""


@dataclass(frozen=True, eq=False)
class Template:
    """A pattern sought in the whitened residuals.

    Attributes
    ----------
    family : str
        Name of the scan it belongs to.
    word : str
        Name of the channel.
    rows : ndarray of int, shape (k,)
        Indices of the residuals it covers.
    weights : ndarray, shape (k,)
        Its values there, whitened like the residuals.
    where : mapping
        Its place: 'lags', 'level', 'x', 'y', 'amp', 'condition', 'exposure', 'k', ...
    """

    family: str
    word: str
    rows: NDArray[np.int64]
    weights: FloatArray
    where: Mapping[str, object] = field(default_factory=dict)


def middle(values: FloatArray, weights: FloatArray) -> tuple[float, float]:
    """Interval of the values that holds the middle 90 % of the weights."""
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    low, high = np.searchsorted(share, (0.05, 0.95))
    return float(values[order][low]), float(values[order][min(high, len(values) - 1)])


class Group:
    """All channels of one name (folds, conditions) as one table."""

    def __init__(
        self, word: str, members: list[tuple[Channel, int]], level: str = "level"
    ) -> None:
        self.word, self.members, self._level = word, members, level
        names = [n for n in members[0][0].axes if all(n in c.axes for c, _ in members)]
        self.axes = {n: np.concatenate([c.axes[n] for c, _ in members]) for n in names}
        self.size = sum(len(c) for c, _ in members)
        self.rows = np.concatenate([s + np.arange(len(c)) for c, s in members])
        self._whitener = _Whitener([c for c, _ in members])
        columns = [self.axes[n] for n in NUMBERS]
        self.condition = np.array([
            label_of(condition_at(row)) for row in zip(*columns, strict=True)
        ])  # fmt: skip

    def predicted(self, residuals: FloatArray) -> FloatArray:
        """Prediction of a fit for all values, in the unit of the channel, from its residuals."""
        return np.concatenate([
            c.values - c.unwhiten(residuals[start : start + len(c)])
            for c, start in self.members
        ])  # fmt: skip

    def templates(self, patterns: Iterable[Pattern]) -> Iterator[Template]:
        """Whiten patterns, one after another; those that are zero or not finite are left out."""
        some: list[_Sparse] = []
        held = 0
        for family, pattern, where in patterns:
            rows = np.nonzero(pattern)[0]
            some.append(_Sparse(family, where, rows, pattern[rows]))
            held += len(rows)
            if held > TOGETHER:
                yield from self._whitened(some)
                some, held = [], 0
        yield from self._whitened(some)

    def _whitened(self, patterns: list[_Sparse]) -> Iterator[Template]:
        for one, (rows, weights) in zip(
            patterns, self._whitener.whiten(patterns), strict=True
        ):
            size = np.abs(weights)
            used = size > 1e-12 * size.max(initial=0.0)
            if not used.any() or not np.isfinite(weights).all():
                continue
            rows, weights = rows[used], weights[used]
            told = dict(one.where)
            if "level" in told and self._level in self.axes:
                told["level"] = middle(
                    self.axes[self._level][rows].astype(float), weights**2
                )
            yield Template(one.family, self.word, self.rows[rows], weights, told)


@dataclass(frozen=True, eq=False)
class _Sparse:
    """A pattern by its values that are not 0."""

    family: str
    where: Mapping[str, object]
    rows: NDArray[np.int64]
    values: FloatArray


class _Whitener:
    """Channels one after another, whitened as :meth:`Channel.whiten` does.

    Sparse matrices make the cost of a pattern that of its values that are not 0.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        # Transposed, because patterns are rows.
        self._whiten = csr_array(block_diag([c.whitener.T for c in channels], format="csr"))
        size = self._whiten.shape[0]
        self._gather = self._spread = None
        # Inverse errors of values from which noise in common is estimated, 0 for all others.
        self._alone = np.zeros(size)
        if any(c.common for c in channels):
            common = join_common([c.common or Common.none(len(c)) for c in channels])
            self._gather, self._spread = common.gather.T.tocsr(), common.spread.T.tocsr()
            errors = np.concatenate([c.errors for c in channels])
            self._alone = np.where(common.tells, 1 / errors, 0.0)

    def whiten(
        self, patterns: list[_Sparse]
    ) -> Iterator[tuple[NDArray[np.int64], FloatArray]]:
        """Yield indices, ascending, and whitened values of each pattern where they are not 0."""
        alone = [bool(self._alone[p.rows].all()) for p in patterns]
        rest = [p for p, own in zip(patterns, alone, strict=True) if not own]
        whole = self._product(rest)
        ends = iter(pairwise(whole.indptr))
        for pattern, own in zip(patterns, alone, strict=True):
            if own:
                yield pattern.rows, pattern.values * self._alone[pattern.rows]
            else:
                here = slice(*next(ends))
                yield whole.indices[here], whole.data[here]

    def _product(self, patterns: list[_Sparse]) -> csr_array:
        starts = np.cumsum([0, *(len(p.rows) for p in patterns)])
        rows = np.concatenate([np.zeros(0, np.int64), *(p.rows for p in patterns)])
        values = np.concatenate([np.zeros(0), *(p.values for p in patterns)])
        out = csr_array((values, rows, starts), shape=(len(patterns), len(self._alone)))
        if self._gather is not None:
            told = out @ self._gather
            told.sort_indices()  # sums in the order of values, as of dense patterns
            out = out - told @ self._spread
            out.sort_indices()
        out = out @ self._whiten
        out.sort_indices()
        return out


Pattern = tuple[str, FloatArray, dict[str, object]]
