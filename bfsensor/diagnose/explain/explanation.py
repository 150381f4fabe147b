"""An explanation of a mismatch: effects with their laws and nonparametric terms, judged by one score."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bfsensor.diagnose.detect.locate import Mismatch
from bfsensor.diagnose.detect.model_error import (
    ACCURACY,
    SAME,
    charge,
    explained_by_word,
    left_by_word,
    overlap,
    stands_out,
)
from bfsensor.diagnose.explain.law_terms import OwnChange
from bfsensor.diagnose.explain.nonparametric import Columns
from bfsensor.diagnose.explain.pursuit import Choice
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.effects.effect import Effect
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Part:
    """One effect, or one group of nonparametric terms, of an explanation.

    Attributes
    ----------
    name : str
        Name of the effect, or of the group.
    change : OwnChange or None
        The effect's own change of the predictions when it was added; None of a group of terms.
    white : ndarray, shape (n,)
        That change, whitened.
    own : mapping of str to float
        Decrease of the chi-square by the effect, by channel.
    laws : tuple of (Choice, Columns)
        Terms of another law.
    by_law : mapping of str to float
        Decrease of the chi-square by these terms, by channel.
    """

    name: str
    change: OwnChange | None
    white: FloatArray
    own: Mapping[str, float]
    laws: tuple[tuple[Choice, Columns], ...] = ()
    by_law: Mapping[str, float] = field(default_factory=dict)

    def law_terms(self) -> frozenset[str]:
        """Names of the terms that are in the model."""
        return frozenset(t.name for c, _ in self.laws for t in c.terms)

    def errors(self, left: Mapping[str, float]) -> dict[str, float]:
        """Relative error of the effect's prediction by channel, 0.02 to 1.

        Where a law corrects the prediction by a relative square L / E, it is expected to be wrong
        by the same factor once more; what is still left above noise is an error as it stands.

        Parameters
        ----------
        left : mapping of str to float
            Chi-square above noise by channel.
        """
        out = {}
        for word, own in self.own.items():
            if own <= 0:
                continue
            law = self.by_law.get(word, 0.0) / own
            rest = np.sqrt(left.get(word, 0.0) / own)
            out[word] = float(np.clip(max(law, rest), ACCURACY, 1.0))
        return out


@dataclass(frozen=True, eq=False)
class Explanation:
    """A fitted model, what it is made of, and the residuals that stand out.

    Attributes
    ----------
    base : Model
        The baseline without effects.
    model : Model
        The fit of all together.
    mismatch : Mismatch
        Its residuals.
    tried : int
        Number of classes of effects that each effect was the best of.
    parts : tuple of Part
        Effects, in the model's order.
    free : tuple of (Choice, Columns, Part)
        Groups of nonparametric terms beside the effects' laws.
    locate : callable
        Finds what stands out in a model's residuals.
    """

    base: Model
    model: Model
    mismatch: Mismatch
    tried: int
    locate: Callable[[Model], Mismatch]
    parts: tuple[Part, ...] = ()
    free: tuple[tuple[Choice, Columns, Part], ...] = ()

    @property
    def score(self) -> float:
        """Chi-square of the fit plus all charges: the smaller, the better."""
        effects = sum(self.charge(e) for e in self.model.effects)
        laws = sum(penalty(c) for p in self.parts for c, _ in p.laws)
        return (
            self.model.fit.total + effects + laws + sum(penalty(c) for c, *_ in self.free)
        )

    def charge(self, effect: Effect, tried: int | None = None) -> float:
        """Chi-square that the best of all classes of effects gains by chance, at all their starts.

        Starts are places, periods or bits that were tried.  ``tried`` are the classes, by default all.
        """
        layout = self.model.predictor.layout
        starts = effect.family.starts(replace(layout, sightings=()))
        tried = self.tried if tried is None else tried
        number = len(fitted(effect)) + effect.searched(layout)
        return charge(number, tried * max(len(starts), 1))

    def stands_out(self) -> bool:
        """Whether residuals are beyond noise and beyond the errors of the effects' predictions."""
        return stands_out(self.mismatch, self.explained(), self.errors())

    def explained(self) -> dict[str, float]:
        """Decrease of the chi-square by channel, of all that was added."""
        return explained_by_word(self.base.fit, self.model.fit)

    def errors(self, left: Mapping[str, float] | None = None) -> dict[str, float]:
        """Relative error of the predictions by channel, the largest of all effects."""
        out: dict[str, float] = {}
        for part in self.parts:
            for word, error in part.errors(left or {}).items():
                out[word] = max(out.get(word, ACCURACY), error)
        return out

    def bound(self, template: FloatArray) -> float:
        """Deviate that errors of what was added before may give a template, which is then fitted."""
        fit = self.model.fit
        left = left_by_word(fit, fit.left - template)
        before = (*self.parts, *(part for *_, part in self.free))
        return sum(overlap(fit, template, p.white, p.errors(left)) for p in before)

    def reach(self, words: Sequence[str]) -> float:
        """Chi-square that errors of what was added before may leave in some channels, at most."""
        left = left_by_word(self.model.fit)
        return sum(
            error**2 * part.own[word]
            for part in (*self.parts, *(p for *_, p in self.free))
            for word, error in part.errors(left).items() if word in words
        )  # fmt: skip

    def takes_most(self, n: int) -> bool:
        """Whether the n-th effect explains more than is left above noise in the channels where it acts.

        What is left is weighted by the effect's gain in each channel.
        """
        own, left = self.parts[n].own, left_by_word(self.model.fit)
        total = sum(own.values())
        return total**2 > sum(gain * left.get(word, 0.0) for word, gain in own.items())

    def net(self, gain: float, template: FloatArray) -> float:
        """Part of a gain that errors of the effects' predictions cannot make."""
        return max(float(np.sqrt(max(gain, 0.0))) - self.bound(template), 0.0) ** 2

    def same(self, choice: Choice) -> bool:
        """Whether what nonparametric terms describe may be an effect of the explanation by another law.

        It may if an error of :data:`~bfsensor.diagnose.detect.model_error.SAME` of all that effects
        of its channels explain gives as much, or one of at most that part of the effects' own
        changes, value by value.
        """
        fit, template = self.model.fit, choice.template
        length = float(np.sqrt(template @ template))
        by_value = sum(
            overlap(fit, template, p.white, dict.fromkeys(p.own, SAME)) for p in self.parts
        )
        by_law = SAME**2 * sum(self.of_effects(w) for w in choice.family.words)
        return bool(length < max(by_value, np.sqrt(by_law)))

    def of_effects(self, word: str) -> float:
        """Decrease of the chi-square, in all channels, by the effects that act in one channel.

        The law of an effect may be wrong in a channel where it explains little: the charge that a
        full row spills, the spots of an exposure that remembers the one before.
        """
        acts = [word in e.touches for e in self.model.effects]
        return sum(
            sum(p.own.values()) for p, here in zip(self.parts, acts, strict=True) if here
        )

    def with_effect(self, effect: Effect, model: Model | None = None) -> Explanation:
        """Add an effect, refit everything unless that fit is given, and find what still stands out."""
        model = model or self.model.with_effects((*self.model.effects, effect))
        effects = model.effects
        change = OwnChange(model.predictor, model.fit.values, effects)
        part = Part(
            effects[-1].name, change, change.whitened(model.fit),
            explained_by_word(self.model.fit, model.fit),
        )  # fmt: skip
        return self._to(model, parts=(*self.parts, part))

    def with_law(self, n: int, choice: Choice) -> Explanation:
        """Free the law of the n-th effect in one channel by chosen terms."""
        columns, (word,) = Columns(choice.terms), choice.family.words
        model = self.model.with_columns(columns)
        part = self.parts[n]
        gain = max(self.model.fit.total - model.fit.total, 0.0)
        part = replace(
            part, laws=(*part.laws, (choice, columns)),
            by_law={**part.by_law, word: part.by_law.get(word, 0.0) + gain},
        )  # fmt: skip
        return self._to(model, parts=(*self.parts[:n], part, *self.parts[n + 1 :]))

    def with_free(self, choice: Choice) -> Explanation:
        """Add a group of nonparametric terms."""
        columns = Columns(choice.terms)
        model = self.model.with_columns(columns)
        fit = self.model.fit
        part = Part(
            choice.family.group, None, choice.template[: len(fit.residuals)],
            explained_by_word(fit, model.fit),
        )  # fmt: skip
        return self._to(model, free=(*self.free, (choice, columns, part)))

    def without(self, n: int) -> Explanation:
        """Take the n-th effect and its law out, and refit."""
        parts = (*self.parts[:n], *self.parts[n + 1 :])
        effects = [e for k, e in enumerate(self.model.effects) if k != n]
        gone = [columns for _, columns in self.parts[n].laws]
        predictor = self.model.predictor.without_columns(gone)
        model = Model(predictor, self.model.fit).with_effects(effects)
        return replace(self, model=model, parts=parts)

    def plain(self) -> Model:
        """Fit without the groups of nonparametric terms."""
        gone = [columns for _, columns, _ in self.free]
        predictor = self.model.predictor.without_columns(gone)
        return Model(predictor, self.model.fit).with_effects(self.model.effects)

    def shares(self, outside: Sequence[Choice]) -> dict[str, float]:
        """Parts of the chi-square above noise that were explained by what, and that are left.

        Parameters
        ----------
        outside : sequence of Choice
            Groups of terms that no effect of the explanation may be by another law.

        Returns
        -------
        dict of str to float
            'effects', 'laws' (including terms that may be a law), 'outside' and 'left'; their sum is
            1, or 0 where nothing is above noise.
        """
        free = {id(c): sum(z * z for z in c.z) for c, *_ in self.free}
        beyond = sum(free[id(c)] for c in outside)
        out = {
            "effects": sum(sum(p.own.values()) for p in self.parts),
            "laws": sum(sum(p.by_law.values()) for p in self.parts)
            + sum(free.values()) - beyond,
            "outside": beyond,
            # Channels above their degrees of freedom by chance are not left.
            "left": sum(left_by_word(self.model.fit).values()) if self.mismatch.detected else 0.0,
        }  # fmt: skip
        total = sum(out.values())
        return {k: v / total if total else 0.0 for k, v in out.items()}

    def touched(self) -> tuple[str, ...]:
        """Channels that the effects change by more than one parameter gains by chance."""
        fit, least, out = self.model.fit, charge(1, 1), []
        for word in dict.fromkeys(c.word for c in fit.channels):
            rows = fit.of(word)
            sizes = [float(p.white[rows] @ p.white[rows]) for p in self.parts]
            gains = [p.own.get(word, 0.0) for p in self.parts]
            if max(sizes + gains, default=0.0) > least:
                out.append(word)
        return tuple(out)

    def located(self) -> Explanation:
        """Find again what stands out, after effects were taken out."""
        return replace(self, mismatch=self.locate(self.model))

    def _to(self, model: Model, **changed: object) -> Explanation:
        return replace(self, model=model, mismatch=self.locate(model), **changed)  # type: ignore[arg-type]


def penalty(choice: Choice) -> float:
    """Chi-square that chance gives terms chosen from as many."""
    return float(sum(z * z for z in choice.z) - choice.score)
