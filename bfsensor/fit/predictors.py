"""Predictions of data sets from the parameters of a device, with derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.device.quantities import Prior
from bfsensor.errors import FitError
from bfsensor.fit.data import DataSet
from bfsensor.fit.spot_response import slope_weights
from bfsensor.typing import FloatArray

Prediction = tuple[FloatArray, FloatArray]
"""Values, shape (n,), and their derivatives by all parameters, shape (n, p)."""


class PredictedEdges(Protocol):
    """Boundary shifts of a flat at one condition, with derivatives by the emulator's parameters."""

    @property
    def kx(self) -> FloatArray:
        """Mean shifts of right edges [pixel/e-], odd sides, (0, 0) in the middle."""

    @property
    def ky(self) -> FloatArray:
        """Mean shifts of upper edges [pixel/e-], odd sides, (0, 0) in the middle."""

    @property
    def dkx(self) -> FloatArray:
        """Derivatives of ``kx``, first axis by parameter."""

    @property
    def dky(self) -> FloatArray:
        """Derivatives of ``ky``, first axis by parameter."""

    @property
    def areas(self) -> FloatArray:
        """Relative area changes a_ij [1/e-], ``[j, i]`` from lag (0, 0)."""

    @property
    def jacobian(self) -> FloatArray:
        """Derivatives of ``areas``, first axis by parameter."""


class Emulator(Protocol):
    """Predictor of the boundary shifts of a device as a function of its parameters."""

    @property
    def parameters(self) -> Sequence[str]:
        """Dotted names of the parameters, in the order of the values."""

    def predict(self, values: FloatArray, condition: Condition) -> PredictedEdges:
        """Predict the response at values of the parameters [internal units] and a condition."""


class DataPredictor(Protocol):
    """Predictor of one data set as a function of all free parameters."""

    def __call__(self, values: FloatArray) -> Prediction:
        """Predict at the values of all free parameters [internal units], shape (p,)."""


def held(names: Sequence[str], condition: Condition) -> NDArray[np.bool_]:
    """Find the parameters that a condition states, which are therefore not free there.

    A voltage that was recorded with a measurement is not a free parameter of its prediction; one
    that was not recorded is the device's, with its prior.

    Parameters
    ----------
    names : sequence of str
        Dotted names of parameters.
    condition : Condition
        Condition of a measurement.

    Returns
    -------
    held : ndarray of bool, shape (p,)
        True for parameters that the condition states.

    Examples
    --------
    >>> held(["operating_point.back_bias", "silicon.thickness"], Condition(back_bias=-60.0))
    array([ True, False])
    """
    return np.array([
        name.startswith("operating_point.")
        and getattr(condition, name.partition(".")[2], None) is not None
        for name in names
    ], bool)  # fmt: skip


class _Responses:
    """Emulator as a function of all parameters of a fit, which may be more than its own."""

    def __init__(self, emulator: Emulator, priors: Sequence[Prior]) -> None:
        names = [prior.name for prior in priors]
        missing = [name for name in emulator.parameters if name not in names]
        if missing:
            raise FitError(f"the emulator's parameters {', '.join(missing)} have no prior")
        self._emulator = emulator
        self._names = tuple(emulator.parameters)
        self._at = np.array([names.index(name) for name in emulator.parameters], int)
        self._means = np.array([priors[k].mean for k in self._at])

    def predict(
        self, values: FloatArray, condition: Condition
    ) -> tuple[PredictedEdges, NDArray[np.int64]]:
        """Predict; give for each row of the jacobian the number of the fit's parameter, or -1."""
        stated = held(self._names, condition)
        own = np.where(stated, self._means, values[self._at])
        return self._emulator.predict(own, condition), np.where(stated, -1, self._at)


