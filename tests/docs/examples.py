"""Texts of the pages, their examples and command lines, and how command lines are parsed."""

from __future__ import annotations

import re
import shlex

import click
import pytest

from tests.docs.pages import DOCS, load

GENERATED = (
    "gallery",
    "validation",
    "reference/generated",
    "concepts/effects.md",
    "reference/api.md",
)
"""Pages of other code's docstrings, which are tested there, and of results."""

REFERENCE = {
    f"reference/{name}": make() for name, make in load("reference_pages").PAGES.items()
}
PAGES = {
    name: path.read_text(encoding="utf-8")
    for path in sorted(DOCS.rglob("*.md"))
    if not (name := path.relative_to(DOCS).as_posix()).startswith(GENERATED)
    and name not in REFERENCE
} | REFERENCE
"""Text of the pages, also of those that are written when the site is built."""


def blocks(page, *languages):
    """Text of a page's fenced blocks of some languages, with the line that each begins on."""
    text = PAGES[page]
    for found in re.finditer(r"^```(\w+)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        if found[1] in languages:
            yield text.count("\n", 0, found.start(2)), found[2]


def commands():
    """Command lines of shell blocks, by page and line, comments and continuations resolved."""
    for page in PAGES:
        for start, text in blocks(page, "sh", "console", "bash"):
            joined = text.replace("\\\n", " ")
            for n, line in enumerate(joined.splitlines()):
                words = shlex.split(line, comments=True)
                yield pytest.param(words, id=f"{page}:{start + n + 1}")


def accept(command, name, words, parent=None):
    """Let click parse a command line down to its last command, without running any."""
    with command.make_context(name, list(words), parent=parent) as context:
        if isinstance(command, click.Group):
            rest = [*context._protected_args, *context.args]
            inner, found, left = command.resolve_command(context, rest)
            return accept(found, inner, left, context)
    return name


def ignore_files(monkeypatch):
    """Let click accept names of files that only a reader of an example has."""
    plain = click.Path.convert

    def convert(self, value, param, context):
        self.exists = False
        return plain(self, value, param, context)

    monkeypatch.setattr(click.Path, "convert", convert)
