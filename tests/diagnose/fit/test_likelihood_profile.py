"""Intervals by likelihood profiles: none where the chi-square is a parabola, else exact ends."""

from __future__ import annotations

import numpy as np
import pytest

from bfsensor.diagnose.explain.attribution import WIDENED, Found
from bfsensor.diagnose.fit import likelihood_profile as profile
from bfsensor.diagnose.fit.likelihood_profile import LOWER, linear_interval, ranged, settle
from bfsensor.effects.effect import Parameter
from bfsensor.effects.psf_wings import PsfWings
from bfsensor.errors import ConvergenceError
from bfsensor.inference.likelihood_profile import Profile, Scale, profiles_in
from bfsensor.inference.local_likelihood import LocalLikelihood

AMP = Parameter("amp", "", 0.1, 10.0, signed=True, amplitude=True)
SHAPE = Parameter("shape", "", 0.1, 10.0, law="flat")
WIDTHS = 1.0, 1.96


def valley(left, best, parameters=(AMP, SHAPE)):
    """Chi-square near a point of residuals in closed form, with central derivatives."""
    best, h = np.array(best, float), 1e-6
    slopes = np.stack(
        [(left(best - h * d) - left(best + h * d)) / (2 * h) for d in np.eye(len(best))], 1
    )
    own = [ranged(p) for p in parameters]
    return LocalLikelihood(own, best, left, slopes, np.full(len(best), 1e-4))


def test_of_linear_parameters_errors_are_believed():
    design = np.random.default_rng(8803).normal(size=(40, 2))
    assert (
        profiles_in(valley(lambda p: -design @ (p - [1.0, 2.0]), [1.0, 2.0]), WIDTHS) == {}
    )


def test_a_parabola_has_the_interval_of_its_errors():
    """Held at values with a nuisance that follows, it rises as the covariance says."""
    x = np.linspace(-3.0, 5.0, 9)
    low, high, *closed = Profile(x, (x - 1.0) ** 2 / 0.25).interval(1.96)
    # Straight roots are interpolated exactly.
    assert (low, high) == pytest.approx((0.02, 1.98)) and all(closed)


def bent(p):
    """Amplitude times an exponential, as a trap's release: values at 1 to 6, errors of 0.25."""
    k = np.arange(1.0, 7.0)
    return (2.0 * np.exp(-k / 2.0) - p[0] * np.exp(-k / p[1])) / 0.25


def exact_rise(shape):
    """The amplitude is linear: at any shape its best is known."""
    k = np.arange(1.0, 7.0)
    data, form = 2.0 * np.exp(-k / 2.0) / 0.25, np.exp(-k / shape) / 0.25
    return data @ data - (data @ form) ** 2 / (form @ form)


@pytest.mark.parametrize("width", WIDTHS)
def test_a_bent_case_has_its_exact_profile(width):
    found = profiles_in(valley(bent, [2.0, 2.0]), WIDTHS)
    low, high, *closed = found["shape"].interval(width)
    assert all(closed)
    # A twentieth of the interval: 1 % of the rise is given away, the rest is interpolation.
    for end in (low, high):
        assert np.sqrt(exact_rise(end)) == pytest.approx(width, rel=0.05), end
    # The parabola's ends would be far off: the profile is needed here.
    error = valley(bent, [2.0, 2.0]).errors[1]
    assert abs(exact_rise(2.0 + 1.96 * error) / 1.96**2 - 1) > 0.3
    # The amplitude follows the same curve: its ends are those of the best shape there.
    k = np.arange(1.0, 7.0)
    shapes = np.linspace(0.3, 12.0, 20_001)[:, None]
    amp = found["amp"].interval(width)[1]
    rises = (((2.0 * np.exp(-k / 2.0) - amp * np.exp(-k / shapes)) / 0.25) ** 2).sum(1)
    assert np.sqrt(rises.min()) == pytest.approx(width, rel=0.05)


