"""Detection of outermost rows and columns of a sensor that scatter more than inner ones."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.typing import FloatArray

UNLIKE = 8.0
"""Excess of the scatter of a line at the rim over that of inner lines [standard errors] above which
it is left out.  Chosen: noise never reaches 8 (no line of 200 maps in the tests); with 16, lines
of up to twice that excess stay in maps and are found as effects."""

INNER = 64
"""Largest number of inner lines whose median scatter is the reference.  Chosen: it is then known to
1.25 / 64^(1/2) = 0.16 of one line's standard error; with 128, to 0.11."""


class Border(NamedTuple):
    """A row (``axis`` 0) or column (1) at the rim; ``ratio`` of its scatter to an inner line's."""

    axis: int
    line: int
    ratio: float

    def __str__(self) -> str:
        word = ("row", "column")[self.axis]
        return (
            f"{word} {self.line}, at the rim, scatters {self.ratio:.1f} times as much as inner "
            f"{word}s: left out of maps"
        )

    def cut(self, image: NDArray[Any]) -> None:
        """Set the line of an image to nan, in place."""
        (image if self.axis == 0 else image.T)[self.line] = np.nan


def find_borders(image: NDArray[Any]) -> list[Border]:
    """Find lines at the rim that differ from the next line by more scatter than inner ones do.

    The outer boundary of a pixel at the rim is set by the guard ring and not by another pixel, so
    that the model of inner boundaries does not hold there.  The difference to the next line
    removes the shape of the light, the median a line's mean, and the median deviation single bad
    pixels.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Map of relative response; nan where nothing is read.

    Returns
    -------
    list of Border
        Usually empty; empty too along an axis with fewer than 8 lines.

    Examples
    --------
    >>> image = np.random.default_rng(1).normal(0, 0.003, (128, 128))
    >>> find_borders(image)
    []
    >>> image[:, 0] += 0.012 * np.sin(np.arange(128) / 5)
    >>> print(find_borders(image)[0])
    column 0, at the rim, scatters 4.1 times as much as inner columns: left out of maps
    """
    out = []
    for axis, lines in ((0, image), (1, image.T)):
        count, length = lines.shape
        if count < 8:
            continue
        inner = np.unique(np.linspace(1, count - 3, INNER).astype(int))
        usual = float(np.nanmedian(_scatter(lines[inner + 1] - lines[inner])))
        rim = _scatter(lines[[1, -2]] - lines[[0, -1]])
        # The relative standard error of a scatter by median deviations of n values: 1.17 / n^(1/2).
        most = usual * (1 + UNLIKE * 1.17 / np.sqrt(length))
        for index, own in zip((0, count - 1), rim, strict=True):
            if own > most:
                # The variance of a difference is that of two lines, of which one is an inner one.
                ratio = np.sqrt(2 * (own / usual) ** 2 - 1)
                out.append(Border(axis, index, float(ratio)))
    return out


def _scatter(values: NDArray[Any]) -> FloatArray:
    """Robust standard deviation of each row; nan for one that is not read."""
    out = np.full(len(values), np.nan)
    read = np.isfinite(values).any(1)
    middle = np.nanmedian(values[read], axis=1, keepdims=True)
    out[read] = 1.4826 * np.nanmedian(np.abs(values[read] - middle), axis=1)
    return out
