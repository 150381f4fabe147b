"""Variance parameters: amplitudes constrained by the scatter of values, fitted by REML scoring."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.detect import scatter
from bfsensor.diagnose.detect.scatter import scatter_of
from bfsensor.diagnose.fit.gauss_newton import Steps
from bfsensor.effects.illumination_turbulence import IlluminationTurbulence
from bfsensor.errors import FitError
from bfsensor.inference.parameters import FreeParameter, ParameterSpace
from bfsensor.inference.random_effects import likeliest

COUNT = 80
STRENGTHS = np.geomspace(300.0, 3e4, COUNT)
"""Scatter of each value by an amplitude of one, noise being one."""


class Shaken:
    """Predicts values of one level, which an effect makes scatter and else leaves as they are."""

    effects = (IlluminationTurbulence({"rms": 1e-3, "corr": 20.0}),)

    def __init__(self, start: float) -> None:
        one = FreeParameter(
            "effect 0 illumination_turbulence rms",
            "effect",
            0,
            start,
            1e-6,
            False,
            0.0,
            0.1,
        )
        self.space = ParameterSpace((one,))
        self.names, self.start = self.space.names, self.space.start

    def predict(self, channel, point):
        del point
        return np.zeros(len(channel))

    def linear(self, channel):
        return {"level": np.ones(len(channel))}

    def depends(self, channel):
        del channel
        return np.array([False])

    def modes(self, channel, point):
        del channel
        return np.diag(point[0] * STRENGTHS)


def channel(amplitude: float, seed: int) -> Channel:
    noise = np.random.default_rng(seed).standard_normal((2, COUNT))
    values = 7.0 + noise[0] + amplitude * STRENGTHS * noise[1]
    return Channel(
        "flat_mean", values, (np.eye(COUNT),), {"n": np.arange(COUNT)}, "", "fit"
    )


def restricted(amplitude: float, values: np.ndarray) -> float:
    """Minus twice the logarithm of the restricted likelihood, the level unknown."""
    weights = 1 / (1 + (amplitude * STRENGTHS) ** 2)
    mean = float(weights @ values) / weights.sum()
    square = float(weights @ (values - mean) ** 2)
    return square - float(np.log(weights).sum()) + float(np.log(weights.sum()))


@pytest.mark.parametrize("start", [1e-4, 3e-4, 1e-3, 0.02])
@pytest.mark.parametrize("seed", range(3))
def test_the_likeliest_amplitude_is_found(start, seed):
    one = channel(1e-3, seed)
    steps = Steps(Shaken(start), [one])
    steps.go()
    grid = np.geomspace(1e-4, 1e-2, 2000)
    best = grid[np.argmin([restricted(a, one.values) for a in grid])]
    assert steps.point[0] == pytest.approx(best, rel=0.02)


def test_errors_are_those_of_the_scatter():
    pulls = []
    for seed in range(100):
        steps = Steps(Shaken(5e-4), [channel(1e-3, 100 + seed)])
        steps.go()
        pulls.append((steps.point[0] - 1e-3) / steps.solved.errors[0])
    assert np.mean(pulls) == pytest.approx(0.0, abs=0.4)
    assert np.std(pulls) == pytest.approx(1.0, abs=0.25)


def test_an_amplitude_that_no_channel_constrains_stays(monkeypatch):
    monkeypatch.setattr(IlluminationTurbulence, "scatters", ())
    steps = Steps(Shaken(3e-4), [channel(1e-3, 0)])
    steps.go()
    assert steps.point[0] == 3e-4 and len(steps.score.target) == 0


def test_gain_before_a_fit_is_that_of_the_likelihood():
    """Values change too: by the factor and by its square."""
    rng = np.random.default_rng(5)
    modes = rng.normal(0, 0.3, (COUNT, 30))
    one, two = rng.normal(0, 0.5, (2, COUNT))
    left = 2 * one + 4 * two + 2 * modes @ rng.standard_normal(30)
    left += rng.standard_normal(COUNT)
    _, sizes, right = np.linalg.svd(modes, full_matrices=False)
    vectors = np.array([left, one, two])
    gain, factor = likeliest(sizes**2, vectors @ modes @ right.T, vectors @ vectors.T)
    covariance = np.eye(COUNT) + factor**2 * modes @ modes.T
    after = left - factor * one - factor**2 * two
    square = float(after @ np.linalg.solve(covariance, after))
    square += float(np.linalg.slogdet(covariance)[1])
    assert gain == pytest.approx(float(left @ left) - square, rel=1e-9)
    assert factor == pytest.approx(2.0, rel=0.15)


class Modes:
    """Predictor of one effect that changes two of three channels by given modes."""

    start = np.zeros(0)

    def __init__(self, modes: dict[str, np.ndarray]) -> None:
        self._modes = modes

    def with_effects(self, effects, values):
        return self

    def modes(self, channel, point):
        return self._modes[channel.word]


def test_a_candidate_is_weighed_as_with_its_modes_written_out(monkeypatch):
    rng = np.random.default_rng(8)
    words, n = ("bias_level", "flat_cov", "flat_mean"), 20
    channels = [SimpleNamespace(word=w, whiten=lambda a: 0.5 * a) for w in words]
    given = {
        "bias_level": rng.normal(size=(n, 3)),
        "flat_mean": np.diag(rng.uniform(1, 3, n)),
    }
    effect = SimpleNamespace(scatters=("bias_level", "flat_mean"), name="settling")
    basis = np.linalg.qr(rng.normal(size=(3 * n + 2, 5)))[0]
    fit = SimpleNamespace(channels=channels, starts=np.arange(0, 4 * n, n), basis=basis)
    vectors = rng.normal(size=(3, 3 * n + 2))
    vectors -= vectors @ basis @ basis.T
    whole = np.zeros((3 * n + 2, n + 3))
    whole[:n, :3], whole[2 * n : 3 * n, 3:] = (
        0.5 * given["bias_level"],
        0.5 * given["flat_mean"],
    )
    whole -= basis @ (basis.T @ whole)
    _, sizes, right = np.linalg.svd(whole, full_matrices=False)
    wanted = likeliest(sizes**2, vectors @ whole @ right.T, vectors @ vectors.T)
    found = scatter_of(Modes(given), fit, effect, np.zeros(0))
    assert found.likeliest(*vectors) == pytest.approx(wanted, rel=1e-9)
    monkeypatch.setattr(scatter, "MOST", n - 1)
    with pytest.raises(
        FitError, match="settling has 20 independent changes in flat_mean; at most 19"
    ):
        scatter_of(Modes(given), fit, effect, np.zeros(0))