def test_the_units_of_parameters_do_not_matter():
    """A parameter a hundred million times smaller than another, as 1/e- beside a power."""
    unit = np.array([1e-8, 1.0, 1e3])

    def left(p):
        k = np.arange(1.0, 9.0)
        return (2.0 * np.exp(-k / 2.0) + 0.1 - p[0] * np.exp(-k / p[1]) - p[2]) / 0.25

    def found(unit):
        parameters = [
            Parameter(n, "", 0.1 * u, 10.0 * u, law="flat", signed=True)
            for n, u in zip("abc", unit, strict=True)
        ]
        best = np.array([2.0, 2.0, 0.1])
        step = 1e-6 * unit
        slopes = np.stack(
            [
                (left(best - d / unit) - left(best + d / unit)) / (2 * s)
                for d, s in zip(np.diag(step), step, strict=True)
            ],
            1,
        )
        own = [ranged(p) for p in parameters]
        near = LocalLikelihood(
            own, best * unit, lambda p: left(p / unit), slopes, 1e-4 * unit
        )
        return near, profiles_in(near, WIDTHS)

    (plain, usual), (scaled, other) = found(np.ones(3)), found(unit)
    assert scaled.errors / unit == pytest.approx(plain.errors)
    assert usual.keys() == other.keys() >= {"a", "b"}
    for name, u in zip("ab", unit, strict=False):
        for width in WIDTHS:
            low, high, *closed = other[name].interval(width)
            assert [low / u, high / u, *closed] == pytest.approx(
                usual[name].interval(width)
            )


def test_a_parameter_that_does_not_matter_has_the_whole_range():
    told = profiles_in(valley(lambda p: np.array([3.0 * (p[0] - 1.0)]), [1.0, 4.0]), WIDTHS)
    low, high, *closed = told["shape"].interval(1.0)
    # Half of the range beyond either end is where fits may go.
    assert (low, high) == pytest.approx((0.1 - 4.95, 10.0 + 4.95)) and not any(closed)
    assert "amp" not in told


def test_a_chi_square_that_flattens_on_one_side_has_one_open_end():
    """A wide halo fits as well as a wider one: the width has no upper end."""

    def left(p):
        return np.array([5.0 * (np.tanh(p[0]) - np.tanh(1.5)), 0.1])

    low, high, low_closed, high_closed = profiles_in(valley(left, [1.5], [SHAPE]), WIDTHS)[
        "shape"
    ].interval(1.0)
    assert low_closed and low == pytest.approx(np.arctanh(np.tanh(1.5) - 0.2), rel=0.02)
    assert not high_closed and high == pytest.approx(14.95)


def test_where_nothing_is_predicted_an_end_is_open():
    def left(p):
        if p[0] > 4.0:
            raise ConvergenceError("no shape any more")
        return np.array([2.0 * np.sqrt(max(p[0], 0.0)) - 2.0 * np.sqrt(3.9)])

    *_, low_closed, high_closed = profiles_in(valley(left, [3.9], [SHAPE]), WIDTHS)[
        "shape"
    ].interval(1.0)
    assert low_closed and not high_closed


def test_a_place_that_the_fit_missed_is_in_the_interval_with_its_value():
    """The chi-square is lowest at 3, the fit ended at 2, where its rise is 1."""
    told = profiles_in(
        valley(
            lambda p: np.array([(p[0] - 3.0) ** 3 + 0.3 * (p[0] - 3.0)]), [2.0], [SHAPE]
        ),
        WIDTHS,
    )
    assert told["shape"].values[np.argmin(told["shape"].rises)] == pytest.approx(
        3.0, abs=0.3
    )


