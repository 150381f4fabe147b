"""Linear least squares with bounds on some of the parameters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from bfsensor.typing import FloatArray

SINGULAR = 1e-10
"""Smallest norm of a unit column's part that is orthogonal to the columns before it.

Below it the design counts as singular, and the solution of least norm is taken.  Chosen: it lies
between round-off, 1e-16 times the number of values, and directions that data constrain; twice as
large, a column that data distinguish to 2e-10 only would count as a copy."""


class BoundedSolution(NamedTuple):
    """Solution of a linear least-squares problem with bounds.

    Parameters
    ----------
    solution : ndarray, shape (p,)
        Parameters at the minimum, 0 for columns that are zero; of equally good solutions the one
        of least norm.
    errors : ndarray, shape (p,)
        Standard deviations of the parameters without bounds, for values of unit variance.
    covariance : ndarray, shape (p, p)
        Covariance of the parameters without bounds, for values of unit variance.
    basis : ndarray, shape (n, rank)
        Orthonormal basis of the columns whose parameters are not at a bound; the residuals are
        orthogonal to it.
    left : ndarray, shape (n,)
        Residuals, target less design times solution.
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
    """Minimise the squared norm of ``target - design @ x`` with every x between its bounds.

    Where the unbounded solution violates a bound, the bounded minimum is found; clipping would
    return a point that may be worse than 0 where columns are nearly parallel.

    Parameters
    ----------
    design : ndarray, shape (n, p)
        Design matrix, one column per parameter, in units of the values' standard deviations.
    target : ndarray, shape (n,)
        Values to reproduce, in the same units.
    low, high : ndarray, shape (p,)
        Lower and upper bounds, infinite where there is none; 0 lies between them.

    Returns
    -------
    solved : BoundedSolution
        Parameters, their errors and the residuals.

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
    # Bounded columns come last: a QR decomposition then leaves a small problem in them alone,
    # with the unbounded parameters at their best.
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
        # A parameter at its bound is not fitted: residuals are orthogonal to the others only.
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


def span(columns: FloatArray) -> FloatArray:
    """Orthonormal basis of the space that columns span, without directions below SINGULAR.

    Columns are brought to unit length first, so that their units do not decide what is dropped.
    """
    norms = np.sqrt((columns**2).sum(0))
    unit = columns[:, norms > 0] / norms[norms > 0]
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
    """Bounded least-squares solution; parameters whose bounds coincide are held there."""
    held = high - low <= 0
    x = np.where(held, low, 0.0)
    if not held.all():
        rest = told - matrix[:, held] @ x[held]
        box = low[~held], high[~held]
        x[~held] = lsq_linear(matrix[:, ~held], rest, bounds=box, method="bvls").x
    return x
