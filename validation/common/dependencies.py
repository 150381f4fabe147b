"""Which files a result depends on, and whether their code is still that of a commit."""

from __future__ import annotations

import ast
import hashlib
import re
import subprocess
import tomllib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
"""Of the checkout."""

PACKAGES = ("bfsensor", "validation", "tests")
"""Whose modules are followed."""

HEADERS = {"validation/common/run_header.py", "validation/common/write_results.py"}
"""No row depends on how the header beside it is written."""

_ZERO = "0" * 40


# -- what a script depends on ------------------------------------------------------------------


def dependencies(script: str, root: Path = ROOT) -> frozenset[str]:
    """List the files that a script depends on, itself included, relative to the checkout.

    These are the modules of this checkout that it imports, directly or through others, at any
    place but under ``TYPE_CHECKING``; and of each device with a distortion table whose name a script
    of ``validation`` or ``tests`` holds as text, the device file and the table.
    """
    seen: set[str] = set()
    todo = [script]
    while todo:
        path = todo.pop()
        if path not in seen | HEADERS:
            seen.add(path)
            todo += _needed(path, root)
    return frozenset(seen)


def module_file(module: str, root: Path = ROOT) -> str | None:
    """File of a module of this checkout; ``None`` if it has none there."""
    if module.partition(".")[0] not in PACKAGES:
        return None
    place = module.replace(".", "/")
    return next(
        (p for p in (f"{place}.py", f"{place}/__init__.py") if (root / p).is_file()), None
    )


@cache
def _needed(path: str, root: Path) -> tuple[str, ...]:
    """Files that one file names."""
    if not path.endswith(".py"):
        return ()
    tree = ast.parse((root / path).read_text())
    found = {f for name in _imports(tree, root) if (f := module_file(name, root))}
    # Packages of bfsensor only list names, which are imported when they are first used.
    found = {f for f in found if not re.fullmatch(r"bfsensor/(.*/)?__init__\.py", f)}
    if not path.startswith("bfsensor/"):
        texts = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)}
        for table in (root / "tables").glob("*/table.fits"):
            if table.parent.name in texts:
                found |= {str((table.with_name(n)).relative_to(root))
                          for n in ("device.toml", "table.fits")}  # fmt: skip
    return tuple(sorted(found))


def _imports(tree: ast.AST, root: Path) -> Iterator[str]:
    """Modules that are imported, and the packages that they are in."""
    for node in _walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [_origin(node.module, alias.name, root) for alias in node.names]
        elif (
            isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "bfsensor"
        ):
            names = [_origin("bfsensor", node.attr, root)]
        else:
            continue
        for name in names:
            parts = name.split(".")
            yield from (".".join(parts[:n]) for n in range(2, len(parts) + 1))