def test_intervals_of_a_found_effect_use_profiles_and_state_open_ends():
    effect = PsfWings({"frac": 0.01, "sigma": 5.0})
    errors = {"frac": 0.001, "sigma": 1.0}
    x = np.linspace(3.0, 24.0, 43)
    profile = Profile(x, np.where(x < 5.0, 4.0 * (x - 5.0) ** 2, 0.0))
    told = Found(effect, 20.0, errors, {}, (), (), {"sigma": profile}).intervals()
    assert told["sigma"]["lo68"] == pytest.approx(5.0 - WIDENED / 2, abs=0.01)
    assert told["sigma"]["hi68"] == 24.0 and told["sigma"]["open68"] == ["hi"]
    low, high = linear_interval(0.01, WIDENED * 0.001, PsfWings.parameters[0])
    assert (told["frac"]["lo68"], told["frac"]["hi68"]) == (low, high)
    assert "open68" not in told["frac"]
    assert "stopped68" not in told["sigma"] and effect.parameters[1].widest[1] == 24.0
    x = np.linspace(3.0, 20.0, 43)
    profile = Profile(x, np.where(x < 5.0, 4.0 * (x - 5.0) ** 2, 0.0))
    told = Found(effect, 20.0, errors, {}, (), (), {"sigma": profile}).intervals()
    # Inside the range of fits: there was nothing to follow it by.
    assert told["sigma"]["open68"] == told["sigma"]["stopped68"] == ["hi"]


class Fitted:
    """A fit in closed form that steps do not move: it stays where it is put."""

    def __init__(self, values, refused=()):
        self.values, self.refused = np.array(values, float), refused
        self.effects = (self,)
        self.total = float(bent(self.values) @ bent(self.values))
        self.fit = self

    changes = PsfWings.changes

    def with_values(self, amp, shape):
        return Fitted([amp, shape], self.refused)

    def with_effects(self, effects):
        if "all" in self.refused:
            raise ConvergenceError("nothing converges")
        return effects[0]


@pytest.fixture
def valleys(monkeypatch):
    monkeypatch.setattr(
        profile, "valley_of", lambda model, n: valley(bent, model.values, (AMP, SHAPE))
    )


@pytest.mark.parametrize("start", [[2.6, 1.5], [1.2, 3.2]])
def test_a_fit_that_ended_early_goes_on_where_profiles_are_lower(valleys, start):
    began = Fitted(start)
    assert began.total > 2 * LOWER
    settled, found = settle(began, 0, WIDTHS)
    assert settled.total < 2 * LOWER
    low, high, *closed = found["shape"].interval(1.0)
    assert low < 2.0 < high
    assert all(closed)


def test_a_fit_at_its_lowest_stays(valleys):
    began = Fitted([2.0, 2.0])
    settled, found = settle(began, 0, WIDTHS)
    assert settled is began
    assert found


def test_a_fit_that_cannot_go_on_stays(valleys):
    began = Fitted([2.6, 1.5], refused=("all",))
    settled, found = settle(began, 0, WIDTHS)
    assert settled is began
    assert found


def test_profiles_that_the_whole_fit_refutes_are_not_reported(valleys):
    """A fit from the lowest point of a profile that ends where it was: linear errors stand."""
    began = Fitted([2.6, 1.5])
    began.with_values = lambda amp, shape: began
    settled, found = settle(began, 0, WIDTHS)
    assert settled is began
    assert found == {}


def test_the_lowest_point_is_kept():
    here = valley(bent, [2.6, 1.5])
    assert here.lowest.square == here.square
    profiles_in(here, WIDTHS)
    assert here.lowest.square < here.square
    left = bent(here.lowest.values)
    assert here.lowest.square == pytest.approx(float(left @ left))


@pytest.mark.parametrize("best", [0.05, 0.5, 50.0])
def test_a_scale_and_its_inverse_agree_far_below_the_plausible_range(best):
    """Lower ends of weak effects lie there; a scale that stops at the range would hide them."""
    own = ranged(Parameter("amp", "", 0.1, 10.0, amplitude=True))
    scale = Scale.of(own, best)
    for value in best * np.array([0.01, 0.3, 1.0, 40.0]):
        assert scale.value(scale.place(value)) == pytest.approx(value, rel=1e-12)
