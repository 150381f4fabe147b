"""Mutated inputs of every door: clear errors or right acceptance, within 5 s and 512 MB each."""

from __future__ import annotations

import pytest

from bfsensor.errors import RecordingError
from tests.fuzz.__main__ import main
from tests.fuzz.doors import DOORS, fuzz
from tests.fuzz.outcomes import Case, Outcome, run

FEW = 32
"""Inputs of each door of the plain run: 512 of sixteen doors take about ten CPU seconds."""

MANY = 640
"""Inputs of each door of the slow run, 10,240 in all."""

SEED = 6271


@pytest.mark.parametrize("name", DOORS)
def test_mutated_inputs_are_refused_clearly_or_read_rightly(name, tmp_path):
    counts, faults = fuzz(name, tmp_path, range(FEW), SEED)
    assert counts.total() == FEW
    assert not [str(one) for one in faults]


@pytest.mark.slow
@pytest.mark.parametrize("name", DOORS)
def test_many_mutated_inputs(name, tmp_path):
    counts, faults = fuzz(name, tmp_path, range(MANY), SEED + 1)
    assert counts.total() == MANY
    assert not [str(one) for one in faults]


def _raise(error):
    raise error


def _spin():
    while True:
        pass


@pytest.mark.parametrize(
    ("load", "judge", "keeps", "outcome"),
    [
        (lambda: _raise(RecordingError("a.csv: no")), str, False, Outcome.CLEAR),
        (lambda: _raise(RecordingError("a.csv: no")), str, True, Outcome.REFUSED),
        (lambda: _raise(RecordingError("no file is named")), str, False, Outcome.FOREIGN),
        (lambda: _raise(KeyError("a.csv")), str, False, Outcome.FOREIGN),
        (lambda: 3, lambda made: "" if made == 3 else "wrong", False, Outcome.RIGHT),
        (lambda: 3, lambda made: "" if made == 4 else "wrong", False, Outcome.SILENT),
        (lambda: bytearray(1 << 40), str, False, Outcome.LIMIT),
        (_spin, str, False, Outcome.LIMIT),
    ],
)
def test_outcomes_are_told_apart(load, judge, keeps, outcome, monkeypatch):
    monkeypatch.setattr("tests.fuzz.outcomes.SECONDS", 0.2)
    assert run(Case("", load, judge, ("a.csv",), keeps)).outcome is outcome


def test_a_check_that_is_lost_is_found(monkeypatch, capsys):
    """Without the check of ranges, devices outside them are accepted, and the table says so."""
    for place in ("checks", "device"):
        monkeypatch.setattr(f"bfsensor.device.{place}.check_range", lambda *args: None)
    assert main(["--door", "device", "--count", "200", "--seed", str(SEED)]) == 1
    assert "silent acceptance: --door device --seed 6271 --only" in capsys.readouterr().out
