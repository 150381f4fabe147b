"""The public names of all rooms and the parameters that they take, as one line each.

``python -m tests.public_names`` writes them to ``tests/data/public_names.txt``, which
``tests/test_public_names.py`` holds against the package.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import bfsensor

ROOT = Path(bfsensor.__file__).parent
LISTED = Path(__file__).parent / "data" / "public_names.txt"
ROOMS = (
    "device", "simulate", "response", "direct", "table", "sweeps", "sensor", "effects",
    "recording", "recording.raw", "recording.campaign", "recording.tables", "measure",
    "inference", "fit", "diagnose", "plots",
)  # fmt: skip
PRIVATE = ("cli", "_kernels")
"""Packages without public names: the command line's contract is its options."""


def packages() -> dict[str, ModuleType]:
    """Give the packages that have public names, the rooms before the top."""
    names = [*(f"bfsensor.{room}" for room in ROOMS), "bfsensor"]
    return {name: import_module(name) for name in names}


def public_objects() -> dict[str, Any]:
    """Give each public object once, by the name in its room."""
    found: dict[int, tuple[str, Any]] = {}
    for package, module in packages().items():
        for name in module.__all__:
            value = getattr(module, name)
            found.setdefault(id(value), (f"{package}.{name}", value))
    return dict(found.values())


def list_names() -> list[str]:
    """One line for each public name: what it takes, or where else it stands."""
    names = {id(value): name for name, value in public_objects().items()}
    lines = []
    for package, module in packages().items():
        for name in module.__all__:
            value, full = getattr(module, name), f"{package}.{name}"
            if names[id(value)] != full:
                lines.append(f"{full} = {names[id(value)]}")
            else:
                lines += _described(full, value)
    return sorted(lines)


def _described(full: str, value: Any) -> Iterator[str]:
    """Lines of a name: of classes those of their own public methods and properties too."""
    if not callable(value):
        yield full
        return
    yield full + _parameters(value)
    if not inspect.isclass(value):
        return
    above = {name for base in value.__mro__[1:] for name in vars(base)}
    fields = set(getattr(value, "__dataclass_fields__", ()))
    for name, member in vars(value).items():
        if name.startswith("_") or name in above | fields:
            continue
        plain = getattr(member, "__func__", member)  # of class and static methods
        yield f"{full}.{name}" + (_parameters(plain) if inspect.isfunction(plain) else "")


def _parameters(value: Any) -> str:
    """Names of the parameters, ``*`` before those that are given by name only."""
    if isinstance(value, type) and issubclass(value, Exception):
        return ""
    words = []
    starred = False
    for name, parameter in inspect.signature(value).parameters.items():
        if parameter.kind is parameter.KEYWORD_ONLY and not starred:
            words.append("*")
        starred |= parameter.kind in (parameter.KEYWORD_ONLY, parameter.VAR_POSITIONAL)
        stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}
        default = "" if parameter.default is parameter.empty else "="
        words.append(f"{stars.get(parameter.kind, '')}{name}{default}")
    return f"({', '.join(words)})"


if __name__ == "__main__":
    LISTED.write_text("\n".join(list_names()) + "\n", encoding="utf-8")
