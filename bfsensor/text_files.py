"""Text that strangers wrote: ECSV and YAML, their size and depth checked before anything is built."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

if TYPE_CHECKING:
    from astropy.table import Table

DEEPEST = 64
"""Largest depth of entries within entries of a YAML text.  Chosen: campaigns and tables have at most 6;
at 128 the loader still has stack left, at 1000 it has none."""


class UnreadableTextError(ValueError):
    """Text that is not what it should be; the message says why in one line."""


def load_yaml(text: str) -> Any:
    """Read a YAML text with plain values only.

    Parameters
    ----------
    text : str
        The text.

    Returns
    -------
    entries : object
        Its mappings, lists and plain values; None where it is empty.

    Raises
    ------
    UnreadableTextError
        Not YAML, deeper than :data:`DEEPEST`, with a key that is given twice, or a named part
        (``&name``) that holds names of others (``*name``): ten of these within one another stand for
        billions of entries.

    Examples
    --------
    >>> load_yaml("kind: {keyword: TYP}")
    {'kind': {'keyword': 'TYP'}}
    """
    try:
        _check(yaml.parse(text, Loader=yaml.SafeLoader))
        return yaml.safe_load(text)
    # A date that does not exist is a ValueError, a list as a key a TypeError.
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise UnreadableTextError(one_line(error)) from None


def read_ecsv(path: str | os.PathLike[str]) -> Table:
    """Read an ECSV table.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    table : astropy.table.Table
        Empty cells are masked.

    Raises
    ------
    UnreadableTextError
        The file cannot be read, is not ECSV, or has a header as :func:`load_yaml` refuses.

    Examples
    --------
    >>> read_ecsv("missing.ecsv")
    Traceback (most recent call last):
    bfsensor.text_files.UnreadableTextError: [Errno 2] No such file or directory: 'missing.ecsv'
    """
    from astropy.table import Table
    from astropy.utils.exceptions import AstropyUserWarning

    try:
        lines = read_lines(path)
        if not lines[0].startswith("# %ECSV"):
            raise UnreadableTextError("the first line must begin with '# %ECSV'")
        header = takewhile(lambda line: line.startswith("#"), lines)
        load_yaml("\n".join(line[2:] for line in header if line[1:2] in (" ", "")))
        with warnings.catch_warnings():
            # astropy only warns of a column whose type does not exist.
            warnings.simplefilter("error", AstropyUserWarning)
            return Table.read(path, format="ascii.ecsv")
    # astropy raises several classes of exception for damaged headers.
    except (
        OSError, ValueError, TypeError, LookupError, AttributeError, AstropyUserWarning
    ) as error:  # fmt: skip
        raise UnreadableTextError(one_line(error)) from None


def read_lines(path: str | os.PathLike[str]) -> list[str]:
    """Read the lines of a text in UTF-8, at least one, without their ends.

    Raises
    ------
    OSError, ValueError
        The file cannot be read, is not UTF-8, or holds the character NUL, at which readers end a word.
    """
    text = Path(path).read_text(encoding="utf-8")
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise UnreadableTextError(f"line {line}: the character NUL is not text")
    return text.split("\n")


def one_line(message: object, most: int = 200) -> str:
    """Text of a message or an exception in one line of printable characters, at most ``most``.

    Examples
    --------
    >>> one_line("spaces    that are   many")
    'spaces that are many'
    """
    text = " ".join(str(message).split())
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def nearly_equal(one: str, other: str) -> bool:
    """Whether two words are equal but for one letter, two that changed places, or capitals.

    Words of one or two letters are so only by their capitals.

    Examples
    --------
    >>> nearly_equal("wavelenqth", "wavelength"), nearly_equal("x", "y"), nearly_equal("X", "x")
    (True, False, True)
    """
    a, b = one.lower(), other.lower()
    if a == b:
        return True
    if min(len(a), len(b)) < 3 or abs(len(a) - len(b)) > 1:
        return False
    same = next(
        (k for k, (p, q) in enumerate(zip(a, b, strict=False)) if p != q),
        min(len(a), len(b)),
    )
    p, q = a[same:], b[same:]
    exchanged = len(p) > 1 and p[:2] == q[1::-1] and p[2:] == q[2:]
    return exchanged or p[1:] == q[1:] or p == q[1:] or p[1:] == q


def _check(events: Iterator[yaml.Event]) -> None:
    """Refuse depths beyond :data:`DEEPEST`, keys given twice, and names within named parts.

    Nothing is built.
    """
    named: list[bool] = []
    # Of each open part its keys so far, None for a list; whether its next entry is a key.
    keys: list[set[str] | None] = []
    key_next: list[bool] = []
    for event in events:
        # An entry of a mapping: keys and values take turns, and a part is an entry as it begins.
        if isinstance(event, yaml.NodeEvent) and keys and (known := keys[-1]) is not None:
            if key_next[-1] and isinstance(event, yaml.ScalarEvent):
                if event.value in known:
                    raise UnreadableTextError(
                        f"line {event.start_mark.line + 1}: {one_line(event.value, 60)!r} is given "
                        "twice: leave out one of them"
                    )
                known.add(event.value)
            key_next[-1] = not key_next[-1]
        if isinstance(event, yaml.CollectionStartEvent):
            named.append(event.anchor is not None)
            keys.append(set() if isinstance(event, yaml.MappingStartEvent) else None)
            key_next.append(True)
            if len(named) > DEEPEST:
                raise UnreadableTextError(
                    f"line {event.start_mark.line + 1}: entries are nested deeper than {DEEPEST}"
                )
        elif isinstance(event, yaml.CollectionEndEvent):
            named.pop()
            keys.pop()
            key_next.pop()
        elif isinstance(event, yaml.AliasEvent) and any(named):
            raise UnreadableTextError(
                f"line {event.start_mark.line + 1}: a named part holds the name *{event.anchor} of "
                "another; write such entries out"
            )
