"""The first sentence of a report has values, errors and units, for every class of the library."""

from dataclasses import dataclass
from string import Formatter

import pytest

from bfsensor.diagnose.explain.attribution import Found
from bfsensor.diagnose.report.class_words import CLASS_WORDS
from bfsensor.diagnose.report.headlines import HEADLINES, _amount, headline, headlines
from bfsensor.effects.charge_diffusion import charge_diffusion
from bfsensor.effects.cti_serial import CtiSerial
from bfsensor.effects.library import LIBRARY
from bfsensor.effects.quantum_yield import quantum_yield
from bfsensor.effects.simulated_physics import DiffusionWidths
from bfsensor.effects.trap_serial import TrapSerial


def found_of(kind, errors=0.05):
    """An effect in the middle of its plausible range, every parameter fitted."""
    values = {p.name: (p.low + p.high) / 2 for p in kind.parameters}
    for p in kind.parameters:
        if p.law == "whole":
            values[p.name] = float(round(values[p.name]))
    fitted = {
        p.name: errors * abs(values[p.name]) + 1e-12
        for p in kind.parameters if p.law != "whole"
    }  # fmt: skip
    return Found(kind(values), 100.0, fitted, {kind.word: 1.0}, (kind.word,))


WIDTHS = DiffusionWidths((((620.0, -50.0), 0.05),), 173.15)
PIECES = charge_diffusion(WIDTHS), quantum_yield(WIDTHS)


@pytest.mark.parametrize("kind", [*LIBRARY, *PIECES], ids=lambda k: f"{k.word}:{k.variant}")
def test_every_class_has_a_headline_with_its_size(kind):
    text = headline(found_of(kind))
    assert text != CLASS_WORDS[kind.word] and "{" not in text
    sizes = {p.name for p in kind.parameters if p.amplitude}
    templates = HEADLINES[kind.word]
    names = [{n for _, n, _, _ in Formatter().parse(t) if n} for t in templates]
    used = next(n for n in names if n <= {p.name for p in kind.parameters})
    assert sizes & used and "+-" in text


def test_values_are_those_of_the_effect():
    effect = CtiSerial({"cti": 1.1234e-6})
    found = Found(effect, 100.0, {"cti": 2e-8}, {"cti_serial": 1.0}, ("cti_serial",))
    assert headline(found) == (
        "serial transfer leaves 1.123e-06 +- 2.2e-08 of the charge behind at each step"
    )
    values = {"size": 30.0, "tau": 1.5, "amp": 0.0, "reach": 100.0}
    trap = TrapSerial(values)
    found = Found(
        trap, 9.0, {"size": 1.0, "tau": 0.1}, {"trap_serial": 1.0}, ("trap_serial",)
    )
    assert "of amplifier 1 holds 30 +- 1.1 e-" in headline(found)


def test_pieces_of_silicon_physics_are_said_as_a_physicist_would():
    effect = PIECES[0]({"growth": 3.1})
    found = Found(
        effect, 100.0, {"growth": 0.4}, {"silicon_physics": 1.0}, ("silicon_physics",)
    )
    assert headline(found) == (
        "diffusion widens by 3.1 +- 0.45 % (variance) per 1e5 e- of charge in the pixel"
    )


@dataclass
class Left:
    detected: bool


@dataclass
class Told:
    found: tuple
    mismatch: Left
    open_world: bool = False
    taken: float = 1.0


def test_what_is_left_is_said():
    one = found_of(CtiSerial)
    assert headlines(Told((one,), Left(False))).endswith("Nothing else is left.")
    assert headlines(Told((one,), Left(True))).endswith("More is left, see below.")
    assert headlines(Told((one,), Left(False), open_world=True)).endswith("see below.")
    assert headlines(Told((), Left(True))) == ""
    assert headlines(Told((one, one), Left(False))).startswith("Serial transfer")
    little = headlines(Told((one,), Left(True), taken=0.007))
    assert little.startswith("No effect of the library explains 99.3 % of what stands out.")
    assert "The smaller part: serial transfer" in little


@pytest.mark.parametrize(
    ("open_", "said"),
    [
        ([], "45000 +- 2.5e+02"),
        (["lo"], "less than 4.52e+04"),
        (["hi"], "more than 4.47e+04"),
        (["lo", "hi"], "4.5e+04 (not constrained)"),
    ],
)
def test_an_open_interval_has_no_error(open_, said):
    told = {"value": 45000.0, "lo68": 44700.0, "hi68": 45200.0, "open68": open_}
    assert _amount(told, whole=False) == said


def test_a_value_within_a_million_of_itself_is_not_constrained():
    told = {"value": 8.4e-5, "lo68": 2e-15, "hi68": 3.5e6}
    assert _amount(told, whole=False) == "8.4e-05 (not constrained)"
    assert _amount(told | {"hi68": 3e-4}, whole=False) == "8.4e-05 +- 0.00015"
