"""Nonparametric terms of the mean of flats: by level, in time, and by the exposure before."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from bfsensor.diagnose.data.channels import Channel, step_of
from bfsensor.diagnose.explain.pursuit import Choice, Dictionary
from bfsensor.diagnose.explain.terms import SCALE, Family, Scene, Term
from bfsensor.typing import FloatArray

LEVEL_POWERS = (1, 2, 3, 4)
"""Powers of the level in relative changes of the mean. Chosen: up to the fourth; higher ones are so
alike over a ladder of levels that they are not distinguished."""

CURVES = 5
"""Highest order of Legendre polynomials in time.  Chosen, to be derived: twice as many follow drifts of
several turns, which waves describe with fewer terms."""

CYCLES, CYCLE_STEP = 10, 0.25
"""Largest number of waves over the campaign, and step between the numbers that are tried. Chosen, to
be derived: a wave between two steps is off by at most an eighth of a period at the ends of the
campaign; with twice the step, by a quarter."""

EIGHTHS = range(4)
"""Phases of a wave that are tried, in eighths; derived: the other four are the same with the other
sign."""

PERIODS = 41
"""Number of periods tried around the best wave, one step to either side.  Chosen: to 1/20 of a step;
twice as many double the time."""


def mean_families(scene: Scene) -> list[Family]:
    """Families of the means of flats: by level, in time, and by the exposure before."""
    flats = [c for c in scene.model.fit.channels if c.word == "flat_mean"]
    if not flats:
        return []
    out = [Family("mean by level", tuple(_by_level(scene, flats)), ("flat_mean",))]
    shots = scene.model.predictor.measured.shots
    hours = {s.number: s.hours for s in shots}
    if len(set(hours.values())) < len(hours):
        # Without times in the headers, exposures are taken to follow one another evenly.
        hours = {s.number: float(n) for n, s in enumerate(shots)}
    if hours:
        terms = tuple(_in_time(flats, hours, len(scene.gains)))
        out.append(Family("mean in time", terms, ("flat_mean",)))
        terms = tuple(_after_exposure(scene))
        out.append(Family("mean by the exposure before", terms, ("flat_mean",)))
    return out


Times = Callable[[Channel], FloatArray]
"""Function that gives the hours since the first flat of each value of a channel."""


def _relative(
    name: str,
    where: Mapping[str, Any],
    change: Callable[[Channel], FloatArray],
    *,
    spots: bool = True,
) -> Term:
    """Term that multiplies the means of flats, and if ``spots`` the fluxes of spots."""
    return Term(name, where, partial(_multiplied, change, spots))


def _multiplied(
    change: Callable[[Channel], FloatArray], spots: bool, channel: Channel
) -> FloatArray | None:
    """Levels of flats, and fluxes of spots, times their relative change."""
    x = channel.axes
    if channel.word == "flat_mean":
        return np.asarray(x["level"] * change(channel))
    if channel.word == "spot" and spots:
        return np.where(x["what"] == "flux", x["flux"] * change(channel), 0.0)
    return None


def _by_level(scene: Scene, flats: list[Channel]) -> Iterator[Term]:
    """Terms by power of the level and by single level, for all amplifiers and for each."""
    times = np.unique(np.concatenate([step_of(c.axes) for c in flats]))

    for amp, label in _amplifiers(scene):
        for p in LEVEL_POWERS:
            yield _relative(
                f"mean x S^{p}{label}",
                {"power": p, "amp": amp},
                partial(_power, scene, p, amp),
                spots=False,
            )
        for time in times if len(times) > 3 else ():
            level = np.concatenate(
                [c.axes["level"][step_of(c.axes) == time] for c in flats]
            )
            told = {"level": float(level.mean() * scene.gains.mean()), "amp": amp}
            change = partial(_at_step, float(time), amp)
            yield _relative(f"mean at {time:g} s{label}", told, change, spots=False)


def _own(channel: Channel, amp: int | None) -> FloatArray:
    """1 for values of an amplifier, or of all (None)."""
    return np.where(amp is None or channel.axes["amp"] == amp, 1.0, 0.0)


def _power(scene: Scene, p: int, amp: int | None, channel: Channel) -> FloatArray:
    """Power of the level in an amplifier."""
    level = scene.gains[channel.axes["amp"].astype(int)] * channel.axes["level"]
    return np.asarray(_own(channel, amp) * (level / SCALE) ** p)


def _at_step(time: float, amp: int | None, channel: Channel) -> FloatArray:
    """1 at one level of an amplifier's flats."""
    return np.asarray(_own(channel, amp) * (step_of(channel.axes) == time))


def _amplifiers(scene: Scene) -> list[tuple[int | None, str]]:
    """All amplifiers together (None), and each by its index from 0; labels count from 1."""
    count = len(scene.gains)
    each = [(n, f", amplifier {n + 1}") for n in range(count)] if count > 1 else []
    return [(None, ""), *each]


