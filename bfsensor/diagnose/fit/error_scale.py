"""Errors of measured a_ij, scaled by the scatter of far lags about a smooth function of distance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.typing import FloatArray

FAR = 2.5
"""Distance of lags [pixel] beyond which a_ij count as far.  Chosen, as the set 'far lags' of the
scans: a_ij beyond are at most 2.5 % (ITL) and 2.8 % (E2V) of a_01, and the baseline predicts them to a
fraction of that; at 5, tables to lag 4 have none and no scale is found."""

SMOOTH = (2.0, 4.0)
"""Powers of one over the distance that are fitted to far lags less the baseline, and are no scatter.
Measured: of changes of 15 quantities of an ITL device (300 pairs of flats) that raise the rms
of far lags by up to 8 errors, 0.17 is left, 0.77 with the first power alone, 0.07 with two more that
depend on the direction; each takes a degree of freedom."""

SURE = 0.95
"""Confidence of the interval of the scale.  Chosen: errors are left as stated where 1 is inside, and
else are multiplied by its upper end, so that noise is hardly ever taken for smaller than it is.  With
17 far lags, of tables to lag 4, a scatter between 0.65 and 1.35 of the stated errors counts as
theirs; at 0.975, half the risk, between 0.61 and 1.42."""


@dataclass(frozen=True)
class ErrorScale:
    """Factor on the stated errors of one table.

    Attributes
    ----------
    table : int
        Index of the table.
    count : int
        Number of far lags.
    scatter : float
        Rms of the far lags about the baseline and a smooth function (:data:`SMOOTH`), in stated errors.
    factor : float
        Factor that is applied: 1 where the interval of the scale holds it, else its upper end.
    """

    table: int
    count: int
    scatter: float
    factor: float

    def said(self, name: str = "the table") -> str:
        """Sentence for the report."""
        text = (
            f"a_ij of {self.count} far lags of {name} scatter by {self.scatter:.2g} of the stated "
            "errors"
        )
        if self.factor == 1:
            return f"{text}: the errors are used as they are"
        return (
            f"{text}: all errors of {name} are multiplied by {self.factor:.2g}, the upper end of the "
            f"{SURE:.0%} interval of that factor"
        )


def scale_errors(measured: MeasuredChannels, baseline: Baseline) -> MeasuredChannels:
    """Scale the errors of tables of a_ij by the scatter of their far lags.

    Published errors may be the scatter of amplifiers instead of the error of the mean, or shared.
    Far from a charge the response of any sensor falls smoothly with distance, so that the
    scatter of these lags about a smooth function is noise.

    Parameters
    ----------
    measured : MeasuredChannels
        From :func:`~bfsensor.diagnose.data.reduced_channels.measure_reduced`; others are returned
        as they are.
    baseline : Baseline
        Predicts the far lags, with its parameters at their nominal values.

    Returns
    -------
    measured : MeasuredChannels
        With scaled errors, and a note for each table with at least four far lags.
    """
    channels, scales = [], []
    predictor = Predictor(measured, baseline)
    for channel in measured.channels:
        if channel.unit != PER_ELECTRON:
            channels.append(channel)
            continue
        left = (
            channel.values - predictor.predict(channel, predictor.start)
        ) / channel.errors
        factors = np.ones(len(channel))
        for table in np.unique(channel.axes["table"]).astype(int):
            own = channel.axes["table"] == table
            distance = np.hypot(channel.axes["i"], channel.axes["j"])
            far = own & (distance > FAR)
            # Far lags that were all written alike show no noise.
            if far.sum() < len(SMOOTH) + 2 or not np.ptp(channel.values[far]):
                continue
            scale = _scale_of(int(table), left[far], distance[far], channel.errors[far])
            factors[own] = scale.factor
            scales.append(scale)
        channels.append(_scaled(channel, factors))
    if not scales:
        return measured
    many = len(scales) > 1
    notes = tuple(s.said(f"table {s.table + 1}" if many else "the table") for s in scales)
    return replace(measured, channels=tuple(channels), notes=(*measured.notes, *notes))


def _scale_of(
    table: int, left: FloatArray, distance: FloatArray, errors: FloatArray
) -> ErrorScale:
    """Scale from residuals of far lags in units of their errors, at their distances [pixel]."""
    smooth = np.array([distance**-power / errors for power in SMOOTH]).T
    smooth /= smooth.max(axis=0)
    left = left - smooth @ np.linalg.lstsq(smooth, left)[0]
    n = len(left) - len(SMOOTH)
    square = float(left @ left)
    low, high = (np.sqrt(square / chi2.ppf(0.5 * (1 + s * SURE), n)) for s in (1, -1))
    factor = 1.0 if low <= 1 <= high else float(high)
    return ErrorScale(table, len(left), float(np.sqrt(square / n)), factor)


def _scaled(channel: Channel, factors: FloatArray) -> Channel:
    """Copy of a channel of single values with errors multiplied by factors."""
    variance = np.square(channel.errors * factors)
    return replace(channel, blocks=tuple(variance[:, None, None]))
