"""Checks of flats' and biases' levels: saturation, gains, outliers and steps in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bfsensor.recording.campaign.campaign import Campaign
from bfsensor.recording.campaign.exposures import Caution, count_of, named
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.recording.campaign.frame_statistics import FrameStatistics, PairStatistics

GAIN_RANGE = (0.8, 1.25)
"""Smallest and largest ratio of the header's gain to mean over variance that passes.

Chosen: far above the few percent that :func:`measure_gains` is uncertain by, and below the factor
of 2 that variances of differences, not halved, make.  If the range were twice as wide, 0.64 to 1.56, a
gain wrong by 1.5, such as another amplifier's, would not be reported.
"""

COLLAPSE = 0.9
"""Largest ratio of a pair's variance to that of a lower level at which it counts as saturated.

The brighter-fatter effect slows the rise of the variance with the level and does not turn it; full
wells and the converter's end do.  Chosen: at 0.8, twice the margin, pairs whose variance fell by
10 to 20 % would pass as sound.  The fall must also be 5 times its statistical error.
"""

STEP, OUTLIER = 0.02, 0.2
"""Relative step in time of the flats' rate, and relative deviation of one flat, that are reported.

Chosen: a step twice as large would let a lamp or gain that changed by 3 % pass, and an outlier twice
as large a flat that is 30 % too dim.  A step must also be 6 times the scatter beside it.
"""

MISMATCH = 0.02
"""Relative difference of the two levels of a pair above which it is reported.

A difference of m at the level L [ADU] leaves (m L p)^2 / 2 of a fixed pattern of the relative rms p in
the pair's variance.  Chosen: at twice the value 4 times as much may remain unreported.
"""

WINDOW = 5
"""Number of exposures on each side of a step whose medians are compared.

Chosen: with twice as many, steps among the first or last 9 exposures, and all steps in fewer than
20, would be missed; the scatter of the medians would be smaller by sqrt(2).
"""


def check_saturation(
    campaign: Campaign, frames: Sequence[FrameStatistics], pairs: Sequence[PairStatistics]
) -> list[Caution]:
    """Report pairs whose variance falls with the level, and flats with many saturated pixels."""
    flats = {one.number: one for one in campaign.of("flat")}
    lit = [f for f in frames if f.exposure in flats]
    full = sorted({f.exposure for f in lit if f.saturated > 0.01})
    heaped = sorted({f.exposure for f in lit if f.top > 0.01 and f.saturated < f.top / 2})
    found = _check_collapse(campaign, pairs)
    if full:
        found.append(
            Caution(
                "saturation",
                f"more than 1 % of the pixels are saturated in {len(full)} flats "
                f"({named(flats[n] for n in full)}); they are masked",
                "mean and variance of the other pixels are biased; leave these flats out in "
                "campaign.yaml: excluded: [FILE, ...]",
                tuple(full),
            )
        )
    if heaped:
        found.append(
            Caution(
                "saturation",
                f"more than 1 % of the pixels have the image's highest value in {len(heaped)} "
                f"flats ({named(flats[n] for n in heaped)}), as at the end of a converter's range",
                "saturated pixels are not masked; state that value [ADU] in campaign.yaml: "
                "keywords: {saturation: {value: ...}}",
                tuple(heaped),
            )
        )
    return found


def _check_collapse(campaign: Campaign, pairs: Sequence[PairStatistics]) -> list[Caution]:
    """Report the pairs of each amplifier whose variance is below that of lower levels."""
    collapsed: dict[str, list[PairStatistics]] = {}
    for mine in _by_amplifier(pairs, _conditions(campaign)):
        rising = sorted((p for p in mine if p.pixels), key=lambda p: p.level)
        most, error = 0.0, 0.0
        for pair in rising:
            sigma = pair.variance * np.sqrt(2.0 / pair.pixels)
            if pair.variance < COLLAPSE * most and most - pair.variance > 5 * np.hypot(
                sigma, error
            ):
                collapsed.setdefault(pair.amplifier, []).append(pair)
            elif pair.variance > most:
                most, error = pair.variance, sigma
    found = []
    for name, wrong in collapsed.items():
        lowest = min(wrong, key=lambda p: p.level)
        found.append(
            Caution(
                "saturation",
                f"{name}: the variance of {count_of(len(wrong), 'pair')} is below that of lower levels, "
                f"from {lowest.level:.0f} ADU on: the full well or the converter's end is reached",
                "their covariances do not measure the brighter-fatter effect; leave these flats "
                "out in campaign.yaml: excluded: [FILE, ...]",
                tuple(n for p in wrong for n in (p.first, p.second)),
            )
        )
    return found


def check_gain(
    campaign: Campaign, frames: Sequence[FrameStatistics], pairs: Sequence[PairStatistics]
) -> list[Caution]:
    """Compare the header's gains with mean over variance of the flat pairs."""
    found = []
    measured = measure_gains(frames, pairs)
    for layout in campaign.amplifiers:
        gain = measured.get(layout.name)
        if gain is None:
            continue
        if layout.gain is None:
            found.append(
                Caution(
                    "gain",
                    f"{layout.name}: no gain in header or campaign.yaml; mean over variance of the "
                    f"pairs gives {gain:.3g} e-/ADU",
                    "a white excess of variance cannot be separated from the gain without Fe55; "
                    f"to use this one, campaign.yaml: keywords: {{gain: {{value: {gain:.3g}}}}}",
                )
            )
        elif not GAIN_RANGE[0] <= layout.gain / gain <= GAIN_RANGE[1]:
            found.append(
                Caution(
                    "gain",
                    f"{layout.name}: the gain is {layout.gain:.3g} e-/ADU by header or "
                    f"campaign.yaml, {gain:.3g} by mean over variance of the pairs (ratio "
                    f"{layout.gain / gain:.2f})",
                    "results per electron are wrong by that ratio if the pairs are right; then "
                    f"state the gain in campaign.yaml: keywords: {{gain: {{value: {gain:.3g}}}}}, "
                    "or one for each of amplifiers",
                )
            )
    return found


