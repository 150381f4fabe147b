"""Templates of scans: a shape in the residuals of one channel, whitened like them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import NUMBERS, condition_at, label_of
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Template:
    """A shape sought in the whitened residuals.

    Attributes
    ----------
    family : str
        Scan it belongs to.
    word : str
        Channel.
    rows : ndarray of int
        Residuals it covers.
    weights : ndarray
        At those rows, whitened like them.
    where : mapping
        What it stands for: 'lags', 'level', 'x', 'y', 'amp', 'condition', 'exposure', 'k', ...
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
    """Channels of one word as one table."""

    def __init__(
        self, word: str, members: list[tuple[Channel, int]], residuals: FloatArray
    ) -> None:
        self.word, self.members, self._residuals = word, members, residuals
        names = [n for n in members[0][0].axes if all(n in c.axes for c, _ in members)]
        self.axes = {n: np.concatenate([c.axes[n] for c, _ in members]) for n in names}
        self.size = sum(len(c) for c, _ in members)
        self.rows = np.concatenate([s + np.arange(len(c)) for c, s in members])
        # Inverse errors of values that tell of others, and 0.
        self._alone = np.concatenate([
            np.where(c.common.tells, 1 / c.errors, 0.0) if c.common else np.zeros(len(c))
            for c, _ in members
        ])  # fmt: skip
        columns = [self.axes[n] for n in NUMBERS]
        self.condition = np.array([
            label_of(condition_at(row)) for row in zip(*columns, strict=True)
        ])  # fmt: skip

    def predicted(self) -> FloatArray:
        """What the fit predicts, in the units of the channel."""
        return np.concatenate([
            c.values - c.unwhiten(self._residuals[start : start + len(c)])
            for c, start in self.members
        ])  # fmt: skip

    def template(
        self, family: str, pattern: FloatArray, where: Mapping[str, object]
    ) -> Template | None:
        """Whiten a pattern; None if it is nothing.

        Of values that tell of others, others have of it what these tell: nothing of their own.
        """
        if not pattern[self._alone == 0].any():
            whole = pattern * self._alone
        else:
            parts, start = [], 0
            for channel, _ in self.members:
                parts.append(channel.whiten(pattern[start : start + len(channel)]))
                start += len(channel)
            whole = np.concatenate(parts)
        used = np.nonzero(np.abs(whole) > 1e-12 * max(np.abs(whole).max(), 1e-300))[0]
        if len(used) == 0 or not np.isfinite(whole).all():
            return None
        told = dict(where)
        weights = whole[used] ** 2
        flux = "flux" if self.word == "spot" else "level"
        if "level" in told and flux in self.axes:
            told["level"] = middle(self.axes[flux][used].astype(float), weights)
        return Template(family, self.word, self.rows[used], whole[used], told)


Pattern = tuple[str, FloatArray, dict[str, object]]
