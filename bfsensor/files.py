"""Files written whole or not at all, and where the files that come with the package lie."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from bfsensor.errors import BFSensorError


def refuse_existing(
    path: str | os.PathLike[str], overwrite: bool, error: type[BFSensorError]
) -> None:
    """Raise the error if there is a file and it is not to be replaced."""
    if Path(path).exists() and not overwrite:
        raise error(f"{path} exists; say overwrite to replace it")


@contextlib.contextmanager
def written_whole(
    path: str | os.PathLike[str], error: type[BFSensorError]
) -> Iterator[Path]:
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
    BFSensorError
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


def tables_dir() -> Path:
    """Find the built-in devices and tables: in a wheel, or beside it in a checkout.

    Returns
    -------
    folder : Path
    """
    package = Path(__file__).resolve().parent
    for folder in (package / "tables", package.parent / "tables"):
        if folder.is_dir():
            return folder
    raise BFSensorError(
        f"the tables of bfsensor are missing beside {package}: reinstall the package"
    )
