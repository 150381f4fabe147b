"""Which questions a campaign leaves open, and the recording that would close each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bfsensor.recording.campaign.campaign import Campaign
from bfsensor.recording.campaign.exposures import LIT, count_of

SERIAL_OVERSCAN, PARALLEL_OVERSCAN = 24, 16
"""Columns and rows that deferred charge, traps and the amplifier's memory need."""

BIASES, DARKS, LEVELS, PAIRS = 10, 10, 8, 24
"""What a campaign that separates most effects has; pairs are for each level."""


@dataclass(frozen=True)
class OpenQuestion:
    """A question that these recordings cannot answer.

    Attributes
    ----------
    question : str
        What stays untested or cannot be told apart.
    because : str
        What these recordings have of it.
    take : str
        The recording that would answer it.
    """

    question: str
    because: str
    take: str

    def __str__(self) -> str:
        return f"{self.question} ({self.because}); {self.take}"


def open_questions(campaign: Campaign) -> tuple[OpenQuestion, ...]:
    """Give what a campaign's recordings cannot separate, whatever the analysis.

    Parameters
    ----------
    campaign : Campaign

    Returns
    -------
    questions : tuple of OpenQuestion
        Empty only for a campaign that has everything.

    Notes
    -----
    Some twins stay whatever is taken of these kinds: charge left behind in the serial
    register and an amplifier that remembers differ only with the pixel time or a reversed
    clock, and a white excess of variance is a gain without an X-ray source.
    """
    return tuple(
        OpenQuestion(question, because, take)
        for question, find, take in _QUESTIONS
        if (because := find(campaign))
    )


def _settings(campaign: Campaign, name: str) -> list[float]:
    """Different settings of a quantity among flats and spots."""
    found = {
        getattr(condition, name)
        for kind in ("flat", "spot")
        for condition in campaign.conditions(kind)
    }
    return sorted(value for value in found if value is not None)


def _one(name: str, unit: str, word: str) -> Callable[[Campaign], str]:
    """Whether there is less than two of a setting."""

    def find(campaign: Campaign) -> str:
        if not (campaign.of("flat") or campaign.of("spot")):
            return ""
        there = _settings(campaign, name)
        if len(there) > 1:
            return ""
        return f"one {word} only, {there[0]:g} {unit}" if there else f"{word} not known"

    return find


def _fewer(kind: str, wanted: int) -> Callable[[Campaign], str]:
    """Whether there are less exposures of a kind than wanted."""

    def find(campaign: Campaign) -> str:
        count = len(campaign.of(kind))
        word = "Fe55 exposure" if kind == "fe55" else kind
        return count_of(count, word) if count < wanted else ""

    return find


def _serial(campaign: Campaign) -> str:
    least = min((one.serial_overscan for one in campaign.amplifiers), default=0)
    return f"{least} columns of serial overscan" if least < SERIAL_OVERSCAN else ""


def _parallel(campaign: Campaign) -> str:
    least = min((one.parallel_overscan for one in campaign.amplifiers), default=0)
    return f"{least} rows of parallel overscan" if least < PARALLEL_OVERSCAN else ""


def _lamp(campaign: Campaign) -> str:
    lit = [one for one in campaign.exposures if one.kind in LIT]
    lacking = [one for one in lit if one.lamp is None]
    if not lacking:
        return ""
    return (
        "no lamp monitor" if len(lacking) == len(lit) else "not every exposure has a lamp"
    )


def _flats(campaign: Campaign) -> str:
    return "" if campaign.pairs() else "no pairs of flats"


def _levels(campaign: Campaign) -> str:
    most = max(
        (len(campaign.exposure_times(one)) for one in campaign.conditions()), default=0
    )
    return f"pairs at {count_of(most, 'level')}" if most < LEVELS else ""


def _pairs(campaign: Campaign) -> str:
    """Most pairs at one level: weak terms need them."""
    counts = [
        len(campaign.pairs(one, exposure_time=time))
        for one in campaign.conditions()
        for time in campaign.exposure_times(one)
    ]
    most = max(counts, default=0)
    return f"at most {count_of(most, 'pair')} a level" if most < PAIRS else ""


def _rates(campaign: Campaign) -> str:
    """Whether the same exposure times were taken at two light rates."""
    lamps = [one.lamp for one in campaign.of("flat") if one.lamp]
    if not campaign.of("flat"):
        return ""
    return "" if lamps and max(lamps) > 1.5 * min(lamps) else "one light rate only"


def _after(campaign: Campaign) -> str:
    """Whether a dark or bias follows a flat directly."""
    kinds = {one.position: one.kind for one in campaign.exposures}
    follows = any(
        kind in ("dark", "bias") and kinds.get(place - 1) in LIT
        for place, kind in kinds.items()
    )
    return "" if follows else "no dark or bias follows light"


def _amplifiers(campaign: Campaign) -> str:
    return "one amplifier" if len(campaign.amplifiers) < 2 else ""


def _spot_temperatures(campaign: Campaign) -> str:
    if not campaign.of("spot"):
        return "no spots"
    there = {one.temperature for one in campaign.conditions("spot")} - {None}
    return "" if len(there) > 1 else "spots at one temperature only"


_QUESTIONS: tuple[tuple[str, Callable[[Campaign], str], str], ...] = (
    ("covariances, gain and the brighter-fatter effect in flats: untested", _flats,
     "take flats in pairs of equal exposure time"),
    ("charge loss, gain nonlinearity and the lamp: cannot be told apart", _lamp,
     "record a photodiode"),
    ("exposure time and flux act alike (shutter, nonlinearity, lamp)", _rates,
     "repeat two levels at another lamp current"),
    ("chromatic effect: untested", _one("wavelength", "nm", "wavelength"),
     "take flats and spots at two more wavelengths"),
    ("device errors and missing physics: cannot be told apart by voltage",
     _one("back_bias", "V", "back bias"), "take two levels at a second back bias"),
    ("storage height and free holes: untested", _one("gate_low", "V", "barrier voltage"),
     "take two levels at other parallel voltages"),
    ("odd, curl and sub-pixel parts of the shifts: never seen by flats",
     _fewer("spot", 1), "take spots at several fluxes and positions"),
    ("diffusion and optics: cannot be told apart", _spot_temperatures,
     "take spots at a second temperature, focus untouched"),
    ("serial charge transfer, traps and the amplifier's memory: hardly seen", _serial,
     f"read {SERIAL_OVERSCAN} columns of overscan"),
    ("parallel charge transfer: hardly seen", _parallel,
     f"read {PARALLEL_OVERSCAN} rows of overscan"),
    ("correlated noise: hardly tested", _fewer("bias", BIASES), f"take {BIASES} biases"),
    ("dark current, glow and hot columns: hardly tested", _fewer("dark", DARKS),
     f"take {DARKS} darks"),
    ("persistence: untested", _after, "take darks directly after saturated flats"),
    ("crosstalk: untested", _amplifiers, "read two amplifiers, spots on one"),
    ("changes of the shifts with charge (b) and full well: weak", _levels,
     f"take {LEVELS} levels, past the turnover"),
    ("long range of the shifts and other weak covariances: weak", _pairs,
     f"take {PAIRS} pairs at two levels"),
    ("a white excess of variance (Fano, quantum yield) is the same as a gain",
     _fewer("fe55", 1), "take an Fe55 exposure"),
)  # fmt: skip