def measure_gains(
    frames: Sequence[FrameStatistics], pairs: Sequence[PairStatistics]
) -> dict[str, float]:
    """Estimate gains by mean over variance, extrapolated to low levels [e-/ADU].

    The estimate serves to check headers; it is good to a few percent.
    """
    gains = {}
    for name in dict.fromkeys(p.amplifier for p in pairs):
        noise = [f.noise for f in frames if f.amplifier == name and np.isfinite(f.noise)]
        white = float(np.median(noise)) ** 2 if noise else 0.0
        mine = [p for p in pairs if p.amplifier == name and p.pixels and p.level > 0]
        # The fixed pattern stays in the difference of unequal flats.  At low levels an error of
        # the read noise would enter the gain: shot noise must be 3 times as large.
        mine = [p for p in mine if p.variance > 4 * white and abs(p.mismatch) <= MISMATCH]
        if not mine:
            continue
        # The brighter-fatter effect lowers variance over mean in proportion to the level, to first
        # order: its value at level 0 is 1 / gain.  Higher orders, and the turnover at saturation,
        # are kept out by a limit of 0.6 of the level at which the variance is largest.
        most = max(p.variance for p in mine)
        level_of_most = max(p.level for p in mine if p.variance >= 0.99 * most)
        low = [p for p in mine if p.level <= 0.6 * level_of_most] or mine
        level = np.array([p.level for p in low])
        ratio = (np.array([p.variance for p in low]) - white) / level
        weight = np.sqrt([p.pixels for p in low])
        degree = 1 if len(set(np.round(level, -1))) > 2 else 0
        slope = float(np.polyfit(level, ratio, degree, w=weight)[-1])
        if slope > 0:
            gains[name] = 1 / slope
    return gains


def check_levels(campaign: Campaign, frames: Sequence[FrameStatistics]) -> list[Caution]:
    """Report biases and flats whose level differs from those of the same settings."""
    found = []
    by_number = {one.number: one for one in campaign.exposures}
    biases = {one.number for one in campaign.of("bias")}
    lit = set()
    for name in dict.fromkeys(f.amplifier for f in frames):
        mine = [f for f in frames if f.amplifier == name and f.exposure in biases]
        if len(mine) < 3:
            continue
        level = np.array([f.level for f in mine])
        noise = np.nanmedian([f.noise for f in mine]) if mine[0].noise > 0 else 10.0
        off = np.abs(level - np.median(level)) > 10 * max(noise, 1.0)
        lit |= {f.exposure for f, bad in zip(mine, off, strict=True) if bad}
    if lit:
        found.append(
            Caution(
                "levels",
                "biases whose level differs from the others' by more than 10 times the noise: "
                f"{named(by_number[n] for n in sorted(lit))}",
                "they saw light, or are exposures of another kind; leave them out in "
                "campaign.yaml: excluded: [FILE, ...]",
                tuple(sorted(lit)),
            )
        )
    out = sorted({n for n, r in _rates(campaign, frames) if abs(r - 1) > OUTLIER})
    if out:
        found.append(
            Caution(
                "levels",
                f"the level of {len(out)} flats is off by more than {OUTLIER:.0%} from others "
                f"of the same exposure time and settings ({named(by_number[n] for n in out)})",
                "lamp, shutter or header is wrong there; leave them out in campaign.yaml: "
                "excluded: [FILE, ...]",
                tuple(out),
            )
        )
    return found


