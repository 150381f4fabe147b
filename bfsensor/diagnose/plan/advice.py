"""Advice on the recording that would separate effects which present recordings do not distinguish."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bfsensor.diagnose.detect.candidate_screen import Rival
from bfsensor.diagnose.detect.model_error import SAME
from bfsensor.diagnose.explain.attribution import Attribution, Found
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.plan.catalogue import Recording, make_recordings
from bfsensor.diagnose.plan.forecast import Forecaster
from bfsensor.diagnose.plan.planned_exposures import Forecast, Information, Planned
from bfsensor.errors import ConvergenceError, DiagnosisError
from bfsensor.units import to_celsius

ENOUGH = 25.0
"""Expected difference of chi-squares above which a recording is expected to decide.  Chosen: 5 standard
deviations; twice as large asks for about twice as many exposures."""

TIMES = (1, 2, 4, 8)
"""Multiples of a recording's exposures that are considered.  Chosen: a further doubling would advise
recordings of hundreds of exposures where nothing smaller decides."""


@dataclass(frozen=True)
class Advice:
    """A recording that would separate one pair of classes.

    Attributes
    ----------
    recording : Recording
        Recording to take.
    times : int
        Multiple of its exposures.
    separates : tuple of str
        The two classes.
    expected : float
        Expected difference of the two models' chi-squares in the new recording, both refitted to
        all recordings; the smaller one of either model being true.
    others : tuple of (str, int, float)
        Other recordings, the best first: name, exposures, expected difference.
    taken : int
        Exposures of the present campaign, the number that a repetition of all takes; 0 if unknown.
    """

    recording: Recording
    times: int
    separates: tuple[str, str]
    expected: float
    others: tuple[tuple[str, int, float], ...] = ()
    taken: int = 0

    @property
    def exposures(self) -> int:
        """Number of exposures to take; 0 if unknown."""
        return self.times * (self.recording.exposures or self.taken)

    @property
    def decides(self) -> bool:
        """Whether the expected difference reaches :data:`ENOUGH`."""
        return self.expected >= ENOUGH

    def said(self) -> str:
        """State the advice in one sentence."""
        one, other = self.separates
        # A reduced recording does not state its number of exposures.
        count = f"{self.exposures} exposures" if self.exposures else f"{self.times} times"
        text = (
            f"{self.recording.words} ({count}{_levels(self)}): expected to separate "
            f"{one} from {other} by a chi-square difference of {self.expected:.3g}"
        )
        if not self.decides:
            text += (
                f", below the {ENOUGH:g} that decide; no other recording that was considered promises "
                "more"
            )
        if self.recording.rule is not None:
            text += f"; {self.recording.rule.why}"
        return text + "."

    def to_report(self) -> dict[str, Any]:
        """Make the block of the key 'plan' in report.json."""
        out = {
            "recording": self.recording.name,
            "separates": list(self.separates),
            "expected_delta_chi2": self.expected,
            "exposures": self.exposures,
            "decides": self.decides,
            "recipe": [_recipe(p, self.times) for p in self.recording.planned],
            "others": [
                {"recording": n, "exposures": k, "expected_delta_chi2": v}
                for n, k, v in self.others
            ],
        }
        if self.recording.rule is not None:
            rule = self.recording.rule
            out["rule"] = {
                "keeps": {w: rule.of(w) for w in self.separates},
                "why": rule.why,
                "source": rule.source,
            }
        return out


@dataclass(frozen=True)
class RecordingPlan:
    """Advice for each pair of classes that recordings do not distinguish.

    Attributes
    ----------
    advised : tuple of Advice
        One recording for each pair; empty where no classes are tied.
    notes : tuple of str
        Recordings that could not be predicted, and why.

    Examples
    --------
    >>> RecordingPlan().said()
    []
    """

    advised: tuple[Advice, ...] = ()
    notes: tuple[str, ...] = ()

    def said(self) -> list[str]:
        """State the advice in sentences, one for each recording, without repetitions.

        Returns
        -------
        list of str
            The key 'recommended_recordings' of report.json.
        """
        return list(dict.fromkeys(a.said() for a in self.advised))

    def to_report(self) -> list[dict[str, Any]]:
        """Make the key 'plan' of report.json.

        Returns
        -------
        list of dict
            One block for each pair of classes.
        """
        return [a.to_report() for a in self.advised]


def plan(
    attribution: Attribution, candidates: Sequence[Recording] | None = None
) -> RecordingPlan:
    """Find the smallest recording that is expected to separate classes that are tied.

    Each pair of tied classes is fitted to the present recordings, one in place of the other.  For
    each candidate recording the predictions of the two fits are compared within its noise, with
    the wrong one's parameters refitted
    (:class:`~bfsensor.diagnose.plan.planned_exposures.Information`); recordings without a prediction
    follow their rule (:func:`ruled`).  Advised is the one that reaches :data:`ENOUGH` with the fewest
    exposures, or else the one with the largest expected difference.

    Parameters
    ----------
    attribution : Attribution
        Effects found, with the classes tied to them.
    candidates : sequence of Recording, optional
        Recordings to consider; by default
        :func:`~bfsensor.diagnose.plan.catalogue.make_recordings` of the campaign.

    Returns
    -------
    RecordingPlan
        Empty where no classes are tied; empty with a note where effects explain less than half of
        the chi-square above noise.
    """
    model = Model(attribution.predictor, attribution.fit)
    pairs = [(f, r) for f in attribution.found for r in _tied(f)]
    if not pairs:
        return RecordingPlan()
    if attribution.taken < SAME:
        note = (
            f"no recording is advised: effects take {100 * attribution.taken:.3g} % of the chi-square "
            "above noise, so that what separates them would leave most of it unexplained"
        )
        return RecordingPlan((), (note,))
    here = Forecaster(model.predictor, model.fit)
    if candidates is None:
        candidates = make_recordings(here.usual, here.brightest, here.brightest_spot)
    made: dict[str, list[Forecast]] = {}
    advised: list[Advice] = []
    notes: list[str] = []
    for recording in candidates:
        if recording.rule is None and not recording.again:
            try:
                found = here.forecasts(recording.planned)
            except DiagnosisError:
                # The campaign has no such light.
                continue
            except ConvergenceError as error:
                # Spots are no longer spots, as when wells are full.
                notes.append(f"no forecast of {recording.name}: {error}")
                continue
            if found:
                made[recording.name] = found
    for found_, rival in pairs:
        names = [e.name for e in model.effects]
        effects = list(model.effects)
        effects[names.index(found_.effect.name)] = rival.effect
        try:
            other = model.with_effects(effects)
        except ConvergenceError as error:
            notes.append(f"no plan for {found_.effect.word} and {rival.word}: {error}")
            continue
        there = Forecaster(other.predictor, other.fit)
        judged = []
        for recording in candidates:
            try:
                values = _expected(recording, here, there, made, found_, rival)
            except (DiagnosisError, ConvergenceError) as error:
                notes.append(
                    f"no forecast of {recording.name} for {found_.effect.word} and "
                    f"{rival.word}: {error}"
                )
                continue
            if values is not None:
                judged.append((recording, values))
        taken = sum(model.predictor.measured.counts.values())
        if judged:
            words = found_.effect.word, rival.word
            advised.append(_choose(judged, words, taken))
    return RecordingPlan(tuple(advised), tuple(notes))


def _tied(found: Found) -> list[Rival]:
    """Best rival of each other class that is tied to an effect."""
    return [
        next(r for r in found.rivals if r.word == word)
        for word in found.tied
        if word != found.effect.word
    ]


def _expected(
    recording: Recording,
    here: Forecaster,
    there: Forecaster,
    made: dict[str, list[Forecast]],
    found: Found,
    rival: Rival,
) -> list[float] | None:
    """Expected chi-square differences for each of :data:`TIMES`; None where they are not known."""
    if recording.rule is not None:
        return [ruled(recording, here, found, rival, times=t) for t in TIMES]
    if recording.again:
        # Difference of the two fits' predictions of the present recordings, without their noise.
        n = len(here.fit.residuals)
        away = here.fit.left[:n] - there.fit.left[:n]
        return [t * float(away @ away) for t in TIMES]
    if recording.name not in made:
        return None
    ours = made[recording.name]
    theirs = there.same(ours, here)
    both = Information(ours, theirs, there.fit), Information(theirs, ours, here.fit)
    return [min(i.delta_chi2(t) for i in both) for t in TIMES]


def ruled(
    recording: Recording, here: Forecaster, found: Found, rival: Rival, *, times: int = 1
) -> float:
    r"""Calculate the expected chi-square difference in a recording that follows a rule.

    For two templates that are equal in the present recordings, and scaled by :math:`f_a` and
    :math:`f_b` in the new one,

    .. math::
        \Delta\chi^2 = \frac{(f_a - f_b)^2\, G}{1 + f^2 G / G_0} ,

    where G is the chi-square gain of as many exposures of the kind recorded, :math:`G_0` that of the
    present ones, and f the larger of the two factors: the wrong effect's amplitude is refitted
    within its error.

    Parameters
    ----------
    recording : Recording
        Recording with a rule.
    here : Forecaster
        Forecaster of the accepted fit.
    found, rival
        The effect found and its rival.
    times : int
        Multiple of the recording's exposures.

    Raises
    ------
    DiagnosisError
        The recording has no rule.
    """
    rule = recording.rule
    if rule is None:
        raise DiagnosisError(
            f"{recording.name}: predicted channel by channel, without a rule"
        )
    own, other = rule.of(found.effect.word), rule.of(rival.word)
    if own == other:
        return 0.0
    layout = here.predictor.layout
    if rule.strength is not None:
        if not layout.segments:
            return 0.0  # A reduced recording states neither pixels nor read noise.
        noise = float(np.nanmean(np.array(here.measured.read_noise) * here.gains))
        seen = found.effect if own else rival.effect
        return times * recording.exposures * rule.strength(seen, layout, noise)
    rows = np.zeros(len(rival.template), bool)
    for word in rule.channels:
        rows[: len(here.fit.residuals)] |= here.fit.of(word)
    before = sum(n for kind, n in here.measured.counts.items() if kind == rule.exposures)
    if not before:
        return 0.0
    gain = float(rival.template[rows] @ rival.template[rows])
    gain *= times * recording.exposures / before
    whole = float(rival.template @ rival.template)
    if not whole:
        return 0.0
    return (own - other) ** 2 * gain / (1 + max(own**2, other**2) * gain / whole)


def _choose(
    judged: Sequence[tuple[Recording, Sequence[float]]], words: tuple[str, str], taken: int
) -> Advice:
    """Choose the fewest exposures that decide, or the largest difference where none does."""
    options = [
        Advice(r, t, words, v, taken=taken)
        for r, values in judged for t, v in zip(TIMES, values, strict=True)
    ]  # fmt: skip
    order = sorted(
        options,
        key=lambda o: (0, o.exposures, -o.expected) if o.decides else (1, 0, -o.expected),
    )
    seen: dict[str, Advice] = {}
    for option in order:
        seen.setdefault(option.recording.name, option)
    best, *rest = seen.values()
    others = tuple((o.recording.name, o.exposures, o.expected) for o in rest[:5])
    return Advice(best.recording, best.times, words, best.expected, others, taken)


def _levels(advice: Advice) -> str:
    """Levels of a recipe's flats in words [e-], to two digits."""
    planned = advice.recording.planned
    levels = [p.level for p in planned if p.kind == "flat" and np.isfinite(p.level)]
    if not levels:
        return ""
    return " at levels of " + ", ".join(f"{float(f'{v:.2g}'):,.0f}" for v in levels) + " e-"


def _recipe(planned: Planned, times: int) -> dict[str, Any]:
    """Settings of planned exposures that differ from the campaign's, with temperature in deg C."""
    usual = Planned(planned.kind, 0)
    told = {
        name: value
        for name, value in asdict(planned).items()
        if value != getattr(usual, name) and value == value
    }
    if "temperature" in told:
        told["temperature"] = to_celsius(told["temperature"])
    return {**told, "kind": planned.kind, "count": planned.count * times}
