"""Amplitudes of candidates at their starting points."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad

from bfsensor.diagnose.detect.candidate_screen import Rival, Screen, _best_factor, evidence
from bfsensor.effects.effect import Effect, Parameter
from bfsensor.effects.persistence import TwoTimesPersistence


@pytest.mark.parametrize("bend", [0.0, 1e-30, 1e-18, 1e-4, 0.5])
@pytest.mark.parametrize("amplitude", [-0.04, 0.05, 3.0])
def test_amplitude_of_a_template_that_is_straight_but_for_rounding(bend, amplitude):
    rng = np.random.default_rng(3)
    one = 400 * rng.standard_normal(300) / np.sqrt(300)
    two = bend * rng.standard_normal(300)
    left = amplitude * one + amplitude**2 * two
    found = _best_factor((one, two), left, signed=True)
    assert found == pytest.approx(amplitude, rel=1e-6)
    if bend < 0.1:
        only = _best_factor((one, two), left, signed=False)
        assert only == pytest.approx(max(amplitude, 0.0), rel=1e-6)


@pytest.mark.parametrize(
    ("law", "value"),
    [
        ("flat", 0.4),
        ("flat", 1.5),
        ("flat", -0.6),
        ("log", 0.4),
        ("log", 8.0),
        ("log", 0.02),
    ],
)
def test_evidence_is_the_integral_over_prior_and_likelihood(law, value):
    """One parameter of a linear model with an error of 2 %, inside and beyond its range."""
    low, high = (0.0, 1.0) if law == "flat" else (0.1, 2.0)

    class Line(Effect):
        word = "line"
        parameters = (Parameter("value", "", low, high, law=law),)

    def prior(
        v,
    ):  # as documented: beyond the range a Gaussian, in the value or its logarithm
        if law == "flat":
            return np.exp(-0.5 * (max(low - v, v - high, 0.0) / 0.25) ** 2)
        near = min(max(v, low), high)
        return np.exp(-0.5 * np.log2(v / near) ** 2) / (near * np.log(high / low))

    error = 0.02 * abs(value)
    gain = (value / error) ** 2  # the chi-square that the best value takes off
    around = quad(
        lambda t: prior(value + error * t) * np.exp(-0.5 * t**2) * error, -8, 8, limit=200
    )[0]
    found = evidence(Line({"value": value}), Line.parameters, gain, np.array([[1 / error]]))
    # Laplace's approximation has the prior constant across the likelihood: at 1.5 and -0.6 its
    # logarithm changes by 8 x 0.03 per error, half the square of that is 0.03 and less.
    assert found == pytest.approx(0.5 * gain + np.log(around), abs=0.05)


def test_no_fit_goes_beyond_what_physics_allows():
    slow = next(p for p in TwoTimesPersistence.parameters if p.name == "slow")
    assert slow.widest == (0.0, 1.0)
    assert slow._replace(ends=(-np.inf, np.inf)).widest == pytest.approx((-0.46, 1.46))
    assert Parameter("reach", "e-", 0.0, 10.0, law="flat", ends=(0.0, np.inf)).widest == (
        0.0,
        15.0,
    )


class Values:
    """Channel of ten values with unit errors."""

    def __init__(self, fold):
        self.fold = fold

    def __len__(self):
        return 10

    def whiten(self, values):
        return values


def screen(left, scatter):
    """Screen of a fitted and a selecting channel; an effect scatters its shape by ``scatter``."""
    out = Screen.__new__(Screen)
    out.fit = SimpleNamespace(
        left=left, channels=[Values("fit"), Values("select")], starts=(0, 10)
    )
    out._select = np.arange(20) >= 10
    out.point = np.zeros(0)
    alone = SimpleNamespace(start=None, modes=lambda channel, _: scatter * np.ones((10, 1)))
    out.predictor = SimpleNamespace(with_effects=lambda effects, point: alone)
    return out


def test_what_scatters_at_random_does_not_refute_an_effect():
    effect = TwoTimesPersistence({p.name: p.low for p in TwoTimesPersistence.parameters})
    template = np.full(20, 10.0)
    # The select fold drew far less than the fit fold, as two tears that ended in like rows.
    left = np.concatenate([np.full(10, 10.0), np.full(10, 2.0)])
    gains = {}
    for scatter in (0.0, 7.0):
        gain, share = screen(left, scatter)._select_gain(effect, template)
        gains[scatter] = gain
        rival = Rival(effect, 1000.0, 0.0, template, gain, share)
        assert rival.refuted == (scatter == 0.0)
    # (8^2 - 2^2) 10 = 600 less; of 640 all but 1 / (1 + 490) are within the scatter.
    assert gains[0.0] == pytest.approx(-600)
    assert gains[7.0] == pytest.approx(-600 + 640 * 490 / 491)
