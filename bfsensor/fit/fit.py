"""Fit the parameters of a device to measurements with priors, by Gauss-Newton rounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bfsensor.device.depletion import check_depleted
from bfsensor.device.device import Device
from bfsensor.device.quantities import Prior
from bfsensor.errors import BFSensorError, FitError
from bfsensor.fit.data import UNITS, DataSet
from bfsensor.fit.degeneracies import find_ties, principal
from bfsensor.fit.device_at import device_at, fitted_device
from bfsensor.fit.finer_mesh import Finer, say
from bfsensor.fit.least_squares import (
    FEWEST,
    FitSolution,
    LeastSquaresProblem,
    profile,
    solve,
)
from bfsensor.fit.posterior import find_posterior
from bfsensor.fit.prediction_error import DRAWS
from bfsensor.fit.predictors import Emulator, Prediction, Tangents, make_predictors
from bfsensor.fit.result import FitResult, FittedSet
from bfsensor.typing import FloatArray

FAR = 3.0
"""Distance of a fitted parameter from the mean of its prior beyond which a note says so [standard
deviations of the prior].

Chosen: 0.3 % of correct priors are as far off; twice as large, only gross conflicts are noted."""

STRAIGHT_PROFILES = "profiles are those of linear predictions: parabolas between the bounds"
"""Note of a fit with profiles whose predictions are linear in the parameters."""

UNSETTLED = (
    "least squares did not converge: values are those of the best point that was found, and errors "
    "are those of linear predictions there"
)
"""Note of a fit whose least squares, or scales of the errors, did not converge."""

ROUNDS = 12
"""Largest number of Gauss-Newton rounds; beyond it the fit is reported as not converged.

