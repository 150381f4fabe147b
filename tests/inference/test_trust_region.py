"""Least squares by a trust region: its end, its bounds, its first radius, and losses."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.errors import ConvergenceError
from bfsensor.inference.trust_region import minimise

X = np.linspace(0.2, 6.0, 40)
TRUTH = np.array([3.0, 2.0])


def left(p):
    return p[0] * np.exp(-X / p[1]) - TRUTH[0] * np.exp(-X / TRUTH[1])


def slopes(p):
    form = np.exp(-X / p[1])
    return np.stack([form, p[0] * form * X / p[1] ** 2], axis=1)


def test_it_ends_at_the_minimum():
    found = minimise(left, slopes, [1.0, 0.5], low=[0.0, 0.1])
    # Of residuals without noise the minimum is exact; steps end at 0.01 errors, quadratically.
    assert found.converged and found.values == pytest.approx(TRUTH, abs=1e-6)
    assert found.square == pytest.approx(0.0, abs=1e-10)


def test_a_parameter_at_its_bound_equals_it():
    found = minimise(left, slopes, [2.0, 1.0], low=[0.0, 0.1], high=[np.inf, 1.5])
    assert found.converged and found.values[1] == 1.5
    # The height is at its best for that width.
    form = np.exp(-X / 1.5)
    best = form @ (TRUTH[0] * np.exp(-X / TRUTH[1])) / (form @ form)
    assert found.values[0] == pytest.approx(best, rel=1e-5)


def test_parameters_with_equal_bounds_or_without_influence_stay():
    found = minimise(
        lambda p: left(p[:2]), lambda p: np.c_[slopes(p[:2]), np.zeros(len(X))],
        [2.0, 1.0, 7.0], low=[2.0, 0.1, -9.0], high=[2.0, 9.0, 9.0],
    )  # fmt: skip
    assert found.values[0] == 2.0 and found.values[2] == 7.0
    assert found.values[1] != 1.0


def test_a_fit_that_runs_out_of_points_ends_with_its_best():
    found = minimise(left, slopes, [0.1, 20.0], low=[0.0, 0.1], evaluations=3)
    assert not found.converged
    assert found.square < float(left([0.1, 20.0]) @ left([0.1, 20.0]))


def test_where_nothing_can_be_computed_the_region_shrinks():
    seen = []

    def torn(p):
        seen.append(p[1])
        if p[1] > 2.5:
            raise ConvergenceError("no width any more")
        return left(p)

    found = minimise(torn, slopes, [1.0, 0.5], low=[0.0, 0.1])
    assert max(seen) > 2.5 and found.values == pytest.approx(TRUTH, abs=1e-6)
    with pytest.raises(ConvergenceError, match="no width"):
        minimise(torn, slopes, [1.0, 3.0])


def test_the_first_step_is_no_longer_than_the_radius():
    seen = []

    def watched(p):
        seen.append(np.array(p))
        return left(p)

    for radius in (0.05, 0.5):
        seen.clear()
        minimise(watched, slopes, [1.0, 1.0], units=[1.0, 1.0], radius=radius)
        first = np.linalg.norm(seen[1] - [1.0, 1.0])
        assert first <= radius * (1 + 1e-9) and first > 0.9 * radius


def test_a_robust_loss_is_not_led_by_an_outlier():
    spoilt = np.zeros(len(X))
    spoilt[5] = 50.0
    plain, robust = (
        minimise(lambda p: left(p) + spoilt, slopes, [2.0, 1.0], low=[0.0, 0.1], loss=loss)
        for loss in ("linear", "cauchy")
    )
    assert abs(robust.values[0] - TRUTH[0]) < 0.1 * abs(plain.values[0] - TRUTH[0])
