"""Fit of the a-matrix to simulated flats with the brighter-fatter effect and without it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from bfsensor.errors import MeasurementError
from bfsensor.typing import FloatArray


def measure_response(on: ArrayLike, off: ArrayLike) -> FloatArray:
    r"""Fit the a-matrix that moved the charge of a simulated flat.

    In a step that brings :math:`n` electrons a pixel, the pixel at :math:`x` gains
    :math:`m(x) = n \sum_d a_d\, q(x - d)` from its neighbours, with :math:`q` the charge of the
    middle of the step less its mean.  All steps are fitted together by least squares, mirrored
    lags as one.  Steps count by the variance of their charge, hence by their level, as they do
    in the covariance of the whole flat, which is :math:`2 \int a(\mu)\, \mu\, d\mu` in first
    order: but the shot noise of the flat, which governs the error of a covariance, drops out.

    Parameters
    ----------
    on, off : array_like, shape (steps, ny, nx)
        Electrons collected up to the end of each step, as periodic images [e-]; ``off`` from
        the same light with equal pixels.

    Returns
    -------
    a : ndarray, shape (ny // 2 + 1, nx // 2 + 1)
        ``a[j, i]`` is the fraction of its area that the pixel at the lag i in x and j in y gains
        for an electron [1/e-], all periods of the array summed; those of all pixels sum to 0.

    Raises
    ------
    MeasurementError
        The arrays do not match, or are not finite.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> off = np.cumsum(rng.poisson(1e4, (4, 9, 9)), axis=0).astype(float)
    >>> on, gained = off.copy(), np.zeros((9, 9))
    >>> for k in range(4):
    ...     before, came = (on[k - 1], off[k] - off[k - 1]) if k else (gained, off[0])
    ...     held = before + 0.5 * came
    ...     gained = gained + came.mean() * 1e-6 * (
    ...         np.roll(held, 1, 0) + np.roll(held, -1, 0) - 2 * held
    ...     )
    ...     on[k] = off[k] + gained
    >>> a = measure_response(on, off)
    >>> print(f"{a[0, 0]:.2e} {a[1, 0]:.2e} {bool(abs(a[0, 1]) < 1e-15)}")
    -2.00e-06 1.00e-06 True
    """
    images, plain = np.asarray(on, float), np.asarray(off, float)
    if images.shape != plain.shape or images.ndim != 3 or min(images.shape) < 1:
        raise MeasurementError(
            f"flats of the shapes {images.shape} and {plain.shape} must both be (steps, ny, nx)"
        )
    if not (np.all(np.isfinite(images)) and np.all(np.isfinite(plain))):
        raise MeasurementError("flats hold values that are not finite")
    came = np.diff(plain, axis=0, prepend=0.0)
    moved = np.diff(images - plain, axis=0, prepend=0.0)
    held = np.concatenate([np.zeros_like(images[:1]), images[:-1]]) + 0.5 * came
    held -= held.mean((1, 2), keepdims=True)
    step = came.mean((1, 2), keepdims=True)
    _, ny, nx = images.shape
    lags = [(j, i) for j in range(ny // 2 + 1) for i in range(nx // 2 + 1)]
    columns = []
    for j, i in lags:
        shifts = sorted({(v % ny, u % nx) for v in (j, -j) for u in (i, -i)})
        total = sum(np.roll(held, shift, (1, 2)) for shift in shifts)
        # A charge with mean 0 does not constrain the sum of all lags, which is set to 0: each lag
        # takes from (0, 0) what it gains.
        columns.append((step * (total - len(shifts) * held)).ravel())
    # The lag (0, 0) is not fitted: the sum rule gives it.
    design = np.column_stack(columns[1:])
    found = np.linalg.lstsq(design, moved.ravel(), rcond=None)[0]
    a = np.concatenate([[0.0], found]).reshape(ny // 2 + 1, nx // 2 + 1)
    counts = [len({(v % ny, u % nx) for v in (j, -j) for u in (i, -i)}) for j, i in lags]
    a[0, 0] = -float(np.dot(counts[1:], found))
    return a
