"""Pairing of flats: successive equal exposures of equal levels; comparison of those without a pair."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.exposure_info import ExposureInfo, Frame, condition_of
from bfsensor.errors import MeasurementError
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.recording.campaign.exposures import PAIR_TOLERANCE
from bfsensor.typing import FloatArray

Flat = tuple[ExposureInfo, Sequence[Frame]]
"""A flat with the frames of all amplifiers."""

FAR = 2.5
"""Distance of lags [pixel] beyond which the brighter-fatter effect is negligible for this
comparison.  Measured (validation/results/real_lags.ecsv): a_ij there are below 1.3e-8 per
electron in both LSST sensors, so that correlations are below 1.3e-3 at 1e5 e-."""

RATIO = (0.45, 2.2)
"""Range of the ratio of two levels within which flats of unlike exposure are compared.  Chosen: it
holds neighbours in a series of levels by factors of two; with a factor of 4.4 the fainter flat's
noise dominates, and the pattern is seen less."""

RISE = 5.0
"""Significance [sigma] of the mean correlation of the far lags above which a fixed pattern
counts as seen.  Chosen: noise reaches 5 in 3e-7 of pairs; with 10, patterns must be twice as
strong to be seen."""


@dataclass(frozen=True)
class UnlikePair:
    """Correlations in the difference of two flats of unlike exposure: reported, never fitted.

    Attributes
    ----------
    first, second : int
        Numbers of the exposures.
    level : float
        Effective level of the scaled difference, to which a linear covariance belongs [ADU].
    ratio : float
        Level of the second over that of the first.
    serial, parallel, near_error : float
        Correlations at the lags (1, 0) and (0, 1), and the error of either.
    far, far_error : float
        Mean correlation of the lags beyond :data:`FAR`, and its error.
    """

    first: int
    second: int
    level: float
    ratio: float
    serial: float
    parallel: float
    near_error: float
    far: float
    far_error: float

    @property
    def rises(self) -> bool:
        """Whether the far lags are significantly positive, as a fixed pattern makes them."""
        return self.far > RISE * self.far_error


def group_flats(flats: Sequence[ExposureInfo]) -> list[list[ExposureInfo]]:
    """Group flats that may make pairs, in order of time.

    By the numbers of pairs in their headers if any flat has one (each flat without is a group of
    its own); otherwise successive flats of one condition and of equal light.
    """
    groups: list[list[ExposureInfo]] = []
    if any(flat.pair is not None for flat in flats):
        by_number: dict[int, list[ExposureInfo]] = {}
        for flat in flats:
            # Negative, so that they are no pair's number.
            key = -1 - flat.number if flat.pair is None else flat.pair
            by_number.setdefault(key, []).append(flat)
        return list(by_number.values())
    light = light_of(flats)
    for flat in flats:
        first = groups[-1][0] if groups else flat
        alike = _is_alike(light[first.number], light[flat.number])
        if groups and alike and condition_of(first) == condition_of(flat):
            groups[-1].append(flat)
        else:
            groups.append([flat])
    return groups


def light_of(flats: Sequence[ExposureInfo]) -> dict[int, float]:
    """Light of flats by number, in units of one second: exposure time times lamp, if all have one."""
    lamps = [flat.lamp for flat in flats]
    known = bool(lamps) and all(lamps)
    usual = float(np.median(np.array(lamps, float))) if known else 1.0
    return {
        flat.number: (flat.exposure_time or 0.0)
        * ((flat.lamp or 0.0) / usual if known else 1.0)
        for flat in flats
    }


def _is_alike(one: float, other: float) -> bool:
    return abs(one - other) <= PAIR_TOLERANCE * max(one, other)


def find_steps(flats: Sequence[ExposureInfo]) -> dict[int, float]:
    """Find the level of a ladder that each flat belongs to.

    Flats of one condition whose light differs by less than :data:`PAIR_TOLERANCE` are of one
    level, although their exposure times may differ.

    Parameters
    ----------
    flats : sequence of ExposureInfo
        All flats.

    Returns
    -------
    steps : dict of int to float
        Median exposure time of its level [s] by the number of the flat; where two levels of one
        condition would share it, as after a change of the lamp, the median light [s at the median
        lamp].
    """
    light = light_of(flats)
    conditions: dict[Condition, list[ExposureInfo]] = {}
    for flat in flats:
        conditions.setdefault(condition_of(flat), []).append(flat)
    steps: dict[int, float] = {}
    for members in conditions.values():
        levels: list[list[ExposureInfo]] = []
        for flat in sorted(members, key=lambda f: light[f.number]):
            if levels and _is_alike(light[levels[-1][0].number], light[flat.number]):
                levels[-1].append(flat)
            else:
                levels.append([flat])
        taken: set[float] = set()
        for level in levels:
            step = float(np.median([f.exposure_time or 0.0 for f in level]))
            if step in taken:
                step = float(np.median([light[f.number] for f in level]))
            taken.add(step)
            steps |= dict.fromkeys((f.number for f in level), step)
    return steps


def by_level(
    groups: Sequence[Sequence[ExposureInfo]], steps: Mapping[int, float]
) -> list[list[Sequence[ExposureInfo]]]:
    """Collect the groups of each condition and level; groups of one flat are left out."""
    levels: dict[tuple, list[Sequence[ExposureInfo]]] = {}
    for group in groups:
        if len(group) > 1:
            key = condition_of(group[0]), steps[group[0].number]
            levels.setdefault(key, []).append(group)
    return list(levels.values())


class PairFinder:
    """Reads flats of equal light, two in memory at a time, and yields pairs of equal level.

    Parameters
    ----------
    read : callable
        Returns the frames of an exposure.
    level : callable
        Returns the mean level of frames [ADU].

    Attributes
    ----------
    single : list of ExposureInfo
        Exposures that were read and found no partner.
    notes : list of str
        A sentence for each two successive flats of equal exposure and unequal level.
    """

    def __init__(
        self,
        read: Callable[[ExposureInfo], Sequence[Frame]],
        level: Callable[[Sequence[Frame]], float],
    ) -> None:
        self._read, self._level = read, level
        self.single: list[ExposureInfo] = []
        self.notes: list[str] = []

    def pairs(
        self, groups: Iterable[Sequence[ExposureInfo]]
    ) -> Iterator[tuple[Flat, Flat]]:
        """Yield pairs of successive flats whose levels agree, each flat once."""
        for group in groups:
            held: tuple[Flat, float] | None = None
            for exposure in group:
                flat = exposure, self._read(exposure)
                level = self._level(flat[1])
                if held is None:
                    held = flat, level
                    continue
                first, other = held
                if abs(level - other) <= PAIR_TOLERANCE * 0.5 * abs(level + other):
                    held = None
                    yield first, flat
                    continue
                self.single.append(first[0])
                self.notes.append(
                    f"flats {first[0].number}, {exposure.number}: levels of {other:.0f} and "
                    f"{level:.0f} ADU make no pair, as they differ by more than {PAIR_TOLERANCE:.0%}: "
                    "fixed pattern would not cancel in their difference"
                )
                held = flat, level
            if held is not None:
                self.single.append(held[0][0])


def compare_unlike(
    first: tuple[int, Sequence[FloatArray]],
    second: tuple[int, Sequence[FloatArray]],
    *,
    lags: int,
) -> UnlikePair | None:
    """Measure the correlations in the difference of two flats of unlike exposure.

    Parameters
    ----------
    first, second : (int, sequence of ndarray)
        Number of the exposure, and each amplifier's image with the bias subtracted [ADU].
    lags : int
        Largest lag [pixel], at least 2.

    Returns
    -------
    UnlikePair or None
        Mean over the amplifiers; None if the ratio of the levels is outside :data:`RATIO` or
        covariances cannot be measured.
    """
    means = [
        float(np.mean([np.nanmean(i) for i in images])) for _, images in (first, second)
    ]
    if min(means) <= 0 or not RATIO[0] <= means[1] / means[0] <= RATIO[1]:
        return None
    j, i = np.indices((lags + 1, lags + 1))
    far = (np.hypot(i, j) > FAR).ravel() / (np.hypot(i, j) > FAR).sum()
    rows, variances = [], []
    for a, b in zip(first[1], second[1], strict=True):
        try:
            found = flat_covariances(a, b, lags=lags, unit="adu")
        except MeasurementError:
            return None
        rho = found.correlations
        matrix = found.error_matrix() / found.covariances[0, 0] ** 2
        rows.append([found.level, rho[0, 1], rho[1, 0], far @ rho.ravel()])
        variances.append([matrix[1, 1], far @ matrix @ far])
    level, serial, parallel, mean = np.mean(rows, axis=0)
    near, distant = np.sqrt(np.mean(variances, axis=0) / len(rows))
    return UnlikePair(
        first[0], second[0], float(level), means[1] / means[0], float(serial), float(parallel),
        float(near), float(mean), float(distant),
    )  # fmt: skip


def scan_unlike(
    flats: Sequence[ExposureInfo],
    images: Callable[[ExposureInfo], Sequence[FloatArray]],
    *,
    lags: int,
) -> list[UnlikePair]:
    """Compare flats without a partner with their neighbours in exposure time.

    Parameters
    ----------
    flats : sequence of ExposureInfo
        Flats without a partner.
    images : callable
        Returns an exposure's images with the bias subtracted [ADU].
    lags : int
        Largest lag [pixel], at least 2.

    Returns
    -------
    pairs : list of UnlikePair
        One for each two neighbours that can be compared.
    """
    out = []
    conditions: dict[Condition, list[ExposureInfo]] = {}
    for flat in flats:
        if flat.exposure_time is not None:
            conditions.setdefault(condition_of(flat), []).append(flat)
    for members in conditions.values():
        held: tuple[int, Sequence[FloatArray]] | None = None
        if len(members) < 2:
            continue
        for flat in sorted(members, key=lambda f: f.exposure_time or 0.0):
            here = flat.number, images(flat)
            found = None if held is None else compare_unlike(held, here, lags=lags)
            held = here
            if found is not None:
                out.append(found)
    return out


def describe_unlike(pairs: Sequence[UnlikePair]) -> list[str]:
    """Sentences on what flats of unlike exposure show; none where nothing is significant."""
    out = []
    ordered = sorted(pairs, key=lambda p: p.level)
    rising = [p for p in ordered if p.rises]
    if rising:
        last = max((n for n, p in enumerate(ordered) if not p.rises), default=-1)
        always = ordered[last + 1 :]
        above = f", in each from {always[0].level:.0f} ADU on" if always else ""
        worst = max(rising, key=lambda p: p.far)
        out.append(
            f"flats of unlike exposure: in {len(rising)} of {len(pairs)} differences of neighbours "
            f"all lags rise together{above} (far lags up to {worst.far:.2g} of the variance, at "
            f"{worst.level:.0f} ADU): fixed pattern that does not scale with the light, saturation "
            "included; not the brighter-fatter effect, which changes far lags by less than 0.2 %. "
            "Of flats of unlike exposure no covariances are used"
        )
    quiet = [p for p in ordered if not p.rises]
    for lag, values in (
        ("(1, 0)", [p.serial for p in quiet]),
        ("(0, 1)", [p.parallel for p in quiet]),
    ):
        z = [v / p.near_error for v, p in zip(values, quiet, strict=True)]
        if quiet and max(z) > RISE and min(z) < -RISE:
            low, high = int(np.argmin(z)), int(np.argmax(z))
            out.append(
                f"flats of unlike exposure whose far lags are quiet: the correlation at lag {lag} "
                f"changes its sign with the level ({values[low]:+.3f} at {quiet[low].level:.0f} ADU, "
                f"{values[high]:+.3f} at {quiet[high].level:.0f} ADU, errors of "
                f"{quiet[low].near_error:.3f}); the brighter-fatter effect grows in proportion to it"
            )
    return out
