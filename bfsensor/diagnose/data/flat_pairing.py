"""Pairing of flats: successive equal exposures of equal levels; comparison of those without a pair."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.exposure_info import ExposureInfo, Frame, condition_of
from bfsensor.errors import MeasurementError
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.typing import FloatArray

Flat = tuple[ExposureInfo, Sequence[Frame]]
"""A flat with the frames of all amplifiers."""

UNEQUAL = 0.05
"""Relative difference of two levels above which flats make no pair.  The part of the fixed
pattern that is not in proportion to the light stays in their difference, in proportion to that
of the levels.  Chosen: ``bfsensor check`` warns above 0.02; with 0.1, up to twice as much
pattern stays."""

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

    By the numbers of pairs in their headers if any flat has one (flats without are then left
    out); otherwise successive flats of one condition and exposure time.
    """
    groups: list[list[ExposureInfo]] = []
    if any(flat.pair is not None for flat in flats):
        by_number: dict[int, list[ExposureInfo]] = {}
        for flat in flats:
            if flat.pair is not None:
                by_number.setdefault(flat.pair, []).append(flat)
        return list(by_number.values())
    for flat in flats:
        if groups and level_of(groups[-1][-1]) == level_of(flat):
            groups[-1].append(flat)
        else:
            groups.append([flat])
    return groups


def level_of(flat: ExposureInfo) -> tuple:
    """Condition and exposure time of a flat, as a key of its level."""
    return condition_of(flat), flat.exposure_time


def by_level(
    groups: Sequence[Sequence[ExposureInfo]],
) -> list[list[Sequence[ExposureInfo]]]:
    """Collect the groups of each condition and exposure time; groups of one flat are left out."""
    levels: dict[tuple, list[Sequence[ExposureInfo]]] = {}
    for group in groups:
        if len(group) > 1:
            levels.setdefault(level_of(group[0]), []).append(group)
    return list(levels.values())


class PairFinder:
    """Reads flats of equal exposure, two in memory at a time, and yields pairs of equal level.

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
        """Yield pairs of successive flats whose levels agree to :data:`UNEQUAL`, each flat once."""
        for group in groups:
            held: tuple[Flat, float] | None = None
            for exposure in group:
                flat = exposure, self._read(exposure)
                level = self._level(flat[1])
                if held is None:
                    held = flat, level
                    continue
                first, other = held
                if abs(level - other) <= UNEQUAL * 0.5 * abs(level + other):
                    held = None
                    yield first, flat
                    continue
                self.single.append(first[0])
                self.notes.append(
                    f"flats {first[0].number}, {exposure.number}: levels of {other:.0f} and "
                    f"{level:.0f} ADU make no pair, as they differ by more than {UNEQUAL:.0%}: "
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
            "No flats of unlike exposure are used"
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
