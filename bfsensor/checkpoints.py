"""Finished stages of a long computation on disk, so that one that was killed goes on."""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

from bfsensor.errors import BFSensorError
from bfsensor.files import written_whole

T = TypeVar("T")

LOG = logging.getLogger(__name__)

ARRAYS = frozenset({
    ("numpy", "ndarray"), ("numpy", "dtype"), ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"), ("numpy.core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"), ("scipy.sparse._csr", "csr_array"),
    ("pathlib", "PosixPath"), ("pathlib", "WindowsPath"), ("builtins", "set"),
    ("builtins", "frozenset"), ("builtins", "complex"), ("builtins", "slice"),
    ("functools", "partial"),
})  # fmt: skip
"""Names outside this package that a stage's file may hold: what arrays and paths are made of, and
partial functions, which then hold functions of this package alone."""


class Checkpoints:
    """Results of stages, each stored when it is finished, by a key of all that they depend on.

    A stage that was stored under the same key is read instead of computed.  The key holds the
    source code of this package, so that stages of other versions are not used.

    Parameters
    ----------
    folder : Path or None
        Folder of the files, made when the first stage ends; None stores nothing.
    *parts : bytes or str
        All that the stages depend on: hashes of files, settings, seeds.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp()) / "unfinished"
    >>> Checkpoints(folder, "seed 1").get("sum", lambda: 1 + 1)
    2
    >>> Checkpoints(folder, "seed 1").get("sum", lambda: 1 / 0)
    2
    """

    def __init__(self, folder: Path | None, *parts: bytes | str) -> None:
        self.folder = folder
        self.key = ""
        if folder is not None:
            told = [p.encode() if isinstance(p, str) else p for p in parts]
            self.key = digest_of([code_digest(), *told])

    def get(self, stage: str, make: Callable[[], T]) -> T:
        """Return the stored result of a stage, or compute and store it.

        Parameters
        ----------
        stage : str
            Name of the stage, once in a computation, fit for a file name.
        make : callable
            Function without arguments that computes the result.  A result that cannot be stored,
            as it holds functions made at run time, is returned all the same.

        Returns
        -------
        result : object
            What ``make`` returned, now or before.
        """
        if self.folder is None:
            return make()
        path = self._path(stage)
        if path.exists():
            try:
                result: T = _read(path)
            except (pickle.UnpicklingError, OSError, EOFError, ValueError) as fault:
                LOG.info("%s is not used: %s", path.name, fault)
            else:
                LOG.info("goes on after %r of an interrupted run", stage)
                return result
        result = make()
        self._write(path, result)
        return result

    def clear(self) -> None:
        """Remove the files of all stages, of other keys too, and the folder if it is then empty."""
        if self.folder is None or not self.folder.is_dir():
            return
        for path in self.folder.glob("stage_*.pickle*"):
            path.unlink(missing_ok=True)
        if not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _path(self, stage: str) -> Path:
        assert self.folder is not None
        return self.folder / f"stage_{stage}_{self.key[:16]}.pickle"

    def _write(self, path: Path, result: Any) -> None:
        try:
            payload = pickle.dumps(result)
        except (pickle.PicklingError, AttributeError, TypeError):
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(path, BFSensorError) as beside:
                beside.write_bytes(hashlib.sha256(payload).digest() + payload)
        except (OSError, BFSensorError) as fault:
            LOG.warning(
                "a stage cannot be stored, an interrupted run would begin again: %s", fault
            )


class _Unpickler(pickle.Unpickler):
    """Reader that makes objects of this package and arrays, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """Class or function of a name, if it is allowed."""
        if module.startswith("bfsensor.") or (module, name) in ARRAYS:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is not part of a stage")


def _read(path: Path) -> Any:
    """Result of a file, which must be whole."""
    data = path.read_bytes()
    payload = data[32:]
    if hashlib.sha256(payload).digest() != data[:32]:
        raise pickle.UnpicklingError("the file is not whole")
    return _Unpickler(io.BytesIO(payload)).load()


def digest_of(parts: Iterable[bytes]) -> str:
    """SHA-256 of some texts, which also depends on where one ends and the next begins.

    Parameters
    ----------
    parts : iterable of bytes
        The texts.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    whole = hashlib.sha256()
    for part in parts:
        whole.update(hashlib.sha256(part).digest())
    return whole.hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file's contents, 64 hexadecimal digits."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def code_digest() -> bytes:
    """SHA-256 of the source code of this package."""
    root = Path(__file__).parent
    return digest_of(p.read_bytes() for p in sorted(root.rglob("*.py"))).encode()
