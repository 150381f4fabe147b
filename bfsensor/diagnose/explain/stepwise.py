"""Stepwise attribution: add effects while they explain a baseline's residuals, then compare each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bfsensor.diagnose.detect.candidate_screen import Rival, Screen
from bfsensor.diagnose.detect.candidates import (
    candidates_of,
    concerned,
    further,
    rank,
    refine,
    seen_of,
    tellable,
    threshold,
    with_fitted,
    with_hypotheses,
)
from bfsensor.diagnose.detect.locate import Mismatch, locate_mismatch
from bfsensor.diagnose.detect.matched_filters import locate_effects
from bfsensor.diagnose.detect.model_error import (
    ACCURACY,
    OUTSIDE_ALARM,
    explained_by_word,
    stands_out,
)
from bfsensor.diagnose.explain.attribution import (
    LEVELS,
    OUTSIDE_WORD,
    WIDENED,
    Attribution,
    Found,
    class_probabilities,
    tied_classes,
)
from bfsensor.diagnose.explain.nonparametric import (
    FreeFit,
    OpenWorld,
    compete,
    explain_outside,
    fit_free_form,
)
from bfsensor.diagnose.explain.terms import Scene
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.fit.fitted_model import Model, compare_held_out
from bfsensor.diagnose.fit.likelihood_profile import Profile, find_profiles, settle
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.exchanged_axes import NAMED
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect
from bfsensor.errors import ConvergenceError

MOST = 4
"""Largest number of effects that are added one after another; a mismatch beyond is left over.
Chosen, to be derived: twice as many double the longest search, and change only campaigns with five or
more effects."""

WEAK = 6.0
"""Increase of the chi-square when an effect is left out, below which it is removed again; also the
least gain of candidates that are tried although noise may reach it.  Chosen, to be derived: one
parameter gains 6 by chance with a probability of 1.4 %; at 12 (0.05 %) more faint effects are missed."""

FAINT = 2
"""Number of candidates below the noise threshold that are fitted where none is above it.  Chosen, to be
derived: twice as many cost two more fits and find faint effects whose templates rank third or fourth."""

NEEDED = 0.5
"""Least ratio of an effect's gain in chi-square beside nonparametric terms to its gain alone.
Chosen, to be derived: at 1 an effect is kept only if no term takes any part of its gain; at a quarter,
effects are named that mostly imitate the unmodelled cause."""

FAR_BETTER = 8.0
"""Chi-square by which one group of nonparametric terms must explain more than the effects, after both
are charged with what chance gives, to replace them. Chosen, to be derived: a likelihood ratio of
exp(4) = 55; twice as large asks for 3,000, and wrong effects that leave nothing are named more
often."""

TAKEN = 9.0
"""Chi-square that each fitted parameter of an effect is charged with, as it is the best of many
candidates.  Chosen, to be derived: twice as large replaces more effects by nonparametric terms."""

WIDTHS = [WIDENED * w for w in LEVELS.values()]
"""Square roots of the rises of the chi-square at which intervals end, 68 % and 95 %."""


def attribute(
    predictor: Predictor,
    fit: BaselineFit,
    mismatch: Mismatch,
    *,
    kinds: Sequence[type[Effect]] | None = None,
    seed: int = 1,
) -> Attribution:
    """Find the effects that explain the residuals of a baseline.

    Forward steps: take the candidate with the greatest evidence among those whose gain exceeds
    the largest gain of noise (false-alarm rate
    :data:`~bfsensor.diagnose.detect.locate.ALARM` over all candidates), refit everything, scan the new
    residuals, and repeat until nothing stands out.  Then each effect is taken out once and compared
    with all candidates in its place: a better one replaces it, equally good ones are listed as tied.

    A mismatch that is left after that, beyond the error of the effects' predictions (see
    :mod:`bfsensor.diagnose.detect.model_error`), is outside the library and is fitted with nonparametric
    terms, first without any effect: effects that explained part of it are named only if the terms
    cannot replace them.  The search also ends where one group of terms leaves nothing and explains
    far more than the effects found so far (:data:`FAR_BETTER`).

    Parameters
    ----------
    predictor : Predictor
        Model of the baseline.
    fit : BaselineFit
        Its fit.
    mismatch : Mismatch
        Residuals of that fit that stand out.
    kinds : sequence of type, optional
        Candidate effects; by default :func:`candidates_of` the baseline.
    seed : int
        Seed of the noise draws that thresholds come from.

    Returns
    -------
    Attribution
        Effects found, possibly none, with the fit that includes them.
    """
    kinds = candidates_of(predictor.baseline) if kinds is None else kinds
    kinds = tellable(kinds, predictor, fit.channels)
    base = Model(predictor, fit)
    candidates = (*kinds, *NAMED)
    first = mismatch
    model, mismatch, rankings, notes, better = _forward(base, mismatch, candidates, seed)
    free: OpenWorld | None = None
    outside = better is not None or _is_outside(base, model, mismatch)
    if not outside:
        places = {n: r for n, r in rankings.items() if n < len(model.effects)}
        judged = concerned(candidates, first, mismatch)
        found, model, mismatch = _judge(model, places, mismatch, judged, seed)
        outside = _is_outside(base, model, mismatch)
    if better is not None:
        free, model = better
        found, mismatch = [], free.mismatch
    elif outside:
        found, model, mismatch, free = _outside(
            base, model, mismatch, rankings, concerned(candidates, first, mismatch), seed
        )
    named = any(f.effect.word == OUTSIDE_WORD for f in found)
    return Attribution(
        found=tuple(sorted(found, key=lambda f: -f.gain)),
        fit=model.fit,
        predictor=model.predictor,
        mismatch=mismatch,
        open_world=outside or named,
        heldout=compare_held_out(base, model),
        notes=tuple(notes),
        free_form=free,
    )


def _forward(
    base: Model, mismatch: Mismatch, kinds: Sequence[type[Effect]], seed: int
) -> tuple[
    Model, Mismatch, dict[int, list[Rival]], list[str], tuple[OpenWorld, Model] | None
]:
    """Add effects one by one while residuals stand out and a candidate explains them.

    Returns the model, its mismatch, the rankings by number of effects present, notes, and a
    nonparametric model that explains far more, or None.
    """
    model, first = base, mismatch
    notes: list[str] = []
    rankings: dict[int, list[Rival]] = {}
    while len(model.effects) < MOST and stands_out(
        mismatch, explained_by_word(base.fit, model.fit), fits=len(model.effects)
    ):
        screen = Screen(model.predictor, model.fit, seen_of(mismatch))
        others = further(concerned(kinds, mismatch), model.effects)
        ranking = with_hypotheses(model, others, rank(screen, others))
        notes += [
            f"{name}, tried at one place: {why}" for name, why in screen.passed_over.items()
        ]
        critical = threshold(screen, ranking, seed=seed)
        good = [r for r in ranking if r.gain > critical and not r.refuted]
        rankings[len(model.effects)] = ranking
        if good:
            ranking = refine(model, ranking)
            good = [r for r in ranking if r.gain > critical and not r.refuted] or good
            rankings[len(model.effects)] = ranking
        else:
            # The mismatch itself is beyond noise already, so that a candidate below the noise of the
            # best of all candidates may explain it; :func:`_step` asks that it leave nothing.
            good = [r for r in ranking if r.gain > WEAK and not r.refuted][:FAINT]
        step = _step(
            model, good, kinds, seed, notes, sure=bool(good) and good[0].gain > critical
        )
        if step is None:
            break
        model, mismatch = step
        better = _better(base, first, model, rankings, seed)
        if better is not None:
            return model, mismatch, rankings, notes, better
    return model, mismatch, rankings, notes, None


def _step(
    model: Model,
    good: Sequence[Rival],
    kinds: Sequence[type[Effect]],
    seed: int,
    notes: list[str],
    *,
    sure: bool,
) -> tuple[Model, Mismatch] | None:
    """Fit the first candidate that converges; one below the threshold must leave nothing."""
    for rival in good:
        try:
            further = model.with_effects((*model.effects, rival.effect))
        except ConvergenceError as error:
            notes.append(f"{rival.effect.name}: {error}")
            continue
        if sure or not locate_mismatch(further.fit, seed=seed).detected:
            return further, locate_effects(further.predictor, further.fit, kinds, seed=seed)
    return None


def _is_outside(base: Model, model: Model, mismatch: Mismatch) -> bool:
    """Whether the residuals are outside the library: :mod:`bfsensor.diagnose.detect.model_error`."""
    explained = explained_by_word(base.fit, model.fit)
    return stands_out(mismatch, explained, fits=len(model.effects), alarm=OUTSIDE_ALARM)


def _outside(
    base: Model,
    model: Model,
    mismatch: Mismatch,
    rankings: dict[int, list[Rival]],
    kinds: Sequence[type[Effect]],
    seed: int,
) -> tuple[list[Found], Model, Mismatch, OpenWorld | None]:
    """Fit nonparametric terms to the residuals, and keep the effects that are needed beside them.

    An effect that explains part of an unmodelled cause is not the cause: where terms explain
    the mismatch without any effect, none is named.  Otherwise an effect stays if its gain beside
    the terms is more than :data:`NEEDED` of its gain alone.
    """
    first = locate_mismatch(base.fit, seed=seed) if model.effects else mismatch
    alone = fit_free_form(base, first, seed=seed)
    chosen, effects, ranking = alone, base, rankings.get(0, [])
    if model.effects:
        beside = fit_free_form(model, mismatch, before=base.fit, seed=seed)
        if not _does_without(base, alone, model, beside):
            chosen, effects = beside, model
            ranking = rankings.get(len(model.effects), [])
            kept = _needed(chosen.model, base)
            if len(kept) < len(model.effects):
                effects = model.with_effects(kept)
                left = locate_mismatch(effects.fit, seed=seed)
                chosen = fit_free_form(effects, left, before=base.fit, seed=seed)
                ranking = []
    told = explain_outside(effects, mismatch, ranking, free=chosen, seed=seed)
    if told is None:
        free, last, left = None, effects, mismatch
    else:
        free, last = told
        left = chosen.mismatch
    found = [
        _found(last, n, _place(last, n, kinds, left), find_profiles(last, n, WIDTHS))
        for n in range(len(last.effects))
    ]
    return found, last, left, free


def _better(
    base: Model,
    mismatch: Mismatch,
    model: Model,
    rankings: Mapping[int, list[Rival]],
    seed: int,
) -> tuple[OpenWorld, Model] | None:
    """Nonparametric model by one group of terms, if it explains far more than the effects do."""
    least = base.fit.total - model.fit.total - _critical(model.effects) + FAR_BETTER
    choices = compete(Scene(base), mismatch)
    if not choices or choices[0].score < least:
        return None
    alone = fit_free_form(base, mismatch, seed=seed)
    gain = base.fit.total - alone.model.fit.total - alone.penalty
    explained = explained_by_word(base.fit, alone.model.fit)
    if len(alone.choices) != 1 or gain < least or stands_out(alone.mismatch, explained):
        return None
    return explain_outside(base, alone.mismatch, rankings.get(0, []), free=alone, seed=seed)


def _does_without(base: Model, alone: FreeFit, model: Model, beside: FreeFit) -> bool:
    """Whether nonparametric terms alone explain as much as effects with terms beside them.

    Each term and parameter is charged with what chance gives.  Where both models have as many
    groups, a difference within the error of the predictions (:data:`ACCURACY`) counts as none.
    """
    if not alone.choices:
        return False
    charged = beside.model.fit.total + beside.penalty + _critical(model.effects)
    cost = alone.model.fit.total + alone.penalty - charged
    if len(alone.choices) > len(beside.choices):
        return bool(cost <= 0)
    return bool(cost <= ACCURACY**2 * (base.fit.total - model.fit.total))


def _place(
    model: Model, n: int, kinds: Sequence[type[Effect]], mismatch: Mismatch
) -> list[Rival]:
    """Rank all candidates in the place of one effect of a model."""
    others = [e for k, e in enumerate(model.effects) if k != n]
    without = model.with_effects(others)
    screen = Screen(without.predictor, without.fit, seen_of(mismatch))
    return rank(screen, further(kinds, others))


def _critical(effects: Sequence[Effect]) -> float:
    """Chi-square that as many effects take by chance."""
    return TAKEN * sum(len(fitted(e)) for e in effects)


def _needed(model: Model, base: Model) -> list[Effect]:
    """Effects whose gain nonparametric terms cannot take over."""
    out = []
    for n, effect in enumerate(model.effects):
        others = [e for k, e in enumerate(model.effects) if k != n]
        gain = model.with_effects(others).fit.total - model.fit.total
        alone = base.fit.total - base.with_effects([effect]).fit.total
        if gain > max(_critical([effect]), NEEDED * alone):
            out.append(effect)
    return out


def _found(
    model: Model, n: int, ranking: Sequence[Rival], profiles: Mapping[str, Profile]
) -> Found:
    """One effect of a model, with the candidates that may stand in its place."""
    effect = model.effects[n]
    gain = next((r.gain for r in ranking if r.effect.name == effect.name), np.nan)
    return Found(
        effect, gain, model.errors(n), class_probabilities(ranking),
        tied_classes(effect, ranking), tuple(ranking), profiles,
    )  # fmt: skip


def _settled(model: Model) -> tuple[Model, list[dict[str, Profile]]]:
    """Profiles of all effects' parameters, with a new fit where one finds a lower chi-square."""
    profiles: dict[int, dict[str, Profile]] = {}
    for n in range(len(model.effects)):
        lower, own = settle(model, n, WIDTHS)
        if lower is not model:
            profiles.clear()
        model, profiles[n] = lower, own
    return model, [
        profiles[n] if n in profiles else find_profiles(model, n, WIDTHS)
        for n in range(len(model.effects))
    ]


