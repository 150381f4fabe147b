"""One picture for each class of effects, drawn by the package's own operations on pixels, and one for
each piece of silicon physics, from results.

``python -m effect_figures FOLDER [CLASS ...]``, from ``docs/``, draws into a folder; the documentation
draws all of them when it is built and keeps them while the code that makes them is the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

import bfsensor

# Modules register their pictures when they are imported.
from effect_figures import collection, light, readout  # noqa: F401
from effect_figures.parts import PICTURES
from effect_figures.pieces import FILE, PIECES


def digest() -> str:
    """Digest of the code that pictures depend on."""
    root = Path(bfsensor.__file__).parent
    found = hashlib.sha256()
    for path in (
        *sorted(Path(__file__).parent.glob("*.py")),
        *sorted((root / "effects").glob("*.py")),
        FILE,
    ):
        found.update(path.read_bytes())
    return found.hexdigest()


def draw_all(folder: Path, words: Iterable[str] | None = None) -> None:
    """Draw the pictures of some or of all classes into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    every = PICTURES | {f"piece_{name}": shown for name, shown in PIECES.items()}
    for word in words or every:
        every[word].draw().savefig(folder / f"{word}.png", dpi=110)


def draw_once(folder: Path) -> None:
    """Draw all pictures unless the folder has those of the same code."""
    mark = folder / "digest.txt"
    if mark.is_file() and mark.read_text() == digest():
        return
    draw_all(folder)
    mark.write_text(digest())
