"""The expansion about a device against polynomials, and what a spoiled solution does to it."""

import numpy as np
import pytest

from bfsensor.response.expansion import expand, steepest

NAMES, SPREADS = ("one", "two"), np.array([2.0, 0.5])
SHAPE = 2, 1, 3, 3


def polynomial(seed=3091):
    """Value, first and second derivatives in spreads of shifts that end at second order."""
    rng = np.random.default_rng(seed)
    value, first, second = (rng.normal(size=(*n, *SHAPE)) for n in ((), (2,), (2, 2)))
    return value, first, 0.5 * (second + np.swapaxes(second, 0, 1))


def solutions(value, first, second):
    """A device and its neighbours a spread to either side, derivatives in units."""
    out = {}
    for at in ((-1, 0), (0, 1), (0, -1), (1, 1), (1, -1)):
        t = np.zeros(2)
        if at[0] >= 0:
            t[at[0]] = at[1]
        bent = np.tensordot(t, second, (0, 0))
        shifts = value + np.tensordot(t, first, 1) + 0.5 * np.tensordot(t, bent, 1)
        out[at] = shifts, (first + bent) / SPREADS[:, None, None, None, None]
    return out


def test_second_order_is_found():
    value, first, second = polynomial()
    found = expand(solutions(value, first, second), np.arange(2), NAMES, SPREADS)
    np.testing.assert_allclose(found.second, second, atol=1e-12)
    t = np.array([0.3, -1.4])
    shifts, slopes = found.at(t)
    wanted = value + np.tensordot(t, first, 1)
    wanted = wanted + 0.5 * np.einsum("m,n,mn...->...", t, t, second)
    np.testing.assert_allclose(shifts, wanted, atol=1e-12)
    np.testing.assert_allclose(slopes, first + np.tensordot(t, second, 1), atol=1e-12)


@pytest.mark.parametrize("lost", [0, 1])
def test_one_bad_derivative_of_a_neighbour_adds_nothing(lost):
    """The smaller of both estimates is taken: one that is 100 too large has no influence."""
    value, first, second = polynomial()
    solved = solutions(value, first, second)
    solved[0, 1][1][lost, 0, 0, 1, 1] += 100.0
    found = expand(solved, np.arange(2), NAMES, SPREADS).second
    np.testing.assert_array_less(np.abs(found), np.abs(second) + 1e-12)
    untouched = np.ones_like(found, bool)
    untouched[:, :, 0, 0, 1, 1] = False
    np.testing.assert_allclose(found[untouched], second[untouched], atol=1e-12)


def test_neighbours_without_derivatives_give_their_own_second_order():
    value, first, second = polynomial()
    solved = solutions(value, first, second)
    for side in (1, -1):
        solved[1, side] = solved[1, side][0], np.zeros((0, *SHAPE))
    # Derivatives by both are known beside the first parameter, on one side alone.
    solved[0, -1] = solved[0, -1][0], np.zeros((0, *SHAPE))
    found = expand(solved, np.arange(2), NAMES, SPREADS).second
    np.testing.assert_allclose(found, second, atol=1e-12)
    solved[0, 1] = solved[0, 1][0], np.zeros((0, *SHAPE))
    found = expand(solved, np.arange(2), NAMES, SPREADS).second
    np.testing.assert_allclose(found[[0, 1], [0, 1]], second[[0, 1], [0, 1]], atol=1e-12)
    assert not found[0, 1].any() and not found[1, 0].any()


def test_the_steepest_parameters_come_first():
    rng = np.random.default_rng(6)
    value = rng.uniform(1.0, 2.0, (2, 1, 9, 9))
    slopes = np.stack(
        [0.03 * value, -0.6 * value]
    )  # times spreads of 2 and 0.5: 0.06, -0.3
    assert steepest(value, slopes, SPREADS, 5).tolist() == [1, 0]
    assert steepest(value, slopes, np.array([20.0, 0.5]), 1).tolist() == [0]
