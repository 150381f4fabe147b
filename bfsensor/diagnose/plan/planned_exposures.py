"""Planned exposures, forecasts of their channels, and the power of these to separate two models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.typing import FloatArray


@dataclass(frozen=True)
class Planned:
    """Planned exposures of one kind and condition; settings that are nan are the campaign's.

    Attributes
    ----------
    kind : str
        'flat', 'spot', 'dark' or 'bias'.
    count : int
        Number of exposures; flats are taken in pairs.
    level : float
        Mean level of flats [e-].
    flux : float
        Flux of spots [e-].
    seconds : float
        Exposure time [s]; for flats in place of the level.
    wavelength, back_bias, temperature : float
        Wavelength [nm], back bias [V] and temperature [K].
    lamp : float
        Reading of the lamp monitor, in the campaign's unit.
    lamp_error : float
        Relative error of that reading; nan: that of the campaign's monitor.
    rate : float
        Light relative to the campaign's.
    overscan : int
        Overscan pixels, serial and parallel; 0: the campaign's.
    after : float
        For darks: level of the exposure before [e-].
    special : str
        Instruction that the other settings do not express.
    """

    kind: str
    count: int
    level: float = np.nan
    flux: float = np.nan
    seconds: float = np.nan
    wavelength: float = np.nan
    back_bias: float = np.nan
    temperature: float = np.nan
    lamp: float = np.nan
    lamp_error: float = np.nan
    rate: float = 1.0
    overscan: int = 0
    after: float = 0.0
    special: str = ""


@dataclass(frozen=True, eq=False)
class Forecast:
    """One channel of exposures that were not taken.

    Attributes
    ----------
    channel : Channel
        Predicted values, with the errors that the recording would have.
    slopes : ndarray, shape (n, p)
        Derivatives by the fit's parameters, in the order of its names [the channel's unit].
    free : mapping of str to ndarray, shape (n,)
        Columns of parameters that no present recording constrains, such as the light at a new
        condition.
    """

    channel: Channel
    slopes: FloatArray
    free: Mapping[str, FloatArray]

    def covariance(self, fit: BaselineFit) -> FloatArray:
        """Covariance of the prediction by the fit's parameters [unit^2], to first order in them."""
        used = np.abs(self.slopes).max(0, initial=0.0) > 0
        slopes = self.slopes[:, used]
        return np.asarray(slopes @ fit.covariance[np.ix_(used, used)] @ slopes.T)


class Information:
    r"""Expected power of planned recordings to separate two models.

    .. math::
        \Delta\chi^2 = d^T (C + J \Sigma J^T)^{-1} d

    with d the difference of the predictions of the two models, each fitted to the present
    recordings, C the noise of the planned ones, J the derivatives by the parameters of the wrong
    model and :math:`\Sigma` their covariance.  Parameters that no present recording constrains are
    fitted to the planned recordings alone.

    Parameters
    ----------
    right, wrong : sequence of Forecast
        Forecasts of the same channels by both models.
    fit : BaselineFit
        Fit of the wrong model.
    """

    def __init__(
        self, right: Sequence[Forecast], wrong: Sequence[Forecast], fit: BaselineFit
    ) -> None:
        pairs = list(zip(right, wrong, strict=True))
        away = np.concatenate([
            a.channel.whiten(a.channel.values - b.channel.values) for a, b in pairs
        ])  # fmt: skip
        slopes = np.concatenate([a.channel.whiten(b.slopes) for a, b in pairs])
        free: dict[str, FloatArray] = {}
        start = 0
        for one, other in pairs:
            rows = slice(start, start + len(one.channel))
            start = rows.stop
            for name, column in other.free.items():
                whole = free.setdefault(name, np.zeros(len(away)))
                whole[rows] = one.channel.whiten(column)
        if free:
            u, s, _ = np.linalg.svd(np.array(list(free.values())).T, full_matrices=False)
            basis = u[:, s > 1e-10 * s.max()]
            away = away - basis @ (basis.T @ away)
            slopes = slopes - basis @ (basis.T @ slopes)
        # The root of the covariance, in units of errors: some directions may have none.
        errors = np.sqrt(np.diag(fit.covariance))
        held = errors > 0
        w, v = np.linalg.eigh(
            fit.covariance[np.ix_(held, held)] / np.outer(errors[held], errors[held])
        )
        design = (slopes[:, held] * errors[held]) @ (v * np.sqrt(np.clip(w, 0.0, None)))
        self._square = float(away @ away)
        self._inner, self._cross = design.T @ design, design.T @ away

    def delta_chi2(self, times: float = 1.0) -> float:
        """Calculate the expected chi-square difference for ``times`` the planned exposures."""
        matrix = np.eye(len(self._cross)) + times * self._inner
        given_way = times**2 * self._cross @ np.linalg.solve(matrix, self._cross)
        return max(float(times * self._square - given_way), 0.0)
