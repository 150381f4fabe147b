"""Files written whole or not at all, and a cache in memory."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


class Cache:
    """Values in memory, each made once.

    Parameters
    ----------
    most : int, optional
        How many are held at most: the one that was asked for longest ago is dropped for a
        new one.  All are held by default.

    Examples
    --------
    >>> kept = Cache()
    >>> kept.get("a", list) is kept.get("a", list)
    True
    """

    def __init__(self, most: int | None = None) -> None:
        self._most = most
        self._values: dict[Hashable, Any] = {}

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Give the value of a key, made if there is none.

        Parameters
        ----------
        key : hashable
            What the value belongs to, or a tuple with it.  Objects that are equal only to
            themselves serve: the cache holds them, so that no other can take their place.
        make : callable
            Gives the value; what it raises passes, and nothing is kept.
        """
        if key in self._values:
            value = self._values.pop(key)
        else:
            value = make()
            if self._most is not None and len(self._values) >= self._most:
                del self._values[next(iter(self._values))]
        # Asked for last, dropped last.
        self._values[key] = value
        return value


def refuse_existing(
    path: str | os.PathLike[str], overwrite: bool, error: type[Exception]
) -> None:
    """Raise the error if there is a file and it is not to be replaced."""
    if Path(path).exists() and not overwrite:
        raise error(f"{path} exists; say overwrite to replace it")


@contextlib.contextmanager
def written_whole(path: str | os.PathLike[str], error: type[Exception]) -> Iterator[Path]:
    """Give a path beside a file to write to; it is renamed once all is written.

    A reader finds the old file or the new one, whatever happens; processes that write the
    same file do not meet, for the name holds the number of the process.

    Parameters
    ----------
    path : path-like
        The file to be.
    error : type
        Raised with the name of the file where it cannot be written.

    Yields
    ------
    beside : Path
        Where to write.

    Raises
    ------
    Exception
        The kind asked for, in place of an ``OSError``.  Any other error passes, and no
        file is left behind.

    Examples
    --------
    >>> import tempfile
    >>> from bfsensor.errors import TableError
    >>> target = Path(tempfile.mkdtemp()) / "note.txt"
    >>> with written_whole(target, TableError) as beside:
    ...     n = beside.write_text("all of it")
    >>> target.read_text()
    'all of it'
    """
    target = Path(path)
    beside = target.with_name(f"{target.name}.{os.getpid()}.part")
    try:
        yield beside
        os.replace(beside, target)
    except OSError as fault:
        raise error(f"{target}: cannot be written: {fault}") from None
    finally:
        beside.unlink(missing_ok=True)
