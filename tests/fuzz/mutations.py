"""Mutations of texts, of trees of plain values, and of bytes; every one is said in words."""

from __future__ import annotations

import copy
import re
from typing import Any, NamedTuple

import numpy as np

Rng = np.random.Generator

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
WORD = re.compile(r"\b[A-Za-z_][A-Za-z0-9_]{2,}\b")

NUMBERS = (
    "0", "-1", "1e30", "-1e30", "nan", "inf", "-inf", "1e-300", "1e400", "9" * 400, "0x10", "1_0",
    "1,5", "1e3", "5", "17", "0.5", "1.0000001", "--3", "", "-0.0", "99999999",
)  # fmt: skip
"""Texts in place of a number."""

OTHERS = (
    '"text"', "true", "null", "[1, 2]", "{a: 1}", "[]", "''", "~", "x" * 10_000, "\x1b[31mred",
    "\u202etxet", "\u0661\u0662", "*a", "&a [1]", "!!python/object:os.system x", "\u00b5m", "\x00",
)  # fmt: skip
"""Texts in place of a value of another type."""

VALUES: tuple[Any, ...] = (
    0, -1, 1e30, float("nan"), float("inf"), -float("inf"), 1e-300, 10**400, True, False, None, "",
    "text", "7", "1e400", [], [1.0, 2.0], {}, {"a": 1}, [[[[1]]]], "x" * 5000, "\x1b[31m", "\u202e",
    0.5, 3, 1e9, -0.0, 2**63, b"bytes", (1, 2), 1 + 2j,
)  # fmt: skip
"""Python values in place of another one."""


class Mutated(NamedTuple):
    """A mutated input: what was done, the bytes, and whether the meaning is the same."""

    words: str
    data: bytes
    keeps: bool = False


def pick(rng: Rng, items: Any) -> Any:
    """One of several items."""
    return items[int(rng.integers(len(items)))]


def short(value: Any) -> str:
    """A value in words of at most 40 characters."""
    if isinstance(value, int) and abs(value) > 10**300:
        return "a huge int"
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def mutate_text(rng: Rng, text: str, first: int = 0) -> Mutated:
    """Mutate a text of lines in one way; the first lines are left alone by changes of values."""
    return pick(rng, (_number, _number, _number, _number, _word, _line, _line, _bytes))(
        rng, text, first
    )


def _number(rng: Rng, text: str, first: int) -> Mutated:
    """Put another number, or another type, in the place of a number."""
    start = sum(len(line) + 1 for line in text.split("\n")[:first])
    found = [one for one in NUMBER.finditer(text) if one.start() >= start]
    if not found:
        return _line(rng, text, first)
    one = pick(rng, found)
    way = rng.random()
    if way < 0.3:
        new = f"{float(one.group()) * float(rng.choice([-1, 0.5, 2, 1.1, 1e3, 1e-3])):.6g}"
    else:
        new = pick(rng, NUMBERS if way < 0.8 else OTHERS)
    changed = text[: one.start()] + new + text[one.end() :]
    at = text.count("\n", 0, one.start()) + 1
    return Mutated(f"line {at}: {one.group()} becomes {short(new)}", changed.encode())


def _word(rng: Rng, text: str, first: int) -> Mutated:
    """Misspell a word, such as a key or a unit."""
    found = list(WORD.finditer(text))
    if not found:
        return _line(rng, text, first)
    one = pick(rng, found)
    letters = list(one.group())
    k = int(rng.integers(len(letters)))
    way = int(rng.integers(4))
    if way == 0:
        letters[k] = "q"
    elif way == 1:
        del letters[k]
    elif way == 2:
        letters.insert(k, pick(rng, "zQ\u00e9\x07"))
    else:
        letters = list("".join(letters).swapcase())
    new = "".join(letters)
    at = text.count("\n", 0, one.start()) + 1
    words = f"line {at}: the word {one.group()} becomes {short(new)}"
    return Mutated(words, (text[: one.start()] + new + text[one.end() :]).encode())