def _in_time(flats: list[Channel], hours: dict[int, float], count: int) -> Iterator[Term]:
    """Polynomials, waves and steps in time."""
    taken = np.unique(np.concatenate([c.axes["exposure"] for c in flats]))
    first, last = hours[int(taken[0])], hours[int(taken[-1])]
    span = max(last - first, 1e-9)

    at = partial(_since, hours, first, span)
    for p in range(1, CURVES + 1):
        yield _relative(
            f"mean, order {p} in time", {"order": p}, partial(_curve, at, span, p)
        )
    most = min(CYCLES, len(taken) // 6)
    for cycles in np.arange(1, most + CYCLE_STEP, CYCLE_STEP):
        for eighth in EIGHTHS:
            yield _wave(at, span, span / cycles, eighth * np.pi / 4)
    for number in taken[2:-1:2]:
        yield _relative(
            f"mean from exposure {int(number)}",
            {"exposure": int(number)},
            partial(_from_exposure, int(number)),
        )


def _since(
    hours: Mapping[int, float], first: float, span: float, channel: Channel
) -> FloatArray:
    """Hours since the first flat."""
    # Planned exposures have no time: they are put at the middle of the campaign.
    there = [hours.get(int(n), first + span / 2) for n in channel.axes["exposure"]]
    return np.array(there) - first


def _curve(at: Times, span: float, p: int, channel: Channel) -> FloatArray:
    """Legendre polynomial of the time over the campaign."""
    shape = np.polynomial.legendre.Legendre.basis(p)
    return np.asarray(shape(2 * at(channel) / span - 1))


def _from_exposure(number: int, channel: Channel) -> FloatArray:
    """1 from an exposure on."""
    return np.where(channel.axes["exposure"] >= number, 1.0, 0.0)


def _wave(at: Times, span: float, period: float, phase: float) -> Term:
    """Cosine of the time since the first flat, with a period [h] and a phase [rad]."""
    told = {"period": period, "phase": phase, "wave": (at, span)}
    late = f", {np.degrees(phase) % 360:.0f} degrees late" if phase else ""
    change = partial(_cosine, at, period, phase)
    return _relative(f"mean, wave of {period:.3g} h{late}", told, change)


def _cosine(at: Times, period: float, phase: float, channel: Channel) -> FloatArray:
    return np.asarray(np.cos(2 * np.pi * at(channel) / period - phase))


def refine_wave(choice: Choice, scene: Scene) -> Choice:
    """Choose again with the best period and phase in place of the first wave.

    A second coefficient, a quarter of a period later, takes up the rest of the phase.
    """
    first = choice.terms[0]
    if "wave" not in first.where:
        return choice
    fit = scene.model.fit
    at, span = first.where["wave"]
    cycles = span / first.where["period"]
    best = (-np.inf, 0.0, 0.0, 0.0)
    for n in np.linspace(cycles - CYCLE_STEP, cycles + CYCLE_STEP, PERIODS):
        pair = tuple(_wave(at, span, span / n, phase) for phase in (0.0, np.pi / 2))
        d = Dictionary(replace(choice.family, terms=pair), fit)
        c = np.linalg.lstsq(
            d.x.T @ d.x - d.u.T @ d.u, b := d.products(fit.left), rcond=1e-6
        )[0]
        best = max(best, (float(b @ c), n, float(c[0]), float(c[1])))
    _, n, cosine, sine = best
    phase = float(np.arctan2(sine, cosine))
    quarter = replace(_wave(at, span, span / n, phase + np.pi / 2), where={"quarter": True})
    wave = replace(_wave(at, span, span / n, phase), more=(quarter,))
    others = [
        t for t in choice.family.terms
        if "wave" not in t.where or abs(span / t.where["period"] - n) > 1
    ]  # fmt: skip
    family = replace(choice.family, terms=(wave, *others), tried=len(choice.family.terms))
    return Dictionary(family, fit).choose() or choice


def _after_exposure(scene: Scene) -> Iterator[Term]:
    """Terms by power of the mean level of the exposure before; one more for missing exposures."""
    measured = scene.model.predictor.measured
    # Levels of exposures were calculated with rough gains: scale them to the fitted ones.
    scale = float(np.mean(scene.gains) / np.mean(measured.gains))
    before: dict[int, float] = {}
    known: dict[int, bool] = {}
    last = None
    for shot in measured.shots:
        before[shot.number] = 0.0 if last is None else scale * last.level / SCALE
        known[shot.number] = last is None or last.number == shot.number - 1
        last = shot

    for p in (1, 2):
        yield _relative(
            f"mean x S^{p} of the exposure before",
            {"power": p},
            partial(_before, before, known, p),
        )
    if not all(known.values()):
        yield _relative(
            "mean after exposures not given", {"missing": True}, partial(_missing, known)
        )


def _before(
    before: Mapping[int, float], known: Mapping[int, bool], p: int, channel: Channel
) -> FloatArray:
    """Power of the level of the exposure before, 0 where that is not known."""
    numbers = [int(n) for n in channel.axes["exposure"]]
    return np.array([before[n] ** p if known.get(n) else 0.0 for n in numbers])


def _missing(known: Mapping[int, bool], channel: Channel) -> FloatArray:
    """1 where the exposure before is not given."""
    return np.array([0.0 if known.get(int(n)) else 1.0 for n in channel.axes["exposure"]])
