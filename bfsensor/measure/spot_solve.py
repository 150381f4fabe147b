"""Solver for the shape of a region's spots: start values, median steps, Gauss-Newton steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import ConvergenceError
from bfsensor.measure.spot_model import Shape
from bfsensor.measure.spot_normal import Normal, SpotProblem, Spots, invert
from bfsensor.measure.spots import Stamps
from bfsensor.typing import FloatArray

_LARGEST_STEPS = 60
"""Largest number of Gauss-Newton steps; beyond it the fit is refused as not converged.

Chosen: with twice as many, widths that converge slowly get twice the time; widths that converge
sooner are the same.
"""

_WIDTH_TOLERANCE, _CENTRE_TOLERANCE = 1e-8, 1e-6
"""Steps of the widths and of the centres below which the iteration ends [pixel].

Chosen: a thousandth of the smallest errors in use.  At twice the values the iteration may end a
step earlier, at widths that differ by less than these tolerances.
"""

_APPROACH_STEPS, _APPROACH_TOLERANCE = 25, 1e-4
"""Largest number of median steps, and the step of the widths below which they end [pixel].

Chosen: outliers are judged against this shape by limits of several standard deviations, for which
1e-4 pixel is enough; the shape is fitted again afterwards.  At twice the tolerance the Gauss-Newton
steps start from a rougher shape.
"""


def start(
    stamps: Stamps, background: float | None, correlation: float
) -> tuple[Spots, Shape]:
    """Start values of fluxes, centres and widths, robust against a few bad pixels."""
    data, good = stamps.electrons, stamps.good
    n, ny, nx = data.shape
    rim = np.ones((ny, nx), bool)
    rim[1:-1, 1:-1] = False
    below = np.zeros(n)
    for k in range(n):
        outer = data[k][rim & good[k]]
        below[k] = np.median(outer) if outer.size else 0.0
    if background is not None:
        below[:] = background
    light = np.where(good, data - below[:, None, None], 0.0)
    j, i = ny // 2, nx // 2
    core = light[:, j - 1 : j + 2, i - 1 : i + 2]
    inner = np.maximum(core.sum(axis=(1, 2)), 1.0)
    # The central 3 x 3 pixels hold part of the light, whose centroid is too close to the middle:
    # a factor of 1.6 corrects that for spots of about 1 pixel rms, as a start value.
    x = np.clip(1.6 * (core[:, :, 2] - core[:, :, 0]).sum(axis=1) / inner, -0.5, 0.5)
    y = np.clip(1.6 * (core[:, 2] - core[:, 0]).sum(axis=1) / inner, -0.5, 0.5)
    typical = np.median(light / inner[:, None, None], axis=0)
    total = max(float(typical.sum()), 1e-3)
    widths = []
    for axis, size, centre in ((0, nx, x), (1, ny, y)):
        place = np.arange(size) - size // 2
        spread = float(typical.sum(axis=axis) @ place**2) / total - np.mean(centre**2)
        # Integration over the pixel has added the variance 1/12.
        widths.append(float(np.sqrt(np.clip(spread - 1 / 12, 0.2, (size / 4) ** 2))))
    flux = np.maximum(light.sum(axis=(1, 2)), inner)
    return Spots(flux, x, y, below), Shape(widths[0], widths[1], correlation)


def approach(
    problem: SpotProblem,
    spots: Spots,
    shape: Shape,
    used: NDArray[np.bool_],
    largest_offset: float,
) -> Shape:
    """Find a robust shape by steps that are the median of each spot's own step.

    A spot with a hundred times the light of the others in one pixel would dominate a common fit
    and make the good spots look bad; it does not affect the median.
    """
    for _ in range(_APPROACH_STEPS):
        normal = problem.linearise(spots, problem.derivatives(spots, shape))
        alone = np.einsum("nij,nj->ni", invert(normal.rest[used]), normal.score[used])
        step = np.median(alone, axis=0)
        shape, _ = _move(problem, spots, shape, normal, step, largest_offset)
        shape = Shape(
            float(np.clip(shape.sigma_x, 0.2, problem.nx / 2)),
            float(np.clip(shape.sigma_y, 0.2, problem.ny / 2)),
            shape.correlation,
        )
        if np.max(np.abs(step)) < _APPROACH_TOLERANCE:
            break
    return shape


def solve(
    problem: SpotProblem,
    spots: Spots,
    shape: Shape,
    used: NDArray[np.bool_],
    largest_offset: float,
) -> tuple[Shape, NDArray[np.bool_]]:
    """Fit the shape by Gauss-Newton steps until the centres of the used spots converge.

    Weights follow the model, so that the sum of squares need not fall from step to step and cannot
    control the step size: steps are bounded instead.  The other spots follow the shape.  The
    second return value is the mask of the spots whose centre did not converge.
    """
    history = []
    for _ in range(_LARGEST_STEPS):
        normal = problem.linearise(spots, problem.derivatives(spots, shape))
        step = np.linalg.solve(
            normal.rest[used].sum(axis=0), normal.score[used].sum(axis=0)
        )
        shape, moved = _move(problem, spots, shape, normal, step, largest_offset)
        history.append(float(np.max(np.abs(step))))
        unsettled = ~(moved < _CENTRE_TOLERANCE)
        if history[-1] < _WIDTH_TOLERANCE and not np.any(unsettled & used):
            return shape, unsettled
        if not (0.15 < shape.sigma_x < problem.nx and 0.15 < shape.sigma_y < problem.ny):
            raise ConvergenceError(
                f"the widths went to {shape.sigma_x:.3g} x {shape.sigma_y:.3g} pixel in "
                f"stamps of {problem.nx} x {problem.ny}: are there spots in the stamps, and is "
                "the stamp 8 sigma wide?",
                history,
            )
    if not np.any(unsettled & used):
        raise ConvergenceError(
            f"the widths still moved by {history[-1]:.2g} pixel after "
            f"{_LARGEST_STEPS} steps",
            history,
        )
    return shape, unsettled


def _move(
    problem: SpotProblem,
    spots: Spots,
    shape: Shape,
    normal: Normal,
    step: FloatArray,
    largest_offset: float,
) -> tuple[Shape, FloatArray]:
    """Apply a step to the shape and to the spots; gives also the move of each centre [pixel]."""
    largest = 0.2 * min(shape.sigma_x, shape.sigma_y)
    step = np.clip(step, -largest, largest)
    own = np.einsum(
        "nab,nb->na", normal.own_inverse, normal.own_score - normal.cross @ step
    )
    bound = largest_offset + 0.5
    before = spots.x.copy(), spots.y.copy()
    spots.flux[...] += own[:, 0]
    spots.x[...] = np.clip(spots.x + np.clip(own[:, 1], -0.3, 0.3), -bound, bound)
    spots.y[...] = np.clip(spots.y + np.clip(own[:, 2], -0.3, 0.3), -bound, bound)
    if problem.own == 4:
        spots.background[...] += own[:, 3]
    correlation = shape.correlation
    if problem.shared == 3:
        # Kept below LARGEST_CORRELATION; spots on a CCD have far smaller ones.
        correlation = float(np.clip(correlation + step[2], -0.75, 0.75))
    moved = np.maximum(np.abs(spots.x - before[0]), np.abs(spots.y - before[1]))
    return Shape(shape.sigma_x + step[0], shape.sigma_y + step[1], correlation), moved
