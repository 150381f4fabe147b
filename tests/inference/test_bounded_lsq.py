"""Least squares in a box: against SciPy's, which solves the whole problem at once."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from bfsensor.inference.bounded_lsq import solve_within


def problem(seed, *, parallel=0.0):
    rng = np.random.default_rng(seed)
    design = rng.normal(size=(60, 7)) * 10.0 ** rng.uniform(-3, 3, 7)
    design[:, 5] = design[:, 4] + parallel * design[:, 5] if parallel else design[:, 5]
    target = rng.normal(size=60)
    low, high = np.full(7, -np.inf), np.full(7, np.inf)
    free = np.linalg.lstsq(design, target, rcond=None)[0]
    # Each end leaves a quarter of what the free solution wants.
    low[2:6], high[2:6] = -0.25 * np.abs(free[2:6]), 0.25 * np.abs(free[2:6])
    return design, target, low, high


@pytest.mark.parametrize("parallel", [0.0, 1e-3])
@pytest.mark.parametrize("seed", range(5))
def test_the_best_inside_the_box(seed, parallel):
    design, target, low, high = problem(seed, parallel=parallel)
    found = solve_within(design, target, low, high)
    scale = np.linalg.norm(design, axis=0)
    other = lsq_linear(design / scale, target, (low * scale, high * scale), tol=1e-14)
    assert (found.solution >= low * (1 + 1e-12)).all()
    assert (found.solution <= high * (1 + 1e-12)).all()
    np.testing.assert_allclose(found.left @ found.left, 2 * other.cost, rtol=1e-9)
    np.testing.assert_allclose(found.left, target - design @ found.solution, atol=1e-9)
    # What the tests of what is left rely on.
    np.testing.assert_allclose(found.basis.T @ found.left, 0.0, atol=1e-8)
    # Clipping the free solution, which is what this is for, is worse.
    clipped = np.clip(np.linalg.lstsq(design, target, rcond=None)[0], low, high)
    assert np.sum((target - design @ clipped) ** 2) > found.left @ found.left * (1 + 1e-6)


def test_without_ends_it_is_plain_least_squares():
    design, target, low, _ = problem(7)
    found = solve_within(
        design, target, np.full_like(low, -np.inf), np.full_like(low, np.inf)
    )
    np.testing.assert_allclose(
        found.solution, np.linalg.lstsq(design, target, rcond=None)[0], rtol=1e-8
    )
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(design.T @ design), rtol=1e-6
    )


def test_held_zero_and_tied_columns():
    design, target, low, high = problem(9)
    low[3] = high[3] = 0.0
    design[:, 6] = 0.0
    found = solve_within(design, target, low, high)
    assert found.solution[3] == 0.0 and found.solution[6] == 0.0 and found.errors[6] == 0.0
    design[:, 6] = design[:, 0]
    tied = solve_within(design, target, low, high)
    np.testing.assert_allclose(tied.left @ tied.left, found.left @ found.left, rtol=1e-9)
    stopped = np.sum(np.isclose(tied.solution, low) | np.isclose(tied.solution, high))
    assert tied.basis.shape[1] == 6 - stopped
