"""Least squares in which some parameters may not leave a box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from bfsensor.typing import FloatArray

SINGULAR = 1e-10
"""Of the norm of a column that is left beside the others: less is a direction no data hold."""


class BoundedSolution(NamedTuple):
    """A linear least-squares problem, solved.

    Attributes
    ----------
    solution, errors : ndarray, shape (p,)
        0 of columns that are zero; in directions that no value depends on the shortest.
        Errors are those without a box.
    covariance : ndarray, shape (p, p)
        Without a box.
    basis : ndarray, shape (n, rank)
        Orthonormal columns that those of the design span which no end stops: what is left is
        orthogonal to them.
    left : ndarray, shape (n,)
        Target less what the solution makes.
    """

    solution: FloatArray
    errors: FloatArray
    covariance: FloatArray
    basis: FloatArray
    left: FloatArray


def solve_within(
    design: FloatArray,
    target: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> BoundedSolution:
    """Minimise the square of ``target - design @ x`` with x between two ends.

    Where the free solution leaves the box, the best one inside it is found: clipping would give
    one that is no improvement where columns are nearly parallel.

    Parameters
    ----------
    design : ndarray, shape (n, p)
        Columns.
    target : ndarray, shape (n,)
        What they should make.
    low, high : ndarray, shape (p,)
        Ends, infinite where there are none; 0 lies between them.

    Returns
    -------
    BoundedSolution

    Examples
    --------
    >>> import numpy as np
    >>> columns = np.array([[1.0, 1.0], [0.0, 0.1]])
    >>> inf = np.full(2, np.inf)
    >>> solve_within(columns, np.array([1.0, -1.0]), np.array([-np.inf, 0.0]), inf).solution
    array([1., 0.])
    """
    norms = np.sqrt((design**2).sum(0))
    used = np.flatnonzero(norms > 0)
    # Those with ends last: with the others at their best, a small problem is left of them.
    ends = np.isfinite(low[used]) | np.isfinite(high[used])
    used = np.concatenate([used[~ends], used[ends]])
    free, scale = int((~ends).sum()), norms[used]
    lowest, highest = low[used] * scale, high[used] * scale
    unit = design[:, used] / scale
    q, r = np.linalg.qr(unit)
    regular = bool((np.abs(np.diag(r)) > SINGULAR).all())
    if regular:
        inverse = solve_triangular(r, np.eye(len(r)))
        told = q.T @ target
        x = solve_triangular(r, told)
    else:
        inverse = np.linalg.pinv(unit, rcond=SINGULAR)
        x = inverse @ target
        q = span(unit)
        told = q.T @ target
    if ((x < lowest) | (x > highest)).any():
        if regular:
            box = lowest[free:], highest[free:]
            x[free:] = _inside(r[free:, free:], told[free:], *box)
            x[:free] = solve_triangular(
                r[:free, :free], told[:free] - r[:free, free:] @ x[free:]
            )
        else:
            x = _inside(q.T @ unit, told, lowest, highest)
        left = target - unit @ x
        # What an end stops is not fitted: what is left is orthogonal to the others.
        stopped = np.isclose(x, lowest, rtol=1e-9) | np.isclose(x, highest, rtol=1e-9)
        q = span(unit[:, ~stopped])
    else:
        left = target - q @ told
    solution, errors = np.zeros(design.shape[1]), np.zeros(design.shape[1])
    solution[used] = x / scale
    errors[used] = np.sqrt((inverse**2).sum(1)) / scale
    covariance = np.zeros((design.shape[1], design.shape[1]))
    covariance[np.ix_(used, used)] = (inverse @ inverse.T) / np.outer(scale, scale)
    return BoundedSolution(solution, errors, covariance, q, left)


def span(unit: FloatArray) -> FloatArray:
    """Orthonormal columns that those of unit length span."""
    q, r = np.linalg.qr(unit)
    if (np.abs(np.diag(r)) > SINGULAR).all():
        return q
    shapes, sizes, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(shapes[:, sizes > SINGULAR * sizes.max(initial=0.0)])


def _inside(
    matrix: FloatArray,
    told: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """Best solution between two ends, which may be the same."""
    held = high - low <= 0
    x = np.where(held, low, 0.0)
    if not held.all():
        rest = told - matrix[:, held] @ x[held]
        box = low[~held], high[~held]
        x[~held] = lsq_linear(matrix[:, ~held], rest, bounds=box, method="bvls").x
    return x
