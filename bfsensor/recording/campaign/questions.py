"""Questions that a campaign's recordings cannot answer, each with the recording that would."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bfsensor.recording.campaign.campaign import Campaign
from bfsensor.recording.campaign.exposures import LIT, count_of

SERIAL_OVERSCAN, PARALLEL_OVERSCAN = 24, 16
"""Columns and rows of overscan below which deferred charge and traps count as hardly seen [pixel].

Chosen: of the charge that traps release with a time constant of t transfers, exp(-24 / t) comes
after 24 columns and is not seen.  With twice as many asked for, time constants twice as long
would be seen as well, and most campaigns would be asked for another readout.
"""

BIASES, DARKS, LEVELS, PAIRS = 10, 10, 8, 24
"""Numbers of biases, of darks, of levels, and of pairs at one level below which more are asked for.

Chosen: errors of noise, dark current and covariances fall with the square root of the number, so
that twice as many would make them smaller by sqrt(2) for twice the time at the bench.
"""


@dataclass(frozen=True)
class OpenQuestion:
    """A question that these recordings cannot answer.

    Attributes
    ----------
    question : str
        Effect that stays untested, or effects that cannot be separated.
    because : str
        Number of such recordings that the campaign has, or what is missing.
    take : str
        Recording that would answer the question.

    Examples
    --------
    >>> print(OpenQuestion("crosstalk: untested", "one amplifier", "read two amplifiers"))
    crosstalk: untested (one amplifier); read two amplifiers
    """

    question: str
    because: str
    take: str

    def __str__(self) -> str:
        return f"{self.question} ({self.because}); {self.take}"


def open_questions(campaign: Campaign) -> tuple[OpenQuestion, ...]:
    """Give the questions that a campaign's recordings cannot answer by any analysis.

    Parameters
    ----------
    campaign : Campaign
        Campaign as :func:`bfsensor.recording.read_campaign` reads it, with or without its pixels
        inspected.

    Returns
    -------
    questions : tuple of OpenQuestion
        Open questions, the fundamental ones first; empty for a campaign that has all kinds of
        recordings.

    Notes
    -----
    Two ambiguities remain with all of these recordings.  Charge deferred in the serial register
    and an amplifier whose output depends on the previous pixel differ only when the pixel time
    or the clock direction changes.  A white excess of variance acts like a gain unless an
    X-ray source gives the gain.

    Examples
    --------
    >>> from pathlib import Path
    >>> from bfsensor.recording import Exposure
    >>> flat = Exposure(0, Path("f0.fits"), "flat", 0)
    >>> questions = open_questions(Campaign(Path("run_1"), "run_1", (flat,)))
    >>> questions[0].because, questions[0].take
    ('no pairs of flats', 'take flats in pairs of equal exposure time')
    """
    return tuple(
        OpenQuestion(question, because, take)
        for question, find, take in _QUESTIONS
        if (because := find(campaign))
    )


def _settings(campaign: Campaign, name: str) -> list[float]:
    """Different values of a setting among flats and spots, ascending."""
    found = {
        getattr(condition, name)
        for kind in ("flat", "spot")
        for condition in campaign.conditions(kind)
    }
    return sorted(value for value in found if value is not None)


def _one(name: str, unit: str, word: str) -> Callable[[Campaign], str]:
    """Make a check that finds fewer than two values of a setting."""

    def find(campaign: Campaign) -> str:
        if not (campaign.of("flat") or campaign.of("spot")):
            return ""
        there = _settings(campaign, name)
        if len(there) > 1:
            return ""
        return f"one {word} only, {there[0]:g} {unit}" if there else f"{word} not known"

    return find


def _fewer(kind: str, wanted: int) -> Callable[[Campaign], str]:
    """Make a check that finds fewer exposures of a kind than wanted."""

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
        "no lamp monitor"
        if len(lacking) == len(lit)
        else f"no lamp reading in {len(lacking)} of {len(lit)} exposures"
    )


def _flats(campaign: Campaign) -> str:
    return "" if campaign.pairs() else "no pairs of flats"


def _levels(campaign: Campaign) -> str:
    most = max(
        (len(campaign.exposure_times(one)) for one in campaign.conditions()), default=0
    )
    return f"pairs at {count_of(most, 'level')}" if most < LEVELS else ""


def _pairs(campaign: Campaign) -> str:
    """Whether one level at least has the pairs that weak covariances need."""
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
    """Whether a dark or bias follows an exposure to light directly."""
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
    ("charge loss, gain nonlinearity and drifts of the lamp: cannot be told apart", _lamp,
     "record a photodiode's reading in the header of each exposure (MONDIODE)"),
    ("effects of exposure time (shutter, dark current) and of charge (nonlinearity): cannot be "
     "told apart", _rates, "repeat two levels at another lamp current"),
    ("chromatic effect: untested", _one("wavelength", "nm", "wavelength"),
     "take flats and spots at two more wavelengths"),
    ("errors of the device's parameters and missing physics: cannot be told apart",
     _one("back_bias", "V", "back bias"), "take flat pairs of two levels at a second back bias"),
    ("depth of the stored charge and free holes between pixels: untested",
     _one("gate_low", "V", "barrier voltage"),
     "take flat pairs of two levels at other voltages of the parallel gates"),
    ("boundary shifts that keep pixel areas (odd, curl and sub-pixel parts): not seen in flats",
     _fewer("spot", 1), "take spots at several fluxes and positions"),
    ("diffusion and optics: cannot be told apart", _spot_temperatures,
     "take spots at a second temperature without touching the focus"),
    ("serial charge transfer, traps and the amplifier's memory: hardly seen", _serial,
     f"read {SERIAL_OVERSCAN} columns of serial overscan"),
    ("parallel charge transfer: hardly seen", _parallel,
     f"read {PARALLEL_OVERSCAN} rows of parallel overscan"),
    ("correlated noise: hardly tested", _fewer("bias", BIASES), f"take {BIASES} biases"),
    ("dark current, glow and hot columns: hardly tested", _fewer("dark", DARKS),
     f"take {DARKS} darks"),
    ("persistence: untested", _after, "take darks directly after saturated flats"),
    ("crosstalk: untested", _amplifiers, "read two amplifiers with spots on one of them"),
    ("change of the boundary shifts with charge (b_ij) and full well: weakly constrained", _levels,
     f"take pairs at {LEVELS} levels, some beyond the level of the largest variance"),
    ("covariances at large lags and other weak ones: weakly constrained", _pairs,
     f"take {PAIRS} pairs at each of two levels"),
    ("a white excess of variance (Fano factor, quantum yield) and the gain: cannot be told apart",
     _fewer("fe55", 1), "take an Fe55 exposure"),
)  # fmt: skip
"""Each question with the check that finds it open, and the recording that would answer it.

One exposure of spots or Fe55 closes its question.  Chosen: with two demanded, a campaign that has
a single one would be asked for another, although the effect is not untested.
"""
