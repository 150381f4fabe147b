"""Fits of mock a_ij of devices drawn from their priors, and how often the truth is covered."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from tqdm import tqdm

from bfsensor.device.condition import Condition
from bfsensor.device.quantities import Prior, describe
from bfsensor.errors import MeasurementError
from bfsensor.files import written_whole
from bfsensor.fit.data import DataSet, area_data
from bfsensor.fit.degeneracies import find_ties, name_combination, principal
from bfsensor.fit.least_squares import ORDERED, FitSolution, LeastSquaresProblem, solve
from bfsensor.fit.posterior import find_posterior
from bfsensor.fit.prediction_error import Missed
from bfsensor.fit.predictors import Emulator, make_predictors

MEASURED = 0.7
"""Posterior over prior width below which a combination has a row of its own."""

OWN = 3
"""Best combinations of each mock's own that have rows."""

PREDICTED = ((0, 0), (1, 0), (0, 1), (1, 1))
"""Lags whose predicted a_ij are held against the true ones; (0, 0) was not fitted."""

WAYS = ("tangent", "posterior", "draws")

Areas = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(eq=False)
class Mocks:
    """What fits of mocks gave so far, and where the random numbers stand.

    Attributes
    ----------
    rng : dict
        State of the generator of truths and noise.
    pulls, remains : dict of list of ndarray
        Of each way: a mock's (fitted - true) / error and posterior over prior errors, of the
        parameters, of the combinations and of the predictions.
    directions, labels
        Combinations that the first mock measures best.
    """

    rng: dict[str, Any]
    pulls: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    remains: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    scales: list[float] = field(default_factory=list)
    chi2: list[float] = field(default_factory=list)
    told: dict[str, Any] = field(default_factory=dict)
    directions: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    labels: list[str] = field(default_factory=list)
    drawn: int = 0
    seconds: float = 0.0

    def save(self, path: Path) -> None:
        """Write all to a file, whole or not at all."""
        with written_whole(path, MeasurementError) as beside:
            beside.write_bytes(pickle.dumps(self))

    @classmethod
    def begun(cls, seed: int, path: Path | None) -> Mocks:
        """Read those of a file, or begin."""
        if path is not None and path.exists():
            found = pickle.loads(path.read_bytes())
            assert isinstance(found, cls)
            return found
        empty: dict[str, Any] = {way: [] for way in WAYS}
        return cls(
            dict(np.random.default_rng(seed).bit_generator.state),
            dict(empty), {way: [] for way in WAYS},
        )  # fmt: skip


