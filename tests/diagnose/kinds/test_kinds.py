"""Kinds of channels: one for each name, known to effects, to the report and to its schema."""

from __future__ import annotations

import json
from importlib import resources

import pytest

from bfsensor.diagnose.data.channels import WORDS
from bfsensor.diagnose.kinds import KINDS
from bfsensor.diagnose.kinds.channel_kind import ChannelKind
from bfsensor.diagnose.report.class_words import NAMES
from bfsensor.effects import Effect

BY_OTHER_METHODS = {"flat_cov", "flat_map", "spot"}
"""Kinds that effects change by several methods of other names, such as :meth:`Effect.covariances`."""


def test_each_channel_has_one_kind() -> None:
    assert set(KINDS) == set(WORDS) and len(KINDS) == len(WORDS)


@pytest.mark.parametrize("word", WORDS)
def test_a_kind_is_known_wherever_channels_are(word: str) -> None:
    kind = KINDS[word]
    assert kind.name == word and NAMES[word] == kind.title
    assert type(kind).patterns is not ChannelKind.patterns
    assert word in BY_OTHER_METHODS or callable(getattr(Effect, word))
    schema = resources.files("bfsensor.diagnose.report") / "report.schema.json"
    assert word in _texts(json.loads(schema.read_text()))


def _texts(node: object) -> set[str]:
    """All words that lists of a schema enumerate."""
    if isinstance(node, dict):
        return set().union(*map(_texts, node.values())) if node else set()
    if isinstance(node, list):
        return {v for v in node if isinstance(v, str)}.union(*map(_texts, node))
    return set()
