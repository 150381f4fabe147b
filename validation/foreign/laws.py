"""All laws together: importing this module fills the register."""

from __future__ import annotations

from validation.foreign import (  # noqa: F401
    laws_amplifier,
    laws_collection,
    laws_geometry,
    laws_light,
    laws_noise,
    laws_silicon,
    laws_transfer,
    laws_unnamed,
)
from validation.foreign.law import LAWS, Law, make_law

OUTSIDE = "outside_library"
CLASSES = tuple(sorted({word for word, _ in LAWS}))

__all__ = ["CLASSES", "LAWS", "OUTSIDE", "Law", "laws_of", "make_law"]


def laws_of(word: str) -> tuple[str, ...]:
    """Names of a class's laws.

    Examples
    --------
    >>> laws_of("tearing")
    ('divisadero', 'ragged')
    """
    return tuple(sorted(name for w, name in LAWS if w == word))
