"""Gauss-Newton steps along a curved minimum, where amplitudes follow shapes; random effects."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.fit.gauss_newton import Steps
from bfsensor.effects.illumination_turbulence import IlluminationTurbulence
from bfsensor.effects.psf_wings import PsfWings
from bfsensor.inference.parameters import FreeParameter, ParameterSpace

PLACES = np.linspace(0.0, 6.0, 40)


def light(frac, sigma):
    """Profile of a halo of Gaussian width ``sigma`` over a window of 6."""
    return frac * np.exp(-0.5 * (PLACES / sigma) ** 2) / sigma


class Halo:
    """One channel: a halo whose width is hardly known, above a level."""

    prior = False
    effects = (PsfWings({"frac": 0.01, "sigma": 3.0}),)
    notes = ()
    baseline = SimpleNamespace(not_below=(), accuracy=())

    def __init__(self, start):
        frac, sigma = start
        self.space = ParameterSpace(
            (
                FreeParameter(
                    "effect 0 psf_wings frac", "effect", 0, frac, 1e-3, False, 0.0, 0.5
                ),
                FreeParameter(
                    "effect 0 psf_wings sigma",
                    "effect",
                    0,
                    sigma,
                    1e-3,
                    self.prior,
                    0.1,
                    30.0,
                ),
            )
        )
        self.names, self.start = self.space.names, self.space.start

    def predict(self, channel, point):
        del channel
        return 1e4 * light(*point)

    def slope(self, channel, point, n, here):
        step = np.array(point)
        step[n] += 1e-5 * max(point[n], 1e-3)
        return (self.predict(channel, step) - here) / (step[n] - point[n])

    def depends(self, channel):
        del channel
        return np.ones(2, bool)

    def linear(self, channel):
        return {"level": np.ones(len(channel))}

    def modes(self, channel, point):
        del point
        return np.zeros((len(channel), 0))


def channel(truth, seed=3):
    values = (
        1e4 * light(*truth) + 5.0 + np.random.default_rng(seed).normal(0, 1, len(PLACES))
    )
    axes = {"n": np.arange(len(PLACES))}
    return Channel("spot", values, (np.eye(len(PLACES)),), axes, "", "fit")


@pytest.mark.parametrize("start", [(0.05, 0.5), (0.002, 1.0), (0.3, 20.0), (0.0, 2.0)])
def test_a_curved_minimum_is_followed_to_its_end(start):
    one = channel((0.02, 3.0))
    steps = Steps(Halo(start), [one])
    steps.go()
    # The least of a grid over widths, with amplitude and level at their best.
    best = np.inf
    for sigma in np.geomspace(0.3, 30, 400):
        design = np.array([1e4 * light(1.0, sigma), np.ones(len(PLACES))]).T
        best = min(best, float(np.linalg.lstsq(design, one.values, rcond=None)[1][0]))
    assert steps.solved.left @ steps.solved.left == pytest.approx(best, abs=0.05)
    # The chi-square returned is that of the point, not one that a linear model promises.
    left = one.values - 1e4 * light(*steps.point)
    left = left - left.mean()
    assert left @ left == pytest.approx(
        float(steps.solved.left @ steps.solved.left), abs=0.02
    )


def test_a_step_that_does_harm_is_not_reported_as_gain():
    """Derivatives of the wrong sign: nothing gains, and the fit stays where it was."""
    halo = Halo((0.01, 3.0))
    forward = halo.slope
    halo.slope = lambda *args: -forward(*args)
    one = channel((0.02, 3.0))
    steps = Steps(halo, [one])
    steps.go()
    left = one.values - 1e4 * light(*steps.point)
    left = left - left.mean()
    assert left @ left == pytest.approx(
        float(steps.solved.left @ steps.solved.left), abs=1e-6
    )
    np.testing.assert_allclose(steps.point, (0.01, 3.0))


class Chance(Halo):
    """An effect with more random effects than values, and a width with a prior."""

    prior = True
    effects = (IlluminationTurbulence({"rms": 1e-3, "corr": 20.0}),)

    def modes(self, channel, point):
        del point
        # Fewer and more columns than values, one of them along the level.
        count = 3 * len(channel)
        out = np.random.default_rng(8).normal(0, 0.4, (len(channel), count))
        out[:, 0] = 2.0
        return out


@pytest.mark.parametrize("start", [(0.02, 3.0), (0.0, 2.0), (0.4, 3.0)])
def test_random_effects_are_projected_out(start):
    """Chi-squares and errors of the projected problem are those of the whole one."""
    steps = Steps(Chance(start), [channel((0.02, 3.0))])
    steps.differentiate(np.ones(2, bool), steps.point)
    whole = steps.solve(steps.point, np.ones(2, bool))
    left, slopes = steps._projected(steps.point), steps._projected_slopes()
    assert len(whole.solution) > 100 and slopes.shape[1] == 2
    assert left @ left == pytest.approx(whole.left @ whole.left, rel=1e-10)
    used = slopes.any(0)
    errors = np.sqrt(np.diag(np.linalg.inv(slopes[:, used].T @ slopes[:, used])))
    np.testing.assert_allclose(errors, whole.errors[:2][used], rtol=1e-8)


def test_the_last_solution_holds_all_parameters():
    steps = Steps(Chance((0.02, 3.0)), [channel((0.02, 3.0))])
    steps.go()
    assert len(steps.solved.solution) == 2 + 1 + 3 * len(PLACES)
    assert steps.solved.basis.shape[1] > 100
