"""Exposures of a campaign: their conditions, their grouping by condition, and pairs of flats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bfsensor.device.condition import Condition

TOLERANCES = {
    "wavelength": 1.0, "temperature": 2.0, "back_bias": 0.5, "gate_high": 0.1, "gate_low": 0.1,
}  # fmt: skip
"""Largest gap between neighbouring readings that count as one setting [nm, K, V].

Chosen: above the scatter of a test bench's monitors, below the steps that are set on purpose.  If
they were twice as large, two temperatures 3 K apart would be one condition, and two flats of
such a step could be a pair.
"""

PAIR_TOLERANCE = 0.05
"""Largest difference of the light of a pair's flats over the larger one, if campaign.yaml gives no
other.  Chosen: each flat is divided by its mean before they are subtracted, so that pattern in
proportion to the light drops out; with 0.1, up to twice as much of other pattern stays."""

LIT = ("flat", "sflat", "spot", "qe", "light")
"""Kinds of exposures to light of a lamp."""


@dataclass(frozen=True)
class Exposure:
    """One exposure and its conditions; a condition that is not known is None.

    Attributes
    ----------
    number : int
        SEQNUM where every exposure has a different one, else the position.
    path : Path
        The file.
    kind : str
        'bias', 'dark', 'flat', 'sflat' (superflat), 'spot', 'qe' (quantum efficiency), 'ppump'
        (pocket pumping), 'fe55' or 'light' (any other exposure to light).
    position : int
        Place in the order of time, from 0; exposures that are set aside are counted.
    exposure_time : float or None
        Exposure time [s].
    mjd : float or None
        Time stamp [MJD]: begin or middle of the exposure, as the camera writes it.
    wavelength : float or None
        Wavelength of the light [nm]; None also without light.
    filter : str or None
        Name of a filter.
    back_bias, gate_high, gate_low : float or None
        Voltages of the back side, the collecting gates and the barrier gates [V].
    temperature : float or None
        Temperature of the sensor [K].
    lamp : float or None
        Reading of the lamp monitor, in any unit; None without light.
    pair : int or None
        Number of the pair, equal for its two flats; None for an exposure without a partner.

    Examples
    --------
    >>> one = Exposure(7, Path("f7.fits"), "flat", 7, gate_high=4.0, gate_low=-8.0)
    >>> one.gates, one.back_bias
    ((4.0, -8.0), None)
    """

    number: int
    path: Path
    kind: str
    position: int
    exposure_time: float | None = None
    mjd: float | None = None
    wavelength: float | None = None
    filter: str | None = None
    back_bias: float | None = None
    gate_high: float | None = None
    gate_low: float | None = None
    temperature: float | None = None
    lamp: float | None = None
    pair: int | None = None

    @property
    def gates(self) -> tuple[float, float] | None:
        """Voltages of the collecting and the barrier gates [V]; None unless both are known."""
        if self.gate_high is None or self.gate_low is None:
            return None
        return self.gate_high, self.gate_low


@dataclass(frozen=True)
class SetAside:
    """A file that is not used, and the reason."""

    path: Path
    reason: str

    def __str__(self) -> str:
        return f"{self.path.name}: {self.reason}"


@dataclass(frozen=True)
class Caution:
    """Warning about a campaign.

    Attributes
    ----------
    topic : str
        Subject in one word, such as 'missing', 'gain', 'saturation'.
    message : str
        The finding, with the files or amplifiers that it concerns.
    closes : str
        Consequence: the result that is impossible or biased, and the remedy where there is one;
        '' without consequence.
    exposures : tuple of int
        Numbers of the exposures concerned; empty where it concerns all.
    """

    topic: str
    message: str
    closes: str = ""
    exposures: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{self.message}: {self.closes}" if self.closes else self.message


def group_conditions(
    exposures: Sequence[Exposure],
) -> dict[Condition, tuple[Exposure, ...]]:
    """Group exposures by their settings.

    Parameters
    ----------
    exposures : sequence of Exposure
        Exposures in any order.

    Returns
    -------
    groups : dict of Condition to tuple of Exposure
        Exposures by condition, the largest group first.  A condition holds the median of the
        readings that :data:`TOLERANCES` count as one setting.

    Examples
    --------
    >>> two = [Exposure(n, Path("f"), "flat", n, back_bias=v) for n, v in ((0, -60), (1, -60.1))]
    >>> [str(one) for one in group_conditions(two)]
    ['back bias -60.05 V']
    """
    settings = {
        name: cluster([getattr(one, name) for one in exposures], gap)
        for name, gap in TOLERANCES.items()
    }
    groups: dict[Condition, list[Exposure]] = {}
    for k, one in enumerate(exposures):
        # The wavelength of a monochromator is the condition: its order-sorting filter is not.
        word = one.filter if settings["wavelength"][k] is None else None
        values = {name: found[k] for name, found in settings.items()}
        groups.setdefault(Condition(filter=word, **values), []).append(one)
    order = sorted(groups, key=lambda one: -len(groups[one]))
    return {one: tuple(groups[one]) for one in order}


def cluster(values: Sequence[float | None], gap: float) -> list[float | None]:
    """Replace each value by the median of its cluster, whose neighbours differ by at most ``gap``.

    Examples
    --------
    >>> cluster([-5.2, None, -4.8, -30.0], 2.0)
    [-5.0, None, -5.0, -30.0]
    """
    known = sorted({float(v) for v in values if v is not None})
    if not known:
        return [None] * len(values)
    cuts = np.flatnonzero(np.diff(known) > gap) + 1
    medians = {}
    for part in np.split(np.array(known), cuts):
        members = [v for v in values if v is not None and part[0] <= v <= part[-1]]
        # Ten digits, so that the mean of two readings prints with few, such as -60.05.
        medians.update(dict.fromkeys(part.tolist(), float(f"{np.median(members):.10g}")))
    return [None if v is None else medians[float(v)] for v in values]


def find_pairs(
    exposures: Sequence[Exposure], *, tolerance: float = PAIR_TOLERANCE
) -> list[tuple[Exposure, Exposure]]:
    """Pair flats that follow one another, of equal light and settings.

    The light is the exposure time, times the reading of the lamp monitor where both flats have one.

    Two flats with another exposure between them, also one that was set aside, are no pair: the
    lamp may have drifted, and of four equal flats with the second lost, the first and the third
    would else be paired.

    Parameters
    ----------
    exposures : sequence of Exposure
        Flats.
    tolerance : float
        Largest difference of the light of the two over the larger one.

    Returns
    -------
    pairs : list of (Exposure, Exposure)
        Pairs in the order of time, each exposure in at most one.
    """
    same = {
        one.number: setting
        for setting, members in group_conditions(exposures).items()
        for one in members
    }
    pairs, waiting = [], None
    for one in sorted(exposures, key=lambda e: e.position):
        if (
            waiting is not None
            and one.position == waiting.position + 1
            and same[one.number] == same[waiting.number]
            and _alike(one, waiting, tolerance)
        ):
            pairs.append((waiting, one))
            waiting = None
        else:
            waiting = one
    return pairs


def _alike(one: Exposure, other: Exposure, tolerance: float) -> bool:
    """Whether two flats have equal light, as far as their headers say."""
    if one.exposure_time is None or other.exposure_time is None:
        return False
    light, more = one.exposure_time, other.exposure_time
    if one.lamp and other.lamp:
        light, more = light * one.lamp, more * other.lamp
    return abs(light - more) <= tolerance * max(light, more)


def named(exposures: Iterable[Exposure], most: int = 3) -> str:
    """Names of the first ``most`` exposures' files, with the number of the others.

    Examples
    --------
    >>> named([Exposure(n, Path(f"f{n}.fits"), "flat", n) for n in range(5)])
    'f0.fits, f1.fits, f2.fits and 2 more'
    """
    names = [one.path.name for one in exposures]
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest


def count_of(number: int, word: str) -> str:
    """Number with its noun in singular or plural.

    Examples
    --------
    >>> count_of(1, "pair"), count_of(0, "bias"), count_of(3, "flat")
    ('1 pair', 'no biases', '3 flats')
    """
    if number == 1:
        return f"1 {word}"
    plural = f"{word}es" if word.endswith("s") else f"{word}s"
    return f"{number or 'no'} {plural}"


Progress = Callable[[int, int], None]
"""Function that is called with the number of files done and the number of all."""
