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
        Not YAML, deeper than :data:`DEEPEST`, or a named part (``&name``) that holds names of others
        (``*name``): ten of these within one another stand for billions of entries.

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
        with Path(path).open(encoding="utf-8", newline=None) as lines:
            header = takewhile(lambda line: line.startswith("#"), lines)
            load_yaml("".join(line[2:] or "\n" for line in header if line[1:2] == " "))
        with warnings.catch_warnings():
            # astropy only warns of a column whose type does not exist.
            warnings.simplefilter("error", AstropyUserWarning)
            return Table.read(path, format="ascii.ecsv")
    # astropy raises several classes of exception for damaged headers.
    except (
        OSError, ValueError, TypeError, LookupError, AttributeError, AstropyUserWarning
    ) as error:  # fmt: skip
        raise UnreadableTextError(one_line(error)) from None


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


def _check(events: Iterator[yaml.Event]) -> None:
    """Refuse depths beyond :data:`DEEPEST`, and names within named parts, without building them."""
    named: list[bool] = []
    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            named.append(event.anchor is not None)
            if len(named) > DEEPEST:
                raise UnreadableTextError(
                    f"line {event.start_mark.line + 1}: entries are nested deeper than {DEEPEST}"
                )
        elif isinstance(event, yaml.CollectionEndEvent):
            named.pop()
        elif isinstance(event, yaml.AliasEvent) and any(named):
            raise UnreadableTextError(
                f"line {event.start_mark.line + 1}: a named part holds the name *{event.anchor} of "
                "another; write such entries out"
            )
