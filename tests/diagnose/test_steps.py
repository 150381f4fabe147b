"""Steps of a fit where amplitudes follow shapes along a curved valley."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.diagnose.channels import Channel
from bfsensor.diagnose.steps import Steps
from bfsensor.effects.psf_wings import PsfWings

PLACES = np.linspace(0.0, 6.0, 40)


def light(frac, sigma):
    """Of a halo, seen over a window that it outgrows, and what that adds to a width."""
    return frac * np.exp(-0.5 * (PLACES / sigma) ** 2) / sigma


class Halo:
    """One channel: a halo whose width is hardly known, above a level."""

    names = ("effect 0 psf_wings frac", "effect 0 psf_wings sigma")
    prior_rows = np.array([], int)
    effects = (PsfWings({"frac": 0.01, "sigma": 3.0}),)
    notes = ()

    def __init__(self, start):
        self.start = np.array(start, float)

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

    def shapes(self):
        return np.array([False, True])

    def reach(self, point):
        return np.array([[0.0 - point[0], -0.5 * point[1]], [0.5 - point[0], point[1]]])


def channel(truth, seed=3):
    values = (
        1e4 * light(*truth) + 5.0 + np.random.default_rng(seed).normal(0, 1, len(PLACES))
    )
    axes = {"n": np.arange(len(PLACES))}
    return Channel("spot", values, (np.eye(len(PLACES)),), axes, "", "fit")


@pytest.mark.parametrize("start", [(0.05, 0.5), (0.002, 1.0), (0.3, 20.0), (0.0, 2.0)])
def test_the_valley_is_followed_to_its_end(start):
    one = channel((0.02, 3.0))
    steps = Steps(Halo(start), [one])
    steps.go_carefully()
    # The least of a grid over widths, with amplitude and level at their best.
    best = np.inf
    for sigma in np.geomspace(0.3, 30, 400):
        design = np.array([1e4 * light(1.0, sigma), np.ones(len(PLACES))]).T
        best = min(best, float(np.linalg.lstsq(design, one.values, rcond=None)[1][0]))
    assert steps.solved.left @ steps.solved.left == pytest.approx(best, abs=0.05)
    # What is told is what the point gives.
    left = one.values - 1e4 * light(*steps.point)
    left = left - left.mean()
    assert left @ left == pytest.approx(
        float(steps.solved.left @ steps.solved.left), abs=0.02
    )


def test_harm_is_not_told_as_gain():
    """Derivatives of the wrong sign: nothing gains, and the fit stays where it was."""
    halo = Halo((0.01, 3.0))
    forward = halo.slope
    halo.slope = lambda *args: -forward(*args)
    one = channel((0.02, 3.0))
    steps = Steps(halo, [one])
    steps.go_carefully()
    left = one.values - 1e4 * light(*steps.point)
    left = left - left.mean()
    assert left @ left == pytest.approx(
        float(steps.solved.left @ steps.solved.left), abs=1e-6
    )
    np.testing.assert_allclose(steps.point, (0.01, 3.0))
