"""What is public: listed by every room, documented, and changed on purpose only."""

from __future__ import annotations

import ast
import difflib
import inspect
import re
from importlib import import_module

import pytest

from bfsensor._lazy import lazy_names
from tests.public_names import (
    LISTED,
    PRIVATE,
    ROOMS,
    ROOT,
    list_names,
    packages,
    public_objects,
)

CHANGED = """The public surface of bfsensor changed:
{}
If that is meant, run `python -m tests.public_names`, commit its list, and say so in CHANGELOG.md.
What was removed or renamed, and a parameter that was, must first work for one release with a
DeprecationWarning: CONTRIBUTING.md, "Versions and deprecation"."""


def folder_of(package):
    return ROOT.joinpath(*package.split(".")[1:])


def blocks(package):
    """What a package's file shows to type checkers, and what Python runs instead."""
    (block,) = (
        node
        for node in ast.parse((folder_of(package) / "__init__.py").read_text()).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    (assigned,) = block.orelse
    return block.body, ast.literal_eval(assigned.value.args[1])


def test_the_public_surface_changes_on_purpose_only():
    listed, found = LISTED.read_text().splitlines(), list_names()
    changes = [
        line
        for line in difflib.unified_diff(listed, found, lineterm="", n=0)
        if re.match(r"[-+](?![-+])", line)
    ]
    assert not changes, CHANGED.format("\n".join(changes))


def test_every_package_has_public_names_or_is_private():
    rooms = {p.parent.name for p in ROOT.glob("*/__init__.py")}
    assert rooms == {room.partition(".")[0] for room in ROOMS} | set(PRIVATE)


@pytest.mark.parametrize("package", packages())
def test_the_three_lists_of_a_package_are_one(package):
    module = packages()[package]
    shown, run = blocks(package)
    modules = {f"{package}.{name}": names for name, names in run.items()}
    assert {n.module: [a.name for a in n.names] for n in shown} == modules
    listed = [name for name in module.__all__ if name != "__version__"]
    assert sorted(listed) == sorted(name for names in run.values() for name in names)
    assert dir(module) == sorted(module.__all__)
    for origin, names in modules.items():
        for name in names:
            assert getattr(module, name) is getattr(import_module(origin), name)


@pytest.mark.parametrize("package", packages())
def test_no_public_name_is_hidden_by_a_module(package):
    """Python sets a package's attribute to the module of that name once that is imported."""
    modules = {path.stem for path in folder_of(package).iterdir()}
    assert not modules & set(packages()[package].__all__)


def test_unknown_names_are_refused_by_rooms():
    get, _ = lazy_names("bfsensor.device", {"device": ["Device"]})
    with pytest.raises(
        AttributeError, match=r"^module 'bfsensor.device' has no attribute 'Devise'$"
    ):
        get("Devise")


DOCUMENTED = {n: v for n, v in public_objects().items() if callable(v)}


@pytest.mark.parametrize("name", DOCUMENTED)
def test_public_names_are_documented(name):
    value = DOCUMENTED[name]
    text = value.__doc__ or ""
    summary = text.strip().partition("\n")[0]
    # A dataclass without a docstring is given its signature.
    assert summary.endswith(".") and not text.startswith(f"{value.__name__}(")
    if inspect.isclass(value):
        return
    sections = re.findall(r"^ *(\w[\w ]*)\n *-{3,}$", text, re.MULTILINE)
    if inspect.signature(value).parameters:
        assert "Parameters" in sections
    if inspect.signature(value).return_annotation not in ("None", None):
        assert {"Returns", "Yields"} & set(sections)
