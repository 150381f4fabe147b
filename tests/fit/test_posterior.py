"""Posteriors of curved predictions, and of predictions with errors, against integrals on grids."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bfsensor.device.condition import Condition
from bfsensor.device.quantities import Prior
from bfsensor.errors import ConvergenceError, FitError
from bfsensor.fit import posterior
from bfsensor.fit.data import DataSet
from bfsensor.fit.degeneracies import principal
from bfsensor.fit.least_squares import LeastSquaresProblem, profile, solve
from bfsensor.fit.posterior import find_posterior
from bfsensor.fit.posterior_draws import bent_about, sample_posterior, with_draws
from bfsensor.fit.prediction_error import Missed, measure_missed, widen
from bfsensor.inference.profile_bounds import LEVELS, profile_bounds

TURN = 0.4
"""Curvature of the first number with the second parameter [errors a squared spread, over 5]."""

PRIORS = (Prior("p.x", 1.0, 1.0), Prior("p.y", -2.0, 2.0))


def bent(values, turn=TURN):
    """x + turn y^2 measured to 0.2, in units of the priors' spreads: a banana."""
    x, y = values[0] - 1.0, (values[1] + 2.0) / 2.0
    return (
        np.array([x + turn * y**2, 0.5 * y]),
        np.array([[1.0, turn * y], [0.0, 0.25]]),
    )


def problem(turn=TURN, priors=PRIORS, values=(0.3, 0.1)):
    data = DataSet(
        "two", "areas", np.array(values), np.array([0.2, 2.0]), (Condition(),) * 2,
        np.zeros((2, 2), int), scaled=False,
    )  # fmt: skip
    return LeastSquaresProblem(priors, (data,), (lambda v: bent(v, turn),))


def on_a_grid(whole, unknown=None):
    """Points and weights of the posterior."""
    t = np.linspace(-6, 6, 401)
    x, y = np.meshgrid(1.0 + t, -2.0 + 2.0 * t, indexing="ij")
    data = whole.sets[0]
    r = np.array([
        x - 1.0 + TURN * ((y + 2.0) / 2.0) ** 2 - data.values[0], (y + 2.0) / 4.0 - data.values[1]
    ]) / data.errors[:, None, None]  # fmt: skip
    inverse = np.linalg.inv(np.eye(2) + (0 if unknown is None else unknown))
    chi2 = np.einsum("iab,ij,jab->ab", r, inverse, r)
    chi2 += (x - 1.0) ** 2 + ((y + 2.0) / 2.0) ** 2
    for value, prior in zip((x, y), whole.priors, strict=True):
        chi2[(value < prior.low) | (value > prior.high)] = np.inf
    weight = np.exp(-0.5 * (chi2 - chi2.min()))
    return np.array([x, y]), weight / weight.sum()


def test_second_derivatives_are_found():
    whole = problem()
    found = bent_about(whole, solve(whole))
    expected = np.zeros((2, 2, 2))
    expected[0, 1, 1] = 2 * TURN / 0.2
    np.testing.assert_allclose(found.second, expected, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["free", "bound", "unknown"])
def test_draws_have_the_moments_of_a_banana(case):
    priors = PRIORS
    if case == "bound":
        priors = (PRIORS[0], replace(PRIORS[1], low=-3.0))
    unknown = np.diag([4.0, 0.0]) if case == "unknown" else None
    whole = problem(priors=priors)
    found = solve(whole)
    draws = sample_posterior(whole, found, unknown=unknown)
    points, weight = on_a_grid(whole, unknown)
    mean = np.einsum("iab,ab->i", points, weight)
    off = points - found.values[:, None, None]
    about = np.einsum("iab,jab,ab->ij", off, off, weight)
    spread = np.sqrt(np.einsum("iab,ab->i", (points - mean[:, None, None]) ** 2, weight))
    # 4800 draws, of which at least one in ten is independent: 5 % of a width.
    assert np.all(np.abs(draws.mean(0) - mean) < 4 * spread / np.sqrt(480))
    covariance = with_draws(found, draws).covariance
    np.testing.assert_allclose(
        np.sqrt(np.diag(covariance)), np.sqrt(np.diag(about)), rtol=4 / np.sqrt(2 * 480)
    )
    # The linear error of x is far too small, as it lacks the curvature in y.
    if case == "free":
        assert np.sqrt(about[0, 0]) > 1.5 * np.sqrt(found.covariance[0, 0])


