"""The fit of non-linear and linear parameters and random effects: what it says fits together."""

from __future__ import annotations

import numpy as np

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
