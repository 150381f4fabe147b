"""Stepwise attribution: effects, their laws and nonparametric terms are added while one score falls."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from bfsensor.diagnose.detect.candidate_screen import Rival, Screen
from bfsensor.diagnose.detect.candidates import (
    REFITTED,
    candidates_of,
    concerned,
    further,
    name_of,
    rank,
    refine,
    seen_of,
    tellable,
    with_fitted,
    with_hypotheses,
)
from bfsensor.diagnose.detect.locate import Mismatch, locate_mismatch
from bfsensor.diagnose.detect.matched_filters import locate_effects
from bfsensor.diagnose.detect.model_error import SAME, charge, left_by_word, stands_out
from bfsensor.diagnose.explain.attribution import (
    LEVELS,
    OUTSIDE_WORD,
    Attribution,
    Found,
    class_probabilities,
    scale_of,
    tied_classes,
)
from bfsensor.diagnose.explain.explanation import Explanation, Part
from bfsensor.diagnose.explain.law_terms import OwnChange, law_choices
from bfsensor.diagnose.explain.nonparametric import (
    MOST_GROUPS,
    FreeFit,
    OpenWorld,
    compete,
    explain_outside,
)
from bfsensor.diagnose.explain.pursuit import Choice
from bfsensor.diagnose.explain.solved_again import Resolver
from bfsensor.diagnose.explain.terms import Scene
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.fit.fitted_model import Model, compare_held_out
from bfsensor.diagnose.fit.likelihood_profile import Profile, find_profiles, settle
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.exchanged_axes import NAMED
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect
from bfsensor.effects.family import EffectFamily
from bfsensor.errors import ConvergenceError
from bfsensor.typing import FloatArray

MOST = 4
"""Largest number of effects that are added one after another; a mismatch beyond is left over.
Chosen: twice as many double the longest search, and change only campaigns with five or more effects."""

FAINT = 2
"""Number of candidates whose gain is below the charge of the best of all that are fitted where no
addition is above it.  Chosen: twice as many cost two more fits and find faint effects whose templates
rank third or fourth."""


LONGEST = 300.0
"""CPU seconds of a search after which nothing more is added or exchanged, and a note states it.  Chosen:
of 50 campaigns of an independent bench 42 took less than 190, reading included, and three had not ended
after 540 to 770; with twice as many, these three have a few more effects or terms.  Reports of
searches that end by it differ between machines of different speed; all others do not."""


def attribute(
    predictor: Predictor,
    fit: BaselineFit,
    mismatch: Mismatch,
    *,
    kinds: Sequence[EffectFamily] | None = None,
    seed: int = 1,
) -> Attribution:
    """Find the effects that explain the residuals of a baseline.

    Three kinds of additions compete at each step: an effect of the library, another law of an
    effect that was found (its own change times functions of the channels' coordinates), and a group
    of nonparametric terms.  Each has one score, its gain in chi-square less what the best of all that
    was tried gains by chance (:func:`~bfsensor.diagnose.detect.model_error.charge`); of an effect's
    gain counts only what errors of the effects found before cannot make.  The best one whose score is
    positive, and whose channels agree no worse on held-out recordings, is added, everything is
    refitted, and all channels are scanned and the library asked again, until nothing stands out beyond
    the errors of the predictions.

    At the end every effect is taken out once: it stays if its gain exceeds its charge, and is
    replaced where another one scores better.  An effect whose law takes more than the effect
    itself is not named.

    What nonparametric terms describe is outside the library unless the effects' own predictions,
    wrong by at most half of themselves in every value, may make it: then it is a part of the
    effect by another law.

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
        Seed of the noise draws that p-values come from.

    Returns
    -------
    Attribution
        Effects found, possibly none, with the fit that includes them.
    """
    kinds = candidates_of(predictor.baseline) if kinds is None else kinds
    kinds = tellable(kinds, predictor, fit.channels)
    base = Model(predictor, fit)
    notes: list[str] = []
    resolver = Resolver(predictor.baseline.solver, notes)
    search = _Search((*kinds, *NAMED), seed, mismatch, notes, resolver=resolver)
    empty = Explanation(base, base, mismatch, max(len(kinds), 1), search.locate)
    found, places = search.finished(*search.forward(empty))
    return _attribution(found, places, search)


@dataclass(eq=False)
class _Search:
    """Candidates of a search, its mismatch, notes, effects beside the first terms, and refused ones.

    ``joint`` holds the joint fits of the present step by candidate, ``before`` candidates as they
    were fitted last by their class, and ``ends`` is the CPU time of the process at which nothing more
    is added.
    """

    kinds: Sequence[EffectFamily]
    seed: int
    first: Mismatch
    notes: list[str]
    nearest: list[Rival] = field(default_factory=list)
    refused: set[str] = field(default_factory=set)
    ends: float = field(default_factory=lambda: time.process_time() + LONGEST)
    joint: dict[Effect, Model] = field(default_factory=dict)
    before: dict[EffectFamily, Effect] = field(default_factory=dict)
    resolver: Resolver = field(default_factory=lambda: Resolver(None))

    def locate(self, model: Model) -> Mismatch:
        """Find what stands out in a model's residuals, by scans and by effects not in it."""
        return locate_effects(model.predictor, model.fit, self.kinds, seed=self.seed)

    def forward(self, now: Explanation) -> tuple[Explanation, dict[str, list[Rival]]]:
        """Add what scores best while anything stands out; rankings are by name of the effect."""
        places: dict[str, list[Rival]] = {}
        # Terms only take what is left: effects that gained nothing before them gain nothing behind
        # them, and all are asked again where nothing else can be added.
        asked: list[EffectFamily] | None = None
        while now.mismatch.detected and not self._late():
            step = self._step(now, asked)
            if step is None and asked is not None:
                step = self._step(now)
            if step is None:
                break
            after, ranking = step
            asked = None
            if len(after.parts) > len(now.parts):
                places[after.parts[-1].name] = ranking
            else:
                asked = [r.effect.family for r in ranking if self._beyond_chance(now, r)]
            if not now.free and after.free:
                self.nearest = ranking
            now = after
            wrong = [
                n
                for n, p in enumerate(now.parts)
                if sum(p.by_law.values()) > sum(p.own.values())
            ]
            if wrong:
                # What remains of such an effect is its place alone, which terms describe without it.
                self.refused |= {now.parts[n].name for n in wrong}
                for n in reversed(wrong):
                    now = now.without(n)
                now, asked = now.located(), None
        return now, {n: r for n, r in places.items() if n in [p.name for p in now.parts]}

    def _late(self) -> bool:
        """Whether the time of the search is over; a note states it once."""
        note = (
            f"the search for effects was ended after {LONGEST:g} CPU seconds: more effects, or others "
            "in place of those that are named, were not looked for"
        )
        late = time.process_time() > self.ends
        if late and note not in self.notes:
            self.notes.append(note)
        return late

    def _step(
        self, now: Explanation, asked: Sequence[EffectFamily] | None = None
    ) -> tuple[Explanation, list[Rival]] | None:
        """The best addition that holds, with the ranking of effects; None if none does.

        ``asked`` are the effects that are ranked, by default all.
        """
        ranking = self._ranked(now, asked) if len(now.parts) < MOST else []
        # What errors of predictions may leave asks for no further terms, but an effect elsewhere in
        # the same channels may be in it.
        more = now.stands_out()
        laws = [
            (n, choice) for n, part in enumerate(now.parts)
            if more and part.change is not None
            for choice in law_choices(part.change, now.model.fit, part.law_terms())
        ]  # fmt: skip
        free = (
            [c for c in compete(Scene(now.model), now.mismatch) if not _taken(c, now)]
            if more and len(now.free) < MOST_GROUPS else []
        )  # fmt: skip
        good = [r for r in ranking if self._beyond_chance(now, r)][:REFITTED]
        extra = {r.effect.name: _law_score(now, r) for r in good}
        best = free[0].score if free else 0.0
        law = max((c.score for _, c in laws), default=0.0)
        # Terms that fit better do not replace an effect, or its law, that is wrong by less than
        # half in norm.
        near = (1 - SAME**2) * best
        options: list[tuple[float, float, Callable[[], Explanation]]] = [
            (c.score, near, partial(now.with_law, n, c)) for n, c in laws
        ]
        ranking, reached = _with_laws(ranking, extra), 0.0
        for rival in reversed([r for r in ranking if r.effect.name in extra]):
            score = self._net(now, rival) - now.charge(rival.effect)
            # An effect beside others must beat their laws by itself, not with a law of its own.
            if score > 0 and (not now.parts or score >= law):
                # Effects are tried in the order of their evidence.
                reached = max(reached, score + rival.law)
                needed = near * _where(now, rival, free[0]) if free else 0.0
                options.append((reached, needed, self._adding(now, rival)))
        options.reverse()
        options.sort(key=lambda o: -o[0])
        first = [o for o in options if o[0] >= o[1]]
        if free and not first:
            faint = self._faint(now, ranking, sum(z * z for z in free[0].z))
            if faint is not None:
                return faint
        terms = [(c.score, near, partial(now.with_free, c)) for c in free[:1]]
        options = [*first, *terms, *(o for o in options if o[0] < o[1])]
        for *_, add in options:
            after = self._tried(now, add)
            if after is not None:
                return after, ranking
        return self._faint(now, ranking)

    def _adding(self, now: Explanation, rival: Rival) -> Callable[[], Explanation]:
        """Addition of a candidate, by its joint fit where one was made."""
        return partial(self._added, now, rival.effect, self.joint.get(rival.effect))

    def _added(
        self, now: Explanation, effect: Effect, model: Model | None = None
    ) -> Explanation:
        """Add an effect; a quantity of the device is solved at its fitted value first."""
        if self.resolver.acts(effect):
            model = model or now.model.with_effects((*now.model.effects, effect))
            model = self.resolver.model(model, len(model.effects) - 1)
            effect = model.effects[-1]
            self._renew(effect)
        return now.with_effect(effect, model)

    def _renew(self, effect: Effect) -> None:
        """Let further fits of a quantity of the device begin from its newest solution."""
        self.kinds = [effect.family if name_of(k) == effect.name else k for k in self.kinds]

    def _net(self, now: Explanation, rival: Rival) -> float:
        """Gain of a candidate that errors of what was added before cannot make."""
        if rival.effect.scatters:
            return max(rival.gain - now.reach(rival.effect.touches), 0.0)
        return now.net(rival.gain, rival.template)

    def _beyond_chance(self, now: Explanation, rival: Rival) -> bool:
        """Whether a candidate gains more than one of its kind does by chance."""
        return self._net(now, rival) > charge(len(fitted(rival.effect)), 1)

    def _ranked(
        self, now: Explanation, asked: Sequence[EffectFamily] | None = None
    ) -> list[Rival]:
        """Effects that may be added, by decreasing evidence; those of the closest gains fitted."""
        screen = Screen(
            now.model.predictor, now.model.fit, seen_of(now.mismatch), self.before
        )
        kinds = further(concerned(self.kinds, now.mismatch), now.model.effects)
        kinds = kinds if asked is None else [k for k in kinds if k in asked]
        ranked = rank(screen, kinds)
        self.before |= {r.effect.family: r.effect for r in ranked if r.gain > 0}
        ranking = with_hypotheses(now.model, kinds, ranked)
        self.notes += [
            f"{name}, tried at one place: {why}" for name, why in screen.passed_over.items()
        ]
        ranking = [
            r for r in ranking if not r.refuted and r.effect.name not in self.refused
        ]
        # Only effects whose gain is beyond chance are worth a joint fit.
        good = [r for r in ranking if self._beyond_chance(now, r)]
        others = [r for r in ranking if r not in good]
        self.joint.clear()
        good = refine(now.model, good, self.joint) if good else []
        solved: list[Rival] = []
        for rival in good:
            solved.append(
                self._solved(now, rival, max([r.gain for r in solved], default=0.0))
            )
        return sorted([*solved, *others], key=lambda r: -r.evidence)

    def _solved(self, now: Explanation, rival: Rival, best: float) -> Rival:
        """A candidate that was fitted jointly, with its gain after the device was solved there.

        ``best`` is the largest gain of others.
        """
        model = self.joint.get(rival.effect)
        if model is None or not self.resolver.acts(rival.effect):
            return rival
        try:
            again = self.resolver.model(
                model, len(model.effects) - 1, now.model.fit.total - best
            )
        except ConvergenceError as error:
            self.notes.append(f"{rival.effect.name}: {error}")
            return rival
        if again is model:
            return rival
        effect = again.effects[-1]
        self.joint[effect] = again
        self._renew(effect)
        gain = now.model.fit.total - again.fit.total
        return replace(
            rival, effect=effect, gain=gain,
            evidence=rival.evidence + 0.5 * (gain - rival.gain),
        )  # fmt: skip

    def _tried(
        self, now: Explanation, add: Callable[[], Explanation]
    ) -> Explanation | None:
        """An addition, if its fit converges, its score falls, and held-out recordings agree."""
        try:
            after = add()
        except ConvergenceError as error:
            self.notes.append(str(error))
            return None
        if after.score >= now.score or not holds(now, after):
            return None
        return after

    def _faint(
        self, now: Explanation, ranking: Sequence[Rival], least: float = 0.0
    ) -> tuple[Explanation, list[Rival]] | None:
        """An effect whose gain alone is beyond chance, and at least ``least``, that leaves nothing.

        The mismatch is beyond noise already, so that one candidate is not charged for the others
        where it takes all of it, as much as nonparametric terms take.
        """
        good = [
            r for r in ranking
            if self._net(now, r) > max(now.charge(r.effect, 1), least)
        ]  # fmt: skip
        for rival in good[:FAINT]:
            try:
                after = self._adding(now, rival)()
            except ConvergenceError as error:
                self.notes.append(f"{rival.effect.name}: {error}")
                continue
            if not locate_mismatch(after.model.fit, seed=self.seed).detected:
                return after, list(ranking)
        return None

    def finished(
        self, now: Explanation, places: Mapping[str, list[Rival]]
    ) -> tuple[Explanation, dict[str, list[Rival]]]:
        """Remove effects that the others make needless, and replace those that score worse."""
        out: dict[str, list[Rival]] = dict(places)
        for name in [p.name for p in sorted(now.parts, key=lambda p: sum(p.own.values()))]:
            n = [p.name for p in now.parts].index(name)
            if not now.takes_most(n):
                now = now.without(n).located()
        again = len(now.parts) + len(now.free) > 1 and not _lost(now)
        while again and not self._late():
            again = False
            for n, part in enumerate(now.parts):
                without = now.without(n)
                template = moved(without.model.fit, now.model.fit)
                gain = without.model.fit.total - now.model.fit.total
                if without.net(gain, template) < now.charge(now.model.effects[n]):
                    now, again = without.located(), True
                    break
                law = sum(part.by_law.values())
                ranking = self._in_place(now, without, n, gain - law)
                better, out[part.name] = self._exchanged(now, without, part, ranking)
                if better is not None:
                    now, again = better, True
                    break
        return now, out

    def _exchanged(
        self, now: Explanation, without: Explanation, part: Part, ranking: list[Rival]
    ) -> tuple[Explanation | None, list[Rival]]:
        """An explanation that scores better with another effect in one's place, and the ranking there.

        Candidates of more evidence are fitted jointly. One that scores worse has the gain of its joint
        fit, below that of the effect; one whose fit does not converge has no place in the ranking.
        """
        own = next((r for r in ranking if r.effect.name == part.name), None)
        law = sum(part.by_law.values())
        above = [r for r in ranking if own is None or r.evidence > own.evidence]
        for rival in above[:REFITTED]:
            ranking = [r for r in ranking if r is not rival]
            try:
                other = self._added(without, rival.effect)
                # Without its laws: others come with what is added to the exchanged one.
                if other.score < now.score + law:
                    other, _ = self.forward(other)
            except ConvergenceError:
                continue
            # The score falls with every exchange, so that the search ends.
            if other.score < now.score:
                return other, ranking
            if own is not None:
                ranking.append(_behind(rival, own, other.score - now.score))
        return None, sorted(ranking, key=lambda r: -r.evidence)

    def _in_place(
        self, now: Explanation, without: Explanation, n: int, gain: float
    ) -> list[Rival]:
        """Rank all candidates in the place of one effect."""
        screen = Screen(
            without.model.predictor, without.model.fit, seen_of(self.first), self.before
        )
        kinds = concerned(self.kinds, self.first, now.mismatch)
        ranking = rank(screen, further(kinds, without.model.effects))
        name = now.parts[n].name
        ranking = [r for r in ranking if not r.refuted or r.effect.name == name]
        ranking = with_fitted(ranking, now.model.effects[n], gain)
        good = ranking[:REFITTED]
        return _with_laws(ranking, {r.effect.name: _law_score(without, r) for r in good})


def _lost(now: Explanation) -> bool:
    """Whether more stands out that nothing describes than effects take: exchanges would follow it."""
    shares = now.shares(())
    return now.mismatch.detected and shares["left"] > shares["effects"]


def _behind(rival: Rival, own: Rival, worse: float) -> Rival:
    """A candidate whose joint fit scores worse than that of the effect it would replace."""
    return replace(
        rival,
        gain=min(rival.gain, own.gain - worse),
        evidence=min(rival.evidence, own.evidence - 0.5 * worse),
    )


def holds(before: Explanation, after: Explanation) -> bool:
    """Whether held-out recordings agree no worse than chance makes them.

    The chi-square of the held-out values of all channels may rise by no more than one parameter gains
    by chance: what is added was not fitted to them, and must be there.
    """
    squares = compare_held_out(before.model, after.model)
    return sum(b - a for a, b, _ in squares.values()) <= charge(1, 1)


def moved(before: BaselineFit, after: BaselineFit) -> FloatArray:
    """Whitened change of all values between two fits, zero in the rows of the priors of the first."""
    out = np.zeros(len(before.left))
    out[: len(before.residuals)] = before.residuals - after.residuals
    return out


def _taken(choice: Choice, now: Explanation) -> bool:
    """Whether all terms of a choice are in the model already."""
    there = {t.name for c, *_ in now.free for t in c.terms}
    return all(t.name in there for t in choice.terms)


def _where(now: Explanation, rival: Rival, choice: Choice) -> float:
    """Share of the gain of terms in the channels where an effect acts, at least SAME squared.

    Terms that act in more channels than an effect leave the others to other effects.
    """
    fit, least = now.model.fit, charge(1, 1)
    words = {
        w for w in dict.fromkeys(c.word for c in fit.channels)
        if float(np.square(rival.template[: len(fit.residuals)][fit.of(w)]).sum()) > least
    }  # fmt: skip
    taken = choice.template[: len(fit.residuals)]
    inside = sum(float(np.square(taken[fit.of(w)]).sum()) for w in words)
    whole = float(taken @ taken)
    return max(inside / whole, SAME**2) if words and whole else 1.0


def _law_score(now: Explanation, rival: Rival) -> float:
    """Score of the laws that a candidate would need, to first order; 0 if they take more than it."""
    fit = now.model.fit
    left = fit.left - rival.template
    length = float(np.sqrt(rival.template @ rival.template))
    if not length or not any(
        left_by_word(fit, left).get(w, 0.0) for w in rival.effect.touches
    ):
        return 0.0
    beside = replace(
        fit, left=left, basis=np.column_stack([fit.basis, rival.template / length])
    )
    effects = (*now.model.effects, rival.effect)
    change = OwnChange(now.model.predictor, fit.values, effects)
    choices = law_choices(change, beside)
    gain = sum(z * z for c in choices for z in c.z)
    if gain > rival.gain:
        return 0.0
    # Laws cannot take more than the effect leaves above noise where it acts: templates of curves,
    # whose parameters reached the ends of their ranges, leave more than their joint fits.
    rows = np.any([fit.of(w) for w in rival.effect.touches], axis=0)
    above = float(fit.residuals[rows] @ fit.residuals[rows]) - int(rows.sum())
    return float(np.clip(sum(c.score for c in choices), 0.0, max(above - rival.gain, 0.0)))


def _with_laws(ranking: Sequence[Rival], scores: Mapping[str, float]) -> list[Rival]:
    """Ranking with the scores of other laws, by name of the effect.

    Laws decide where they make what an effect explains more than a quarter less than what another
    one does (the square of an error by half), and between effects that explain as much by
    themselves; otherwise the effect counts as it is.
    """
    ranking = [replace(r, law=scores.get(r.effect.name, 0.0)) for r in ranking]
    enough = (1 - SAME**2) * max((r.gain + r.law for r in ranking), default=0.0)
    out = [
        replace(
            r,
            evidence=r.evidence
            - 0.5 * max(enough - r.gain - r.law, 0.0)
            + 0.5 * min(r.law, charge(1, 1)),
        )
        for r in ranking
    ]
    return sorted(out, key=lambda r: -r.evidence)


def _attribution(
    now: Explanation, places: Mapping[str, list[Rival]], search: _Search
) -> Attribution:
    """Settle the fit, and state what was found, what is left, and what is outside the library."""
    outside = [c for c, *_ in now.free if not now.same(c)]
    last = search.resolver.settled(now.model)
    free: OpenWorld | None = None
    scales = [scale_of(sum(part.own.values())) for part in now.parts]
    model, profiles = _settled(last, scales)
    mismatch = (
        now.mismatch if model is now.model else locate_mismatch(model.fit, seed=search.seed)
    )
    if now.free:
        choices = tuple(c for c, *_ in now.free)
        scores = {c.family.group: c.score for c in choices}
        told = explain_outside(
            now.plain(), mismatch, search.nearest,
            free=FreeFit(model, choices, scores, mismatch), seed=search.seed,
        )  # fmt: skip
        free = told[0] if told is not None else None
    explained = {w: max(c, now.of_effects(w)) for w, c in now.explained().items()}
    left = stands_out(mismatch, explained, dict.fromkeys(explained, SAME), library=False)
    nothing = not now.parts and mismatch.detected
    found = [
        _found(model, n, places.get(part.name, []), own, scales[n])
        for n, (part, own) in enumerate(zip(now.parts, profiles, strict=True))
    ]
    named = any(f.effect.word == OUTSIDE_WORD for f in found)
    return Attribution(
        found=tuple(sorted(found, key=lambda f: -f.gain)),
        fit=model.fit,
        predictor=model.predictor,
        mismatch=mismatch,
        open_world=bool(outside) or left or nothing or named,
        heldout=compare_held_out(now.base, model),
        notes=tuple(search.notes),
        free_form=free,
        shares=now.shares(outside),
        touched=now.touched(),
    )


def _found(
    model: Model,
    n: int,
    ranking: Sequence[Rival],
    profiles: Mapping[str, Profile],
    scale: float,
) -> Found:
    """One effect of a model, with the candidates that may stand in its place."""
    effect = model.effects[n]
    gain = next((r.gain for r in ranking if r.effect.name == effect.name), np.nan)
    return Found(
        effect, gain, model.errors(n), class_probabilities(ranking),
        tied_classes(effect, ranking), tuple(ranking), profiles, scale,
    )  # fmt: skip


def _settled(
    model: Model, scales: Sequence[float]
) -> tuple[Model, list[dict[str, Profile]]]:
    """Profiles of all effects' parameters, with a new fit where one finds a lower chi-square.

    ``scales`` are factors on the standard errors of each effect at which intervals end.
    """
    widths = [[scale * w for w in LEVELS.values()] for scale in scales]
    profiles: dict[int, dict[str, Profile]] = {}
    for n in range(len(model.effects)):
        lower, own = settle(model, n, widths[n])
        if lower is not model:
            profiles.clear()
        model, profiles[n] = lower, own
    return model, [
        profiles[n] if n in profiles else find_profiles(model, n, widths[n])
        for n in range(len(model.effects))
    ]
