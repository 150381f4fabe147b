"""Results are those that were recorded."""

from __future__ import annotations

import pytest

from tests.golden.cases import CASES
from tests.golden.record import differences, machine, make_entry, read_record, same_machine

RECORD = read_record()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.golden if case.quick else pytest.mark.slow)
        for name, case in CASES.items()
    ],
)
def test_results_are_those_recorded(name):
    here = same_machine(name, RECORD, machine())
    assert differences(name, make_entry(name), RECORD, bits=here) == []


def test_what_differs_is_said():
    """A last bit where bits count; elsewhere a number beyond its tolerance or its error."""
    held = {"digests": {"image": "a"}, "numbers": {"sum": 100.0, "x": 1.0, "x width": 0.5}}
    record = {"cases": {"star/itl": held}}

    def said(*, bits=False, **changed):
        numbers = held["numbers"] | changed
        entry = {"digests": {"image": "b"}, "numbers": numbers}
        return differences("star/itl", entry, record, bits=bits)

    assert said(bits=True) == ["star/itl: image is not the same, bit for bit"]
    assert said() == said(sum=100.19) == said(x=1.099) == []
    assert said(sum=100.21) == ["star/itl: sum is 100.21, was 100 +- 0.2"]
    assert said(x=1.11) == ["star/itl: x is 1.11, was 1 +- 0.1"]
    assert said(sum=float("nan")) and said(y=1.0)
    assert differences("star/e2v", held, record, bits=True) == ["star/e2v: not recorded"]