def _walk(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those under ``if TYPE_CHECKING``, which never run."""
    todo = [tree]
    while todo:
        node = todo.pop()
        if not (
            isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        ):
            yield node
            todo += ast.iter_child_nodes(node)


def _origin(module: str, name: str, root: Path) -> str:
    """Module that a name comes from: a module itself, or where the package takes it from."""
    if module_file(f"{module}.{name}", root):
        return f"{module}.{name}"
    return _public_names(module, root).get(name, module)


@cache
def _public_names(module: str, root: Path) -> dict[str, str]:
    """Module of each public name of a package of bfsensor: its imports under ``TYPE_CHECKING``."""
    file = module_file(module, root) or ""
    if not re.fullmatch(r"bfsensor/(.*/)?__init__\.py", file):
        return {}
    return {
        alias.name: node.module
        for block in ast.parse((root / file).read_text()).body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


# -- whether code is the same ------------------------------------------------------------------


def code_digest(content: bytes, path: str) -> str:
    r"""Hash of what counts in a file.

    Of Python this is all but imports, docstrings, comments, annotations, the layout, and the names
    of modules of ``validation`` in texts: a script that moves has another command.  Of TOML the
    values count, of any other file every byte.

    Examples
    --------
    >>> one = code_digest(b"from a import f\n\nx = f(1)", "x.py")
    >>> one == code_digest(b"'''Doc.'''\nfrom b.a import f\nx = f( 1 )  # why", "y.py")
    True
    >>> one == code_digest(b"from a import f\n\nx = f(2)", "x.py")
    False
    """
    if path.endswith(".py"):
        tree = ast.parse(content)
        for node in ast.walk(tree):
            for name in ("body", "orelse", "finalbody"):
                if isinstance(body := getattr(node, name, None), list):
                    setattr(node, name, [line for line in body if not _says_nothing(line)])
            for name in ("annotation", "returns"):
                if hasattr(node, name):
                    setattr(node, name, None)
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                node.value = re.sub(r"\bvalidation\.[\w.]+", "", node.value)
        content = ast.dump(tree).encode()
    elif path.endswith(".toml"):
        content = repr(tomllib.loads(content.decode())).encode()
    return hashlib.sha256(content).hexdigest()


def _says_nothing(node: ast.stmt) -> bool:
    """Imports, and text that stands alone: docstrings of modules, classes, functions, constants."""
    text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return isinstance(node, ast.Import | ast.ImportFrom) or (
        text and isinstance(node.value.value, str)
    )


# -- what changed since a commit ---------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """One file that differs between a commit and another one, or the files on disk."""

    old: str
    new: str
    old_blob: str
    new_blob: str


class History:
    """What git knows of a checkout; of a copy without a repository, nothing."""

    def __init__(self, root: Path = ROOT) -> None:
        self.root = root

    def knows(self, commit: str) -> bool:
        """Whether the clone has the commit: a shallow one lacks the old ones."""
        return bool(commit) and self._git("cat-file", "-t", commit).strip() == "commit"

    def date(self, commit: str) -> str:
        """Day of the commit, UTC."""
        return datetime.fromtimestamp(self.seconds(commit), UTC).date().isoformat()

    def seconds(self, commit: str) -> int:
        """When the commit was made [s since 1970]; only of commits that the clone has."""
        return int(self._git("log", "-1", "--format=%ct", commit))

    def changed(self, commit: str, files: Collection[str]) -> Iterator[Change]:
        """Find which files have other code on disk than at the commit; ``old`` is "" of new ones."""
        there = {f: Change("", f, _ZERO, _ZERO) for f in set(files) - self._tracked()}
        there |= {c.new: c for c in self._changes(commit)}
        for file in sorted(files):
            if file in there and self._other(there[file]):
                yield there[file]

    def last_same(self, commit: str, changed: Iterable[Change]) -> str:
        """Last commit up to which none of the changes was made, on the way from the rows to now."""
        changed = list(changed)
        way = self._git(
            "rev-list", "--first-parent", "--reverse", f"{commit}..HEAD"
        ).split()
        low, high = 0, len(way)  # all before low are as the commit is; high, if any, is not
        while low < high:
            middle = (low + high) // 2
            if self._any_made(commit, way[middle], changed):
                high = middle
            else:
                low = middle + 1
        return self._git("rev-parse", "--short", way[low - 1] if low else commit).strip()

    def _any_made(self, commit: str, then: str, changed: Collection[Change]) -> bool:
        between = {c.old: c for c in self._changes(commit, then) if c.old}
        if any(c.old in between and self._other(between[c.old]) for c in changed if c.old):
            return True
        added = [c.new for c in changed if not c.old]
        return bool(added and self._git("ls-tree", "--name-only", then, "--", *added))

    def _other(self, change: Change) -> bool:
        """Whether the code of two versions of a file differs."""
        if not change.new:
            return True
        if not change.old:
            return self._digest(change.new_blob, change.new) != code_digest(b"", change.new)
        return self._digest(change.old_blob, change.old) != self._digest(
            change.new_blob, change.new
        )

    @cache  # noqa: B019 one object lives as long as the process
    def _digest(self, blob: str, path: str) -> str:
        if blob == _ZERO:  # on disk
            return code_digest((self.root / path).read_bytes(), path)
        done = self._run("cat-file", "blob", blob)
        if done.returncode:
            raise LookupError(f"this clone does not have {path} as of {blob[:7]}")
        return code_digest(done.stdout, path)

    @cache  # noqa: B019
    def _tracked(self) -> frozenset[str]:
        return frozenset(self._git("ls-files").splitlines())

    @cache  # noqa: B019
    def _changes(self, commit: str, then: str | None = None) -> tuple[Change, ...]:
        """Files that differ, renamed ones as one change; against the files on disk by default."""
        names = [commit] if then is None else [commit, then]
        raw = self._git("diff", "--raw", "-M", "-l0", "-z", "--no-abbrev", *names).split(
            "\0"
        )
        found = []
        fields = iter(raw)
        for field in fields:
            if not field:
                continue
            _, _, old_blob, new_blob, status = field.split()
            old = next(fields)
            new = next(fields) if status[0] in "RC" else old
            found.append(Change("" if status[0] in "AC" else old, "" if status == "D" else new,
                                old_blob, new_blob))  # fmt: skip
        return tuple(found)

    def _git(self, *words: str) -> str:
        """Answer of git, empty where it has none."""
        done = self._run(*words)
        return done.stdout.decode() if done.returncode == 0 else ""

    def _run(self, *words: str) -> subprocess.CompletedProcess[bytes]:
        command = ["git", *words]
        try:
            return subprocess.run(command, cwd=self.root, capture_output=True, check=False)
        except FileNotFoundError:  # git is not installed
            return subprocess.CompletedProcess(command, 127, b"", b"")
