r"""The forward model of a region's spots: one shape, and each spot's own flux and centre.

The normal equations are those of :mod:`bfsensor.measure.spot_normal`, solved in
:mod:`bfsensor.measure.spot_solve`; here spots that do not belong are dropped, and errors and
the bias of noise are found.
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
# Of chi2 per pixel: a thousandth of the noise, which the tolerances of centres leave as well.
_LEAST_MISFIT = 1e-6


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

    is compared with every pixel, whose variance is the model's own signal plus the read
    noise squared.  The widths are those before the pixels integrate.

    Parameters
    ----------
    stamps : Stamps
        Spots of a region in which the shape may be called one; at least one.
    read_noise : float
        Rms of each pixel beside its Poisson noise [e-]; not used where the stamps bring
        variances.
    weights : {'noise', 'equal'}
        Of the pixels.  'noise', the inverse variance, has the smallest errors for Gaussian
        spots.  Of any other profile it gives a width that moves with the peak, for the
        wings count for more as they rise above the background: a slope without any effect.
        'equal', as published, gives the same width at every peak, with errors larger by a
        half: **take it for B-F slopes** unless chi2 says that the spots are Gaussian.
    background : float, optional
        Signal below the spots [e-], the same for all; by default one free number for
        each spot, which costs little in stamps of 4 sigma and follows gradients.
    correlation : float or None
        Of x and y in the spots, -0.8 to 0.8; 0, axes along the pixels, for the fields of
        a CCD do not tilt a spot.  None: free.
    largest_offset : float
        A spot with its centre further from the middle of its central pixel, in x or in y,
        is dropped [pixel].
    limit : float
        A spot is dropped if its residuals, or its own widths, differ from those of the
        region's other spots by more than this many standard deviations (the larger of
        what noise gives and of 1.48 median deviations).
    correct_bias : bool
        Noise in the centres makes spots look narrower, by :math:`\sigma / 2f` without
        background.  That is small, but the same for all spots, while the error falls with
        their number; the term is computed to first order (Box 1971) and taken out.

    Returns
    -------
    SpotFit
        Shape with errors, and every spot with its status.

    Raises
    ------
    MeasurementError
        An argument outside its range, or fewer than half of the spots are left.
    ConvergenceError
        The shape did not settle.

    Notes
    -----
    Weights by noise follow the model, not the data: that is the maximum of the likelihood for
    Poisson noise alone, and nearly so with read noise.  The boundaries that the brighter-fatter
    effect moves also lower the variance near the peak and correlate neighbours; that is not
    counted (in flats it is about 5 % of the variance at 50,000 e-).  The errors by scatter
    between spots hold in any case.

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
    # Why each spot was dropped last; a spot may come back if a worse one made it look bad,
    # but not once sets begin to take turns.
    last = np.full(len(stamps), "masked", dtype="<U8")
    closed = False
    for count in range(_ROUNDS):
        # First beside the shape that most spots ask for, then beside the fitted one.
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
            f"which of {len(stamps)} spots to use did not settle in {_ROUNDS} rounds",
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
    """Spots with a bad pixel about the centre or with hardly more pixels than parameters."""
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
    """Status of every spot beside the shape that the used ones have."""
    dof = np.maximum(problem.good.sum(axis=1) - problem.own, 1)
    reduced = normal.chi2 / dof
    typical = float(np.median(reduced[used]))
    deviation = 1.4826 * float(np.median(np.abs(reduced[used] - typical)))
    noise = typical * np.sqrt(2 / dof)
    uneven = np.abs(reduced - typical) > limit * np.maximum(deviation, noise)
    # A good fit is no fault, and what rounding leaves of noiseless spots is a good fit.
    uneven &= reduced > typical + _LEAST_MISFIT
    # What the widths would be if this spot alone decided.
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
    # Scores sum to zero over the spots: n - 1 are independent.
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
    """What to add to the widths for the curvature of the model in the noisy centres.

    The covariance of a spot's own parameters times the second derivatives of its model is
    a mean residual; half of it, fitted, is the bias with its sign turned.  Unless weights
    are the inverse variances, the derivatives at the noisy centres also correlate with
    what is left of the noise; that mean score is a bias as it stands.
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
    """Mean score of each spot from derivatives that its noise has changed, (n, own + shared)."""
    model = spots.flux[:, None] * slopes[0] + spots.background[:, None]
    jacobian = problem.jacobian(spots.flux, slopes)
    own = slice(0, problem.own)
    # Covariance of flux and centre with the residuals.
    with_noise = normal.own_inverse @ normal.weighted[:, own]
    with_noise *= problem.variance(model)[:, None]
    left = with_noise - normal.own_covariance @ jacobian[:, own]
    left *= problem.good[:, None]
    by_flux = problem.jacobian(np.ones(len(model)), slopes)
    # The flux itself and the background enter as they are.
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
