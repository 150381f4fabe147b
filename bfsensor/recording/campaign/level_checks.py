"""Checks of levels against one another, the clock, the lamp and the header's gain."""

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
"""Header's gain over mean / variance that passes: beyond is another amplifier's, or 2."""

COLLAPSE = 0.9
"""A variance below this part of that of a lower level is saturated: the brighter-fatter
effect slows its rise, it never turns it."""

STEP, OUTLIER = 0.02, 0.2
"""Relative steps and outliers of the flats' rate that are named."""

MISMATCH = 0.02
"""Relative difference of the two levels of a pair above which it is named."""

WINDOW = 5
"""Exposures on each side of a step."""


def check_saturation(
    campaign: Campaign, frames: Sequence[FrameStatistics], pairs: Sequence[PairStatistics]
) -> list[Caution]:
    """Name pairs whose variance falls, and frames with many pixels at one highest value."""
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
                "means and variances of what is left are biased",
                tuple(full),
            )
        )
    if heaped:
        found.append(
            Caution(
                "saturation",
                f"pixels heap up at one highest value in {len(heaped)} flats "
                f"({named(flats[n] for n in heaped)}): the converter's end? say so: "
                "keywords: {saturation: {value: ADU}}",
                "saturated pixels are not masked",
                tuple(heaped),
            )
        )
    return found


def _check_collapse(campaign: Campaign, pairs: Sequence[PairStatistics]) -> list[Caution]:
    """Name the pairs of each amplifier whose variance is below that of lower levels."""
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
                f"from {lowest.level:.0f} ADU on: saturated",
                "leave them out of covariances; they give the full well",
                tuple(n for p in wrong for n in (p.first, p.second)),
            )
        )
    return found


def check_gain(
    campaign: Campaign, frames: Sequence[FrameStatistics], pairs: Sequence[PairStatistics]
) -> list[Caution]:
    """Hold the header's gains against mean over variance of the flat pairs."""
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
                    f"{layout.name}: no gain; mean over variance of the pairs says "
                    f"{gain:.3g} e-/ADU",
                    "a white excess of variance cannot be told from it without Fe55",
                )
            )
        elif not GAIN_RANGE[0] <= layout.gain / gain <= GAIN_RANGE[1]:
            found.append(
                Caution(
                    "gain",
                    f"{layout.name}: the gain is {layout.gain:.3g} e-/ADU by header or "
                    f"campaign.yaml, {gain:.3g} by mean over variance of the pairs (ratio "
                    f"{layout.gain / gain:.2f})",
                    "everything per electron is wrong by that ratio",
                )
            )
    return found


def measure_gains(
    frames: Sequence[FrameStatistics], pairs: Sequence[PairStatistics]
) -> dict[str, float]:
    """Estimate gains by mean over variance, extrapolated to low levels [e-/ADU].

    A check, not a measurement: good to a few percent.
    """
    gains = {}
    for name in dict.fromkeys(p.amplifier for p in pairs):
        noise = [f.noise for f in frames if f.amplifier == name and np.isfinite(f.noise)]
        white = float(np.median(noise)) ** 2 if noise else 0.0
        mine = [p for p in pairs if p.amplifier == name and p.pixels and p.level > 0]
        # The pattern of unequal flats stays in their difference.
        mine = [p for p in mine if p.variance > 4 * white and abs(p.mismatch) <= MISMATCH]
        if not mine:
            continue
        # Above half of the largest variance the brighter-fatter effect bends the curve, and
        # saturation turns it.
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
    """Name biases with light, and flats that stand out of those like them."""
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
                f"biases whose level stands out: {named(by_number[n] for n in sorted(lit))}",
                "light or another kind of exposure under a wrong name",
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
                exposures=tuple(out),
            )
        )
    return found


def check_level_steps(
    campaign: Campaign, frames: Sequence[FrameStatistics]
) -> list[Caution]:
    """Find a step in time of the flats' rate: a lamp or a gain that jumped."""
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
            "gain and lamp jumped there: fit the parts apart",
            (rates[at][0],),
        )
    ]


def check_pedestals(campaign: Campaign, frames: Sequence[FrameStatistics]) -> list[Caution]:
    """Find a step in time of the pedestals."""
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
                    "biases taken before do not hold after it",
                    (mine[at].exposure,),
                )
            )
    return found


def _rates(
    campaign: Campaign, frames: Sequence[FrameStatistics]
) -> list[tuple[int, float]]:
    """Levels by the lamp's light over the median of flats like them, in the order of time.

    Only flats of the same settings and exposure time are compared: no nonlinearity enters.
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
        # A window that has a part of the other side gives the same step, with more scatter.
        score = abs(step) - 2 * float(np.mean(np.abs(both)))
        if score > most:
            best, most = (k, step, 1.4826 * float(np.median(np.abs(both)))), score
    return best


def _conditions(campaign: Campaign) -> dict[int, int]:
    """Give the number of the condition of each flat."""
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
