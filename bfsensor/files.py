"""Files written whole or not at all, and a cache in memory."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


class Cache:
    """Cache of values in memory, each computed once.

    Parameters
    ----------
    most : int, optional
        Largest number of values, 1 or more; beyond it the least recently used one is dropped.
        By default all are held.

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
        """Return the value of a key, computed if it is not held.

        Parameters
        ----------
        key : hashable
            Object to which the value belongs, or a tuple with it.  Objects that are equal only
            to themselves serve: the cache holds them, so that no other can take their identity.
        make : callable
            Function without arguments that computes the value; its exceptions pass, and
            nothing is held then.

        Returns
        -------
        value : object
            The value that ``make`` returned for this key.
        """
        if key in self._values:
            value = self._values.pop(key)
        else:
            value = make()
            if self._most is not None and len(self._values) >= self._most:
                del self._values[next(iter(self._values))]
        # A dict keeps the order of insertion: the least recently used key comes first.
        self._values[key] = value
        return value


def refuse_existing(
    path: str | os.PathLike[str], overwrite: bool, error: type[Exception]
) -> None:
    """Raise the given error if the file exists and ``overwrite`` is False."""
    if Path(path).exists() and not overwrite:
        raise error(f"{path} exists; say overwrite to replace it")


@contextlib.contextmanager
def held(folder: str | os.PathLike[str], error: type[Exception]) -> Iterator[None]:
    """Hold a folder of unfinished work, so that a second process refuses before it works.

    Parameters
    ----------
    folder : path-like
        The folder, which is made, and removed if it is empty at the end; a file ``.in_use`` in it
        is locked.  The lock ends with the process, however that ends.
    error : type
        Exception class to raise.

    Raises
    ------
    Exception
        The given class: another process holds the folder, or it cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from bfsensor.errors import TableError
    >>> folder = Path(tempfile.mkdtemp(), "t.fits.levels")
    >>> with held(folder, TableError):
    ...     [path.name for path in folder.iterdir()]
    ['.in_use']
    """
    path = Path(folder, ".in_use")
    new = not path.parent.exists()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a+b", buffering=0)
    except OSError as fault:
        raise error(f"{folder}: cannot be written: {fault}") from None
    with file:
        # Systems without this module do without the lock.
        with contextlib.suppress(ImportError):
            import fcntl

            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                file.seek(0)
                raise error(
                    f"{folder}: another process works on this output "
                    f"(number {file.read(20).decode().strip()}): "
                    "wait until it ends, or name another output"
                ) from None
        # The number only helps to find the process: a full disk is an error where results are written.
        with contextlib.suppress(OSError):
            file.truncate(0)
            file.write(str(os.getpid()).encode())
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
                if new:
                    path.parent.rmdir()  # only where nothing is in it


@contextlib.contextmanager
def written_whole(path: str | os.PathLike[str], error: type[Exception]) -> Iterator[Path]:
    """Yield a temporary path beside a file; it is renamed to the file once all is written.

    A reader finds the old file or the new one, never a part; processes, threads and hosts that write
    the same file do not disturb one another, because the temporary name is random.  Where the path is
    a link, the file that it leads to is replaced.

    Parameters
    ----------
    path : path-like
        File to write; one that exists is replaced.
    error : type
        Exception class to raise, with the name of the file, where it cannot be written.

    Yields
    ------
    beside : Path
        Temporary path to write to.

    Raises
    ------
    Exception
        The given class, in place of an ``OSError``.  Any other exception passes unchanged; the
        temporary file is removed in both cases.

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
    target = Path(os.path.realpath(path))
    beside = target.with_name(f"{target.name}.{secrets.token_hex(4)}.part")
    try:
        yield beside
        os.replace(beside, target)
    except OSError as fault:
        # The system's error repeats the path.
        raise error(f"{path}: cannot be written: {fault.strerror or fault}") from None
    finally:
        # A name that is too long is neither there nor can be removed.
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
