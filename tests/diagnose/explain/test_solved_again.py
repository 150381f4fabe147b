"""Quantities of a device are solved at their fitted values, and fitted again."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bfsensor import Device
from bfsensor.diagnose.data.channels import PER_ELECTRON
from bfsensor.diagnose.detect.candidate_screen import Rival
from bfsensor.diagnose.explain.attribution import Found, tied_quantities
from bfsensor.diagnose.explain.solved_again import MOST_SOLVED, WORSE, Resolver
from bfsensor.diagnose.model.device_solver import PHASES, DeviceSolver
from bfsensor.diagnose.report.attribution_words import _said_quantity
from bfsensor.diagnose.report.headlines import headline
from bfsensor.effects.changed_device import Moved, Quantity, Solution
from bfsensor.effects.charge_loss import ChargeLoss
from bfsensor.effects.device_parameter import device_parameters
from bfsensor.effects.effect import Layout, Parameter, Shot
from bfsensor.effects.family import TemplateFamily
from bfsensor.effects.interpixel_coupling import InterpixelCoupling
from bfsensor.effects.simulated_physics import SiliconPhysics
from bfsensor.effects.voltage_dependence import VoltageDependence
from bfsensor.errors import DeviceError

KEY = (620.0, -50.0)
SHOT = Shot("flat", 0, 1.0, *KEY, 173.15)
LAYOUT = Layout((8, 8), ())
NOMINAL, TRUTH = 2.0, 5.0
OTHER = "gates.field_oxide"


def shape(size):
    k = np.zeros((3, 3))
    k[1, 1] = size
    return k, k.T


def response(value):
    """A shift that saturates with the quantity, as no straight line does."""
    return 1e-6 * np.tanh((value - NOMINAL) / 4.0)


def family(**solved):
    (made,) = device_parameters(
        {"silicon.thickness": {KEY: shape(1e-6 / 4.0)}}, {"silicon.thickness": 0.5},
        {"silicon.thickness": NOMINAL}, units={"silicon.thickness": "um"},
        bounds={"silicon.thickness": (-1.5, 8.0)},
    )  # fmt: skip
    return replace(made, template=made.template._replace(**solved))


def together(by, other):
    """What another quantity adds to the shift: a part of its own, and one that grows with the first."""
    return other * (2e-7 + 5e-8 * by)


class Solver:
    def __init__(self, refuses=np.inf):
        self.asked, self.refuses = [], refuses

    def moved(self, name, value, *, cells, levels, beside):
        self.asked.append((value, cells, levels))
        self.beside = beside
        if value > self.refuses:
            raise DeviceError("not depleted")
        size = response(value) + together(value - NOMINAL, beside.get(OTHER, 0.0))
        return Moved(((KEY, shape(size)),))


class Fit:
    """Model of one number, the shift that was measured, which the effect is fitted to.

    Another quantity has a pull, which the baseline predicts by its derivative.
    """

    def __init__(self, effects, pull=0.0):
        channel = SimpleNamespace(
            word="flat_cov", unit=PER_ELECTRON, axes={"level": np.array([4e4, 4e4])}
        )
        baseline = SimpleNamespace(
            units={OTHER: "um"}, spread={OTHER: 2.0}, nominal={OTHER: 0.0}, temperature=173.15,
            derivative=lambda name, key: shape(2e-7),
        )  # fmt: skip
        self.predictor = SimpleNamespace(baseline=baseline)
        self.other = 2.0 * pull
        self.fit = SimpleNamespace(channels=[channel], total=0.0, pulls={OTHER: pull})
        self.effects = [self._fitted(effects[0])]

    def _fitted(self, effect):
        values = np.linspace(*effect.parameters[0].ends, 4001)
        (name,) = effect.values
        got = np.array([shift(effect.with_values(**{name: v})) for v in values])
        true = response(TRUTH) + together(TRUTH - NOMINAL, self.other)
        best = values[np.argmin(abs(got + 2e-7 * self.other - true))]
        return effect.with_values(**{name: float(best)})

    def with_effects(self, effects):
        return Fit(effects, self.fit.pulls[OTHER])


def shift(effect):
    return effect.edges(*shape(0.0), SHOT, LAYOUT)[0][1, 1]


def test_a_template_is_that_of_the_derivative_and_of_the_solution():
    solved = Solution(6.0, Moved(((KEY, shape(response(6.0))),)))
    kind = family(solved=solved)
    assert shift(kind({"silicon.thickness": 6.0})) == pytest.approx(response(6.0))
    near = shift(kind({"silicon.thickness": NOMINAL + 1e-4}))
    assert near == pytest.approx(1e-4 * 1e-6 / 4.0, rel=1e-3)
    assert shift(kind({"silicon.thickness": NOMINAL})) == 0.0
    # Without a derivative it is the straight line.
    line = family(solved=solved, slopes=())
    assert shift(line({"silicon.thickness": 4.0})) == pytest.approx(0.5 * response(6.0))


def test_the_fitted_value_is_that_of_the_solved_device():
    solver = Solver()
    linear = Fit([family()({"silicon.thickness": 3.0})])
    wrong = linear.effects[0]["silicon.thickness"]
    assert wrong == pytest.approx(NOMINAL + 4.0 * np.tanh(0.75), abs=1e-3)
    found = Resolver(solver).model(linear, 0).effects[0]
    assert found["silicon.thickness"] == pytest.approx(TRUTH, abs=0.02)
    assert 1 < len(solver.asked) <= MOST_SOLVED
    # The last solution is on the mesh of the baseline.
    again = Resolver(solver).settled(Fit([found])).effects[0]
    assert solver.asked[-1][1:] == (32, False)
    assert again["silicon.thickness"] == pytest.approx(TRUTH, abs=0.02)


def test_the_device_is_solved_with_all_fitted_quantities_at_once():
    solver = Solver()
    linear = Fit([family()({"silicon.thickness": 3.0})], pull=1.5)
    found = Resolver(solver).model(linear, 0).effects[0]
    assert solver.beside == {OTHER: 3.0}
    assert found["silicon.thickness"] == pytest.approx(TRUTH, abs=0.15)
    assert found.solved_beside == {OTHER: 1.5}
    # With the quantity alone its value would take what both together do.
    alone = replace(found.of, template=found.template._replace(
        solved=Solution(TRUTH, Moved(((KEY, shape(response(TRUTH))),)))))  # fmt: skip
    wrong = Fit([alone({"silicon.thickness": TRUTH})], pull=1.5).effects[0]
    assert abs(wrong["silicon.thickness"] - TRUTH) > 0.5


def test_a_step_beyond_the_possible_is_halved():
    solver = Solver(refuses=3.5)
    linear = Fit([family()({"silicon.thickness": 3.0})])
    resolver = Resolver(solver)
    found = resolver.model(linear, 0).effects[0]
    assert [value for value, *_ in solver.asked][:2] == pytest.approx([4.5, 3.3])
    assert found.template.solved.value < 3.5
    assert "taken by its derivative, not solved at" in resolver.notes[0]


def test_a_value_far_from_its_solution_is_noted():
    resolver = Resolver(Solver(refuses=3.5))
    linear = Fit([family()({"silicon.thickness": 3.0})])
    found = resolver.settled(linear).effects[0]
    own = found.template.solved.value
    assert own < 3.5 < found["silicon.thickness"]
    assert any(f"is extrapolated from a solution at {own:.3g}" in n for n in resolver.notes)
    resolver = Resolver(Solver())
    resolver.settled(Fit([family()({"silicon.thickness": 3.0})]))
    assert resolver.notes == []


def test_a_fit_that_is_worse_than_another_is_not_solved_for_again():
    solver = Solver()
    linear = Fit([family()({"silicon.thickness": 3.0})])
    Resolver(solver).model(linear, 0, best=-2 * WORSE)
    assert len(solver.asked) == 1


def test_what_has_no_solution_is_taken_by_its_derivative_and_noted():
    resolver = Resolver(Solver(refuses=2.1))
    linear = Fit([family()({"silicon.thickness": 3.0})])
    assert resolver.model(linear, 0) is linear
    (note,) = resolver.notes
    assert (
        "device_parameter:silicon.thickness: taken by its derivative, not solved at 4.5"
        in note
    )


def test_nothing_is_solved_without_a_device_or_between_numbers_of_gates():
    linear = Fit([family()({"silicon.thickness": 3.0})])
    assert Resolver(None).model(linear, 0) is linear
    gates = Parameter(PHASES, "gates", 1.0, 2.0, neutral=2.0, law="flat", signed=True,
                      amplitude=True, ends=(1.0, 2.0))  # fmt: skip
    template = Quantity(PHASES, 2.0, 1.0, (), Solution(1.0, Moved(((KEY, shape(1e-7)),))))
    kind = TemplateFamily(
        SiliconPhysics, "silicon_physics", "fewer_gates", template, "", (gates,)
    )
    assert not Resolver(Solver()).acts(kind({PHASES: 1.5}))
    assert shift(kind({PHASES: 1.5})) == pytest.approx(0.5e-7)


def test_values_beyond_what_a_device_can_have_are_not_fitted():
    kind = family()
    assert kind.parameters[0].widest == (NOMINAL - 1.5, NOMINAL + 8.0)
    assert [s["silicon.thickness"] for s in kind.starts(LAYOUT)] == pytest.approx(
        [NOMINAL + 0.5 * 48**0.5, NOMINAL - 1.5]
    )


def test_another_quantity_that_does_as_well_is_named_beside_it():
    kind = family()
    (named,) = device_parameters(
        {OTHER: {KEY: shape(1e-7)}}, {OTHER: 0.1}, {OTHER: 1.0}, units={OTHER: "um"},
        bounds={OTHER: (-1.0, 8.0)},
    )  # fmt: skip
    own = Rival(kind({"silicon.thickness": 3.0}), 40.0, 15.0, np.array([1.0, 0.0]))
    close = Rival(named({OTHER: 1.5}), 39.0, 14.0, np.array([0.9, 0.1]))
    loss = Rival(ChargeLoss({"q": 1e-7}), 39.0, 14.0, np.array([0.9, 0.1]))
    assert tied_quantities(own.effect, [own, close, loss]) == (OTHER,)
    assert tied_quantities(own.effect, [own, replace(close, gain=20.0), loss]) == ()
    assert tied_quantities(loss.effect, [loss, close]) == ()
    found = Found(
        own.effect,
        40.0,
        {"silicon.thickness": 0.1},
        {},
        ("device_parameter",),
        (own, close),
    )
    assert headline(found).endswith("nominally 2 um, or field oxide differs")
    vague = replace(found, errors={"silicon.thickness": 4000.0})
    assert "is 3 um (not constrained), nominally 2 um" in headline(vague)


def test_the_quantity_that_does_best_stands_beside_a_law_of_the_shifts():
    quantity = family()({"silicon.thickness": 3.0})
    law, coupling = (
        VoltageDependence({"delta": -0.05}),
        InterpixelCoupling({"ax": 1e-3, "ay": 1e-3, "decay": 0.0}),
    )
    rival = Rival(quantity, 50.0, 20.0, np.array([0.7, 0.7]))

    def found(effect, gain, tied=()):
        own = Rival(effect, gain, 40.0, np.array([1.0, 0.0]))
        return Found(effect, gain, {}, {}, (effect.word, *tied), (own, rival))

    assert found(law, 100.0).quantity is rival
    (said,) = _said_quantity(found(law, 100.0))
    assert said.startswith(
        "Of the device's quantities thickness does best: at 3 um, nominally 2, it takes 50 of 100"
    )
    assert "may be the cause" in said
    # It is tied, is nearer to nothing than to the law, or what was found is no law of the shifts.
    assert found(law, 100.0, ("device_parameter",)).quantity is None
    assert found(law, 201.0).quantity is None
    assert found(coupling, 100.0).quantity is None
    assert found(quantity, 100.0).quantity is None
    assert _said_quantity(found(coupling, 100.0)) == []


def test_a_value_beyond_the_last_that_could_be_solved_has_an_open_interval():
    def found(value, pulls):
        solved = Solution(4.0, Moved(((KEY, shape(response(4.0))),)), pulls)
        effect = family(solved=solved)({"silicon.thickness": value})
        return Found(effect, 40.0, {"silicon.thickness": 0.1}, {}, ("device_parameter",))

    told = found(5.0, {}).intervals()["silicon.thickness"]
    assert (told["lo95"], told["hi95"]) == (4.0, 5.0)
    assert told["open95"] == told["stopped95"] == ["hi"]
    assert "is more than 4 um" in headline(found(5.0, {}))
    # Near the solution, and where the candidate was never solved at a fitted value, errors stand.
    for near in (found(4.1, {}), found(5.0, None)):
        assert "open95" not in near.intervals()["silicon.thickness"]


def test_a_solver_states_values_in_units_of_device_files():
    device = Device.load("itl_sta3800c")
    solver = DeviceSolver(device.to_toml(), (-50.0,), (620.0,), True, True)
    name = "channel_stop.implant[0].dose"
    assert solver.unit(name) == "cm-2" and solver.nominal(name) < -1e11
    less = solver.device_at(name, 0.5 * solver.nominal(name), -60.0)
    assert less.operating_point.back_bias == -60.0
    assert less.channel_stop.implants[0].dose == pytest.approx(
        0.5 * device.channel_stop.implants[0].dose
    )
    assert solver.device_at(PHASES, 1.0, -50.0).gates.collecting_phases == 1
    # Acceptors cannot become donors, nor a stop have a negative diffusion.
    assert solver.range(name)[1] == 0.0
    assert solver.range("channel_stop.side_diffusion")[0] == 0.0


def test_a_device_whose_mesh_cannot_be_moved_is_solved_on_its_own(monkeypatch):
    asked = []

    def walk(device, *, cells, backgrounds, keep, laid_for=None):
        asked.append(laid_for is not None)
        if laid_for is not None:
            raise DeviceError("not in the order of those that the mesh was laid for")
        size = 1e-6 * device.silicon.thickness
        return SimpleNamespace(edges=lambda wavelength, kelvin: shape(size))

    monkeypatch.setattr("bfsensor.diagnose.model.device_solver.walk", walk)
    device = Device.load("itl_sta3800c")
    solver = DeviceSolver(device.to_toml(), (-50.0,), (620.0,), True, True)
    ((key, (kx, _)),) = solver.moved("silicon.thickness", 103.0).edges
    assert key == KEY and kx[1, 1] == pytest.approx(3e-6)
    assert asked == [False, True, False]
