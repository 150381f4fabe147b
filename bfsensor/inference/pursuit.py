"""Orthogonal matching pursuit: the few of many columns that explain residuals beyond noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor.inference.evidence import chance_gain
from bfsensor.typing import FloatArray

MOST_TERMS = 6
"""Largest number of columns that are taken. Chosen, to be derived: twice as many fit finer detail, which
a second sample mostly refuses."""

SPANNED = 1e-3
"""Least part of a column's square that a fit's parameters do not span; columns below are not taken.
Chosen: such a column differs from a combination of parameters by 3 % of its norm; twice as large
removes the columns that are hardest to separate from gains and light."""


class Pursuit:
    """Columns to choose from, with what a fit's parameters absorb of them.

    Parameters
    ----------
    x : ndarray, shape (n, k)
        Whitened columns, in the rows where any is not zero.
    u : ndarray, shape (rank, k)
        Their products with an orthonormal basis of what the parameters span.
    probability : float
        Probability that noise alone gives the best of all columns its gain or more.
    accuracy : float
        Relative error of the columns: what is left of a taken one within it is no further column.
    squares : ndarray, shape (k,), optional
        Squares of the columns, for columns in single precision.
    simple : ndarray of bool, shape (k,), optional
        Columns that are preferred to others that explain no more than chance does.
    tried : int
        Number of columns of which these are the best, if there were more.

    Attributes
    ----------
    free : ndarray, shape (k,)
        Square of each column's part that the parameters do not span; 0 where it is negligible.

    Examples
    --------
    >>> noise = np.random.default_rng(4).standard_normal(60)
    >>> x = np.eye(60)[:, :5]
    >>> pursuit = Pursuit(x, np.zeros((0, 5)), probability=0.01, accuracy=0.02)
    >>> [n for n, _ in pursuit.pursue(x.T @ (noise + 30 * x[:, 3] - 9 * x[:, 1]))]
    [3, 1]
    """

    def __init__(
        self,
        x: FloatArray,
        u: FloatArray,
        *,
        probability: float,
        accuracy: float,
        squares: FloatArray | None = None,
        simple: NDArray[np.bool_] | None = None,
        tried: int = 1,
    ) -> None:
        self.x, self.u, self.simple, self.tried = x, u, simple, tried
        self.probability, self.accuracy = probability, accuracy
        raw = (x**2).sum(0) if squares is None else squares
        free = raw - (u**2).sum(0)
        self.free = np.where(free > SPANNED * raw, free, 0.0)

    @property
    def critical(self) -> float:
        """Square of the deviate that noise gives the best of all columns with that probability."""
        count = max(int((self.free > 0).sum()), self.tried, 1)
        return chance_gain(1, count, self.probability)

    def pursue(
        self, products: FloatArray, *, positive: bool = False
    ) -> list[tuple[int, float]]:
        """Take the column of largest deviate, project it out of the others, and repeat.

        Parameters
        ----------
        products : ndarray, shape (k,)
            Scalar products of the columns with the residuals.
        positive : bool
            Whether coefficients must be positive.

        Returns
        -------
        list of (int, float)
            Taken columns with their deviates [standard deviations], in order.
        """
        b, first = products, self.free
        free, critical = first.copy(), self.critical
        taken: list[FloatArray] = []
        path: list[tuple[int, float]] = []
        while len(path) < MOST_TERMS:
            # A column of which earlier ones span more than 98 % (chosen) would have a coefficient
            # dominated by their errors.
            z = deviates(b, np.where(free > 0.02 * first, free, 0.0))
            size = z if positive else np.abs(z)
            if not len(size):
                break
            n = self._farthest(size)
            if size[n] ** 2 < critical:
                break
            if path and size[n] < self.accuracy * abs(path[0][1]):
                break
            path.append((n, float(z[n])))
            new = self.x.T @ self.x[:, n] - self.u.T @ self.u[:, n]
            for old in taken:
                new = new - old * old[n]
            new = new / np.sqrt(free[n])
            taken.append(new)
            b = b - new * z[n]
            free = free - new**2
        return path

    def _farthest(self, size: FloatArray) -> int:
        """Index of the largest deviate, or of the best simple column if that explains as much."""
        best = int(np.argmax(size))
        if self.simple is None:
            return best
        n = int(np.argmax(np.where(self.simple, size, 0.0)))
        return n if size[n] ** 2 > size[best] ** 2 - self._same(size[best]) else best

    def _same(self, z: float) -> float:
        """Difference of chi-squares that does not separate two columns, by chance or their errors."""
        return chance_gain(1, 1, self.probability) + (self.accuracy * z) ** 2

    def alike(
        self, n: int, products: FloatArray, *, positive: bool = False
    ) -> list[tuple[int, float]]:
        """Other columns that alone explain as much as a given one, with their coefficients."""
        free = self.free
        z = deviates(products, free)
        size = np.where((z > 0) | (not positive), np.abs(z), 0.0)
        close = size**2 > size[n] ** 2 - self._same(size[n])
        order = [int(m) for m in np.argsort(-size) if close[m] and m != n]
        return [(m, float(products[m] / free[m])) for m in order]


def deviates(products: FloatArray, free: FloatArray) -> FloatArray:
    """Deviates of columns from products and free squares; 0 where the parameters span them."""
    return np.where(free > 0, products / np.sqrt(np.where(free > 0, free, 1.0)), 0.0)
