"""Coverage of the fit's intervals for devices drawn from their priors."""

from __future__ import annotations

import numpy as np

from bfsensor import Device
from bfsensor.device.quantities import choose_priors
from tests.fit.toys import MEANS, PRIORS, SPREADS, toy_emulator
from validation.device_fit.mock_fits import draw_truth, pulls_of_ranks, recover

MOCKS = 150
EMULATOR = toy_emulator()
ERRORS = np.full((5, 5), 0.02 * np.abs(EMULATOR.predict(np.array(MEANS), None).areas[0, 1]))


def all_of(rows):
    return next(row for row in rows if row["kind"] == "all")


def test_intervals_cover_as_they_say_whatever_the_errors_are_told_to_be():
    for misstated in (1.0, 3.0):
        rows, told = recover(
            EMULATOR, PRIORS, ERRORS, mocks=MOCKS, seed=88, misstated=misstated
        )
        whole = all_of(rows)
        assert abs(whole["within_68"] - 0.683) < 3.5 * whole["within_68_error"]
        assert abs(whole["within_95"] - 0.95) < 3.5 * whole["within_95_error"]
        assert abs(whole["pull"]) < 3.5 * whole["pull_error"]
        # One scale has an error of 15 %; 1 / misstated on average.
        assert abs(whole["scale"] * misstated - 1) < 3 * 0.15 / np.sqrt(MOCKS) + 0.02
        assert len(rows) >= len(PRIORS) + 2 and told["silent"] == []


def test_a_truth_that_the_emulator_does_not_know_is_not_covered():
    """Of another toy: the same machinery sees that intervals are wrong."""
    other = toy_emulator(seed=99)

    def areas(values):
        step = 4 * (values - np.array(MEANS))
        return other.predict(np.array(MEANS) + step / np.array(SPREADS), None).areas

    rows, _ = recover(EMULATOR, PRIORS, ERRORS, mocks=30, seed=88, areas=areas)
    assert all_of(rows)["within_68"] < 0.5


def test_a_device_that_cannot_be_is_drawn_again():
    refused = []

    def areas(values):
        if values[0] > MEANS[0]:
            refused.append(values[0])
            raise ValueError("no such device")
        return EMULATOR.predict(values, None).areas

    rows, _ = recover(EMULATOR, PRIORS, ERRORS, mocks=10, seed=3, areas=areas)
    assert refused and all_of(rows)["mocks"] == 10


def test_the_truth_s_rank_among_normal_draws_is_its_pull():
    draws = 3.0 + 2.0 * np.random.default_rng(5).standard_normal((40_000, 1))
    for truth in (1.0, 3.0, 6.0):
        assert abs(pulls_of_ranks(draws - truth)[0] - (3.0 - truth) / 2.0) < 0.03
    assert np.isfinite(pulls_of_ranks(draws - 99.0)).all()


def test_truths_are_devices_that_can_be():
    """E2V's oxides are equally thick: drawn apart, half of the pairs would be out of order."""
    priors = choose_priors(Device.load("e2v_ccd250"), ("gate_oxide", "field_oxide"))
    rng = np.random.default_rng(7)
    gate, field = np.array([draw_truth(priors, rng) for _ in range(200)]).T
    assert [p.name for p in priors] == ["gates.gate_oxide", "gates.field_oxide"]
    assert np.all(gate <= field) and gate.std() > 0.3 * priors[0].spread


def test_mocks_that_were_stopped_go_on(tmp_path):
    """As in one go: truths, noise, combinations and rows."""
    kept = tmp_path / "mocks.pickle"
    whole, told = recover(EMULATOR, PRIORS, ERRORS, mocks=6, seed=3)
    recover(EMULATOR, PRIORS, ERRORS, mocks=2, seed=3, kept=kept)
    rows, again = recover(EMULATOR, PRIORS, ERRORS, mocks=6, seed=3, kept=kept)
    assert rows == whole
    assert again | {"cpu_s_a_fit": 0} == told | {"cpu_s_a_fit": 0}
    other, _ = recover(EMULATOR, PRIORS, ERRORS, mocks=6, seed=4)
    assert rows != other
