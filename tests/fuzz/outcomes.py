"""Running one mutated input within limits, and what it may end in."""

from __future__ import annotations

import contextlib
import resource
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import galsim
import numpy as np

from bfsensor.errors import BFSensorError

SECONDS = 5
"""CPU seconds that one input may take; chosen, a thousand times a usual one."""

MEMORY = 512 << 20
"""Bytes by which one input may let the process grow; chosen, a hundred times a usual one."""

LONGEST = 600
"""Characters that a message may have; chosen, seven lines of a terminal."""


class Outcome(Enum):
    """What reading an input ended in; all but the first two are faults."""

    CLEAR = "clear error"
    RIGHT = "right acceptance"
    SILENT = "silent acceptance"
    REFUSED = "valid input refused"
    FOREIGN = "foreign exception"
    LIMIT = "time or memory"


FAULTS = tuple(one for one in Outcome if one not in (Outcome.CLEAR, Outcome.RIGHT))
"""Outcomes that are bugs."""


@dataclass(frozen=True)
class Case:
    """One mutated input of a door.

    Attributes
    ----------
    words : str
        The mutation in words.
    load : callable
        Reads the input and returns what was made of it.
    judge : callable
        Takes that object; returns '' where it is what the input states, within the limits that are
        declared, and otherwise what is wrong.  It reads the input in its own way.
    names : tuple of str
        An error must name one of these: the file, or the argument.
    keeps : bool
        True where the mutation changes no meaning: the input must be accepted.
    errors : tuple of type
        Exceptions that the door's documentation allows beside the package's and GalSim's.
    """

    words: str
    load: Callable[[], Any]
    judge: Callable[[Any], str]
    names: tuple[str, ...]
    keeps: bool = False
    errors: tuple[type[BaseException], ...] = ()


class Door:
    """A place where strangers' input enters; ``make`` mutates a valid one.

    Parameters
    ----------
    folder : Path
        An empty folder for the door's files.
    """

    name = ""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make(self, rng: np.random.Generator) -> Case:
        """Return one mutated input."""
        raise NotImplementedError

    def write(self, name: str, data: bytes) -> Path:
        """Write a file of the door; one of the same name is replaced."""
        path = self.folder / name
        path.write_bytes(data)
        return path


class Ended(NamedTuple):
    """Outcome of a case, with the error or with what is wrong."""

    outcome: Outcome
    said: str


class _OutOfTimeError(BaseException):
    """The time limit was reached; no ``except Exception`` may catch it."""


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    """Raise where the limits of time or memory are exceeded."""

    def stop(number: int, frame: object) -> None:
        raise _OutOfTimeError

    before = signal.signal(signal.SIGPROF, stop)
    limits = resource.getrlimit(resource.RLIMIT_AS)
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, limits[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, limits)


def run(case: Case) -> Ended:
    """Read a mutated input and judge what was made of it."""
    try:
        with _limited(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # numpy warns of numbers that passed the checks and are of no use.
            warnings.simplefilter("error", RuntimeWarning)
            found = case.load()
    except (_OutOfTimeError, MemoryError) as error:
        return Ended(Outcome.LIMIT, type(error).__name__)
    except (BFSensorError, galsim.GalSimError, *case.errors) as error:
        unclear = _unclear(str(error), case.names)
        said = one_line(error)
        if unclear:
            return Ended(Outcome.FOREIGN, f"an error that {unclear}: {said}")
        return Ended(Outcome.REFUSED if case.keeps else Outcome.CLEAR, said)
    except Exception as error:
        return Ended(Outcome.FOREIGN, f"{type(error).__name__}: {one_line(error)}")
    wrong = case.judge(found)
    return Ended(Outcome.SILENT, wrong) if wrong else Ended(Outcome.RIGHT, "")


def _unclear(text: str, names: tuple[str, ...]) -> str:
    """Say why a message is not clear; '' where it is."""
    if not text.isprintable():
        return "has several lines or control characters"
    if len(text) > LONGEST:
        return f"has {len(text)} characters"
    if not any(name in text for name in names):
        return f"does not name {' or '.join(names)}"
    return ""


def one_line(error: object) -> str:
    """First 200 printable characters of an error."""
    return "".join(c if c.isprintable() else "?" for c in str(error))[:200]
