"""Docstrings of effects state the parameters and plausible ranges that the classes declare."""

import pytest

from bfsensor.effects import LIBRARY, HotColumns


@pytest.mark.parametrize("kind", LIBRARY, ids=lambda kind: kind.__name__)
def test_a_docstring_states_the_range_of_every_parameter(kind):
    text = " ".join(kind.__doc__.split())
    for p in kind.parameters:
        unit = f" [{p.unit}]" if p.unit else ""
        family = p.name.rstrip("0123456789")
        if kind is HotColumns and family != p.name:  # places and parts are stated together
            together = {
                "x": "``x1`` to ``x6`` [pixel]",
                "part": "``part2`` to ``part6``: 0.02 to 1",
            }
            assert together[family] in text
            continue
        assert f"``{p.name}``{unit}: {p.low:g} to {p.high:g}" in text