class AreaPredictor:
    """Predictor of a_ij by an emulator."""

    def __init__(self, data: DataSet, emulator: Emulator, priors: Sequence[Prior]) -> None:
        self._data, self._responses = data, _Responses(emulator, priors)
        self._groups = _by_condition(data)

    def __call__(self, values: FloatArray) -> Prediction:
        """Predict at the values of all free parameters [internal units], shape (p,)."""
        i, j = self._data.places.T
        found = np.zeros(len(i))
        slopes = np.zeros((len(i), len(values)))
        for condition, rows in self._groups.items():
            response, at = self._responses.predict(values, condition)
            areas = np.asarray(response.areas)
            reach = min(areas.shape) - 1
            if max(i[rows].max(), j[rows].max()) > reach:
                raise FitError(f"{self._data.name}: lags beyond {reach} are not predicted")
            found[rows] = areas[j[rows], i[rows]]
            jacobian = np.asarray(response.jacobian)
            for n, column in enumerate(at):
                if column >= 0:
                    slopes[rows, column] = jacobian[n, j[rows], i[rows]]
        return found, slopes


class SlopePredictor:
    """Predictor of B-F slopes of spots, which are linear in the shifts of an emulator."""

    def __init__(self, data: DataSet, emulator: Emulator, priors: Sequence[Prior]) -> None:
        self._data, self._responses = data, _Responses(emulator, priors)
        self._groups = _by_condition(data)
        self._weights = slope_weights(data.sigma)

    def __call__(self, values: FloatArray) -> Prediction:
        """Predict at the values of all free parameters [internal units], shape (p,)."""
        axes = self._data.places[:, 0]
        found = np.zeros(len(axes))
        slopes = np.zeros((len(axes), len(values)))
        for condition, rows in self._groups.items():
            response, at = self._responses.predict(values, condition)
            found[rows] = self._weights.slopes(response.kx, response.ky)[axes[rows]]
            changes = self._weights.slopes(response.dkx, response.dky)
            for n in np.flatnonzero(at >= 0).tolist():
                slopes[rows, at[n]] = changes[n, axes[rows]]
        return found, slopes


class TangentPredictor:
    """Predictor that is linear in the parameters about one set of their values."""

    def __init__(
        self,
        middle: FloatArray,
        values: FloatArray,
        derivatives: FloatArray,
    ) -> None:
        self._middle, self._values, self._slopes = middle, values, derivatives

    def __call__(self, values: FloatArray) -> Prediction:
        """Predict at the values of all free parameters [internal units], shape (p,)."""
        return self._values + self._slopes @ (values - self._middle), self._slopes


Tangents = Callable[[DataSet, Sequence[Prior]], TangentPredictor]
"""Function that makes the linear predictor of a data set for given priors."""


def make_predictors(
    sets: Sequence[DataSet],
    emulator: Emulator | None,
    priors: Sequence[Prior],
    tangents: Mapping[str, Tangents] | None = None,
    *,
    late: bool = False,
) -> tuple[DataPredictor, ...]:
    """Make the predictor of each data set.

    Parameters
    ----------
    sets : sequence of DataSet
        Data sets to predict.
    emulator : Emulator or None
        Emulator of boundary shifts for areas and slopes; None if there are no such sets.
    priors : sequence of Prior
        Priors of all free parameters, in the order of the fit.
    tangents : mapping of str to callable, optional
        Makers of predictors for the kinds 'saturation', 'diffusion' and 'depletion'.
    late : bool
        Whether the emulator is supplied later: predicting areas and slopes before is an error.

    Returns
    -------
    predictors : tuple of DataPredictor
        One for each set.

    Raises
    ------
    FitError
        There is no predictor for a kind.
    """
    out: list[DataPredictor] = []
    for data in sets:
        if data.kind in ("areas", "slopes"):
            if emulator is None and late:
                out.append(_open)
                continue
            if emulator is None:
                raise FitError(f"{data.name}: {data.kind} need an emulator or linearise")
            kind = AreaPredictor if data.kind == "areas" else SlopePredictor
            out.append(kind(data, emulator, priors))
        elif tangents and data.kind in tangents:
            out.append(tangents[data.kind](data, priors))
        else:
            raise FitError(f"{data.name}: no predictor of {data.kind}: give tangents")
    return tuple(out)


def _open(values: FloatArray) -> Prediction:
    """Predictor of a set whose emulator is not there yet."""
    raise FitError("areas and slopes cannot be predicted before the device was solved")


def _by_condition(data: DataSet) -> dict[Condition, NDArray[np.int64]]:
    """Numbers of a data set by their condition."""
    out: dict[Condition, list[int]] = {}
    for row, condition in enumerate(data.conditions):
        out.setdefault(condition, []).append(row)
    return {condition: np.array(rows) for condition, rows in out.items()}
