"""Results as rows of an ECSV file, added one by one; the file is whole at every moment."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table

from validation.common.run_header import commit_here, run_header

Row = Mapping[str, Any]


def read_rows(path: str | Path) -> list[dict[str, Any]]:
    """Read the rows of a file; none if it is not there.  Empty cells of text are ""."""
    if not Path(path).exists():
        return []
    table = Table.read(path, format="ascii.ecsv")
    out = []
    for row in table:
        values = {n: row[n] for n in table.colnames}
        out.append({n: _plain(v, table[n].dtype.kind) for n, v in values.items()})
    return out


def _plain(value: Any, kind: str) -> Any:
    if np.ma.is_masked(value):
        return "" if kind in "USO" else np.nan
    return value.item() if isinstance(value, np.generic) else value


def write_rows(path: str | Path, rows: Sequence[Row], command: str) -> None:
    """Write rows that have the same columns; what made them goes into the header.

    A file that is there already is taken for one with earlier rows among these, and what its header
    says of them is kept.

    Examples
    --------
    >>> import tempfile
    >>> target = Path(tempfile.mkdtemp()) / "two.ecsv"
    >>> write_rows(target, [{"name": "a", "p": 0.5}, {"name": "", "p": 0.1}], "python -m this")
    >>> read_rows(target)
    [{'name': 'a', 'p': 0.5}, {'name': '', 'p': 0.1}]
    """
    table = Table({name: [row[name] for row in rows] for name in (rows[0] if rows else {})})
    path = Path(path)
    there = Table.read(path, format="ascii.ecsv").meta if path.exists() else None
    table.meta = run_header(command, there=there)
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        table.write(beside, format="ascii.ecsv", overwrite=True)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def append_rows(
    path: str | Path,
    rows: Iterable[Row],
    command: str,
    *,
    key: Sequence[str],
    replace: bool = False,
) -> int:
    """Add rows whose ``key`` columns no row has yet; return how many were added.

    Each row tells the commit that it was made at.  Several processes may add to one file: each
    waits for the other.

    Parameters
    ----------
    path : path
        Of the file, made if it is not there.
    rows : iterable of mapping
        To add.
    command : str
        That made them.
    key : sequence of str
        Columns that tell rows apart.
    replace : bool
        Whether rows take the place of those with their key.

    Examples
    --------
    >>> import tempfile
    >>> target = Path(tempfile.mkdtemp()) / "two.ecsv"
    >>> for p in 0.5, 0.1:
    ...     append_rows(target, [{"name": "a", "p": p}], "python -m this", key=["name"])
    1
    0
    >>> append_rows(target, [{"name": "a", "p": 0.1}], "", key=["name"], replace=True)
    1
    >>> [row["p"] for row in read_rows(target)]
    [0.1]
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path.parent):
        old = read_rows(path)
        # Rows of before commits were told one by one are of the header's.
        made = Table.read(path, format="ascii.ecsv").meta.get("commit", "") if old else ""
        old = [{**r, "commit": r.get("commit", made)} for r in old]
        new = [{**r, "commit": commit_here()} for r in rows]
        taken = {tuple(r[k] for k in key) for r in (new if replace else old)}
        kept, others = (new, old) if replace else (old, new)
        others = [r for r in others if tuple(r[k] for k in key) not in taken]
        added = new if replace else others
        if added:
            write_rows(path, [*others, *kept] if replace else [*kept, *others], command)
    return len(added)


@contextlib.contextmanager
def locked(folder: str | Path, *, wait: bool = True) -> Iterator[None]:
    """Hold a folder that one process at a time can hold; it is let go when the process dies.

    Raises
    ------
    BlockingIOError
        Another process holds it and ``wait`` is false.
    """
    import fcntl

    held = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    finally:
        os.close(held)
