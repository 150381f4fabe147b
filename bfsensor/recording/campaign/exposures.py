"""Exposures of a campaign, grouped by the conditions under which they were taken."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bfsensor.device.condition import Condition

TOLERANCES = {
    "wavelength": 1.0, "temperature": 2.0, "back_bias": 0.5, "gate_high": 0.1, "gate_low": 0.1,
}  # fmt: skip
"""Steps that a bench's readings make by themselves [nm, K, V]: smaller gaps are one setting."""

LIT = ("flat", "sflat", "spot", "qe", "light")
"""Kinds that a lamp made."""


@dataclass(frozen=True)
class Exposure:
    """One exposure; None where nothing says.

    Attributes
    ----------
    number : int
        SEQNUM where every exposure has its own, else the position.
    path : Path
        The file.
    kind : str
        'bias', 'dark', 'flat', 'sflat', 'spot', 'qe', 'ppump', 'fe55' or 'light'.
    position : int
        Place in the order of time, from 0, those set aside counted.
    exposure_time : float or None
        [s].
    mjd : float or None
        As the header has it: beginning or middle, it does not say [d].
    wavelength : float or None
        [nm]; None also without light.
    filter : str or None
        Name of a filter.
    back_bias, gate_high, gate_low : float or None
        Back bias, collecting and barrier gates [V].
    temperature : float or None
        Of the sensor [K].
    lamp : float or None
        Reading of the lamp monitor, of any unit; None without light.
    pair : int or None
        Equal for the two flats of a pair.
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
        """Collecting and barrier gate [V]; None unless both are known."""
        if self.gate_high is None or self.gate_low is None:
            return None
        return self.gate_high, self.gate_low


@dataclass(frozen=True)
class SetAside:
    """A file that is not used, and why."""

    path: Path
    reason: str

    def __str__(self) -> str:
        return f"{self.path.name}: {self.reason}"


@dataclass(frozen=True)
class Caution:
    """Something about a campaign that its reader should know.

    Attributes
    ----------
    topic : str
        One word, such as 'lamp', 'gain', 'saturation'.
    message : str
        What is wrong, and where.
    closes : str
        The question that it closes or bends; '' where none.
    exposures : tuple of int
        Numbers of the exposures it is about; empty where all.
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
    """Group exposures by their settings, readings that jitter taken as one.

    Parameters
    ----------
    exposures : sequence of Exposure

    Returns
    -------
    groups : dict of Condition to tuple of Exposure
        The largest first.

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
        # A filter's name beside a monochromator says nothing more.
        word = one.filter if settings["wavelength"][k] is None else None
        values = {name: found[k] for name, found in settings.items()}
        groups.setdefault(Condition(filter=word, **values), []).append(one)
    order = sorted(groups, key=lambda one: -len(groups[one]))
    return {one: tuple(groups[one]) for one in order}


def cluster(values: Sequence[float | None], gap: float) -> list[float | None]:
    """Give each value the median of its cluster: sorted neighbours no further than ``gap``.

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
        # Ten digits: the mean of two readings should print as they do.
        medians.update(dict.fromkeys(part.tolist(), float(f"{np.median(members):.10g}")))
    return [None if v is None else medians[float(v)] for v in values]


def find_pairs(
    exposures: Sequence[Exposure], *, tolerance: float = 1e-3
) -> list[tuple[Exposure, Exposure]]:
    """Pair flats: neighbours in time, of equal exposure time and settings.

    Whatever lay between two flats, also an exposure that was set aside, parts them: a pair
    is never made across a gap.

    Parameters
    ----------
    exposures : sequence of Exposure
        In the order of time.
    tolerance : float
        Relative difference of the exposure times.

    Returns
    -------
    pairs : list of (Exposure, Exposure)
        Each exposure at most once.
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
            and _equal(one.exposure_time, waiting.exposure_time, tolerance)
        ):
            pairs.append((waiting, one))
            waiting = None
        else:
            waiting = one
    return pairs


def _equal(one: float | None, other: float | None, tolerance: float) -> bool:
    if one is None or other is None:
        return False
    return abs(one - other) <= tolerance * max(one, other)


def named(exposures: Iterable[Exposure], most: int = 3) -> str:
    """Name some exposures and count the rest.

    Examples
    --------
    >>> named([Exposure(n, Path(f"f{n}.fits"), "flat", n) for n in range(5)])
    'f0.fits, f1.fits, f2.fits and 2 more'
    """
    names = [one.path.name for one in exposures]
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest


def count_of(number: int, word: str) -> str:
    """Give a number with its noun.

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
"""Called with what is done and what there is."""
