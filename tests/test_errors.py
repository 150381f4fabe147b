"""Errors: each is a BFSensorError and the built-in that fits, and survives pickling."""

from __future__ import annotations

import pickle

import pytest

from bfsensor import errors

CLASSES = {
    errors.BFSensorError: Exception,
    errors.DeviceError: ValueError,
    errors.TableError: ValueError,
    errors.MeasurementError: ValueError,
    errors.RecordingError: ValueError,
    errors.SensorError: ValueError,
    errors.SensorTypeError: TypeError,
    errors.SimulationError: ValueError,
    errors.DiagnosisError: ValueError,
    errors.FitError: ValueError,
    errors.EffectError: ValueError,
    errors.SweepError: ValueError,
    errors.ConvergenceError: RuntimeError,
}


def test_the_list_of_this_file_is_complete():
    found = {
        c
        for c in vars(errors).values()
        if isinstance(c, type) and issubclass(c, errors.BFSensorError)
    }
    assert found == set(CLASSES)


@pytest.mark.parametrize(("kind", "builtin"), CLASSES.items())
def test_hierarchy(kind, builtin):
    assert issubclass(kind, builtin)
    assert issubclass(kind, errors.BFSensorError)
    others = set(CLASSES) - {kind, errors.BFSensorError}
    known = {errors.SensorError} if kind is errors.SensorTypeError else set()
    assert {other for other in others if issubclass(kind, other)} == known


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("kind", CLASSES)
def test_pickling_keeps_class_and_message(kind, protocol):
    error = kind("pixel: pitch_x = '-1 um' must be above 0 um")
    again = pickle.loads(pickle.dumps(error, protocol))
    assert type(again) is kind
    assert str(again) == str(error)


def test_convergence_error_keeps_its_history():
    error = errors.ConvergenceError("no end", [1.0, 0.25, 0.2])
    assert error.history == (1.0, 0.25, 0.2)
    again = pickle.loads(pickle.dumps(error))
    assert again.history == error.history
    assert str(again) == "no end"
    assert errors.ConvergenceError("no end").history == ()