def _judge(
    model: Model,
    rankings: dict[int, list[Rival]],
    mismatch: Mismatch,
    kinds: Sequence[type[Effect]],
    seed: int,
) -> tuple[list[Found], Model, Mismatch]:
    """Compare each effect with all candidates in its place; remove or replace it where needed."""
    swapped = True
    rounds = 0
    places = dict(rankings)
    # Three rounds are chosen, to be derived: two effects that replace each other in turn would
    # otherwise never end; each round costs as many rankings as there are effects.
    while swapped and len(model.effects) > 1 and rounds < 3:
        swapped, rounds = False, rounds + 1
        for n in range(len(model.effects)):
            others = tuple(e for k, e in enumerate(model.effects) if k != n)
            without = model.with_effects(others)
            gain = without.fit.total - model.fit.total
            if gain < WEAK:
                model, places, swapped = without, {}, True
                break
            screen = Screen(without.predictor, without.fit, seen_of(mismatch))
            ranking = refine(without, rank(screen, further(kinds, others)))
            ranking = places[n] = with_fitted(ranking, model.effects[n], gain)
            here = next(
                (r for r in ranking if r.effect.name == model.effects[n].name), None
            )
            best = ranking[0]
            # A margin of 1 in the logarithm of the evidence, chosen, to be derived, prevents a
            # swap between candidates whose evidences differ by less than their approximation.
            if best.effect.name != model.effects[n].name and (
                here is None or best.evidence > here.evidence + 1.0
            ):
                other = without.with_effects((*others, best.effect))
                if other.fit.total < model.fit.total:
                    model, places, swapped = other, {}, True
                    break
    last = model
    model, profiles = _settled(model)
    if model.effects and (rounds or model is not last):
        mismatch = locate_mismatch(model.fit, seed=seed)
    out = [_found(model, n, places.get(n, []), own) for n, own in enumerate(profiles)]
    return out, model, mismatch