def draw_truth(priors: Sequence[Prior], rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw each parameter from its prior, anew where it lies outside its bounds.

    All of them anew where there is no such device, as with a gate oxide above the field oxide: half
    of the E2V device's neighbours.
    """
    names = [prior.name for prior in priors]
    out = np.empty(len(priors))
    while True:
        for n, prior in enumerate(priors):
            while True:
                out[n] = rng.normal(prior.mean, prior.spread)
                if prior.low < out[n] < prior.high:
                    break
        if not any(
            out[names.index(low)] > out[names.index(high)]
            for low, high in ORDERED
            if {low, high} <= set(names)
        ):
            return out


def recover(
    emulator: Emulator,
    priors: Sequence[Prior],
    errors: NDArray[np.float64],
    *,
    mocks: int,
    seed: int,
    areas: Areas | None = None,
    misstated: float = 1.0,
    emulator_misses: NDArray[np.float64] | None = None,
    kept: Path | None = None,
) -> tuple[list[dict[str, Any]], Mapping[str, Any]]:
    """Fit mocks of known devices.

    Parameters
    ----------
    emulator : Emulator
        What the fit uses.
    priors : sequence of Prior
        From which truths are drawn, and which the fit is told.
    errors : ndarray, shape (ny, nx)
        Of the mock a_ij [1/e-]; (0, 0) is left out.
    mocks : int
        How many.
    seed : int
        Of truths and noise.
    areas : callable, optional
        True a_ij of parameters [the emulator's]; raises ValueError where there is no such device,
        and another is drawn.
    misstated : float
        Errors told to the fit over true ones.
    emulator_misses : ndarray, shape (k, ny, nx), optional
        What the emulator misses of a_ij [1/e-] over the priors.
    kept : Path, optional
        File of the mocks of this very run so far, after which it goes on.

    Returns
    -------
    rows : list of dict
        ``pull`` and ``pull_rms`` of (fitted - true) / error with the error of the mean,
        ``within_68`` and ``within_95``, ``remains`` (posterior over prior error; of predictions
        relative to themselves), ``scale``.
    told : mapping
        Ties and silent parameters of the first mock, seconds a fit.
    """
    mock = Mocks.begun(seed, kept)
    rng = np.random.default_rng()
    rng.bit_generator.state = mock.rng
    independent = np.ones(errors.shape, bool)
    independent[0, 0] = False
    bar = tqdm(total=mocks, initial=len(mock.scales), desc="mocks", disable=None)
    while len(mock.scales) < mocks:
        truth = draw_truth(priors, rng)
        try:
            true = (
                np.asarray(emulator.predict(truth, Condition()).areas)
                if areas is None
                else areas(truth)
            )
        except ValueError:
            continue
        ny, nx = errors.shape
        noisy = true[:ny, :nx] + errors * rng.standard_normal(errors.shape)
        data = area_data("mock", noisy, misstated * errors, independent=independent)
        found = _fit_mock(mock, _problem(data, emulator, priors), emulator_misses, truth)
        _hold_predictions(mock, emulator, found, true)
        mock.rng = dict(rng.bit_generator.state)
        if kept is not None:
            mock.save(kept)
        bar.update()
    bar.close()
    return _rows(mock, [describe(prior.name) for prior in priors]), mock.told | {
        "cpu_s_a_fit": round(mock.seconds / mocks, 3), "drawn": mock.drawn,
    }  # fmt: skip


def _fit_mock(
    mock: Mocks,
    problem: LeastSquaresProblem,
    emulator_misses: NDArray[np.float64] | None,
    truth: NDArray[np.float64],
) -> FitSolution:
    """Fit one more and hold the truth against what the fit says; the tangent's solution."""
    (data,), names = problem.sets, tuple(prior.name for prior in problem.priors)
    begin = time.process_time()
    tangent = solve(problem)
    missed = None
    if emulator_misses is not None:
        i, j = data.places.T
        missed = Missed(
            np.zeros((len(emulator_misses), len(names))), (emulator_misses[:, j, i],)
        )
    posterior = find_posterior(problem, tangent, None, missed=missed)
    mock.seconds += time.process_time() - begin
    mock.drawn += "draws" in posterior.record
    spreads = problem.spreads
    if not mock.told:
        ties, silent = find_ties(names, tangent.sensitivity)
        mock.told = {"ties": list(ties), "silent": [describe(n) for n in silent]}
        scaled = tangent.covariance / np.outer(spreads, spreads)
        mock.directions = np.array(
            [one.weights for one in principal(scaled) if one.remains < MEASURED]
        ).reshape(-1, len(names))
        mock.labels = [name_combination(names, weights) for weights in mock.directions]
    off = (tangent.values - truth) / spreads
    for way, solution in zip(WAYS[:2], (tangent, posterior.solution), strict=True):
        scaled = solution.covariance / np.outer(spreads, spreads)
        error = np.sqrt(np.diag(scaled))
        own = np.array([one.weights for one in principal(scaled)[:OWN]])
        # Combinations of parameters in units of their priors.
        along = np.concatenate([mock.directions, own])
        width = np.sqrt(np.einsum("cp,pq,cq->c", along, scaled, along))
        mock.pulls[way].append(np.concatenate([off / error, along @ off / width]))
        mock.remains[way].append(np.concatenate([error, width]))
    if posterior.draws is None:
        mock.pulls["draws"].append(mock.pulls["posterior"][-1])
    else:
        ranks = np.vstack([np.eye(len(names)), along])
        away = (posterior.draws - truth) / spreads @ ranks.T
        mock.pulls["draws"].append(pulls_of_ranks(away))
    mock.remains["draws"].append(mock.remains["posterior"][-1])
    mock.scales.append(float(tangent.scales[0]))
    mock.chi2.append(float(tangent.chi2[0]) / len(data.values))
    return tangent


def _hold_predictions(
    mock: Mocks, emulator: Emulator, tangent: FitSolution, true: NDArray[np.float64]
) -> None:
    """Add what the fit predicts, as the tangent has it, against the true ones there."""
    told, errors = _predicted(emulator, tangent.values, tangent.covariance)
    off = (told - np.array([true[j, i] for i, j in PREDICTED])) / errors
    mock.pulls["tangent"][-1] = np.append(mock.pulls["tangent"][-1], off)
    mock.remains["tangent"][-1] = np.append(
        mock.remains["tangent"][-1], np.abs(errors / told)
    )


def _rows(mock: Mocks, names: Sequence[str]) -> list[dict[str, Any]]:
    """Bias and coverage of each way for each parameter, combination and prediction."""
    count, rows = len(names), []
    kinds = ["parameter"] * count + ["combination"] * len(mock.labels) + ["own"] * OWN
    called = [*names, *mock.labels, *(f"own {n + 1}" for n in range(OWN))]
    for way in WAYS:
        every, left = np.array(mock.pulls[way]), np.array(mock.remains[way])
        more = len(every[0]) - len(called)
        predicted = [f"a at {lag}" for lag in PREDICTED][:more]
        for n, (name, kind) in enumerate(
            zip([*called, *predicted], [*kinds, *["prediction"] * more], strict=True)
        ):
            rows.append({"way": way} | _row(name, kind, every[:, n]))
            rows[-1]["remains"] = round(float(np.mean(left[:, n])), 3)
        # Parameters of one mock share its noise: the mocks count, not the pulls.
        rows.append({"way": way} | _row("all parameters", "all", every[:, :count]))
        rows[-1]["remains"] = round(float(np.mean(left[:, :count])), 3)
    for row in rows:
        row |= {
            "mocks": len(mock.scales), "scale": round(float(np.mean(mock.scales)), 3),
            "scale_scatter": round(float(np.std(mock.scales)), 3),
            "chi2_per_n": round(float(np.mean(mock.chi2)), 3),
        }  # fmt: skip
    return rows


def _predicted(
    emulator: Emulator, values: NDArray[np.float64], covariance: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Areas at the fitted values, and the errors that the posterior leaves them."""
    response = emulator.predict(values, Condition())
    i, j = np.array(PREDICTED).T
    slope = np.asarray(response.jacobian)[:, j, i]
    errors = np.sqrt(np.einsum("pn,pq,qn->n", slope, covariance, slope))
    return np.asarray(response.areas)[j, i], errors


def _problem(
    data: DataSet, emulator: Emulator, priors: Sequence[Prior]
) -> LeastSquaresProblem:
    return LeastSquaresProblem(
        tuple(priors), (data,), make_predictors((data,), emulator, priors)
    )


def _row(name: str, kind: str, pulls: NDArray[np.float64]) -> dict[str, Any]:
    """Bias and coverage with their errors from the scatter between mocks."""
    by_mock = pulls.reshape(len(pulls), -1)

    def mean(values: NDArray[np.float64]) -> tuple[float, float]:
        each = values.mean(1)
        return round(float(each.mean()), 3), round(
            float(each.std(ddof=1) / np.sqrt(len(each))), 3
        )

    bias, one, two = (
        mean(v) for v in (by_mock, np.abs(by_mock) <= 1, np.abs(by_mock) <= 1.96)
    )
    return {
        "name": name, "kind": kind, "pull": bias[0], "pull_error": bias[1],
        "pull_rms": round(float(np.sqrt(np.mean(by_mock**2))), 3),
        "within_68": one[0], "within_68_error": one[1],
        "within_95": two[0], "within_95_error": two[1],
    } | {
        f"within_{share}_{end}": bound
        for share, part in (("68", one[0]), ("95", two[0]))
        for end, bound in zip(("low", "high"), wilson(part, len(by_mock)), strict=True)
    }  # fmt: skip


def pulls_of_ranks(away: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pulls of the truth as many draws as lie above it would have of a normal distribution.

    Parameters
    ----------
    away : ndarray, shape (m, k)
        Draws less the truth.
    """
    above = (np.sum(away > 0, axis=0) + 0.5) / (len(away) + 1)
    return np.asarray(norm.ppf(above))


def wilson(part: float, count: int, z: float = 1.96) -> tuple[float, float]:
    """Bounds of a share that was counted among independent trials (Wilson 1927)."""
    middle = (part + z**2 / (2 * count)) / (1 + z**2 / count)
    half = (
        z / (1 + z**2 / count) * np.sqrt(part * (1 - part) / count + (z / (2 * count)) ** 2)
    )
    return round(float(middle - half), 3), round(float(middle + half), 3)
