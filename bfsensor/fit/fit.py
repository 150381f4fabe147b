"""Fit a device: priors, data and an emulator to a result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bfsensor.device import Device
from bfsensor.errors import FitError
from bfsensor.fit.changing import fitted_device
from bfsensor.fit.data import UNITS, DataSet
from bfsensor.fit.predictors import Emulator, Prediction, Tangents, make_predictors
from bfsensor.fit.quantities import DIFFUSION, Prior
from bfsensor.fit.result import FitResult, FittedSet
from bfsensor.fit.solve import FEWEST, Problem, Solution, profile, solve
from bfsensor.fit.ties import combinations, find_ties

FAR = 3.0
"""Spreads of its prior from which a fitted parameter is remarked upon."""


ROUNDS = 10
SETTLED = 0.1
"""Largest change of a prediction by another fine solution where the fit ended [scaled error]."""

Values = NDArray[np.float64]


def fit_device(
    device: Device,
    sets: Sequence[DataSet],
    priors: Sequence[Prior],
    emulator: Emulator | None,
    *,
    refine: Callable[[Values], Emulator] | None = None,
    tangents: Mapping[str, Tangents] | None = None,
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
    refine : callable, optional
        What gives an emulator that is right at values of the parameters
        (:class:`~bfsensor.fit.finer.Refiner`): the fit is repeated until it is right where it
        ends, with the derivatives of ``emulator``.
    tangents : mapping, optional
        What predicts saturation and diffusion
        (:func:`~bfsensor.fit.tangents.make_tangents`).
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
    ConvergenceError
        The fit does not settle.
    """
    unknown = [name for name in profiles if name not in [prior.name for prior in priors]]
    if unknown:
        raise FitError(
            f"{unknown[0]} is not free, and has no profile; free are "
            f"{', '.join(prior.name for prior in priors)}"
        )
    problem = Problem(
        tuple(priors), tuple(sets), make_predictors(sets, emulator, priors, tangents)
    )
    settling: list[str] = []
    if refine is None:
        before, found = problem.predict(problem.means), solve(problem)
    else:
        problem, found, before, settling = _settle(problem, refine)
    names = tuple(prior.name for prior in priors)
    ties, silent = find_ties(names, found.sensitivity)
    known = combinations(found.sensitivity)
    result = FitResult(
        device=device.to_toml(),
        fitted_device=fitted_device(
            device, priors, found.values, np.sqrt(np.diag(found.covariance)), source
        ).to_toml(),
        parameters=names, prior=problem.means, spread=problem.spreads, value=found.values,
        covariance=found.covariance, sets=_sets(problem, found, before),
        remains=np.array([one.remains for one in known]),
        weights=np.array([one.weights for one in known]),
        ties=ties, silent=silent,
        profiles={name: profile(problem, found, name) for name in profiles},
    )  # fmt: skip
    told = [
        *(note for data in sets for note in data.notes),
        *_remarks(result, priors),
        *settling,
        *notes,
    ]
    fields = {f: getattr(result, f) for f in result.__dataclass_fields__}
    return FitResult(**(fields | {"notes": tuple(dict.fromkeys(told))}))


def _settle(
    problem: Problem, refine: Callable[[Values], Emulator]
) -> tuple[Problem, Solution, list[Prediction], list[str]]:
    """Fit with an emulator that is right where the last fit ended, until that does not matter.

    Gives the problem and its solution, predictions at the priors' means, and a remark.
    """
    now = _with_emulator(problem, refine(problem.means))
    before = now.predict(now.means)
    found = solve(now)
    history: list[float] = []
    for _ in range(ROUNDS):
        there = _with_emulator(problem, refine(found.values))
        moved = 0.0
        for k, data in enumerate(problem.sets):
            if data.fitted:
                one, other = (p.predictors[k](found.values)[0] for p in (now, there))
                error = found.scales[k] * data.errors
                moved = max(moved, float(np.max(np.abs(other - one) / error)))
        history.append(moved)
        now, found = there, solve(there, start=found.values)
        if moved < SETTLED:
            return now, found, before, [f"settled in {len(history)} fine solutions"]
    return now, found, before, [
        f"not settled: the last fine solution moved predictions by {history[-1]:.1f} scaled errors"
    ]  # fmt: skip


def _with_emulator(problem: Problem, emulator: Emulator) -> Problem:
    """Give the problem with areas and slopes of another emulator."""
    predictors = tuple(
        make_predictors((data,), emulator, problem.priors)[0]
        if data.kind in ("areas", "slopes")
        else old
        for data, old in zip(problem.sets, problem.predictors, strict=True)
    )
    return Problem(problem.priors, problem.sets, predictors)


def _sets(
    problem: Problem, found: Solution, before: Sequence[Prediction]
) -> tuple[FittedSet, ...]:
    """Data beside what is predicted before and after."""
    after = problem.predict(found.values)
    out = []
    for k, data in enumerate(problem.sets):
        value, slope = after[k]
        open_ = np.einsum("np,pq,nq->n", slope, found.covariance, slope)
        dof = len(data.values) - found.determined[k]
        estimated = data.fitted and data.scaled and dof >= FEWEST
        scale = float(found.scales[k])
        first = before[k][0]
        out.append(FittedSet(
            data.name, data.kind, UNITS[data.kind], data.fitted, data.labels, data.places,
            data.values, data.errors, first, value, np.sqrt(np.maximum(open_, 0.0)),
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
