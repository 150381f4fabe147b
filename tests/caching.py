"""What tests make once and keep outside the checkout, by the content of the code that makes it.

Everything here only saves time: without the folder, or with another one, tests do the same.  The
folder is ``bfsensor-tests`` in the user's cache folder (``XDG_CACHE_HOME``), or what
``BFSENSOR_TEST_CACHE`` says; an empty ``BFSENSOR_TEST_CACHE`` keeps nothing.
"""

from __future__ import annotations

import ast
import hashlib
import os
import pickle
import platform
import shutil
import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

ROOT = Path(__file__).resolve().parents[1]
OURS = ("bfsensor", "tests", "validation")
LIBRARIES = ("numpy", "scipy", "numba", "astropy", "galsim")
KEPT_DAYS = 14
"""Folders of code that nobody ran for so long are removed: each holds tens of MB."""

Made = TypeVar("Made")


def cache_folder() -> Path | None:
    """Give the folder, or None where nothing is to be kept."""
    given = os.environ.get("BFSENSOR_TEST_CACHE")
    if given is not None:
        return Path(given) if given else None
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "bfsensor-tests"


@lru_cache(maxsize=1)
def kernels_digest() -> str:
    """Digest of all kernels: compiled ones hold code of others that they call."""
    files = sorted((ROOT / "bfsensor" / "_kernels").glob("*.py"))
    return _digest(path.read_bytes() for path in files)


@lru_cache(maxsize=64)
def code_digest(*modules: str) -> str:
    """Digest of modules of the checkout, of all that they import in it, and of libraries.

    Imports inside functions count.  What a module loads by a name made at run time does not:
    give such modules as well.
    """
    found: dict[str, bytes] = {}
    waiting = [*modules, *OURS[:1]]
    while waiting:
        name = waiting.pop()
        path = _file_of(name)
        if name in found or path is None:
            continue
        found[name] = path.read_bytes()
        waiting += _imports(path)
    # Last bits depend on the processor and on how many threads share a sum.
    machine = " ".join([processor(), os.environ.get("OMP_NUM_THREADS", "")])
    versions = [f"{name} {version(name)}".encode() for name in LIBRARIES] + [
        machine.encode()
    ]
    return _digest([*versions, *(found[name] for name in sorted(found))])


def keep(key: object, make: Callable[[], Made], *, made_by: Iterable[str]) -> Made:
    """Give what ``make`` gives, from the cache where the same code made it for the same key.

    Parameters
    ----------
    key : object
        What is asked for; its ``repr`` tells all.
    make : callable
        Makes it; the result pickles.
    made_by : iterable of str
        Modules that make it, see :func:`code_digest`.
    """
    folder = cache_folder()
    if folder is None:
        return make()
    digest = _digest([code_digest(*made_by).encode(), repr(key).encode()])
    path = folder / "made" / f"{digest}.pickle"
    try:
        with path.open("rb") as stream:
            made: Made = pickle.load(stream)
        os.utime(path)
        return made
    except (OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError):
        pass
    made = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}")
    beside.write_bytes(pickle.dumps(made))
    os.replace(beside, path)
    return made


def keep_files(
    into: Path, make: Callable[[], Made], *, key: object, made_by: Iterable[str]
) -> Made:
    """Give what ``make`` gives, which finds in a folder the files that it wrote there before.

    For solvers that keep finished levels: they go on from what is there.

    Parameters
    ----------
    into : Path
        The folder, empty; tests may change what is in it afterwards.
    make, key, made_by
        As for :func:`keep`.
    """
    folder = cache_folder()
    if folder is None:
        return make()
    digest = _digest([code_digest(*made_by).encode(), repr(key).encode()])
    kept = folder / "made" / digest
    if kept.is_dir():
        shutil.copytree(kept, into, dirs_exist_ok=True)
        os.utime(kept)
        return make()
    made = make()
    beside = kept.with_name(f"{digest}.{os.getpid()}")
    shutil.copytree(into, beside)
    try:
        beside.rename(kept)
    except OSError:  # another process was first
        shutil.rmtree(beside)
    return made


def remove_old(folder: Path) -> None:
    """Remove what nobody used for :data:`KEPT_DAYS`."""
    oldest = time.time() - 86400 * KEPT_DAYS
    for path in [*folder.glob("numba/*"), *folder.glob("made/*")]:
        try:
            if path.stat().st_mtime < oldest:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        except OSError:  # another run removed it first
            continue


def processor() -> str:
    """Model of the processor."""
    described = Path("/proc/cpuinfo")
    lines = described.read_text().splitlines() if described.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor()


def _file_of(module: str) -> Path | None:
    if module.partition(".")[0] not in OURS:
        return None
    place = ROOT.joinpath(*module.split("."))
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        if path.is_file():
            return path
    return None


def _imports(path: Path) -> list[str]:
    """Modules that a file names in imports that run; of ``from a import b`` both ``a`` and ``a.b``.

    Packages name the modules of their public names under ``TYPE_CHECKING``: of ``from a import b``
    such a module counts as well, of the package itself it does not.
    """
    names: list[str] = []
    waiting: list[ast.AST] = [ast.parse(path.read_bytes())]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            given = {alias.name for alias in node.names}
            names += [node.module, *(f"{node.module}.{name}" for name in given)]
            names += [m for name, m in _public_names(node.module).items() if name in given]
        waiting += ast.iter_child_nodes(node)
    return [name for name in names if name.partition(".")[0] in OURS]


def _public_names(package: str) -> dict[str, str]:
    """Module of each public name that a package imports when it is first used."""
    path = _file_of(package)
    if path is None or path.name != "__init__.py":
        return {}
    return {
        alias.name: node.module
        for block in ast.parse(path.read_bytes()).body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


def _digest(parts: Iterable[bytes]) -> str:
    total = hashlib.sha256()
    for part in parts:
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()[:24]
