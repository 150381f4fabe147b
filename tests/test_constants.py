"""No constant of a module is defined twice: the second would change what users of the first get."""

import ast
from collections import Counter
from pathlib import Path

import pytest

import bfsensor

FILES = sorted(Path(bfsensor.__file__).parent.rglob("*.py"))


def twice(source: str) -> list[str]:
    """Names in capitals that a module's top level assigns more than once."""
    names = Counter(
        target.id
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name) and target.id.isupper()
    )
    return [name for name, count in names.items() if count > 1]


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_a_constant_is_defined_once(path):
    assert twice(path.read_text()) == []


def test_the_second_definition_is_found():
    assert twice("ALIKE = 2.0\nOTHER = 1\nALIKE = 1.01\n") == ["ALIKE"]
