"""Public names of packages, imported when they are first used: numba and astropy are slow to load."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, modules: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make ``__getattr__`` and ``__dir__`` of a package that imports its names at first use.

    A package lists its names three times, for three readers: in ``__all__`` for people and
    documentation, in imports under ``TYPE_CHECKING`` for type checkers and editors, and in the
    call of this function for Python.  ``tests/test_public_names.py`` holds them equal.

    Parameters
    ----------
    package : str
        The package's ``__name__``.
    modules : mapping of str to sequence of str
        Public names by the module that defines them, its path relative to the package.

    Returns
    -------
    getattr_, dir_ : callable
        Functions to assign to the package's ``__getattr__`` and ``__dir__``.
    """
    origins = {name: f"{package}.{m}" for m, names in modules.items() for name in names}

    def getattr_(name: str) -> Any:
        if name not in origins:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(origins[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def dir_() -> list[str]:
        return sorted(sys.modules[package].__all__)

    return getattr_, dir_