def test_where_predictions_bend_the_posterior_is_drawn_from_and_intervals_are_kept():
    whole = problem()
    found = solve(whole)
    bending = find_posterior(whole, found, None)
    assert bending.record["curved"] and bending.record["draws"] == 4800
    low, high = np.array(bending.record["central_95"]).T
    assert np.all(low < bending.record["mean"]) and np.all(high > bending.record["mean"])
    # The best combination changes its direction: its draws lie to one side of the fit.
    ends, mean = (bending.record["combinations"][k] for k in ("central_95", "mean"))
    scaled = bending.solution.covariance / np.outer(whole.spreads, whole.spreads)
    best = principal(scaled)[0]
    along = (bending.draws - found.values) / whole.spreads @ best.weights
    assert mean[0] == pytest.approx(along.mean(), abs=1e-9)
    inside = (along > ends[0][0]) & (along < ends[0][1])
    assert inside.mean() == pytest.approx(0.95, abs=1e-3)
    # x + 0.4 y^2 is measured to 0.2, and so it is predicted however wide x and y are.
    assert bending.left[0][0] == pytest.approx(0.2, rel=0.2)
    straight = find_posterior(problem(0.0), solve(problem(0.0)), None)
    assert not straight.record["curved"]
    np.testing.assert_array_equal(
        straight.solution.covariance, solve(problem(0.0)).covariance
    )


def test_what_predictions_miss_is_an_error_of_theirs():
    """As if the data's own errors were larger, where it is independent of the parameters."""
    whole = problem(0.0)
    found = solve(whole)
    size = np.array([0.3, 0.0])
    missed = Missed(np.zeros((4, 2)), (np.array([size, -size, size, -size]),))
    wider, left = widen(whole, found, missed)
    data = whole.sets[0]
    errors = np.hypot(data.errors, size)
    larger = LeastSquaresProblem(PRIORS, (replace(data, errors=errors),), whole.predictors)
    np.testing.assert_allclose(wider.covariance, solve(larger).covariance, rtol=1e-10)
    assert np.all(left[0] <= np.hypot(np.sqrt(np.diag(
        bent(found.values, 0.0)[1] @ found.covariance @ bent(found.values, 0.0)[1].T
    )), size) + 1e-12)  # fmt: skip


def test_misses_are_measured_over_the_posterior_within_bounds():
    priors = (PRIORS[0], replace(PRIORS[1], low=-3.0))
    whole = problem(0.0, priors)
    found = solve(whole)
    refused = []

    def exact(values):
        if values[0] > 1.4:
            refused.append(values)
            raise ValueError("no such device")
        return [bent(values)[0]]

    missed = measure_missed(whole, found, exact, draws=40, seed=77)
    assert refused and len(missed.at) == 40
    assert np.all(missed.at[:, 1] >= -3.0) and np.all(missed.at[:, 0] <= 1.4)
    y = (missed.at[:, 1] + 2.0) / 2.0
    np.testing.assert_allclose(missed.values[0][:, 0], TURN * y**2)
    with pytest.raises(FitError, match="only 0 of 3 devices drawn"):
        measure_missed(whole, found, lambda v: exact(v + 9.0), draws=3)


def test_a_bent_profile_has_the_bounds_of_its_exact_one():
    """The profile of y, with x at its best everywhere, is known in closed form."""
    whole = problem()
    found = solve(whole)
    values, rise = profile(whole, found, "p.y")
    y = (values + 2.0) / 2.0
    # x has prior 0 +- 1 and datum 0.3 - 0.4 y^2 +- 0.2: minimised over x.
    exact = (0.3 - TURN * y**2) ** 2 / (1 + 0.04) + (0.5 * y - 0.1) ** 2 / 4 + y**2
    np.testing.assert_allclose(rise, exact - found.total, atol=1e-6)
    fine = np.linspace(values[0], values[-1], 20001)
    t = (fine + 2.0) / 2.0
    height = (0.3 - TURN * t**2) ** 2 / 1.04 + (0.5 * t - 0.1) ** 2 / 4 + t**2 - found.total
    for level in LEVELS.values():
        inside = fine[height <= level]
        bounds = profile_bounds(values, rise, level)
        step = values[1] - values[0]
        # Straight between points a twelfth of it apart at most.
        assert bounds.low == pytest.approx(inside[0], abs=0.1 * step)
        assert bounds.high == pytest.approx(inside[-1], abs=0.1 * step)


def test_a_profile_that_ends_at_a_bound_is_one_sided():
    priors = (PRIORS[0], replace(PRIORS[1], low=-2.5))
    whole = problem(0.0, priors)
    found = solve(whole)
    values, rise = profile(whole, found, "p.y")
    assert values[0] == -2.5
    bounds = profile_bounds(values, rise, LEVELS["95 %"])
    assert bounds.low == -np.inf
    error = np.sqrt(found.covariance[1, 1])
    assert bounds.high == pytest.approx(found.values[1] + np.sqrt(3.84) * error, abs=1e-3)


def test_draws_that_do_not_agree_are_said_so(monkeypatch):
    whole = problem()
    found = solve(whole)

    def refuse(*args, **more):
        raise ConvergenceError("draws differ between chains", [2.0])

    monkeypatch.setattr(posterior, "sample_posterior", refuse)
    left = find_posterior(whole, found, None)
    assert "differ between chains: errors are too small" in left.words
    assert left.record["not_drawn"] and "draws" not in left.record
    np.testing.assert_array_equal(left.solution.covariance, found.covariance)


def test_chains_that_are_too_short_do_not_agree():
    whole = problem(turn=40 * TURN)
    with pytest.raises(ConvergenceError, match=r"draws of p\.\w differ between chains"):
        sample_posterior(whole, solve(whole), steps=3)
