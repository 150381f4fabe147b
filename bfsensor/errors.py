"""Errors of bfsensor: each is also the built-in that fits, and all survive pickling."""

from __future__ import annotations

from collections.abc import Sequence


class BFSensorError(Exception):
    """Base of all errors that bfsensor raises on purpose."""


class DeviceError(BFSensorError, ValueError):
    """A device is wrong, or does not allow what was asked of it."""


class TableError(BFSensorError, ValueError):
    """A distortion table is wrong, or was asked for something outside it."""


class MeasurementError(BFSensorError, ValueError):
    """Data do not allow the measurement."""


class RecordingError(BFSensorError, ValueError):
    """A recording lacks something, or holds what cannot be read as it says."""


class SensorError(BFSensorError, ValueError):
    """A sensor for image simulation was given what it cannot use."""


class SimulationError(BFSensorError, ValueError):
    """A simulation of electrons was asked for something it cannot do."""


class DiagnosisError(BFSensorError, ValueError):
    """Recordings and prediction cannot be held against one another as asked."""


class FitError(BFSensorError, ValueError):
    """A device cannot be fitted to the measurements as asked."""


class EffectError(BFSensorError, ValueError):
    """An effect was given parameters or data that it has no meaning for."""


class SweepError(BFSensorError, ValueError):
    """Work cannot be spread as asked."""


class ConvergenceError(BFSensorError, RuntimeError):
    """An iteration did not reach its tolerance; nothing unconverged is returned.

    Parameters
    ----------
    message : str
        What did not converge.
    history : sequence of float
        Residual of each iteration.
    """

    def __init__(self, message: str, history: Sequence[float] = ()) -> None:
        super().__init__(message)
        self.history = tuple(history)

    def __reduce__(self) -> tuple[type[ConvergenceError], tuple[str, tuple[float, ...]]]:
        return type(self), (str(self), self.history)
