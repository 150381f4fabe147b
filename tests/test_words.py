"""The checker of words finds what it is made to find."""

from __future__ import annotations

import pytest

from tests.words import ROOT, dialect, faults, texts


@pytest.mark.parametrize(
    "text",
    [
        "Strengths that are told by scatter.", "Left to chance.", "Bends of the valley.",
        "Taken anew where it walked.", "Off its card.", "A free form.", "Foreign shadows.",
    ],
)  # fmt: skip
def test_dialect_is_found(text):
    assert list(dialect(text))


@pytest.mark.parametrize(
    "text",
    [
        "Two effects that cannot be told apart.", "Keys: device_card, outside_library.",
        "A FITS card.", "The header card GAIN.",
    ],
)  # fmt: skip
def test_the_words_of_the_field_and_of_contracts_stay(text):
    assert not list(dialect(text))


def test_constants_and_openings_are_found(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.words.ROOT", tmp_path)
    (tmp_path / "bfsensor").mkdir()
    path = tmp_path / "bfsensor" / "some.py"
    path.write_text(
        '"""Of two constants."""\n\nLIMIT = 3.0\n"""Largest residual [sigma]."""\n\n'
        'WIDTH = 2.0\n"""Width [pixel]; chosen, twice as much takes twice the time."""\n'
    )
    assert [(fault.line, fault.text) for fault in faults(path)] == [
        (1, "begins without a subject: 'Of two constants.'"),
        (3, "LIMIT states no origin"),
    ]
    assert ROOT.is_dir()


@pytest.mark.parametrize("path", texts(), ids=lambda path: str(path.relative_to(ROOT)))
def test_texts_of_the_package_and_its_documentation_keep_the_rules(path):
    """Dialect, texts without a subject, constants without an origin: ``python -m tests.words``."""
    assert not [str(fault) for fault in faults(path)]
