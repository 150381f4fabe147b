"""Products of a difference image at all lags, and corrections for clipping and local means."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.stats import norm

from bfsensor.typing import FloatArray


def box_edges(shape: tuple[int, ...], box: int | None) -> list[NDArray[np.int64]]:
    """Edges of boxes of nearly equal size in y and in x, the last one included [pixel]."""
    counts = [1 if box is None else max(round(n / box), 1) for n in shape]
    return [
        np.round(np.linspace(0, n, c + 1)).astype(np.int64)
        for n, c in zip(shape, counts, strict=True)
    ]


def sum_boxes(image: NDArray[Any], edges: list[NDArray[np.int64]]) -> FloatArray:
    """Sum within each box."""
    rows = np.add.reduceat(image, edges[0][:-1], axis=0, dtype=float)
    return np.asarray(np.add.reduceat(rows, edges[1][:-1], axis=1))


def subtract_box_means(
    image: FloatArray, good: NDArray[np.bool_], edges: list[NDArray[np.int64]]
) -> FloatArray:
    """Subtract each box's mean over its good pixels; bad pixels become zero."""
    count = sum_boxes(good, edges)
    mean = sum_boxes(np.where(good, image, 0.0), edges) / np.maximum(count, 1.0)
    wide = np.repeat(np.repeat(mean, np.diff(edges[0]), 0), np.diff(edges[1]), 1)
    return np.where(good, image - wide, 0.0)


def sum_products(
    d: FloatArray, good: NDArray[np.bool_], lags: int
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Sums of products and numbers of pairs, [sign of j, j, i]."""
    # Padding by the largest lag keeps opposite sides from wrapping into one another.
    shape = [next_fast_len(n + lags, real=True) for n in d.shape]
    out = []
    for image in (d, good.astype(float)):
        spectrum = rfft2(image, s=shape)
        product = irfft2(spectrum.real**2 + spectrum.imag**2, s=shape)
        j, i = np.arange(lags + 1)[:, None], np.arange(lags + 1)[None]
        out.append(np.stack([product[j, i], product[-j, i]]))
    return out[0], np.rint(out[1]).astype(np.int64)


def undo_clipping(raw: FloatArray, clip: float) -> FloatArray:
    """Correct covariances for the part that clipping removes from a Gaussian.

    Cut at k sigma its variance is t = 1 - 2 k phi(k) / (2 Phi(k) - 1) of the whole.  Two
    pixels correlated by rho have the density phi phi (1 + rho x y + ...) (Mehler), whose
    first moment of x y, both cut, is rho t^2; the next term is of order rho^3.
    """
    if not np.isfinite(clip):
        return raw
    kept = 2 * norm.cdf(clip) - 1
    t = 1 - 2 * clip * norm.pdf(clip) / kept
    out = raw / t**2
    out[0, 0] = raw[0, 0] / t
    return np.asarray(out)


def undo_box_means(
    raw: FloatArray, pixels: int, edges: list[NDArray[np.int64]]
) -> FloatArray:
    """Correct covariances for the part that the subtraction of box means removes.

    From a product d(p) d(q) at the lag L the subtraction removes the mean of C(p - r) over the box
    of q and the mean of C(q - r) over the box of p, and adds the mean of C(r - s) over both: of order
    S / n for n pixels a box, where S is the sum of all covariances.  That is a matrix on the
    covariances, known from the boxes, and solved here.  Covariances beyond the largest lag are
    taken as 0, and bad pixels as scattered at random.
    """
    lags = raw.shape[0] - 1
    plane = np.arange(-lags, lags + 1)
    uses, both, full = [], [], 1.0
    for axis in edges:
        at = np.repeat(np.arange(len(axis) - 1), np.diff(axis))
        size = len(at) / (len(axis) - 1)
        full *= size
        wide = np.pad(at, lags, constant_values=-1)
        use, pair = np.empty((2, lags + 1, 2 * lags + 1))
        for lag in range(lags + 1):
            inside = at[lag:]
            for k, m in enumerate(plane):
                start = lags + m
                use[lag, k] = np.mean(wide[start : start + len(inside)] == inside)
            # Two boxes share covariances across their edge only, (lags / box)^2 of this.
            together = np.mean(inside == at[: len(inside)])
            pair[lag] = together * np.maximum(size - np.abs(plane), 0) / size
        uses.append(use)
        both.append(pair)
    taken = 2 * np.einsum("ab,cd->acbd", *uses) - np.einsum("ab,cd->acbd", *both)
    # The two pixels of a pair are good for certain, others with the probability of any pixel.
    boxes = (len(edges[0]) - 1) * (len(edges[1]) - 1)
    share = np.full(taken.shape, 1 / full)
    share[:, :, lags, lags] = boxes / pixels
    quadrant = np.arange(lags + 1)
    share[quadrant[:, None], quadrant, lags + quadrant[:, None], lags + quadrant] = (
        boxes / pixels
    )
    taken = (taken * share).reshape((lags + 1) ** 2, -1)
    fold = (np.abs(plane)[:, None] * (lags + 1) + np.abs(plane)).ravel()
    matrix = np.eye((lags + 1) ** 2)
    for column, change in zip(fold, taken.T, strict=True):
        matrix[:, column] -= change
    return np.asarray(np.linalg.solve(matrix, raw.ravel()).reshape(raw.shape))