def _line(rng: Rng, text: str, first: int) -> Mutated:
    """Delete, duplicate, exchange, cut or add lines."""
    lines = text.split("\n")
    a, b = (int(k) for k in rng.integers(len(lines), size=2))
    way = int(rng.integers(8))
    if way <= 1:
        del lines[a]
        words = f"line {a + 1} is deleted"
    elif way == 2:
        lines.insert(b, lines[a])
        words = f"line {a + 1} is repeated as line {b + 1}"
    elif way == 3:
        lines[a], lines[b] = lines[b], lines[a]
        words = f"lines {a + 1} and {b + 1} change places"
    elif way == 4:
        lines = lines[:a]
        words = f"cut before line {a + 1}"
    elif way == 5:
        new = pick(
            rng,
            ("unknown_key = 3", "unknown_key: 3", "[" * 20_000, "a." * 3000, "x" * 100_000),
        )
        lines.insert(a, new)
        words = f"line {a + 1} is put in: {short(new)}"
    elif way == 6:
        lines[a] = lines[a][::-1]
        words = f"line {a + 1} is reversed"
    else:
        lines = []
        words = "an empty file"
    return Mutated(words, "\n".join(lines).encode())


def _bytes(rng: Rng, text: str, first: int) -> Mutated:
    return mutate_bytes(rng, text.encode())


def mutate_bytes(rng: Rng, data: bytes) -> Mutated:
    """Flip a bit, change or put in a byte, or cut at a random byte."""
    if not data:
        return Mutated("an empty file stays empty", data, True)
    at = int(rng.integers(len(data)))
    way = int(rng.integers(5))
    if way == 0:
        return Mutated(f"cut at byte {at}", data[:at])
    if way == 1:
        bit = 1 << int(rng.integers(8))
        new = bytes([data[at] ^ bit])
        words = f"byte {at}: bit {bit} flipped"
    elif way == 2:
        new = bytes([int(rng.integers(256))])
        words = f"byte {at} becomes {new!r}"
    elif way == 3:
        new = (
            data[at : at + 1]
            + pick(rng, ("\x00", "\x1b", "\u00e9", "\ufeff", "\u2028")).encode()
        )
        words = f"{new[1:]!r} is put in after byte {at}"
    else:
        return Mutated(f"byte {at} is deleted", data[:at] + data[at + 1 :])
    return Mutated(words, data[:at] + new + data[at + 1 :], new == data[at : at + 1])


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all entries of a tree of mappings and lists."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    out = []
    for key, value in items:
        out.append((*path, key))
        if isinstance(value, dict | list):
            out += leaves(value, (*path, key))
    return out


def mutate_tree(rng: Rng, tree: Any, values: Any = VALUES) -> tuple[str, Any]:
    """Change, delete, rename or add one entry of a tree; returns the words and the new tree."""
    tree = copy.deepcopy(tree)
    path = pick(rng, leaves(tree))
    parent = tree
    for key in path[:-1]:
        parent = parent[key]
    key, where = path[-1], ".".join(str(k) for k in path)
    way = int(rng.integers(8))
    old = parent[key]
    if way == 0:
        del parent[key]
        return f"{where} is deleted", tree
    if way == 1 and isinstance(parent, dict):
        new = pick(
            rng, (f"{key}x", str(key)[:-1], str(key).upper(), "", "\x1b[0m", "k" * 3000)
        )
        parent[new] = parent.pop(key)
        return f"{where} is renamed to {short(new)}", tree
    if way == 2 and isinstance(parent, list):
        parent.append(copy.deepcopy(old))
        return f"{where} is repeated", tree
    if way == 3 and isinstance(old, int | float) and not isinstance(old, bool):
        parent[key] = old * float(rng.choice([-1, 0.5, 2, 1.1, 1e3, 1e-3]))
    else:
        parent[key] = pick(rng, values)
    return f"{where} = {short(old)} becomes {short(parent[key])}", tree


def close(one: Any, other: Any, relative: float = 1e-9) -> bool:
    """Whether two numbers are equal to rounding."""
    try:
        a, b = float(one), float(other)
    except (TypeError, ValueError, OverflowError):
        return False
    return abs(a - b) <= relative * max(abs(a), abs(b))


def harmless(rng: Rng, text: str, first: int = 0) -> Mutated:
    """Add what changes no meaning: a comment, an empty line, blanks at a line's end, CR LF."""
    lines = text.split("\n")
    at = int(rng.integers(first, len(lines)))
    way = int(rng.integers(3))
    if way == 0:
        lines.insert(at, "# of no meaning: \u00b5 = 3")
        words = f"a comment is put in as line {at + 1}"
    elif way == 1:
        lines[at] += "  "
        words = f"blanks at the end of line {at + 1}"
    else:
        return Mutated("lines end in CR LF", text.replace("\n", "\r\n").encode(), True)
    return Mutated(words, "\n".join(lines).encode(), True)
