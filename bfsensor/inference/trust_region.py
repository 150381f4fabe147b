"""Least squares by SciPy's trust region, which always ends with an answer and how it ended."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

ROUNDS = 40
"""Largest number of points that one minimisation evaluates; one that needs more ends at its best
point, marked as not converged.  Chosen: twice as many doubles the time that a fit which does not
converge takes, and changes none that does; fits of ``python -m tests.golden`` need 3 to 15."""

FIRST, STILL = 1e4, 1e-6
"""First radius of the trust region [standard errors], and the part of it below which the minimiser
ends.  Chosen: fits start within 1e4 errors of the minimum, and the first step is a full
Gauss-Newton step; at twice as many the region shrinks once more where that misleads.  The part is
0.01 errors."""

SHRUNK = 3
"""Status of :func:`scipy.optimize.least_squares` where only the size of a step ended it, by
scipy's definition."""


class Minimum(NamedTuple):
    """Place and manner in which a minimisation ended.

    Parameters
    ----------
    values : ndarray, shape (p,)
        Parameters of the smallest sum of squares that was found; those at a bound equal it.
    converged : bool
        Whether that is a minimum; False where the largest number of evaluations ended it.
    shrunk : bool
        Whether only the size of the trust region ended it: derivatives may have misled.
    square : float
        Sum of the squares of the residuals there (of the loss, where one was given).
    """

    values: FloatArray
    converged: bool
    shrunk: bool
    square: float


def minimise(
    residuals: Callable[[FloatArray], FloatArray],
    slopes: Callable[[FloatArray], FloatArray],
    start: ArrayLike,
    *,
    low: ArrayLike = -np.inf,
    high: ArrayLike = np.inf,
    units: ArrayLike | None = None,
    radius: float = FIRST,
    relative: float = 1e-12,
    still: float = STILL,
    evaluations: int = ROUNDS,
    loss: str = "linear",
) -> Minimum:
    """Minimise the sum of the squares of residuals within bounds.

    SciPy's method "trf" takes the distance of the start from the origin as the first radius of its
    trust region.  Here parameters are counted from the start, in their units, with an offset of the
    wanted length.  A point at which the residuals cannot be computed shrinks the region.

    Parameters
    ----------
    residuals : callable
        Residuals, shape (n,), at parameters of shape (p,).  It may raise
        :class:`~bfsensor.errors.ConvergenceError` anywhere but at the start.
    slopes : callable
        Derivatives of the residuals by the parameters, shape (n, p).
    start : array_like, shape (p,)
        First point, within the bounds.
    low, high : array_like, shape (p,) or ()
        Bounds; parameters with equal bounds, or without influence at the start, stay.
    units : array_like, shape (p,), optional
        Unit of each parameter in which the trust region is a sphere; by default the standard errors
        of residuals of unit variance, updated as the fit goes.
    radius : float
        First radius of the trust region [units].
    relative, still : float
        The fit ends where a step lowers the sum of squares by less than the part ``relative``, or
        is shorter than the part ``still`` of the first radius.
    evaluations : int
        Largest number of points.
    loss : str
        Loss of :func:`scipy.optimize.least_squares`, such as 'soft_l1', for residuals with outliers.

    Returns
    -------
    minimum : Minimum
        The best point, and whether it is a minimum.

    Raises
    ------
    ConvergenceError
        The residuals cannot be computed at the start.

    References
    ----------
    Branch, Coleman & Li 1999, SIAM J. Sci. Comput. 21, 1 (trust region with bounds).

    Examples
    --------
    The height and the width of a profile that was measured at five points:

    >>> x = np.arange(5.0)
    >>> def left(p):
    ...     return p[0] * np.exp(-x / p[1]) - 3.0 * np.exp(-x / 2.0)
    >>> def turned(p):
    ...     form = np.exp(-x / p[1])
    ...     return np.stack([form, p[0] * form * x / p[1] ** 2], axis=1)
    >>> found = minimise(left, turned, [1.0, 1.0], low=[0.0, 0.1], still=1e-12)
    >>> found.values.round(6), found.converged
    (array([3., 2.]), True)
    """
    first = np.array(start, float)
    ends = [np.array(np.broadcast_to(end, first.shape)) for end in (low, high)]
    begun, here = residuals(first), slopes(first)
    free = np.flatnonzero((ends[0] < ends[1]) & here.any(0))
    if not len(free):
        return Minimum(first, True, False, float(begun @ begun))
    unit = (
        1 / np.sqrt((here[:, free] ** 2).sum(0))
        if units is None
        else np.broadcast_to(np.asarray(units, float), first.shape)[free]
    )
    offset = radius / np.sqrt(len(free))
    origin = np.full(len(free), offset)

    def at(x: FloatArray) -> FloatArray:
        point = first.copy()
        point[free] += (x - offset) * unit
        return np.asarray(np.clip(point, *ends))

    def left(x: FloatArray) -> FloatArray:
        if np.array_equal(x, origin):
            return begun
        try:
            return residuals(at(x))
        except ConvergenceError:
            return np.full(len(begun), np.nan)

    def turned(x: FloatArray) -> FloatArray:
        there = here if np.array_equal(x, origin) else slopes(at(x))
        return there[:, free] * unit

    found = least_squares(
        left, origin, turned,
        bounds=[(end - first)[free] / unit + offset for end in ends],
        x_scale="jac" if units is None else 1.0,
        ftol=relative, xtol=still, gtol=None, max_nfev=evaluations, loss=loss,
    )  # fmt: skip
    values = at(found.x)
    for side, end in zip((-1, 1), ends, strict=True):
        stopped = free[found.active_mask == side]
        values[stopped] = end[stopped]
    return Minimum(values, found.status > 0, found.status == SHRUNK, 2 * float(found.cost))
