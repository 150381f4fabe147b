"""Exceptions of bfsensor; each also derives from ValueError or RuntimeError and can be pickled."""

from __future__ import annotations

from collections.abc import Sequence

LONGEST = 560
"""Largest number of characters of a message.  Chosen: with the words that a command puts before it,
seven lines of a terminal; with 1120 a text that is quoted takes up to fourteen."""


def in_one_line(text: object, most: int = LONGEST) -> str:
    """Text in one line of printable characters; of one that is too long the middle is left out.

    A message begins with its place and ends with what is allowed: both stay.

    Examples
    --------
    >>> in_one_line("device.toml: name = " + "x" * 1000 + " must be short", 46)
    'device.toml: name = ... xxxxxx must be short'
    """
    line = " ".join(str(text).split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    half = (most - 5) // 2
    return (
        line if len(line) <= most else f"{line[:half].rstrip()} ... {line[-half:].lstrip()}"
    )


class BFSensorError(Exception):
    """Base class of all exceptions that bfsensor raises on purpose.

    Its text is one line of at most :data:`LONGEST` printable characters, whatever input it quotes.
    """

    def __str__(self) -> str:
        return in_one_line(super().__str__())


class DeviceError(BFSensorError, ValueError):
    """A device description is invalid, or the device is outside the range of a method."""


class TableError(BFSensorError, ValueError):
    """A distortion table is invalid, or a request lies outside its range."""


class MeasurementError(BFSensorError, ValueError):
    """The given data or settings do not allow a measurement."""


class RecordingError(BFSensorError, ValueError):
    """A recording of measured data is incomplete, or its content contradicts its description."""


class SensorError(BFSensorError, ValueError):
    """A sensor for image simulation was given an option or data that it cannot use."""


class SensorTypeError(SensorError, TypeError):
    """An argument of a sensor has a type that it cannot use; a TypeError, as GalSim raises one."""


class SimulationError(BFSensorError, ValueError):
    """A simulation of single electrons was given settings or files that it cannot use."""


class DiagnosisError(BFSensorError, ValueError):
    """Recordings and prediction cannot be compared as requested."""


class FitError(BFSensorError, ValueError):
    """A device cannot be fitted to measurements, or an emulator cannot be used, as requested."""


class EffectError(BFSensorError, ValueError):
    """An effect was given parameters or data for which it is not defined."""


class SweepError(BFSensorError, ValueError):
    """A sweep over devices cannot be planned, run or read as requested."""


class ConvergenceError(BFSensorError, RuntimeError):
    """An iteration did not reach its tolerance; nothing unconverged is returned.

    Parameters
    ----------
    message : str
        Which iteration did not converge, and how far it came.
    history : sequence of float
        Size of the residual or of the step in each iteration, in the unit of the message; empty
        where the method has none.

    Attributes
    ----------
    history : tuple of float
        The same numbers.

    Examples
    --------
    >>> ConvergenceError("the potential did not converge", [1.0, 0.5]).history
    (1.0, 0.5)
    """

    def __init__(self, message: str, history: Sequence[float] = ()) -> None:
        super().__init__(message)
        self.history = tuple(history)

    def __reduce__(self) -> tuple[type[ConvergenceError], tuple[str, tuple[float, ...]]]:
        return type(self), (str(self), self.history)
