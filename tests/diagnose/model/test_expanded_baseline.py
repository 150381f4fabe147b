"""A device that is fitted far from its nominal values is solved and linearised there."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.device.condition import Condition
from bfsensor.diagnose import diagnosis, measure_reduced
from bfsensor.diagnose.model import device_baseline, device_solver
from bfsensor.diagnose.model.baseline import Curve
from bfsensor.diagnose.model.cached_response import Walk
from bfsensor.diagnose.model.device_baseline import baseline_of_device, expand_at
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.changed_device import Moved, Solution
from bfsensor.effects.device_parameter import device_parameters
from bfsensor.errors import DeviceError
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.response.edge_response import EdgeResponse

NAME = "silicon.thickness"
HERE = Condition(wavelength=620.0, back_bias=-50.0)


def shift(device):
    """A response with a curvature that a straight line misses."""
    return 1e-9 * (device.silicon.thickness - 90.0) ** 2


@pytest.fixture
def baseline(monkeypatch):
    def walk(device, *, cells, backgrounds=(0.0,), keep=None, laid_for=None):
        k = np.full((len(backgrounds), 2, 5, 5), shift(device))
        return Walk(tuple(backgrounds), np.array([5.0, 100.0]), k, 0.0 * k)

    def solve(device, *, cells, changed):
        slopes = np.array([(shift(other) - shift(device)) / by for other, by in changed])
        dkx = slopes[:, None, None, None] * np.ones((2, 5, 5))
        return EdgeResponse(
            np.array([5.0, 100.0]), dkx[0], dkx[0], dkx, 0.0 * dkx, (0.0, 0.0), 0.0
        )

    monkeypatch.setattr(device_baseline, "walk", walk)
    monkeypatch.setattr(device_solver, "walk", walk)
    monkeypatch.setattr(device_baseline, "solve_response", solve)
    return baseline_of_device(Device.load("itl_sta3800c"), parameters=[NAME])


def test_shifts_are_those_of_the_device_at_nominal_and_fitted_quantities(baseline):
    truth = 1e-9 * 18.0**2
    straight = baseline.at(HERE, {NAME: 8.0})[0][0][2, 2]
    assert straight == pytest.approx(1e-9 * (10.0**2 + 2 * 10.0 * 8.0), rel=1e-3)
    moved = expand_at(baseline, {NAME: 8.0 / baseline.spread[NAME]})
    assert moved.at(HERE, {NAME: 8.0})[0][0][2, 2] == pytest.approx(truth, rel=1e-3)
    assert moved.at(HERE, None)[0][0][2, 2] == baseline.at(HERE)[0][0][2, 2]
    # A straight line through both, so that fits stay linear.
    near = moved.at(HERE, {NAME: 5.0})[0][0][2, 2]
    assert near == pytest.approx(1e-9 * (10.0**2 + 5 / 8 * (18.0**2 - 10.0**2)), rel=1e-3)
    assert moved.nominal == baseline.nominal and moved.spread == baseline.spread
    assert moved.digest != baseline.digest


def test_a_candidate_for_a_quantity_moves_shifts_as_the_fitted_quantity_does(baseline):
    """Else what the fit gains by leaving the quantity's prior is lost between two directions."""
    moved = expand_at(baseline, {NAME: 8.0 / baseline.spread[NAME]})
    for one, steeper in ((baseline, 2 * 10.0), (moved, (18.0**2 - 10.0**2) / 8)):
        slope = one.derivatives_by_condition()[NAME]
        for key, (dkx, _) in slope.items():
            assert dkx[2, 2] == pytest.approx(1e-9 * steeper, rel=1e-3)
            where = Condition(wavelength=key[0], back_bias=key[1])
            change = one.at(where, {NAME: 3.0})[0][0] - one.at(where)[0][0]
            assert dkx[2, 2] == pytest.approx(change[2, 2] / 3.0, rel=1e-6)


def test_curve_is_along_the_line_to_the_solution():
    curve = Curve({"a": 2.0, "b": 1.0}, {})
    assert curve.share({"a": 1.0, "b": 0.5}) == pytest.approx(0.5)
    # At right angles to the line nothing is known but the derivatives.
    assert curve.share({"a": 1.0, "b": -2.0}) == pytest.approx(0.0)


def test_an_effect_solved_beside_fitted_quantities_takes_the_place_of_the_curve(baseline):
    moved = expand_at(baseline, {NAME: 8.0 / baseline.spread[NAME]})
    a = np.full((3, 3), 1e-9)
    table = AreaChangeTable(Path("drawn"), a, a, np.ones((3, 3), bool))
    measured = measure_reduced(table, reach=moved.reach)
    predictor = Predictor(measured, moved)
    nothing = tuple((key, (0 * kx, 0 * ky)) for key, (kx, ky) in moved.edges.items())
    (kind,) = device_parameters({"gates.field_oxide": dict(nothing)}, {"gates.field_oxide": 0.1},
                                {"gates.field_oxide": 1.0})  # fmt: skip
    plain = kind({"gates.field_oxide": 1.5})
    solved = Solution(1.5, Moved(nothing), {NAME: 1.6})
    beside = replace(kind, template=kind.template._replace(solved=solved))(plain.values)

    whole, other = (predictor.with_effects([e]) for e in (plain, beside))
    assert whole.baseline is moved and other.baseline.curve.pulls == {NAME: 1.6}
    there = [b.at(HERE, {NAME: 8.0})[0][0] for b in (other.baseline, baseline, moved)]
    assert np.array_equal(there[0], there[1])
    assert np.all(there[2] > 1.2 * there[0])
    # Results that were cached with the curve do not serve without it.
    assert other.kept is not predictor.kept and other.spots.baseline is other.baseline
    assert other.with_effects([plain]).baseline is moved


def test_small_pulls_and_devices_without_a_solution_stay_as_they_are(baseline, monkeypatch):
    assert diagnosis._expanded(baseline, SimpleNamespace(pulls={NAME: 0.2})) is None
    once = diagnosis._expanded(baseline, SimpleNamespace(pulls={NAME: 1.6}))
    assert once.curve.pulls == {NAME: 1.6}
    assert diagnosis._expanded(once, SimpleNamespace(pulls={NAME: 1.5})) is None
    assert diagnosis._expanded(once, SimpleNamespace(pulls={NAME: 2.5})) is not None

    def refuse(*_, **__):
        raise DeviceError("not depleted")

    monkeypatch.setattr(device_solver, "walk", refuse)
    assert diagnosis._expanded(baseline, SimpleNamespace(pulls={NAME: 1.6})) is None


def test_a_device_far_from_its_solution_is_noted(baseline):
    far = SimpleNamespace(pulls={NAME: 1.6})
    (note,) = diagnosis._not_expanded(baseline, far)
    assert "curved response" in note
    assert diagnosis._not_expanded(diagnosis._expanded(baseline, far), far) == []
