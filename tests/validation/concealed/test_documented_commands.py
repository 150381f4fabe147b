"""Command lines of the documentation that make and score concealed campaigns are accepted."""

from __future__ import annotations

import pytest

from tests.docs.examples import accept, commands, ignore_files
from validation.concealed.__main__ import main

LINES = [c for c in commands() if c.values[0][1:3] == ["-m", "validation.concealed"]]


@pytest.mark.parametrize("words", LINES)
def test_command_lines_are_accepted(words, monkeypatch):
    ignore_files(monkeypatch)
    assert accept(main, "concealed", words[3:])


def test_there_are_such_lines():
    assert len(LINES) >= 4
