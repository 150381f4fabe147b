"""The fit of non-linear and linear parameters and random effects: what it says fits together."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.inference.mixed_model import IDLE, MixedModelFit


class Scaled(MixedModelFit):
    """A line whose slope is nearly the product of a linear parameter and of one that is not."""

    def __init__(self, target, line, bent):
        self._target, self._line, self._bent = target, line, bent
        unit = line / np.sqrt(line @ line)
        super().__init__(
            np.array([0.3]), unit[:, None], prior_rows=np.zeros(0, int), curved=np.ones(1, bool),
            renewed=np.ones(1, bool), variances=np.zeros(0, int), random=False,
        )  # fmt: skip

    def whitened(self, point):
        return self._target - point[0] * (self._line + self._bent)

    def differentiate(self, which, point):
        self.slopes[:, 0] = self._line + self._bent

    def modes_at(self, point):
        return np.zeros((self.total, 0))

    def mode_slopes(self, point):
        return {}

    def limits(self):
        return np.array([[0.0], [1.0]])


def test_linear_parameters_belong_to_the_point():
    """Where both kinds describe the same, a step of one of them leaves the chi-square as it is."""
    rng = np.random.default_rng(4)
    x = np.linspace(1.0, 2.0, 50)
    fit = Scaled(400 * x + rng.standard_normal(50), 300 * x, 1e-3 * x**2)
    fit.point = np.array([0.9])
    fit.differentiate(np.ones(1, bool), fit.point)
    fit._end()
    beta = fit.solved.solution[1:]
    left = fit.whitened(fit.point) - fit.linear @ beta
    assert left @ left < fit.solved.left @ fit.solved.left + IDLE


class Decay(MixedModelFit):
    """Noise, and a decay of random size, whose standard deviation is 100 and whose length is unknown."""

    def __init__(self, size, rms=1.0, length=10.0):
        self.x = np.arange(60.0)
        self._target = size * np.exp(-self.x / length)
        self._target += np.random.default_rng(6).standard_normal(len(self.x))
        super().__init__(
            np.array([rms, 0.8 * length]), np.zeros((60, 0)), prior_rows=np.zeros(0, int),
            curved=np.ones(2, bool), renewed=np.zeros(2, bool), variances=np.arange(2), random=True,
        )  # fmt: skip

    def whitened(self, point):
        return self._target.copy()

    def differentiate(self, which, point):
        pass

    def modes_at(self, point):
        return 100.0 * point[0] * np.exp(-self.x / point[1])[:, None]

    def mode_slopes(self, point):
        own = 100.0 * np.exp(-self.x / point[1])[:, None]
        return {0: own, 1: point[0] * own * self.x[:, None] / point[1] ** 2}

    def limits(self):
        return np.array([[0.99, 0.1], [1.01, 1e3]])


@pytest.mark.parametrize("size", [30.0, 100.0, 300.0])
def test_the_shape_of_a_large_random_effect_is_fitted(size):
    """At three standard deviations a step by Fisher's information is nine times too long."""
    fit = Decay(size)
    fit.go()
    # The error of the length is that of a decay of this size in unit noise.
    slope = size * np.exp(-fit.x / 10.0) * fit.x / 100.0
    assert abs(fit.point[1] - 10.0) < 4 / np.sqrt(slope @ slope)
