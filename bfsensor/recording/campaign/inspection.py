"""Checks of a campaign's pixels: levels, variances and gains, one exposure in memory at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError
from bfsensor.recording.campaign.amplifiers import AmplifierFrame, read_exposure
from bfsensor.recording.campaign.campaign import Campaign
from bfsensor.recording.campaign.exposures import (
    Caution,
    Exposure,
    Progress,
    count_of,
    named,
)
from bfsensor.recording.campaign.frame_statistics import FrameStatistics, PairStatistics
from bfsensor.recording.campaign.level_checks import (
    MISMATCH,
    check_gain,
    check_level_steps,
    check_levels,
    check_pedestals,
    check_saturation,
)
from bfsensor.recording.raw.overscan import MAD_TO_SIGMA, find_overscan, mean_and_scatter

BOX = 256
"""Side of the box in the middle of each amplifier in which levels and variances are taken [pixel].

Chosen: the variance of a pair then has a relative error of sqrt(2) / 256 = 0.6 %.  Twice the side
halves it, for 4 times the memory of flats that wait for their partners.
"""

MOST_NAN = 0.1
"""Largest fraction of an amplifier's image that may be not finite; beyond, an exposure is set aside.

Chosen: a few bad columns pass, a file with missing parts does not.  At twice the value an exposure
of which 15 % are missing would be used.
"""


@dataclass(frozen=True)
class Inspection:
    """A campaign with the statistics of its pixels.

    Attributes
    ----------
    campaign : Campaign
        Campaign with further warnings; exposures whose pixels cannot be used are set aside.
    frames : tuple of FrameStatistics
        Statistics of each exposure and amplifier.
    pairs : tuple of PairStatistics
        Statistics of each pair of flats and amplifier.

    Examples
    --------
    :func:`inspect_campaign` makes one; its example shows the statistics of a pair.
    """

    campaign: Campaign
    frames: tuple[FrameStatistics, ...]
    pairs: tuple[PairStatistics, ...]

    def levels(self, exposure: int) -> dict[str, float]:
        """Give the level of each amplifier in an exposure.

        Parameters
        ----------
        exposure : int
            Number of the exposure.

        Returns
        -------
        levels : dict of str to float
            Level above the pedestal by amplifier [ADU]; empty for an exposure that is not used.
        """
        return {f.amplifier: f.level for f in self.frames if f.exposure == exposure}


def inspect_campaign(campaign: Campaign, *, progress: Progress | None = None) -> Inspection:
    """Read every exposure once, and compare levels, variances and gains.

    Parameters
    ----------
    campaign : Campaign
        Campaign as :func:`bfsensor.recording.read_campaign` reads it.
    progress : callable, optional
        Function that is called with the number of exposures done and the number of all.

    Returns
    -------
    inspection : Inspection
        Exposures whose pixels cannot be read, or of which more than a tenth are not finite, are
        set aside in its campaign.  Its campaign's warnings report saturated pairs, gains of
        headers that mean over variance contradicts by more than 20 %, outliers and steps of
        levels, steps of pedestals, and unequal pairs; these exposures stay.

    Notes
    -----
    Memory holds one exposure, and the boxes of flats that wait for their partners.

    Examples
    --------
    >>> import tempfile
    >>> from astropy.io import fits
    >>> from bfsensor.recording import read_campaign
    >>> rng = np.random.default_rng(8231)
    >>> header = fits.Header({"IMGTYPE": "FLAT", "EXPTIME": 2.0, "CCDGAIN": 1.0})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for n in range(2):
    ...         data = rng.poisson(9000, (64, 64)).astype(np.uint16)
    ...         fits.PrimaryHDU(data, header).writeto(f"{folder}/{n}.fits")
    ...     found = inspect_campaign(read_campaign(folder))
    >>> (pair,) = found.pairs
    >>> abs(pair.level - 9000) < 10, abs(pair.variance / pair.level - 1) < 0.1
    (True, True)
    """
    frames: list[FrameStatistics] = []
    pairs: list[PairStatistics] = []
    waiting: dict[int, tuple[Exposure, dict[str, NDArray[np.float32]]]] = {}
    found = campaign
    holed: list[Exposure] = []
    for k, one in enumerate(campaign.exposures):
        if progress is not None:
            progress(k, len(campaign.exposures))
        try:
            read = read_exposure(campaign, one)
        except RecordingError as error:
            found = found.without(one, str(error).removeprefix(f"{one.path}: "))
            continue
        mine = [_statistics(frame) for frame in read]
        worst = max(mine, key=lambda f: f.not_finite)
        if worst.not_finite > MOST_NAN:
            found = found.without(
                one,
                f"{worst.not_finite:.0%} of the pixels of {worst.amplifier} are not finite",
            )
            continue
        if worst.not_finite:
            holed.append(one)
        frames += mine
        if one.kind == "flat" and one.pair is not None:
            boxes = {frame.name: _box(frame) for frame in read}
            if one.pair in waiting:
                partner, others = waiting.pop(one.pair)
                pairs += [_compare(partner, one, n, others[n], boxes[n]) for n in boxes]
            else:
                waiting[one.pair] = (one, boxes)
        del read
    if progress is not None:
        progress(len(campaign.exposures), len(campaign.exposures))
    frames = _above_biases(found, frames)
    pairs = _with_levels(pairs, frames)
    cautions = []
    if holed:
        cautions.append(
            Caution(
                "pixels",
                f"pixels that are not finite in {named(holed)}",
                "they are masked",
                tuple(one.number for one in holed),
            )
        )
    cautions += check_mismatch(found, pairs)
    cautions += check_saturation(found, frames, pairs)
    cautions += check_gain(found, frames, pairs)
    cautions += check_levels(found, frames)
    cautions += check_level_steps(found, frames)
    cautions += check_pedestals(found, frames)
    return Inspection(found.with_warnings(*cautions), tuple(frames), tuple(pairs))


def check_mismatch(campaign: Campaign, pairs: Sequence[PairStatistics]) -> list[Caution]:
    """Report the pairs whose two levels differ, so that their fixed pattern does not cancel."""
    wrong = sorted({(p.first, p.second) for p in pairs if abs(p.mismatch) > MISMATCH})
    if not wrong:
        return []
    most = max(abs(p.mismatch) for p in pairs)
    first = [one for one in campaign.exposures if one.number in {a for a, _ in wrong}]
    return [
        Caution(
            "pairs",
            f"{count_of(len(wrong), 'pair')} of unequal levels, by up to {most:.1%} ({named(first)})",
            "fixed pattern stays in their differences and raises their variance; a stable lamp, or "
            "pairs of equal levels by a column pair in manifest.ecsv, avoid that",
            tuple(n for pair in wrong for n in pair),
        )
    ]


def _statistics(frame: AmplifierFrame) -> FrameStatistics:
    """Level, pedestal and fractions of bad pixels of one amplifier."""
    image = frame.image
    finite = np.isfinite(image)
    share = 1.0 - float(np.count_nonzero(finite)) / image.size
    top = float(np.max(image, where=finite, initial=-np.inf))
    place = find_overscan(frame.layout)
    over = frame.pixels[:0] if place is None else frame.pixels[place]
    over = over[np.isfinite(over)] if over.shape[1] > 2 else over[:0]
    pedestal, noise = mean_and_scatter(over)
    box = _box(frame)
    raw, _ = mean_and_scatter(box[np.isfinite(box)])
    return FrameStatistics(
        exposure=frame.exposure,
        amplifier=frame.name,
        level=raw if np.isnan(pedestal) else raw - pedestal,
        pedestal=pedestal,
        noise=noise,
        not_finite=share,
        saturated=float(np.count_nonzero(image >= frame.saturation)) / image.size,
        top=float(np.count_nonzero(image == top)) / image.size,
    )


def _box(frame: AmplifierFrame) -> NDArray[np.float32]:
    """Middle of an image, copied; masked pixels are nan, saturated ones stay.

    Saturated pixels must stay: the collapse of their variance is what shows saturation.
    """
    ny, nx = frame.image.shape
    y, x = max((ny - BOX) // 2, 0), max((nx - BOX) // 2, 0)
    place = np.s_[y : y + BOX, x : x + BOX]
    box = frame.image[place].copy()
    box[frame.mask[place] & (box < frame.saturation)] = np.nan
    return box


def _compare(
    first: Exposure, second: Exposure, amplifier: str, one: NDArray[np.float32],
    other: NDArray[np.float32],
) -> PairStatistics:  # fmt: skip
    """Variance of a pair; :func:`_with_levels` fills in its level, which needs the pedestals."""
    difference = (one - other).astype(np.float64)
    difference = difference[np.isfinite(difference)]
    if difference.size < 100:
        return PairStatistics(
            first.number, second.number, amplifier, np.nan, np.nan, 0, 0.0
        )
    middle = np.median(difference)
    sigma = MAD_TO_SIGMA * np.median(np.abs(difference - middle))
    # Differences that are mostly equal (saturated flats) have a MAD of 0: no cut then.
    kept = difference[np.abs(difference - middle) <= 5 * sigma] if sigma else difference
    return PairStatistics(
        first.number,
        second.number,
        amplifier,
        np.nan,
        float(kept.var() / 2),
        kept.size,
        0.0,
    )


def _above_biases(
    campaign: Campaign, frames: Sequence[FrameStatistics]
) -> list[FrameStatistics]:
    """Subtract the median level of the biases from levels without overscan."""
    biases = {one.number for one in campaign.of("bias")}
    out = []
    for name in dict.fromkeys(f.amplifier for f in frames):
        raw = [f for f in frames if f.amplifier == name and np.isnan(f.pedestal)]
        levels = [f.level for f in raw if f.exposure in biases]
        if not levels:
            continue
        pedestal = float(np.median(levels))
        out += [replace(f, level=f.level - pedestal, pedestal=pedestal) for f in raw]
    done = {(f.exposure, f.amplifier): f for f in out}
    return [done.get((f.exposure, f.amplifier), f) for f in frames]


def _with_levels(
    pairs: Sequence[PairStatistics], frames: Sequence[FrameStatistics]
) -> list[PairStatistics]:
    """Fill in the level of each pair and the difference of its two."""
    level = {(f.exposure, f.amplifier): f.level for f in frames}
    out = []
    for pair in pairs:
        a, b = level[pair.first, pair.amplifier], level[pair.second, pair.amplifier]
        mean = (a + b) / 2
        off = (b - a) / mean if mean > 0 else 0.0
        # Levels of dim flats differ by errors of the pedestals, not by light: 5 ADU are allowed.
        off = off if abs(b - a) > 5.0 else 0.0
        out.append(replace(pair, level=mean, mismatch=off))
    return out
