"""Lines of pixels at the rim of a sensor that are unlike those beside them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.typing import FloatArray

UNLIKE = 8.0
"""Standard errors by which a line at the rim must scatter more than others to be left out."""

INNER = 64
"""Inner lines, at most, that are looked at."""


class Border(NamedTuple):
    """A row (``axis`` 0) or column (1) at the rim; ``ratio`` of its scatter to others'."""

    axis: int
    line: int
    ratio: float

    def __str__(self) -> str:
        word = ("row", "column")[self.axis]
        return (
            f"{word} {self.line}, at the rim, scatters {self.ratio:.1f} times as much as "
            f"{word}s do: left out of maps"
        )

    def cut(self, image: NDArray[Any]) -> None:
        """Blank the line of an image."""
        (image if self.axis == 0 else image.T)[self.line] = np.nan


def find_borders(image: NDArray[Any]) -> list[Border]:
    """Find lines at the rim whose pixels differ from their neighbours more than inner ones do.

    The outer boundary of such a pixel lies between it and no other: what moves boundaries there
    is not what does inside.  Light's shape and a line's mean cancel or do not matter; the scatter
    is a robust one, so that single bad pixels do not either.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        A map; nan where nothing is read.

    Returns
    -------
    list of Border
        Usually none.

    Examples
    --------
    >>> image = np.random.default_rng(1).normal(0, 0.003, (128, 128))
    >>> find_borders(image)
    []
    >>> image[:, 0] += 0.012 * np.sin(np.arange(128) / 5)
    >>> print(find_borders(image)[0])
    column 0, at the rim, scatters 4.1 times as much as columns do: left out of maps
    """
    out = []
    for axis, lines in ((0, image), (1, image.T)):
        count, length = lines.shape
        if count < 8:
            continue
        inner = np.unique(np.linspace(1, count - 3, INNER).astype(int))
        usual = float(np.nanmedian(_scatter(lines[inner + 1] - lines[inner])))
        rim = _scatter(lines[[1, -2]] - lines[[0, -1]])
        # Of a robust scatter of n values: 1.17 / n^(1/2) of it.
        most = usual * (1 + UNLIKE * 1.17 / np.sqrt(length))
        for index, own in zip((0, count - 1), rim, strict=True):
            if own > most:
                # A difference holds the scatter of two lines, of which one is as usual.
                ratio = np.sqrt(2 * (own / usual) ** 2 - 1)
                out.append(Border(axis, index, float(ratio)))
    return out


def _scatter(values: NDArray[Any]) -> FloatArray:
    """Robust standard deviation of each row; nan of one that is not read."""
    out = np.full(len(values), np.nan)
    read = np.isfinite(values).any(1)
    middle = np.nanmedian(values[read], axis=1, keepdims=True)
    out[read] = 1.4826 * np.nanmedian(np.abs(values[read] - middle), axis=1)
    return out
