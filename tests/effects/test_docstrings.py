"""Docstrings of effects state the parameters and plausible ranges that the classes declare."""

import pytest

from bfsensor.effects import LIBRARY


@pytest.mark.parametrize("kind", LIBRARY, ids=lambda kind: kind.__name__)
def test_a_docstring_states_the_range_of_every_parameter(kind):
    text = " ".join(kind.__doc__.split())
    for p in kind.parameters:
        unit = f" [{p.unit}]" if p.unit else ""
        place = p.name[0] == "x" and p.name[1:].isdigit()
        if place:  # places of hot columns are stated together
            assert "``x1`` to ``x6`` [pixel]" in text
            continue
        assert f"``{p.name}``{unit}: {p.low:g} to {p.high:g}" in text
