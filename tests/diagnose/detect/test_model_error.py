"""What an effect explains counts by channel, whether residuals or pulls had taken it up before."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.diagnose.detect.model_error import explained_by_word
from bfsensor.diagnose.fit.baseline_fit import BaselineFit


class Named:
    """Channel of four values."""

    def __init__(self, word):
        self.word = word

    def __len__(self):
        return 4


def fit_with(covariances, means, pulls):
    """Fit of two channels, with pulls of parameters behind their residuals, and a score."""
    residuals = np.array([*covariances, *means], float)
    return BaselineFit(
        (Named("flat_cov"), Named("flat_mean")), (), np.zeros(0), np.zeros(0), residuals,
        np.zeros((8, 0)), np.array([0, 4, 8]), {}, left=np.array([*residuals, *pulls, 50.0]),
        scores=1,
    )  # fmt: skip


def test_a_pull_that_is_given_up_counts_where_the_residuals_changed():
    """The prior of a thickness 7 of its uncertainties off had taken all but a little of a mismatch."""
    before = fit_with([1, -1, 1, 0], [1, 1, 1, 1], [7.0, 1.0])
    after = fit_with([0, 1, 1, 1], [1, 1, 1, 1], [0.0, 1.0])
    assert explained_by_word(before, after) == {
        "flat_cov": pytest.approx(49.0),
        "flat_mean": 0.0,
    }
    # In two channels by the squares of their changes, 6 and 2, beside what each loses itself.
    after = fit_with([0, 1, 1, 1], [1, 1, 0, 0], [1.0, 1.0])
    found = explained_by_word(before, after)
    assert found["flat_cov"] == pytest.approx(0.75 * 48.0)
    assert found["flat_mean"] == pytest.approx(0.25 * 48.0 + 2.0)


def test_nothing_is_explained_between_equal_fits():
    one = fit_with([1, -1, 1, 0], [1, 1, 1, 1], [7.0, 1.0])
    assert explained_by_word(one, one) == {"flat_cov": 0.0, "flat_mean": 0.0}
