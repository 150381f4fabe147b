"""What a device with given parameters is expected to show, and how that changes with them."""

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
    """Response of a flat at one condition.

    ``kx``, ``ky``: mean shifts of right and upper edges [pixel/e-], odd sides, (0, 0) in the
    middle.  ``areas``: a_ij [1/e-], [j, i] from (0, 0).  ``dkx``, ``dky``, ``jacobian``: their
    derivatives by the emulator's parameters, along the first axis.
    """

    @property
    def kx(self) -> FloatArray:
        """Of right edges."""

    @property
    def ky(self) -> FloatArray:
        """Of upper edges."""

    @property
    def dkx(self) -> FloatArray:
        """By parameter."""

    @property
    def dky(self) -> FloatArray:
        """By parameter."""

    @property
    def areas(self) -> FloatArray:
        """By lag."""

    @property
    def jacobian(self) -> FloatArray:
        """By parameter and lag."""


class Emulator(Protocol):
    """Response of a device for any values of its parameters, in their order."""

    @property
    def parameters(self) -> Sequence[str]:
        """Dotted names."""

    def predict(self, values: FloatArray, condition: Condition) -> PredictedEdges:
        """Response at parameters [internal units] and a condition."""


class DataPredictor(Protocol):
    """Prediction of one data set."""

    def __call__(self, values: FloatArray) -> Prediction:
        """Predict at the values of all free parameters [internal units], shape (p,)."""


def held(names: Sequence[str], condition: Condition) -> NDArray[np.bool_]:
    """Which parameters a condition states, so that they are not free there.

    A voltage that was written down with the measurement is no parameter of its fit; one that
    was not is the device's, with its prior.
    """
    return np.array([
        name.startswith("operating_point.")
        and getattr(condition, name.partition(".")[2], None) is not None
        for name in names
    ], bool)  # fmt: skip


class _Responses:
    """Responses of an emulator by the fit's parameters, which may be more than its own."""

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
        """Response, and the fit's parameters that the jacobian's rows are of, -1 where held."""
        stated = held(self._names, condition)
        own = np.where(stated, self._means, values[self._at])
        return self._emulator.predict(own, condition), np.where(stated, -1, self._at)


class AreaPredictor:
    """a_ij as the emulator has them."""

    def __init__(self, data: DataSet, emulator: Emulator, priors: Sequence[Prior]) -> None:
        self._data, self._responses = data, _Responses(emulator, priors)
        self._groups = _by_condition(data)

    def __call__(self, values: FloatArray) -> Prediction:
        """Predict."""
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
    """Slopes of spots, linear in the shifts."""

    def __init__(self, data: DataSet, emulator: Emulator, priors: Sequence[Prior]) -> None:
        self._data, self._responses = data, _Responses(emulator, priors)
        self._groups = _by_condition(data)
        self._weights = slope_weights(data.sigma)

    def __call__(self, values: FloatArray) -> Prediction:
        """Predict."""
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
    """Numbers taken as straight in the parameters about one set of values."""

    def __init__(
        self,
        middle: FloatArray,
        values: FloatArray,
        derivatives: FloatArray,
    ) -> None:
        self._middle, self._values, self._slopes = middle, values, derivatives

    def __call__(self, values: FloatArray) -> Prediction:
        """Predict."""
        return self._values + self._slopes @ (values - self._middle), self._slopes


Tangents = Callable[[DataSet, Sequence[Prior]], TangentPredictor]


def make_predictors(
    sets: Sequence[DataSet],
    emulator: Emulator | None,
    priors: Sequence[Prior],
    tangents: Mapping[str, Tangents] | None = None,
    *,
    late: bool = False,
) -> tuple[DataPredictor, ...]:
    """Make what predicts each data set.

    Parameters
    ----------
    sets : sequence of DataSet
        What is predicted.
    emulator : Emulator or None
        Of areas and shifts; None where only saturation and widths are.
    priors : sequence of Prior
        Of all free parameters, in the order of the fit.
    tangents : mapping of str to callable, optional
        What makes the predictor of the kinds that no emulator has: 'saturation', 'diffusion'.

    late : bool
        The emulator is not there yet: areas and slopes are left open.

    Raises
    ------
    FitError
        A kind for which nothing predicts.
    """
    out: list[DataPredictor] = []
    for data in sets:
        if data.kind in ("areas", "slopes"):
            if emulator is None and late:
                out.append(_open)
                continue
            if emulator is None:
                raise FitError(f"{data.name}: {data.kind} need an emulator")
            kind = AreaPredictor if data.kind == "areas" else SlopePredictor
            out.append(kind(data, emulator, priors))
        elif tangents and data.kind in tangents:
            out.append(tangents[data.kind](data, priors))
        else:
            raise FitError(f"{data.name}: nothing predicts {data.kind}")
    return tuple(out)


def _open(values: FloatArray) -> Prediction:
    raise FitError("predicted before the device was solved")


def _by_condition(data: DataSet) -> dict[Condition, NDArray[np.int64]]:
    """Rows of each condition."""
    out: dict[Condition, list[int]] = {}
    for row, condition in enumerate(data.conditions):
        out.setdefault(condition, []).append(row)
    return {condition: np.array(rows) for condition, rows in out.items()}
