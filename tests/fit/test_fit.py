"""The whole fit: result, files, priors by name, what is tied."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from bfsensor import Device
from bfsensor.device.condition import Condition
from bfsensor.device.quantities import choose_priors, quantities, with_priors
from bfsensor.errors import DeviceError, FitError
from bfsensor.fit.degeneracies import find_ties, principal
from bfsensor.fit.fit import fit_device
from bfsensor.fit.result import WELL_KNOWN, FitResult, FittedSet
from tests.fit.test_least_squares import TRUTH
from tests.fit.toys import MEANS, PRIORS, SPREADS, toy_data, toy_emulator
from tests.response.linear_emulator import quadrant

DEVICE = Device.load("itl_sta3800c")


def run(**more):
    emulator = toy_emulator()
    sets = [toy_data(emulator, TRUTH, 12), toy_data(emulator, TRUTH, 13, fitted=False)]
    return fit_device(
        with_priors(DEVICE, PRIORS), sets, PRIORS, emulator, source="a toy", **more
    )


def test_result_is_written_and_read_back_equal(tmp_path):
    result = run(profiles=["silicon.thickness"], notes=["a note"])
    result.write(tmp_path / "fit.json")
    again = FitResult.read(tmp_path / "fit.json")
    assert again == result
    np.testing.assert_array_equal(again.covariance, result.covariance)
    assert again.sets[1].fitted is False and np.isnan(again.sets[1].scale_error)
    assert again.said() == result.said()
    other = json.loads((tmp_path / "fit.json").read_text())
    other["value"][0] += 1e-12
    (tmp_path / "other.json").write_text(json.dumps(other))
    assert FitResult.read(tmp_path / "other.json") != result


def test_a_device_that_is_not_depleted_where_it_was_measured_is_refused_first():
    emulator = toy_emulator()
    data = toy_data(emulator, TRUTH, 12, condition=Condition(back_bias=-5.0))
    with pytest.raises(
        DeviceError, match=r"back_bias = '-5 V' does not deplete the silicon"
    ):
        fit_device(with_priors(DEVICE, PRIORS), [data], PRIORS, None)


def test_fitted_device_has_values_uncertainties_and_origin():
    result = run()
    device = Device.from_toml(result.fitted_device)
    assert device.silicon.thickness == pytest.approx(result.value[0], rel=1e-12)
    known = device.provenance["silicon.thickness"]
    assert known.origin == "fitted" and known.source == "a toy"
    assert known.uncertainty == pytest.approx(result.error[0])
    assert known.uncertainty < SPREADS[0]
    assert device.operating_point.back_bias == pytest.approx(result.value[2])
    # What was not free is as it was.
    assert device.gates == DEVICE.gates
    assert Device.from_toml(result.device).silicon == DEVICE.silicon


def test_predictions_carry_the_posterior():
    result = run()
    held = result.sets[1]
    slope = toy_emulator().predict(np.array(MEANS), None).jacobian
    i, j = held.places.T
    expected = np.sqrt(np.diag(slope[:, j, i].T @ result.covariance @ slope[:, j, i]))
    np.testing.assert_allclose(held.after_error, expected, rtol=1e-10)
    # Drawn from the same truth: 25 pulls of a unit width.
    assert np.mean(held.pulls**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 25))
    assert np.mean(((held.before - held.values) / held.errors) ** 2) > 2


def test_what_is_said():
    lines = run(notes=["a note"]).said().splitlines()
    assert lines[0].split() == ["parameter", "prior", "fitted", "pull"]
    assert lines[1].startswith("thickness") and "100.0 +- 5.0 um" in lines[1]
    assert "(-2.40 +- 0.80)e12 cm-3" in lines[2]
    assert any("not fitted" in line for line in lines)
    assert "note: a note" in lines
    assert lines[-1].startswith("chi2/n = ") and "/25 = " in lines[-1]


def test_damaged_results_are_refused(tmp_path):
    path = tmp_path / "fit.json"
    path.write_text("{")
    with pytest.raises(FitError, match=r"fit\.json: "):
        FitResult.read(path)
    path.write_text('{"schema": "other"}')
    with pytest.raises(FitError, match="its schema is 'other'"):
        FitResult.read(path)
    path.write_text('{"schema": "bfsensor device fit 1"}')
    with pytest.raises(FitError, match=r"fit\.json: .*KeyError"):
        FitResult.read(path)


def test_priors_by_name():
    everything = choose_priors(DEVICE, ("all", "back_bias:5 V"))
    names = [prior.name for prior in everything]
    assert "well.spill_barrier" not in names and names[-1] == "operating_point.back_bias"
    assert everything[-1].spread == 5.0
    # One given with a spread of its own counts over the file's.
    (doping,) = choose_priors(DEVICE, ("background_doping:1e11 cm-3",))
    assert doping.spread == pytest.approx(0.1)
    assert (doping.low, doping.high) == (-1e6, 0.0)
    (other,) = choose_priors(DEVICE, ("background_doping:-1.7e12 cm-3+-7e11 cm-3",))
    assert (other.mean, other.spread) == pytest.approx((-1.7, 0.7))
    known = with_priors(DEVICE, (doping,)).provenance["silicon.background_doping"]
    assert known.uncertainty == pytest.approx(0.1) and known.origin == "published"
    for asked, message in (
        (("dose",), "no quantity 'dose' in the device; did you mean channel"),
        (("thicknes",), "did you mean silicon.thickness"),
        (("gate_high",), "states no uncertainty of operating_point.gate_high: give one"),
        (("thickness:5 V +- 1 um",), "--free thickness:5 V .. 1 um: '5 V' is not a length"),
        (
            ("background_doping:1e12 cm-3+-1e11 cm-3",),
            "background_doping: 1 lies outside -1e",
        ),
        (("thickness:5 V",), "--free thickness:5 V: '5 V' is not a length"),
        (("thickness:0 um",), "spread of the prior 0.0 must be above 0"),
    ):
        with pytest.raises(FitError, match=message):
            choose_priors(DEVICE, asked)
    sure = Device.from_toml(DEVICE.to_toml().replace('"guessed"', '"fitted"'))
    with pytest.raises(FitError, match=r"'guessed'.*: all, or"):
        choose_priors(sure)


def test_quantities_are_those_of_the_file():
    known = quantities(DEVICE)
    assert set(DEVICE.provenance) <= set(known)
    assert known["channel_stop.implant[1].dose"].value == -8000.0
    assert known["gates.gate_oxide"].low == 0.0


def test_a_tie_of_two_is_found_where_it_is():
    rng = np.random.default_rng(5)
    one, other, third = rng.normal(size=(3, 20))
    names = ("silicon.thickness", "gates.gate_oxide", "gates.field_oxide")
    tied = np.column_stack([one, -2 * one + 0.2 * other, third])
    ties, silent = find_ties(names, tied)
    assert silent == () and len(ties) == 1
    assert ties[0].startswith("gate oxide and thickness (opposite sign)")
    assert find_ties(names, np.column_stack([one, other, third]))[0] == ()
    # The tied direction is worse known than either of two untied ones.
    known = principal(np.linalg.inv(np.eye(3) + tied.T @ tied))
    assert known[-1].remains > known[0].remains
    np.testing.assert_allclose(np.abs(known[-1].weights[:2]), [0.89, 0.45], atol=0.05)


def test_a_profile_of_what_is_held_is_refused():
    with pytest.raises(FitError, match=r"gates\.gate_oxide .*free are silicon"):
        run(profiles=["gates.gate_oxide"])


def bent(emulator, values):
    """Shifts with a term that is quadratic in the first parameter."""
    by = (values[0] - MEANS[0]) / SPREADS[0]
    return tuple((1 + 0.15 * by + 0.08 * by**2) * e for e in emulator.edges)


def test_gauss_and_newton_find_the_minimum_of_what_is_not_straight():
    emulator, asked = toy_emulator(count=1), []
    truth = np.array([MEANS[0] + 1.5 * SPREADS[0]])

    def linearise(values):
        asked.append(values)
        step = 1e-5 * SPREADS[0]
        low, here, high = (bent(emulator, values + s * step) for s in (-1, 0, 1))
        slopes = tuple((b - a)[None] / (2 * step) for a, b in zip(low, high, strict=True))
        return replace(emulator, nominal=values, edges=here, slopes=slopes)

    data = toy_data(linearise(truth), truth, 12, part=0.01, scaled=False)
    found = fit_device(DEVICE, [data], PRIORS[:1], None, linearise=linearise)
    i, j = data.places.T

    def minimised(value):
        a = quadrant(*bent(emulator, np.array([value])))[j, i]
        return (
            np.sum(((a - data.values) / data.errors) ** 2)
            + ((value - MEANS[0]) / SPREADS[0]) ** 2
        )

    best = minimize_scalar(minimised, (MEANS[0], truth[0]), method="brent")
    assert found.value[0] == pytest.approx(best.x, abs=0.02 * found.error[0])
    assert found.notes[-1].startswith("settled in ") and 3 <= len(asked) <= 8
    # One tangent alone ends elsewhere.
    once = fit_device(DEVICE, [data], PRIORS[:1], linearise(np.array(MEANS[:1])))
    assert abs(once.value[0] - best.x) > 2 * found.error[0]


def test_a_step_to_where_there_is_no_device_is_halved():
    emulator, asked = toy_emulator(), []

    def linearise(values):
        asked.append(values)
        if len(asked) == 2:
            raise FitError("no such device")
        return emulator

    data = toy_data(emulator, TRUTH, 12)
    found = fit_device(DEVICE, [data], PRIORS, None, linearise=linearise)
    np.testing.assert_allclose(asked[2] - MEANS, 0.5 * (asked[1] - MEANS))
    wanted = fit_device(DEVICE, [data], PRIORS, emulator)
    np.testing.assert_allclose(found.value, wanted.value, rtol=1e-6)

    def nowhere(values):
        if np.any(values != np.array(MEANS)):
            raise FitError("no such device")
        return emulator

    with pytest.raises(FitError, match="no solution"):
        fit_device(DEVICE, [data], PRIORS, None, linearise=nowhere)


def test_profiles_are_told_with_their_bounds_beside_those_of_the_error():
    result = run(profiles=["silicon.thickness"])
    found = result.bounds()["silicon.thickness"]
    for share, reach in (("68 %", 1.0), ("95 %", np.sqrt(3.84))):
        wanted = result.value[0] + reach * result.error[0] * np.array([-1, 1])
        np.testing.assert_allclose(found[share], wanted, rtol=1e-4)
    assert result.to_dict()["profile_bounds"] == {"silicon.thickness": found}
    (line,) = [one for one in result.said().splitlines() if one.startswith("profile of")]
    assert line.startswith("profile of thickness: 68 % ") and "open" not in line


def test_what_draws_leave_of_combinations_is_told():
    result = run()
    known = np.sum(result.remains < WELL_KNOWN)
    assert known >= 1 and "of draws" not in result.said()
    ends = [[-0.31 - n, 0.12 + n] for n in range(len(result.parameters))]
    drawn = replace(result, posterior={"combinations": {"central_95": ends}})
    lines = [one for one in drawn.said().splitlines() if one.startswith("measured to")]
    assert len(lines) == known and lines[0].endswith("; 95 % of draws from -0.31 to +0.12")


def test_devices_drawn_from_the_posterior_widen_it():
    emulator, asked = toy_emulator(), []

    def solved(values):
        """The toy with a_ij quadratic in the thickness, unlike its linear predictions."""
        asked.append(values)
        bend = 0.02 * ((values[0] - MEANS[0]) / SPREADS[0]) ** 2
        return replace(emulator, edges=tuple((1 + bend) * e for e in emulator.edges))

    plain = run()
    assert plain.posterior["curved"] is False and "solved" not in plain.posterior
    assert any("do not include" in note for note in plain.notes)
    wide = run(solved=solved, draws=9)
    assert len(asked) == 9 and wide.posterior["solved"] == 9
    np.testing.assert_array_equal(wide.value, plain.value)
    assert np.all(wide.error >= plain.error) and wide.error[1] > 1.02 * plain.error[1]
    np.testing.assert_allclose(wide.posterior["tangent_error"], plain.error)
    assert wide.remains[0] > 1.02 * plain.remains[0]
    same = run(solved=lambda values: emulator)
    np.testing.assert_allclose(same.covariance, plain.covariance, rtol=1e-8)
    np.testing.assert_allclose(
        same.sets[1].after_error, plain.sets[1].after_error, rtol=1e-6
    )


@pytest.mark.parametrize("fitted", [True, False])
def test_pulls_scatter_by_one(fitted):
    """Predictions of data that were not fitted have errors of their own: 4,000 normal numbers."""
    n, scale, rng = 4000, 1.7, np.random.default_rng(640)
    errors, own = rng.uniform(1, 3, n), rng.uniform(2, 4, n)
    found = FittedSet(
        name="", kind="areas", unit="", fitted=fitted, labels=("",) * n,
        places=np.zeros((n, 2), int), values=scale * errors * rng.standard_normal(n),
        errors=errors, before=np.zeros(n),
        after=np.zeros(n) if fitted else own * rng.standard_normal(n), after_error=own,
        chi2=0.0, chi2_before=0.0, scale=scale, scale_error=0.0, determined=0.0,
    )  # fmt: skip
    assert found.pulls.std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * n))
