"""Fit a device: priors, data and an emulator to a result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bfsensor.device.depletion import check_depleted
from bfsensor.device.device import Device
from bfsensor.device.quantities import DIFFUSION, Prior
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
"""Spreads of its prior from which a fitted parameter is remarked upon."""

STRAIGHT_PROFILES = (
    "profiles are those of predictions straight in the parameters: parabolas within bounds"
)

ROUNDS = 12
SETTLED = 0.1
"""Largest miss of a prediction by the tangent of the round before [scaled error]."""

SHORTEST = 0.1
"""Of steps, relative to that of the tangent."""


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
        Where the fit begins; what is not free stays.
    sets : sequence of DataSet
        Measured numbers; those with ``fitted=False`` are only predicted.
    priors : sequence of Prior
        Of the free parameters.
    emulator : Emulator or None
        Response of the device by its parameters; they must be among the priors.
    linearise : callable, optional
        What solves the device at values of its parameters with all derivatives
        (:class:`~bfsensor.fit.linear_response.Linearise`), in place of ``emulator``; a
        :class:`~bfsensor.fit.finer_mesh.Finer` for the values of a finer mesh, which the result tells.
    tangents : mapping, optional
        What predicts saturation and diffusion
        (:func:`~bfsensor.fit.linear_predictors.make_tangents`).
    solved : callable, optional
        What solves the device at values of all free parameters without derivatives
        (:class:`~bfsensor.fit.full_solutions.FullSolutions`): what predictions miss over the
        posterior then counts in its errors (:mod:`bfsensor.fit.prediction_error`); by default a
        note says that it does not.
    draws : int
        From the posterior, at which the device is solved.
    progress : callable, optional
        Called with (solved, draws).
    profiles : sequence of str
        Parameters whose profile likelihood is wanted.
    source : str
        What is written into the fitted device file.
    notes : sequence of str
        To be kept with the result.

    Returns
    -------
    FitResult

    Raises
    ------
    FitError
        Nothing to fit, or nothing that predicts it.
    DeviceError
        The device as given is not fully depleted at a condition of the measurements.
    ConvergenceError
        The fit does not settle.
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
        *([say(mesh)] if mesh else []),
        *notes,
    ]
    return replace(result, notes=tuple(dict.fromkeys(found_out)))


def _check_profiles(profiles: Sequence[str], names: Sequence[str]) -> None:
    """Refuse profiles of parameters that are not free."""
    unknown = [name for name in profiles if name not in names]
    if unknown:
        raise FitError(
            f"{unknown[0]} is not free, and has no profile; free are {', '.join(names)}"
        )


def _settle(
    problem: LeastSquaresProblem, linearise: Callable[[FloatArray], Emulator]
) -> tuple[LeastSquaresProblem, FitSolution, list[Prediction], list[str]]:
    """Gauss and Newton: fit, solve the device where the fit ends, fit again.

    Steps that raise what is minimised, or lead to no device, are halved.  Gives the problem and its
    solution, predictions at the priors' means, and a remark.
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
                raise FitError("the fit leads to where the device has no solution")
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
            told = f"settled in {number} rounds of Gauss and Newton"
            return now, solve(now, start=values), before, [told]
    told = f"not settled: the last solution moved predictions by {moved:.1f} scaled errors"
    return now, solve(now, start=values), before, [told]


def _objective(
    problem: LeastSquaresProblem, values: FloatArray, scales: FloatArray
) -> float:
    """What is minimised, at given scales of the errors."""
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
    """Predictions of all sets from a solution at the values."""
    return lambda values: [
        value for value, _ in _with_emulator(problem, solved(values)).predict(values)
    ]


def _with_emulator(problem: LeastSquaresProblem, emulator: Emulator) -> LeastSquaresProblem:
    """Give the problem with areas and slopes of another emulator."""
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
    """Data beside what is predicted before and after."""
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
    """What a reader should know of the solution."""
    out = []
    for k, prior in enumerate(priors):
        if abs(result.pulls[k]) > FAR:
            out.append(
                f"{prior.name} lies {abs(result.pulls[k]):.1f} spreads from its prior: prior and "
                "data do not agree, and the emulator is not proven there"
            )
        near = 1e-3 * prior.spread
        if min(result.value[k] - prior.low, prior.high - result.value[k]) < near:
            out.append(f"{prior.name} is at the end of what can be: its error is too small")
        if prior.name == DIFFUSION:
            out.append(
                "diffusion over Einstein's is no quantity of a device file: not in it"
            )
    kinds = {one.kind for one in result.sets}
    if kinds & {"saturation", "diffusion"}:
        out.append("saturation and widths are straight in the parameters about the device")
    return out
