"""What a campaign records, in time order: sizes, geometry, exposures.

Sizes (flat pairs at each of eight levels of the first condition, pairs at each of two levels of
the others):

    T    128 x 128, 4 pairs, 1 pair      tests: one dither of the spots
    S    256 x 256, 4 pairs, 2 pairs     CI, effects of transfer and amplifier
    M    512 x 512, 8 pairs, 4 pairs     nightly
    L    512 x 512, 24 pairs, 12 pairs   scored, brighter-fatter terms

The ladder of levels is walked up and down, one pair at each step, so that time is not flux.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

FLAT_SECONDS = (1.0, 5.0, 12.5, 20.0, 30.0, 40.0, 50.0, 60.0)
SPOT_SECONDS = (1.25, 3.75, 7.5, 11.25, 15.0, 20.0, 25.0, 30.0)
SECONDS_BETWEEN = 5.0
"""Readout and all else between two exposures [s]."""

FIRST_MJD = 60000.0


@dataclass(frozen=True)
class Geometry:
    """Pixels, overscans and amplifiers; each amplifier reads a strip of columns.

    Odd-numbered ones (the second, the fourth) read from the high end of their strip.
    """

    pixels: int = 256
    amplifiers: int = 2
    prescan: int = 8
    serial_overscan: int = 24
    parallel_overscan: int = 16

    def __post_init__(self) -> None:
        if self.pixels < 32 or self.amplifiers < 1 or self.pixels % self.amplifiers:
            raise ValueError(
                f"pixels = {self.pixels}, amplifiers = {self.amplifiers}: at least 32 pixels, "
                "a multiple of the amplifiers"
            )

    @property
    def width(self) -> int:
        """Columns of light read by one amplifier."""
        return self.pixels // self.amplifiers

    @property
    def raw_shape(self) -> tuple[int, int]:
        """Rows and columns of one amplifier's raw frame."""
        return (
            self.pixels + self.parallel_overscan,
            self.prescan + self.width + self.serial_overscan,
        )


@dataclass(frozen=True)
class Size:
    """Pixels and numbers of flat pairs, levels and dithers of a campaign."""

    pixels: int
    pairs: int
    condition_pairs: int
    dithers: int = 3
    flat_seconds: tuple[float, ...] = FLAT_SECONDS
    spot_seconds: tuple[float, ...] = SPOT_SECONDS


SIZES = {
    "T": Size(128, 4, 1, dithers=1),
    "S": Size(256, 4, 2),
    "M": Size(512, 8, 4),
    "L": Size(512, 24, 12),
}


@dataclass(frozen=True)
class Exposure:
    """One exposure: kind, place in time and the condition it is taken in.

    Attributes
    ----------
    kind : str
        BIAS, DARK, FLAT or SPOT.
    sequence : int
        Place in the order of time; numbers of withheld exposures are left out of a campaign.
    mjd : float
        Start [d].
    seconds : float
        Commanded exposure time [s].
    wavelength : float
        [nm]; that of the lamp's filter, also in the dark.
    back_bias, temperature : float
        [V], [C].
    withheld : bool
        Taken, but not part of the campaign: what a prediction is held against.
    """

    kind: str
    sequence: int
    mjd: float
    seconds: float
    wavelength: float = 620.0
    back_bias: float = -60.0
    temperature: float = -100.0
    withheld: bool = False

    @property
    def hours(self) -> float:
        """Time since the campaign began [h]."""
        return (self.mjd - FIRST_MJD) * 24.0

    @property
    def file(self) -> str:
        """Name of the exposure's file."""
        return f"{self.kind.lower()}_{self.sequence:04d}.fits.fz"


class _Clock:
    """Numbers and times exposures as they are added."""

    def __init__(self) -> None:
        self.exposures: list[Exposure] = []
        self._seconds = 0.0

    def add(self, kind: str, seconds: float, *, count: int = 1, **condition: float | bool):
        for _ in range(count):
            mjd = FIRST_MJD + self._seconds / 86400.0
            self.exposures.append(
                replace(Exposure(kind, len(self.exposures), mjd, seconds), **condition)
            )
            self._seconds += seconds + SECONDS_BETWEEN


def exposures_of(size: Size) -> tuple[Exposure, ...]:
    """Return the exposures of a campaign in the order of time, withheld ones among them.

    Examples
    --------
    >>> taken = [e for e in exposures_of(SIZES["S"]) if not e.withheld]
    >>> len(taken), sum(e.kind == "FLAT" for e in taken)
    (152, 88)
    """
    clock = _Clock()
    clock.add("BIAS", 0.0, count=10)
    clock.add("DARK", 60.0, count=4)
    for step in range(size.pairs):
        upwards = step % 2 == 0
        for seconds in size.flat_seconds if upwards else size.flat_seconds[::-1]:
            clock.add("FLAT", seconds, count=2)
            # a dark right after the brightest flats shows what stays behind
            if seconds == size.flat_seconds[-1] and step < 4:
                clock.add("DARK", 15.0)
    middle, bright = (
        size.flat_seconds[3::3][:2] if len(size.flat_seconds) > 6 else (20.0, 50.0)
    )
    held = 2 * size.condition_pairs
    if size.condition_pairs:
        clock.add("FLAT", 40.0, count=2 * held, withheld=True)
        for condition in (
            {"wavelength": 480.0},
            {"wavelength": 950.0},
            {"back_bias": -40.0},
        ):
            if "back_bias" in condition:
                clock.add("FLAT", 40.0, count=held, back_bias=-40.0, withheld=True)
            for seconds in (middle, bright):
                clock.add("FLAT", seconds, count=held, **condition)
    for _ in range(size.dithers):
        for seconds in size.spot_seconds:
            clock.add("SPOT", seconds)
    if size.dithers and size.condition_pairs:
        clock.add("SPOT", 17.5, count=2, withheld=True)
        for seconds in (7.5, 25.0):
            for condition in (
                {"wavelength": 950.0},
                {"back_bias": -40.0},
                {"temperature": -80.0},
            ):
                clock.add("SPOT", seconds, count=size.dithers, **condition)
    clock.add("BIAS", 0.0, count=4)
    return tuple(clock.exposures)
