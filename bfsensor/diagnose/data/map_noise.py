"""Noise that means of rows, columns and blocks share because they average the same pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import csr_array, hstack, vstack

from bfsensor.diagnose.data.channels import Common
from bfsensor.typing import FloatArray


class BlockNoise(NamedTuple):
    """Errors of blocks' means conditional on those of columns and rows of the same pixels.

    Attributes
    ----------
    kept : ndarray of int, shape (kept,)
        Indices of blocks, counted by rows, that do not follow from columns, rows and the other
        blocks: (R - 1) (C - 1) of R x C.  Below, R and C also count rows and columns of blocks
        that the rim cuts off.
    covariance : ndarray, shape (kept, kept)
        Covariance of the kept blocks' means given columns and rows, for pixels of variance 1.
    spread : ndarray, shape (kept, R + C)
        Regression of the kept blocks' means on the sums of pixels over rows of blocks and over
        columns of blocks.
    gather : csr_array, shape (R + C, nx + ny)
        These sums as combinations of the means of columns and, after them, of rows.
    """

    kept: NDArray[np.int64]
    covariance: FloatArray
    spread: FloatArray
    gather: csr_array

    def common(self) -> Common:
        """Shared noise of columns, rows and kept blocks, in this order."""
        lines = self.gather.shape[1]
        above = csr_array((lines, len(self.spread.T)))
        right = csr_array((self.gather.shape[0], len(self.kept)))
        return Common(
            csr_array(vstack([above, csr_array(self.spread)], format="csr")),
            csr_array(hstack([self.gather, right], format="csr")),
        )


def block_noise(good: NDArray[np.bool_], side: int) -> BlockNoise:
    """Errors of blocks' means given the means of columns and rows of the same pixels.

    For white noise of pixels, sums over rows and over columns of blocks follow from the means of
    rows and columns.  The rest of a block's noise is the residual of a two-way table (weighted
    least squares of row plus column effects) and independent of them.  Exact where blocks are
    complete or absent; single bad pixels are taken as evenly spread.

    Parameters
    ----------
    good : ndarray of bool, shape (ny, nx)
        Pixels that are read; blocks with no more than half of their pixels are left out.
    side : int
        Side of a block [pixel]; pixels beyond the last whole block count in columns and rows.

    Returns
    -------
    BlockNoise

    Examples
    --------
    >>> noise = block_noise(np.ones((8, 8), bool), 4)
    >>> noise.kept, noise.covariance
    (array([0]), array([[0.015625]]))
    """
    (ny, nx), whole = good.shape, (good.shape[0] // side, good.shape[1] // side)
    starts = [np.arange(0, n, side) for n in (ny, nx)]
    pixels = np.add.reduceat(np.add.reduceat(good, starts[0], 0, int), starts[1], 1)
    row, column = np.nonzero(pixels > 0.5 * np.outer(*(
        np.diff(np.append(s, n)) for s, n in zip(starts, (ny, nx), strict=True)
    )))  # fmt: skip
    count = pixels[row, column].astype(float)
    full = np.flatnonzero((row < whole[0]) & (column < whole[1]))
    kept = full[_kept(row[full], column[full], whole)]
    # Row and column sums of the two-way table of blocks, as linear functions of block means.
    table = np.zeros((sum(map(len, starts)), len(count)))
    table[row, np.arange(len(count))] = count
    table[len(starts[0]) + column, np.arange(len(count))] = count
    design = (table > 0).T.astype(float)
    known = design[kept] @ np.linalg.pinv(table @ design)
    covariance = np.diag(1 / count[kept]) - known @ design[kept].T
    return BlockNoise(
        row[kept] * whole[1] + column[kept], 0.5 * (covariance + covariance.T), known,
        _gather(good, starts, table.sum(1)),
    )  # fmt: skip


def _kept(
    row: NDArray[np.int64], column: NDArray[np.int64], shape: tuple[int, int]
) -> NDArray[np.int64]:
    """Indices of blocks that do not follow from the others and the sums over rows and columns.

    Blocks are edges of a bipartite graph of rows and columns; those of a spanning forest follow
    from the sums and are dropped, the last ones first.
    """
    joined = DisjointSet(range(sum(shape)))
    order = np.argsort(-np.maximum(row - shape[0], column - shape[1]), kind="stable")
    kept = [n for n in order if not joined.merge(int(row[n]), int(shape[0] + column[n]))]
    return np.sort(np.array(kept, int))


def _gather(
    good: NDArray[np.bool_], starts: list[NDArray[np.int64]], pixels: FloatArray
) -> csr_array:
    """Matrix from the means of columns and rows to sums over rows and columns of blocks."""
    ny, nx = good.shape
    of_rows, of_columns = (
        np.repeat(np.arange(len(s)), np.diff(np.append(s, n)))
        for s, n in zip(starts, (ny, nx), strict=True)
    )
    at = np.concatenate([len(starts[0]) + of_columns, of_rows])
    count = np.concatenate([good.sum(0), good.sum(1)]).astype(float)
    share = count * (pixels / np.maximum(np.bincount(at, count), 1))[at]
    return csr_array((share, (at, np.arange(nx + ny))), shape=(len(pixels), nx + ny))
