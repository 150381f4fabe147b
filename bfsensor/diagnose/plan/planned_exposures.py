"""Exposures that could be taken: what they are, what a fit says of them, what they would tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.typing import FloatArray


@dataclass(frozen=True)
class Planned:
    """Exposures of one kind and condition; what is nan is as in the campaign.

    Attributes
    ----------
    kind : str
        'flat', 'spot', 'dark' or 'bias'.
    count : int
        Exposures; flats are taken in pairs.
    level : float
        Of flats [e-].
    flux : float
        Of spots [e-].
    seconds : float
        Exposure time [s]; of flats instead of the level.
    wavelength, back_bias, temperature : float
        [nm], [V], [K].
    lamp : float
        Reading of the lamp monitor.
    lamp_error : float
        Its relative error.
    rate : float
        Light, in units of the campaign's.
    overscan : int
        Overscan pixels, serial and parallel; 0: the campaign's.
    after : float
        Of darks: level of the exposure before [e-].
    special : str
        What is done otherwise, in words.
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
        Values as predicted, errors as the recording would have them.
    slopes : ndarray, shape (n, p)
        Derivatives by the fit's parameters, in the order of its names [unit].
    free : mapping of str to ndarray, shape (n,)
        Columns of what nothing recorded so far tells, such as the light of a new condition.
    """

    channel: Channel
    slopes: FloatArray
    free: Mapping[str, FloatArray]

    def covariance(self, fit: BaselineFit) -> FloatArray:
        """Of the prediction, by the fit's parameters [unit^2], linear in them."""
        used = np.abs(self.slopes).max(0, initial=0.0) > 0
        slopes = self.slopes[:, used]
        return np.asarray(slopes @ fit.covariance[np.ix_(used, used)] @ slopes.T)


class Information:
    r"""How far recordings that were not taken would set two models apart.

    .. math::
        \Delta\chi^2 = d^T (C + J \Sigma J^T)^{-1} d

    with d the difference of what the two, each fitted to what there is, predict, C the noise of
    the new recordings, J the derivatives by the parameters of the model that is wrong and
    :math:`\Sigma` their covariance; what nothing recorded tells yet is fitted to the new
    recordings alone.

    Parameters
    ----------
    right, wrong : sequence of Forecast
        The same channels by both models.
    fit : BaselineFit
        Of the wrong one.
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
        """Expected difference of the chi-squares, the recordings taken so many times."""
        matrix = np.eye(len(self._cross)) + times * self._inner
        given_way = times**2 * self._cross @ np.linalg.solve(matrix, self._cross)
        return max(float(times * self._square - given_way), 0.0)