def check_level_steps(
    campaign: Campaign, frames: Sequence[FrameStatistics]
) -> list[Caution]:
    """Report a step in time of the flats' level over exposure time, and over the lamp."""
    rates = [(n, r) for n, r in _rates(campaign, frames) if abs(r - 1) <= OUTLIER]
    at, step, scatter = _largest_step(np.array([r for _, r in rates]))
    if abs(step) < STEP or abs(step) < 6 * scatter:
        return []
    by_number = {one.number: one for one in campaign.exposures}
    lamp = "over the lamp monitor's reading " if _has_lamp(campaign) else ""
    return [
        Caution(
            "levels",
            f"the flats' rate {lamp}steps by {step:+.1%} at "
            f"{by_number[rates[at][0]].path.name}",
            "lamp or gain changed there; analyse the exposures before and after it as two campaigns",
            (rates[at][0],),
        )
    ]


def check_pedestals(campaign: Campaign, frames: Sequence[FrameStatistics]) -> list[Caution]:
    """Report a step in time of the overscan's level."""
    found = []
    by_number = {one.number: one for one in campaign.exposures}
    for name in dict.fromkeys(f.amplifier for f in frames):
        mine = [f for f in frames if f.amplifier == name and np.isfinite(f.noise)]
        if not mine:
            continue
        noise = float(np.median([f.noise for f in mine]))
        at, step, scatter = _largest_step(np.array([f.pedestal for f in mine]))
        if abs(step) > max(3 * noise, 6 * scatter, 3.0):
            found.append(
                Caution(
                    "pedestal",
                    f"{name}: the overscan steps by {step:+.1f} ADU at "
                    f"{by_number[mine[at].exposure].path.name} (noise {noise:.1f} ADU)",
                    "bias frames from before the step do not give the zero level after it",
                    (mine[at].exposure,),
                )
            )
    return found


def _rates(
    campaign: Campaign, frames: Sequence[FrameStatistics]
) -> list[tuple[int, float]]:
    """Level over lamp reading of each flat, over the median of its group, in the order of time.

    A group has the same settings and exposure time, so that nonlinearity does not enter.
    """
    level: dict[int, list[float]] = {}
    for f in frames:
        if np.isfinite(f.pedestal):
            level.setdefault(f.exposure, []).append(f.level)
    with_lamp = _has_lamp(campaign)
    out: dict[int, float] = {}
    for members in campaign.conditions("flat").values():
        groups: dict[float, list[tuple[int, float]]] = {}
        for one in members:
            if one.exposure_time is None or one.number not in level:
                continue
            light = one.lamp if with_lamp and one.lamp else 1.0
            value = float(np.mean(level[one.number])) / light
            groups.setdefault(round(one.exposure_time, 3), []).append((one.number, value))
        for group in groups.values():
            middle = float(np.median([value for _, value in group]))
            if len(group) > 1 and middle > 0:
                out.update({number: value / middle for number, value in group})
    return [
        (one.number, out[one.number]) for one in campaign.exposures if one.number in out
    ]


def _has_lamp(campaign: Campaign) -> bool:
    return all(one.lamp is not None and one.lamp > 0 for one in campaign.of("flat"))


def _largest_step(values: FloatArray) -> tuple[int, float, float]:
    """Index, size and scatter of the largest step between medians of neighbours in time."""
    if len(values) < 2 * WINDOW:
        return 0, 0.0, 0.0
    best, most = (0, 0.0, 0.0), 0.0
    for k in range(WINDOW, len(values) - WINDOW + 1):
        before, after = values[k - WINDOW : k], values[k : k + WINDOW]
        step = float(np.median(after) - np.median(before))
        both = np.concatenate([before - np.median(before), after - np.median(after)])
        # Medians of a window that is off by an exposure give the same step, with more scatter.
        score = abs(step) - 2 * float(np.mean(np.abs(both)))
        if score > most:
            best, most = (k, step, 1.4826 * float(np.median(np.abs(both)))), score
    return best


def _conditions(campaign: Campaign) -> dict[int, int]:
    """Index of the condition of each flat, by the flat's number."""
    return {
        one.number: k
        for k, members in enumerate(campaign.conditions("flat").values())
        for one in members
    }


def _by_amplifier(
    pairs: Sequence[PairStatistics], same: dict[int, int]
) -> list[list[PairStatistics]]:
    """Group pairs by amplifier and condition."""
    groups: dict[tuple[str, int], list[PairStatistics]] = {}
    for pair in pairs:
        groups.setdefault((pair.amplifier, same.get(pair.first, -1)), []).append(pair)
    return list(groups.values())
