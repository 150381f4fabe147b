"""Two runs of flats of one camera: what one of them teaches, held against the other.

``SHARED/recordings/sbig_flats`` (SBIG ST-7-type CCD, Astr480/CCDChar @ ccdc2a3): ramps of single
flats.  Neighbours in exposure time are scaled to one another and
measured block by block (:func:`bfsensor.measure.flat_pairs.flat_covariances`), for the light varies by
37 % over the sensor; blocks of one run are averaged in bins of level.  Differences whose far lags
rise (fixed pattern, above 17,000 to 25,000 ADU) are left out.  A run is then a table of
covariances as anybody could have reduced it, and goes to
:func:`bfsensor.diagnose.diagnosis.diagnose_measured` with the other run as the fold that no fit
sees.  Baseline: white noise with near areas that float.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.flat_pairing import RATIO
from bfsensor.diagnose.data.reduced_channels import measure_reduced
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.free_baseline import free_baseline
from bfsensor.diagnose.model.open_baseline import CampaignSource
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.errors import MeasurementError
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.recording.campaign.campaign import read_campaign
from bfsensor.recording.tables.covariance_tables import CovarianceTable

RUNS = ("langford", "bergeson")
GAIN = 0.43
"""[e-/ADU], of mean over variance; it floats in every fit."""
RIM = 16
"""Pixels at the rim that are dark or masked in places."""
BLOCK, LAGS, FAR, RISE = 116, 4, 2.5, 3.0
"""Side of a block [pixel], largest lag, distance from which a lag is far, deviation [sigma] of the
mean of far lags from which a difference is left out."""
SHARED = 1.5
"""On variances of means: neighbouring differences share a flat, their covariances correlate by 1/4."""
BEYOND = 1.3
"""Factor on levels up to which a fit is believed."""
BINS = np.geomspace(25.0, 2.6e4, 15)
"""Edges of the levels [ADU]."""

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Block:
    """Covariances of one block of one difference.

    Attributes
    ----------
    difference : int
        Which two flats: its first's place in the order of exposure times.
    place : int
        Which column of blocks.
    level : float
        [ADU]
    covariances, pairs : ndarray, shape (lags + 1, lags + 1)
        [ADU^2], and numbers of pairs of pixels.
    """

    difference: int
    place: int
    level: float
    covariances: Values
    pairs: Values


def measure_blocks(folder: Path) -> list[Block]:
    """Covariances of a run, block by block; differences with fixed pattern left out."""
    source = CampaignSource(read_campaign(folder))
    biases = [e for e in source.exposures if e.kind == "bias"]
    bias = np.mean([source.read(e)[0].image for e in biases], axis=0)
    flats = sorted(
        (e for e in source.exposures if e.kind == "flat"),
        key=lambda e: e.exposure_time or 0,
    )

    def image(n: int) -> Values:
        (frame,) = source.read(flats[n])
        clean = np.where(frame.mask, np.nan, frame.image - bias)
        return np.asarray(clean[RIM:-RIM, RIM:-RIM], float)

    out: list[Block] = []
    second = image(0)
    for n in range(len(flats) - 1):
        first, second = second, image(n + 1)
        ratio = np.nanmean(second) / np.nanmean(first)
        if not RATIO[0] <= ratio <= RATIO[1] or _rises(first, second):
            continue
        for y in range(0, first.shape[0] - BLOCK + 1, BLOCK):
            for x in range(0, first.shape[1] - BLOCK + 1, BLOCK):
                at = np.s_[y : y + BLOCK, x : x + BLOCK]
                try:
                    own = flat_covariances(first[at], second[at], lags=LAGS, unit="adu")
                except MeasurementError:
                    continue
                out.append(Block(n, x // BLOCK, own.level, own.covariances, own.pairs))
    return out


def _rises(first: Values, second: Values) -> bool:
    """Whether the far lags of a difference rise together, or it cannot be measured."""
    try:
        whole = flat_covariances(first, second, lags=LAGS, unit="adu")
    except MeasurementError:
        return True
    j, i = np.indices(whole.covariances.shape)
    far = (np.hypot(i, j) > FAR).ravel() / (np.hypot(i, j) > FAR).sum()
    error = np.sqrt(far @ whole.error_matrix() @ far)
    return bool(far @ whole.covariances.ravel() > RISE * error)


def tabulate(blocks: Sequence[Block], name: str) -> CovarianceTable:
    """Average blocks in bins of level, to a table in electrons with Bartlett's errors."""
    levels, values, matrices, counts, numbers = [], [], [], [], []
    for low, high in pairwise(BINS):
        own = [b for b in blocks if low <= b.level < high]
        if len(own) < 3:
            continue
        pairs = np.sum([b.pairs for b in own], axis=0)
        mean = np.sum([b.covariances * b.pairs for b in own], axis=0) / pairs
        levels.append(
            float(np.average([b.level for b in own], weights=[b.pairs[0, 0] for b in own]))
        )
        values.append(mean.ravel() * GAIN**2)
        matrices.append(SHARED * GAIN**4 * bartlett_matrix(mean, pairs))
        counts.append(pairs.ravel().astype(int))
        numbers.append(len({b.difference for b in own}))
    size = (LAGS + 1) ** 2
    j, i = (np.tile(a.ravel(), len(levels)) for a in np.indices((LAGS + 1, LAGS + 1)))
    matrix = block_diag(*matrices)
    return CovarianceTable(
        Path(name), np.full(size * len(levels), "all"), GAIN * np.repeat(levels, size), i, j,
        np.concatenate(values), np.sqrt(np.diag(matrix)), np.concatenate(counts),
        np.repeat(numbers, size), np.full(size * len(levels), np.nan),
        np.full(size * len(levels), np.nan), matrix,
    )  # fmt: skip


