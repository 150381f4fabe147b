"""Words that no text of the package uses, and origins that every constant states.

``python -m tests.words [FOLDER_OR_FILE ...]`` lists what a path breaks, a line each.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]

DIALECT = {
    r"\btold\b(?! apart)": "constrained by, stated, given, or returned",
    r"\btells?\b(?! apart)|\btelling\b": "states, reports, shows, or constrains",
    r"\bleft to chance\b": "random effect",
    r"\bvalleys?\b": "likelihood profile",
    r"\b(?:walks?|walked|walking)\b": "cached response, path, or electron's drift",
    r"(?<!FITS )(?<!header )(?<!device )\bcards?\b": "nominal value, nominal device, or keyword",
    r"\boff its card\b": "differs from its nominal value",
    r"\banew\b": "again",
    r"\bevened out\b": "relaxed by brighter-fatter feedback",
    r"\bfree[- ]form\b": "nonparametric",
    r"\bforeign\b": "unmodelled, or of another origin",
    r"\bshadow(?:s|ed|ing)?\b": "correlated template",
    r"\bsightings?\b": "detected fringe",
    r"\bstraight in\b": "linear in",
    r"\b(?:bends?|bent|bending)\b": "quadratic, or second-order",
    r"\bfrom memory\b": "the source, looked up",
    r"\bg(?:ive|ives|iven|ave) up\b": "reported as not converged, or refused",
    r"\bcounts for nothing\b": "is negligible below a stated size",
    r"\bwhat nothing\b|\bwhat no\b": "a noun and a verb",
}
"""Pattern of a word of this project's own, and what the field says instead."""

OPENINGS = re.compile(r"(?:Of|What|That|Those|Whose|Which|Where|How|Part of what)\b")
"""First words of a text that is not a sentence or a noun with its meaning."""

ORIGINS = re.compile(
    r"\b(?:derived|measured|published|chosen|defined|definition|exact|fitted)\b|\b(?:19|20)\d\d\b",
    re.IGNORECASE,
)
"""A constant's value is derived (the formula), measured (the command), published (the source, with
its year), chosen (what changes if it is twice as large), defined by a standard, or exact."""

APART = (
    "docs/glossary.md", "docs/gallery", "docs/reference/generated", "docs/validation",
    "docs/concepts/effects.md",
)  # fmt: skip
"""The page that lists the dialect, and pages that are generated."""

CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")


class Fault(NamedTuple):
    """A place that breaks a rule."""

    path: Path
    line: int
    text: str

    def __str__(self) -> str:
        """Path, line and what is wrong there."""
        return f"{self.path.relative_to(ROOT)}:{self.line}: {self.text}"


def dialect(text: str) -> Iterator[tuple[int, str]]:
    """Words of a text that have a better one, with their lines from 0."""
    for pattern, better in DIALECT.items():
        for found in re.finditer(pattern, text, re.IGNORECASE):
            line = text.count("\n", 0, found.start())
            yield line, f"'{found.group()}': say {better}"


def sentences(source: str) -> Iterator[tuple[int, str]]:
    """Docstrings, texts with a space in them, and comments of Python code, with their lines."""
    tree = ast.parse(source)
    names = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.keyword)}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and (" " in node.value.strip() or id(node) in names)
        ):
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Texts that stand as a statement: docstrings of modules, functions, classes, constants."""
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            yield node.lineno, node.value.value


def constants(source: str) -> Iterator[tuple[int, str, str]]:
    """Line, name and explanation of a module's constants that hold a number.

    The explanation is the docstring below, the comments right above, and one at the line's end.
    """
    lines = source.splitlines()
    body = ast.parse(source).body
    for at, node in enumerate(body):
        target = (
            node.targets[0]
            if isinstance(node, ast.Assign)
            else getattr(node, "target", None)
        )
        value = getattr(node, "value", None)
        if not isinstance(target, ast.Name) or value is None:
            continue
        if not CONSTANT.fullmatch(target.id) or not any(
            isinstance(n, ast.Constant) and type(n.value) in (int, float)
            for n in ast.walk(value)
        ):
            continue
        words = [
            line.partition("#")[2] for line in lines[node.lineno - 1 : node.end_lineno]
        ]
        above = node.lineno - 2
        while above >= 0 and lines[above].lstrip().startswith("#"):
            words.append(lines[above])
            above -= 1
        below = body[at + 1] if at + 1 < len(body) else None
        if (
            isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
            and isinstance(below.value.value, str)
        ):
            words.append(below.value.value)
        yield node.lineno, target.id, " ".join(words)


def faults(path: Path) -> Iterator[Fault]:
    """All that a file breaks; a text that is no Python is looked through for words only."""
    source = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        for line, what in dialect(source):
            yield Fault(path, line + 1, what)
        return
    for start, text in sentences(source):
        for line, what in dialect(text):
            yield Fault(path, start + line, what)
    for line, text in docstrings(source):
        if OPENINGS.match(text.lstrip()):
            first = text.strip().splitlines()[0]
            yield Fault(path, line, f"begins without a subject: {first!r}")
    if path.is_relative_to(ROOT / "bfsensor"):
        for line, name, words in constants(source):
            if not ORIGINS.search(words):
                yield Fault(path, line, f"{name} states no origin")


def texts(*places: Path) -> list[Path]:
    """Files under some places, by default those of the package and of the documentation."""
    places = places or (ROOT / "bfsensor", ROOT / "docs", ROOT / "README.md")
    found = [
        path
        for place in places
        for path in ([place] if place.is_file() else sorted(place.rglob("*")))
        if path.suffix in (".py", ".md") and path.is_file()
    ]
    return [p for p in found if not any(p.is_relative_to(ROOT / name) for name in APART)]


if __name__ == "__main__":
    for place in texts(*(Path(word).resolve() for word in sys.argv[1:])):
        for fault in sorted(set(faults(place)), key=lambda f: f.line):
            print(fault)