Chosen: the two shipped fits take 4 (``tables/*/fit.json``); twice as large, a fit that does not
converge takes twice as long to say so."""

SETTLED = 0.1
"""Largest error of a linear prediction at the end of its step for the fit to count as converged
[scaled error of the number].

Chosen: twice as large, a round fewer is made, and fitted numbers are off by up to 0.2 errors."""

SHORTEST = 0.1
"""Fraction of a full Gauss-Newton step below which a failing step is not halved again.

Chosen: the shortest step is 1/16 of the full one, and it is taken even where the objective grows; at
twice this value it is 1/8."""


def fit_device(
    device: Device,
    sets: Sequence[DataSet],
    priors: Sequence[Prior],
    emulator: Emulator | None,
    *,
    linearise: Callable[[FloatArray], Emulator] | None = None,
    tangents: Mapping[str, Tangents] | None = None,
    solved: Callable[[FloatArray], Emulator] | None = None,
    draws: int = DRAWS,
    progress: Callable[[int, int], None] | None = None,
    profiles: Sequence[str] = (),
    source: str = "fitted by bfsensor",
    notes: Sequence[str] = (),
) -> FitResult:
    """Fit the parameters of a device to measurements, with priors.

    Parameters
    ----------
    device : Device
        Device about which the fit is made; its other parameters keep their values.
    sets : sequence of DataSet
        Measured numbers, at least one set; those with ``fitted=False`` are only predicted.
    priors : sequence of Prior
        Gaussian priors of the free parameters [internal units], at least one.
    emulator : Emulator or None
        Boundary shifts of the device as a function of its parameters, all of which need priors;
        None with ``linearise``, or where no set holds areas or slopes.
    linearise : callable, optional
        Function that solves the device and all derivatives at values of the parameters
        (:class:`~bfsensor.fit.linear_response.Linearise`), in place of ``emulator``.  With a
        :class:`~bfsensor.fit.finer_mesh.Finer` predicted values are those of a finer mesh, which the
        result records.
    tangents : mapping, optional
        Makers of linear predictors of saturation levels and diffusion widths
        (:func:`~bfsensor.fit.linear_predictors.make_tangents`); needed only for such data.
    solved : callable, optional
        Function that solves the device without derivatives at values of all free parameters
        (:class:`~bfsensor.fit.full_solutions.FullSolutions`).  With it the error of the
        predictions, measured at draws from the posterior, is added to the errors of the fit
        (:mod:`bfsensor.fit.prediction_error`); without it a note says that it is not.
    draws : int
        Number of draws from the posterior at which ``solved`` is called; 0: none.
    progress : callable, optional
        Called with (draws solved, draws in all).
    profiles : sequence of str
        Free parameters of which the profile likelihood is computed, by dotted name.
    source : str
        Source that the fitted device file states for its fitted values.
    notes : sequence of str
        Notes to keep with the result.

    Returns
    -------
    result : FitResult
        Fitted parameters with covariance, predictions before and after, and degeneracies.

    Raises
    ------
    FitError
        There is nothing to fit, a kind of data has no predictor, or the fit moves to where the
        device has no solution.
    DeviceError
        The device as given is not fully depleted at a condition of the measurements.

    Notes
    -----
    A fit always ends: one that has not converged is returned at its best point, with a note.

    Examples
    --------
    Areas whose shifts are proportional to one parameter, predicted by the analytic model:

    >>> from bfsensor import Device
    >>> from bfsensor.device.quantities import Prior
    >>> from bfsensor.fit import area_data
    >>> from bfsensor.fit.linear_response import LinearEmulator, LinearResponse
    >>> x = 1e-7 * np.outer([1, 2, 1], [1.0, -2.0, 0.5])
    >>> shifts = LinearResponse(x, x.T, 0.01 * x[None], 0.01 * x.T[None])
    >>> data = area_data("made up", 1.05 * shifts.areas, 1e-10 + 0 * shifts.areas, scaled=False)
    >>> emulator = LinearEmulator(
    ...     ("silicon.thickness",), np.array([100.0]), {data.conditions[0]: shifts})
    >>> prior = Prior("silicon.thickness", 100.0, 10.0)
    >>> result = fit_device(Device.load("itl_sta3800c"), [data], [prior], emulator)
    >>> round(float(result.value[0]), 1)
    105.0
    """
    names = tuple(prior.name for prior in priors)
    _check_profiles(profiles, names)
    for condition in dict.fromkeys(c for data in sets for c in data.conditions):
        check_depleted(device_at(device, condition))
    problem = LeastSquaresProblem(
        tuple(priors),
        tuple(sets),
        make_predictors(sets, emulator, priors, tangents, late=linearise is not None),
    )
    settling: list[str] = []
    if linearise is None:
        before, tangent = problem.predict(problem.means), solve(problem)
    else:
        problem, tangent, before, settling = _settle(problem, linearise)
    asked = solved is not None and {"areas", "slopes"} & {data.kind for data in sets}
    posterior = find_posterior(
        problem, tangent, _exact(problem, solved) if solved is not None and asked else None,
        draws=draws, progress=progress,
    )  # fmt: skip
    found = posterior.solution
    ties, silent = find_ties(names, found.sensitivity)
    known = principal(found.covariance / np.outer(problem.spreads, problem.spreads))
    mesh = linearise.record(found.values) if isinstance(linearise, Finer) else {}
    result = FitResult(
        device=device.to_toml(),
        fitted_device=fitted_device(
            device, priors, found.values, np.sqrt(np.diag(found.covariance)), source
        ).to_toml(),
        parameters=names, prior=problem.means, spread=problem.spreads, value=found.values,
        covariance=found.covariance, sets=_sets(problem, found, before, posterior.left),
        remains=np.array([one.remains for one in known]),
        weights=np.array([one.weights for one in known]),
        ties=ties, silent=silent,
        profiles={name: profile(problem, tangent, name) for name in profiles}, mesh=mesh,
        posterior=posterior.record,
    )  # fmt: skip
    straight = bool(profiles) and not posterior.record["curved"]
    found_out = [
        *(note for data in sets for note in data.notes),
        *_remarks(result, priors),
        posterior.words,
        *([STRAIGHT_PROFILES] if straight else []),
        *settling,
        *([] if tangent.converged else [UNSETTLED]),
        *([say(mesh)] if mesh else []),
        *notes,
    ]
    return replace(result, notes=tuple(dict.fromkeys(found_out)))


def _check_profiles(profiles: Sequence[str], names: Sequence[str]) -> None:
    """Refuse profiles of parameters that are not free."""
    unknown = [name for name in profiles if name not in names]
    if unknown:
        raise FitError(
            f"{unknown[0]} has no profile, as it is not free; free are {', '.join(names)}"
        )


def _settle(
    problem: LeastSquaresProblem, linearise: Callable[[FloatArray], Emulator]
) -> tuple[LeastSquaresProblem, FitSolution, list[Prediction], list[str]]:
    """Gauss-Newton rounds: fit linear predictions, solve the device at the result, fit again.

    A step that raises the objective, or leads to no device, is halved (:data:`SHORTEST`).  Gives the
    problem about the last solution, its solution, predictions at the priors' means, and a note.
    """
    values = problem.means
    now = _with_emulator(problem, linearise(values))
    before = now.predict(values)
    moved = np.inf
    for number in range(1, ROUNDS + 1):
        found = solve(now, start=values)
        step, part, there = found.values, 1.0, None
        highest = _objective(now, values, found.scales) + SETTLED
        while there is None:
            try:
                there = _with_emulator(problem, linearise(step))
                worse = _objective(there, step, found.scales) > highest
            except (BFSensorError, ValueError):
                worse = True
            if worse and part > SHORTEST:
                there, part = None, 0.5 * part
                step = values + part * (found.values - values)
            elif there is None:
                raise FitError(
                    "the fit moves to parameters for which the device has no solution, even at "
                    f"{part:g} of its step: give narrower priors"
                )
        moved = max(
            float(np.max(np.abs(other[0] - one[0]) / (scale * data.errors)))
            for data, one, other, scale in zip(
                problem.sets,
                now.predict(step),
                there.predict(step),
                found.scales,
                strict=True,
            )
            if data.fitted
        )
        values, now = step, there
        if part == 1.0 and moved < SETTLED:
            note = f"settled in {number} rounds of Gauss-Newton"
            return now, solve(now, start=values), before, [note]
    note = (
        f"not converged after {ROUNDS} rounds of Gauss-Newton: the last one moved predictions by "
        f"{moved:.1f} scaled errors"
    )
    return now, solve(now, start=values), before, [note]


def _objective(
    problem: LeastSquaresProblem, values: FloatArray, scales: FloatArray
) -> float:
    """Objective at values of the parameters: chi2 with scaled errors, and that of the priors."""
    total = float(np.sum(((values - problem.means) / problem.spreads) ** 2))
    for data, scale, (found, _) in zip(
        problem.sets, scales, problem.predict(values), strict=True
    ):
        if data.fitted:
            total += float(np.sum(((found - data.values) / (scale * data.errors)) ** 2))
    return total


def _exact(
    problem: LeastSquaresProblem, solved: Callable[[FloatArray], Emulator]
) -> Callable[[FloatArray], list[FloatArray]]:
    """Make a function that predicts all sets from a solution of the device at the values."""
    return lambda values: [
        value for value, _ in _with_emulator(problem, solved(values)).predict(values)
    ]


def _with_emulator(problem: LeastSquaresProblem, emulator: Emulator) -> LeastSquaresProblem:
    """Replace the predictors of areas and slopes by those of another emulator."""
    predictors = tuple(
        make_predictors((data,), emulator, problem.priors)[0]
        if data.kind in ("areas", "slopes")
        else old
        for data, old in zip(problem.sets, problem.predictors, strict=True)
    )
    return LeastSquaresProblem(problem.priors, problem.sets, predictors)


def _sets(
    problem: LeastSquaresProblem,
    found: FitSolution,
    before: Sequence[Prediction],
    left: Sequence[FloatArray],
) -> tuple[FittedSet, ...]:
    """Data sets with their predictions at the priors' means (before) and at the solution."""
    after = problem.predict(found.values)
    out = []
    for k, data in enumerate(problem.sets):
        value = after[k][0]
        dof = len(data.values) - found.determined[k]
        estimated = data.fitted and data.scaled and dof >= FEWEST
        scale = float(found.scales[k])
        first = before[k][0]
        out.append(FittedSet(
            data.name, data.kind, UNITS[data.kind], data.fitted, data.labels, data.places,
            data.values, data.errors, first, value, left[k],
            float(found.chi2[k]), float(np.sum(((first - data.values) / data.errors) ** 2)),
            scale, scale / np.sqrt(2 * dof) if estimated else np.nan,
            float(found.determined[k]),
        ))  # fmt: skip
    return tuple(out)


def _remarks(result: FitResult, priors: Sequence[Prior]) -> list[str]:
    """Notes on parameters far from their priors or at bounds, and on linear predictions."""
    out = []
    for k, prior in enumerate(priors):
        if abs(result.pulls[k]) > FAR:
            out.append(
                f"{prior.name} lies {abs(result.pulls[k]):.1f} standard deviations from the mean of "
                "its prior: prior and data disagree, and predictions are not tested so far from it"
            )
        near = 1e-3 * prior.spread
        if min(result.value[k] - prior.low, prior.high - result.value[k]) < near:
            out.append(
                f"{prior.name} is at a bound, beyond which it has no meaning: its error is too small"
            )
    kinds = {one.kind for one in result.sets}
    if kinds & {"saturation", "diffusion", "depletion"}:
        out.append(
            "saturation levels, diffusion widths and full-depletion voltages are predicted linearly "
            "in the parameters"
        )
    return out
