"""Mutants: what is changed in a line, and what is left alone."""

from __future__ import annotations

from tests.mutants import sites
from tests.mutants.sites import Mutant, known, mutants_of

SOURCE = '''\
import numpy as np

LIMIT = 2.0


def spread(x: float, y: float) -> float:
    """Give the root of 2 * x + y."""
    if not x < 0:
        raise ValueError(f"{x - 1} is wrong")
    return np.sqrt(2.0 * x + y)


def describe(x):
    return 2 * x
'''


def test_changes_of_each_line(tmp_path, monkeypatch):
    monkeypatch.setattr(sites, "ROOT", tmp_path)
    path = tmp_path / "bfsensor" / "room" / "some.py"
    path.parent.mkdir(parents=True)
    path.write_text(SOURCE)
    found = list(mutants_of(path))
    assert {m.room for m in found} == {"room"}
    # Not the constant, the docstring, the message, the annotations or what makes a text.
    assert {m.line for m in found} == {8, 10}
    after = {(m.kind, m.after.removeprefix("return ")) for m in found}
    assert after == {
        ("not", "if (x < 0):"), ("comparison", "if not x <= 0:"), ("comparison", "if not x > 0:"),
        ("axis", "if not y < 0:"), ("root", "(2.0 * x + y)"), ("sign", "np.sqrt(2.0 * x - y)"),
        ("term", "np.sqrt((2.0 * x))"), ("term", "np.sqrt((y))"), ("term", "np.sqrt((2.0) + y)"),
        ("term", "np.sqrt((x) + y)"), ("factor", "np.sqrt(1.0 * x + y)"),
        ("axis", "np.sqrt(2.0 * y + y)"), ("axis", "np.sqrt(2.0 * x + x)"),
    }  # fmt: skip
    (halved,) = (m for m in found if m.kind == "factor")
    halved.apply(tmp_path)
    assert path.read_text() == SOURCE.replace("sqrt(2.0", "sqrt(1.0")


def test_lines_of_the_known_mutants_are_in_the_package():
    assert len(known()) == 5
    assert all(isinstance(m, Mutant) and sites._is_other_code(m) for m in known())