def diagnose_run(
    fitted: CovarianceTable, other: CovarianceTable, *, seed: int = 1
) -> Diagnosis:
    """Diagnose one run; the other is the fold that nothing is fitted or chosen by."""
    baseline = free_baseline()
    own, held = (measure_reduced(t, reach=baseline.reach) for t in (fitted, other))
    late = tuple(replace(c, fold="held-out") for c in held.channels)
    return diagnose_measured(
        replace(own, channels=(*own.channels, *late)), baseline, seed=seed
    )


@dataclass(frozen=True)
class Carried:
    """What a diagnosis of one run does to the lag (1, 0) of the other.

    Attributes
    ----------
    fitted, other : str
        The runs.
    levels, correlations, errors : ndarray, shape (n,)
        Of the other [e-], and C_10 / C_00 there.
    before, after : ndarray, shape (n,)
        Correlations that the baseline and the accepted model, both fitted to the first run alone,
        predict; over the measured C_00.
    """

    fitted: str
    other: str
    levels: Values
    correlations: Values
    errors: Values
    before: Values
    after: Values

    def chi2(self, which: str) -> float:
        """Chi-square of 'before' or 'after'."""
        off = (self.correlations - getattr(self, which)) / self.errors
        return float(off @ off)

    @property
    def removed(self) -> float:
        """Part of what the chi-square has above the number of values that goes away."""
        excess = self.chi2("before") - len(self.levels)
        return (self.chi2("before") - self.chi2("after")) / excess


def carry(found: Diagnosis, other: CovarianceTable, names: tuple[str, str]) -> Carried:
    """Predict the lag (1, 0) of the other run by baseline and by what was accepted.

    At the levels between the fitted run's (:data:`BEYOND` more): a law in powers of the level
    says nothing outside.
    """
    held = measure_reduced(other, reach=LAGS)
    (channel,) = held.channels
    predictor, fit = found.accepted
    if found.predictor is None or predictor is None:
        raise MeasurementError("a diagnosis without predictions")
    own = found.fit.channels[0].axes["level"]
    level = channel.axes["level"]
    inside = (level > own.min() / BEYOND) & (level < own.max() * BEYOND)
    serial = inside & (channel.axes["i"] == 1) & (channel.axes["j"] == 0)
    variance = channel.values[inside & (channel.axes["i"] == 0) & (channel.axes["j"] == 0)]
    before, after = (
        predicted(model, channel)[serial] / variance
        for model in (Model(found.predictor, found.fit), Model(predictor, fit))
    )
    return Carried(
        *names, channel.axes["level"][serial], channel.values[serial] / variance,
        channel.errors[serial] / variance, before, after,
    )  # fmt: skip


def predicted(model: Model, channel: Channel) -> Values:
    """What a fitted model predicts for any channel, free-form columns included."""
    values = dict(zip(model.fit.names, model.fit.values, strict=True))
    out = model.predictor.predict(channel, model.fit.values[: len(model.predictor.names)])
    for name, column in model.predictor.linear(channel).items():
        out = out + values.get(name, 0.0) * column
    return np.asarray(out)


def carry_with_range(
    blocks: Mapping[str, Sequence[Block]], fitted: str, other: str
) -> tuple[Diagnosis, Carried, Values]:
    """Diagnose one run and predict the other; then again without each of the fitted run's flats.

    Returns
    -------
    found : Diagnosis
        Of the whole run.
    carried : Carried
        To the other.
    without : ndarray
        Part removed when the diagnosis is made anew without a flat, a value for each: where only
        one flat covers a range of levels the law hangs on it, and no standard deviation tells.
    """
    tables = {n: tabulate(blocks[n], n) for n in (fitted, other)}
    found = diagnose_run(tables[fitted], tables[other])
    carried = carry(found, tables[other], (fitted, other))
    without = []
    numbers = {b.difference for b in blocks[fitted]}
    for flat in sorted(numbers):
        kept = [b for b in blocks[fitted] if b.difference not in (flat - 1, flat)]
        told = diagnose_run(tabulate(kept, fitted), tables[other])
        without.append(carry(told, tables[other], (fitted, other)).removed)
    return found, carried, np.array(without)
