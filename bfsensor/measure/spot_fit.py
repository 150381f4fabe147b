r"""Fit of a region's spots by a forward model: one shape, and each spot's own flux and centre.

The normal equations are those of :mod:`bfsensor.measure.spot_normal`, solved in
:mod:`bfsensor.measure.spot_solve`.  This module drops outlying spots, and computes errors and the
bias that noise causes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import ConvergenceError, MeasurementError
from bfsensor.measure.spot_model import Shape, check_shape, curvatures
from bfsensor.measure.spot_normal import Normal, SpotProblem, Spots, invert
from bfsensor.measure.spot_result import SpotFit
from bfsensor.measure.spot_solve import approach, solve, start
from bfsensor.measure.spots import Stamps
from bfsensor.typing import FloatArray

_ROUNDS = 10
"""Largest number of rounds of fitting and dropping spots.

Chosen: beyond it the fit is refused as not converged.  With twice as many, a set of outliers that
still changes in the tenth round would get ten more.
"""

_LEAST_MISFIT = 1e-6
"""Smallest excess of chi-square per pixel for which a spot is dropped.

Derived: residuals of a thousandth of the noise give (1e-3)^2; the tolerances of centres and
rounding leave as much in spots without noise.
"""


def fit_spots(
    stamps: Stamps,
    *,
    read_noise: float = 0.0,
    weights: str = "noise",
    background: float | None = None,
    correlation: float | None = 0.0,
    largest_offset: float = 1.0,
    limit: float = 6.0,
    correct_bias: bool = True,
) -> SpotFit:
    r"""Fit one Gaussian shape to all spots of a region, with each spot's flux and centre.

    .. math::
        m_n(\mathrm{pixel}) = f_n \int_\mathrm{pixel}
            \mathcal N(\mathbf r - \mathbf r_n; \sigma_x, \sigma_y, \rho)\, d^2 r + b_n

    is fitted to every pixel, whose variance is the model's own signal plus the read noise
    squared.  The widths are those before the integration over pixels.

    Parameters
    ----------
    stamps : Stamps
        Spots of a region in which all have the same shape; at least one.
    read_noise : float
        Rms noise of each pixel besides its Poisson noise [e-], 0 or more; not used where the
        stamps have variances.
    weights : {'noise', 'equal'}
        Weights of the pixels.  'noise', the inverse variance, has the smallest errors for
        Gaussian spots.  For any other profile it gives a width that changes with the peak,
        because the wings gain weight as they rise above the background: a slope without any
        effect.  'equal', as published, gives the same width at every peak, with errors larger by
        a half: **choose it for B-F slopes** unless chi-square shows that the spots are Gaussian.
    background : float, optional
        Signal below the spots [e-], the same for all; by default a free parameter of each spot,
        which costs little in stamps of 4 sigma and follows gradients.
    correlation : float or None
        Correlation of x and y in the spots, -0.8 to 0.8.  The default 0 has the axes along the
        pixels, because the fields of a CCD do not tilt a spot.  None fits it.
    largest_offset : float
        Largest distance of a spot's centre from the middle of its central pixel in x or in y
        [pixel]; beyond it the spot is dropped.
    limit : float
        Largest deviation of a spot's residuals, or of its own widths, from those of the
        region's other spots [standard deviations]; beyond it the spot is dropped.  The standard
        deviation is the larger of that of noise and of 1.48 median deviations.
    correct_bias : bool
        Add the mean amount by which noise in the centres makes spots look narrower,
        :math:`\sigma / 2f` without background, to first order (Box 1971).  It is small but the
        same for all spots, while the error falls with their number.

    Returns
    -------
    fit : SpotFit
        Shape with errors, and every spot with its status.

    Raises
    ------
    MeasurementError
        An argument is out of range, or fewer than half of the spots are left.
    ConvergenceError
        The shape, or the set of used spots, did not settle.

    Notes
    -----
    The variances of the weights are the model's, not the data's: this maximises the likelihood
    for Poisson noise alone, and nearly so with read noise.  The brighter-fatter effect also lowers
    the variance near the peak and correlates neighbours, which is neglected here (in flats it is
    about 5 % of the variance at 50,000 e-).  The errors by scatter between spots hold in any case.

    References
    ----------
    Lage, Bradshaw & Tyson 2017, section 2.1 (there unweighted, centres from first moments).
    Box 1971, J. R. Stat. Soc. B 33, 171.

    Examples
    --------
    >>> from bfsensor.measure.spot_model import integrate_gaussian
    >>> rng = np.random.default_rng(611)
    >>> x, y = rng.uniform(-0.5, 0.5, (2, 200))
    >>> spots = 1e5 * integrate_gaussian(x, y, Shape(1.02, 1.05), 9) + 50.0
    >>> fit = fit_spots(Stamps(rng.poisson(spots)))
    >>> print(f"{fit.sigma_x:.3f} {fit.sigma_y:.3f} {fit.sigma_x_error:.4f}")
    1.020 1.050 0.0002
    """
    _check(read_noise, background, correlation, largest_offset, limit)
    if weights not in ("noise", "equal"):
        raise MeasurementError(f"weights = {weights!r} must be 'noise' or 'equal'")
    problem = SpotProblem(
        stamps,
        read_noise,
        equal_weights=weights == "equal",
        free_background=background is None,
        free_tilt=correlation is None,
    )
    spots, shape = start(stamps, background, correlation or 0.0)
    never = _masked(problem)
    _check_enough(~never, never)
    shape = approach(problem, spots, shape, ~never, largest_offset)
    used, wild = ~never, np.zeros(len(stamps), bool)
    seen: list[NDArray[np.bool_]] = []
    # ``last`` holds the reason for which each spot was dropped last.  A spot may be used again if
    # a worse one made it look bad; once a set of used spots occurs again, ``closed`` ends that.
    last = np.full(len(stamps), "masked", dtype="<U8")
    closed = False
    for count in range(_ROUNDS):
        # Spots are judged against the median shape first, then against the fitted one.
        if count:
            shape, wild = solve(problem, spots, shape, used, largest_offset)
        normal = problem.linearise(
            spots, problem.derivatives(spots, shape), with_noise=True
        )
        status = _judge(problem, spots, normal, used, never, wild, largest_offset, limit)
        last = np.where(status == "used", last, status)
        if closed:
            status = np.where(used, status, last)
        again = status == "used"
        if count and np.array_equal(again, used):
            break
        closed |= any(np.array_equal(again, before) for before in seen)
        seen.append(used)
        used = again & used if closed else again
        _check_enough(used, never)
    else:
        raise ConvergenceError(
            f"the choice of outliers among {len(stamps)} spots did not settle in {_ROUNDS} "
            "rounds; raise limit, or leave doubtful spots out",
            [int(np.sum(one)) for one in seen],
        )
    return _finish(problem, spots, shape, normal, status, correct_bias)


def _check(
    read_noise: float,
    background: float | None,
    correlation: float | None,
    largest_offset: float,
    limit: float,
) -> None:
    if not (read_noise >= 0 and np.isfinite(read_noise)):
        raise MeasurementError(f"read_noise = {read_noise} e- must be 0 e- or more")
    if background is not None and not np.isfinite(background):
        raise MeasurementError(f"background = {background} e- must be finite")
    if correlation is not None:
        check_shape(Shape(1.0, 1.0, correlation))
    if not largest_offset > 0:
        raise MeasurementError(f"largest_offset = {largest_offset} pixel must be above 0")
    if not limit > 0:
        raise MeasurementError(f"limit = {limit} must be above 0 standard deviations")


def _check_enough(used: NDArray[np.bool_], never: NDArray[np.bool_]) -> None:
    possible = int(np.sum(~never))
    if np.sum(used) * 2 < possible or not np.any(used):
        raise MeasurementError(
            f"only {int(np.sum(used))} of {len(used)} spots agree with one Gaussian shape "
            f"({int(np.sum(never))} have too few good pixels); at least half must"
        )


def _masked(problem: SpotProblem) -> NDArray[np.bool_]:
    """Mask of spots with a bad pixel in the central 3 x 3, or with few pixels for a fit."""
    good = problem.stamps.good
    j, i = problem.ny // 2, problem.nx // 2
    core = good[:, j - 1 : j + 2, i - 1 : i + 2].all(axis=(1, 2))
    enough = problem.good.sum(axis=1) >= 2 * (problem.own + problem.shared)
    return ~(core & enough)


def _judge(
    problem: SpotProblem,
    spots: Spots,
    normal: Normal,
    used: NDArray[np.bool_],
    never: NDArray[np.bool_],
    wild: NDArray[np.bool_],
    largest_offset: float,
    limit: float,
) -> NDArray[np.str_]:
    """Status of every spot by its deviation from the shape of the used ones."""
    dof = np.maximum(problem.good.sum(axis=1) - problem.own, 1)
    reduced = normal.chi2 / dof
    typical = float(np.median(reduced[used]))
    deviation = 1.4826 * float(np.median(np.abs(reduced[used] - typical)))
    noise = typical * np.sqrt(2 / dof)
    uneven = np.abs(reduced - typical) > limit * np.maximum(deviation, noise)
    # A chi-square that is too small is no reason to drop a spot, nor are rounding errors.
    uneven &= reduced > typical + _LEAST_MISFIT
    # The step of the widths that each spot alone would take, over its standard error.
    inverse = invert(normal.rest)
    alone = np.einsum("nij,nj->ni", inverse, normal.score)
    variance = np.einsum("nij,njk,nki->ni", inverse, normal.score_variance, inverse)
    pulls = alone / np.sqrt(np.maximum(variance, 1e-300))
    middle = np.median(pulls[used], axis=0)
    spread = 1.4826 * np.median(np.abs(pulls[used] - middle), axis=0)
    odd = np.any(np.abs(pulls - middle) > limit * np.maximum(spread, 1.0), axis=1)
    error = np.sqrt(np.maximum(normal.own_covariance[:, 0, 0], 0.0))
    far = np.maximum(np.abs(spots.x), np.abs(spots.y)) > largest_offset
    status = np.full(len(spots.x), "used", dtype="<U8")
    reasons = {
        "masked": never,
        "faint": ~(spots.flux > 5 * error),
        "centre": far,
        "chi2": uneven,
        "width": odd,
        "diverged": wild,
    }
    for reason, holds in reversed(reasons.items()):
        status[holds] = reason
    return status


def _finish(
    problem: SpotProblem,
    spots: Spots,
    shape: Shape,
    normal: Normal,
    status: NDArray[np.str_],
    correct_bias: bool,
) -> SpotFit:
    """Errors, bias and the result."""
    used = status == "used"
    n, shared = int(np.sum(used)), problem.shared
    inverse = np.linalg.inv(normal.rest[used].sum(axis=0))
    score = normal.score[used]
    # At the minimum the scores of the spots add up to 0: n - 1 are independent.
    spread = score.T @ score * (n / (n - 1)) if n > 1 else np.full((shared, shared), np.nan)
    covariances = []
    for scores in (normal.score_variance[used].sum(axis=0), spread):
        whole = np.zeros((3, 3))
        whole[:shared, :shared] = inverse @ scores @ inverse
        covariances.append(whole)
    bias = _bias(problem, spots, shape, normal, used) if correct_bias else np.zeros(2)
    errors = np.sqrt(np.maximum(np.einsum("naa->na", normal.own_covariance), 0.0))
    pixels = problem.good.sum(axis=1)
    return SpotFit(
        sigma_x=float(shape.sigma_x + bias[0]),
        sigma_y=float(shape.sigma_y + bias[1]),
        correlation=float(shape.correlation),
        covariance=covariances[0],
        scatter_covariance=covariances[1],
        bias_x=float(bias[0]),
        bias_y=float(bias[1]),
        chi2=float(normal.chi2[used].sum()),
        dof=int(pixels[used].sum() - n * problem.own - shared),
        read_noise=float("nan") if problem.known is not None else float(problem.read_noise),
        weights="equal" if problem.equal_weights else "noise",
        x=problem.stamps.x,
        y=problem.stamps.y,
        centre_x=spots.x,
        centre_y=spots.y,
        centre_x_error=errors[:, 1],
        centre_y_error=errors[:, 2],
        flux=spots.flux,
        flux_error=errors[:, 0],
        background=spots.background,
        background_error=errors[:, 3] if problem.own == 4 else np.zeros(len(errors)),
        spot_chi2=normal.chi2,
        spot_dof=pixels - problem.own,
        status=status,
    )


def _bias(
    problem: SpotProblem,
    spots: Spots,
    shape: Shape,
    normal: Normal,
    used: NDArray[np.bool_],
) -> FloatArray:
    """Correction of the widths for the curvature of the model in the noisy centres.

    The covariance of a spot's own parameters times the second derivatives of its model is a
    mean residual.  A fit to half of it is the bias with the opposite sign, hence the correction.
    Unless the weights are inverse variances, the derivatives at the noisy centres are also
    correlated with the residual noise, whose mean score is a bias and is subtracted.
    """
    slopes = problem.derivatives(spots, shape)
    by_xx, by_yy, by_xy = curvatures(slopes, shape)
    own = normal.own_covariance[:, :, :, None]
    curved = 2 * (own[:, 0, 1] * slopes[1] + own[:, 0, 2] * slopes[2])
    curved += spots.flux[:, None] * (
        own[:, 1, 1] * by_xx + own[:, 2, 2] * by_yy + 2 * own[:, 1, 2] * by_xy
    )
    scores = np.einsum("nap,np->na", normal.weighted, 0.5 * curved)
    if problem.equal_weights:
        scores -= _noisy_derivatives(problem, spots, shape, normal, slopes)
    shift = np.einsum("nab,nb->na", normal.own_inverse, scores[:, : problem.own])
    score = scores[:, problem.own :] - np.einsum("nai,na->ni", normal.cross, shift)
    step = np.linalg.solve(normal.rest[used].sum(axis=0), score[used].sum(axis=0))
    return np.asarray(step[:2])


def _noisy_derivatives(
    problem: SpotProblem,
    spots: Spots,
    shape: Shape,
    normal: Normal,
    slopes: FloatArray,
) -> FloatArray:
    """Mean score of each spot by derivatives that vary with its noise, shape (n, own + shared)."""
    model = spots.flux[:, None] * slopes[0] + spots.background[:, None]
    jacobian = problem.jacobian(spots.flux, slopes)
    own = slice(0, problem.own)
    # Covariance of flux and centre with the residuals.
    with_noise = normal.own_inverse @ normal.weighted[:, own]
    with_noise *= problem.variance(model)[:, None]
    left = with_noise - normal.own_covariance @ jacobian[:, own]
    left *= problem.good[:, None]
    by_flux = problem.jacobian(np.ones(len(model)), slopes)
    # The model is linear in flux and background: their derivatives do not depend on the flux.
    by_flux[:, [0, *range(3, problem.own)]] = 0.0
    scores = np.einsum("nkp,np->nk", by_flux, left[:, 0])
    step = 1e-4
    for k, (dx, dy) in enumerate(((step, 0.0), (0.0, step)), 1):
        ends = [
            problem.jacobian(
                spots.flux,
                problem.derivatives(
                    spots._replace(x=spots.x + sign * dx, y=spots.y + sign * dy), shape
                ),
            )
            for sign in (1, -1)
        ]
        by_centre = (ends[0] - ends[1]) / (2 * step)
        scores += np.einsum("nkp,np->nk", by_centre, left[:, k])
    return np.asarray(scores)
