"""What an attribution says: effects with their rivals, probabilities, ties and intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bfsensor.diagnose.detect.candidate_screen import Rival
from bfsensor.diagnose.detect.locate import Mismatch
from bfsensor.diagnose.explain.nonparametric import OpenWorld
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.fit.likelihood_profile import Profile
from bfsensor.diagnose.fit.local_likelihood import linear_interval
from bfsensor.diagnose.model.effect_parameters import widened
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.effect import Effect, Parameter

TIED = 3.0
"""Difference of the log-likelihood from the best within which a rival cannot be told apart."""

ALIKE = 0.95
"""Cosine between templates from which on rivals are of one class."""

OUTSIDE = 0.02
"""Prior probability that what a clean fit explains is none of the library after all (assumed)."""

OUTSIDE_WORD = "outside_library"
"""Class of what no effect of the library is."""


FAILS = 25.0
"""Increase of a channel's chi-square, of values that were not fitted, beyond which what was found is
said to fail there; of 165 concealed trials two had more than 12, both of fits gone astray."""

WIDENED = 1.12
"""Factor on standard errors: of 141 parameters of concealed trials 68 % were within it, by errors of
linear fits 63 % were (closed forms, shapes that bend and tails are left out of these)."""


LEVELS = {"68": 1.0, "95": 1.96}
"""Half widths of intervals, in standard errors of a Gaussian."""


@dataclass(frozen=True, eq=False)
class Found:
    """One effect of an attribution.

    Attributes
    ----------
    effect : Effect
        With its best parameters.
    gain : float
        Increase of the chi-square when it is left out.
    errors : dict of str to float
        Standard errors of the fitted parameters.
    probability : dict of str to float
        Of each class word in its place.
    tied : tuple of str
        Classes that cannot be told from it, its own first.
    rivals : tuple of Rival
        Best of each kind in its place, best first.
    profiles : mapping of str to Profile
        Of parameters whose chi-square is no parabola.
    """

    effect: Effect
    gain: float
    errors: dict[str, float]
    probability: dict[str, float]
    tied: tuple[str, ...]
    rivals: tuple[Rival, ...] = ()
    profiles: Mapping[str, Profile] = field(default_factory=dict)

    def intervals(self, scale: float = WIDENED) -> dict[str, dict[str, Any]]:
        """Values with intervals of 68 and 95 %, as report.json has them.

        Of parameters with a profile they end where the chi-square has risen by as much as
        errors, widened, say; 'open68' and 'open95' list ends, 'lo' or 'hi', that it does not
        reach within the range of fits, 'stopped68' and 'stopped95' those of them that lie inside
        it: beyond nothing could be predicted, or the chi-square hardly rose.  Of all others see
        :func:`linear_interval`.

        Parameters
        ----------
        scale : float
            Factor on errors.
        """
        out = {}
        for p in self.effect.parameters:
            value = self.effect[p.name]
            told = {"value": value}
            if p.name in self.errors:
                for level, width in LEVELS.items():
                    told |= self._interval(p, level, scale * width)
            out[p.name] = told
        return out

    def _interval(self, p: Parameter, level: str, width: float) -> dict[str, Any]:
        """Ends of one interval; 'open95' and the like name those that were not reached."""
        keys = f"lo{level}", f"hi{level}"
        if p.name not in self.profiles:
            ends = linear_interval(self.effect[p.name], width * self.errors[p.name], p)
            return dict(zip(keys, ends, strict=True))
        low, high, *closed = self.profiles[p.name].interval(width)
        # The fit may have ended a little off the lowest place.
        low, high = min(low, self.effect[p.name]), max(high, self.effect[p.name])
        told: dict[str, Any] = dict(zip(keys, (low, high), strict=True))
        open_ = [k for k, c in zip(("lo", "hi"), closed, strict=True) if not c]
        limits = dict(zip(("lo", "hi"), widened(p), strict=True))
        near = 1e-6 * (limits["hi"] - limits["lo"])
        stopped = [k for k in open_ if abs(told[f"{k}{level}"] - limits[k]) > near]
        return (
            told
            | ({f"open{level}": open_} if open_ else {})
            | ({f"stopped{level}": stopped} if stopped else {})
        )


@dataclass(frozen=True, eq=False)
class Attribution:
    """What explains a mismatch.

    Attributes
    ----------
    found : tuple of Found
        Effects, the one that explains most first; empty where none does.
    fit : BaselineFit
        With them.
    predictor : Predictor
        Of that fit.
    mismatch : Mismatch
        What is left with them.
    open_world : bool
        Whether something is left that no effect of the library explains.
    heldout : dict of str to (float, float, int)
        Chi-square before and after, and number of values, by channel, of what was not fitted.
    notes : tuple of str
        How it went.
    free_form : OpenWorld, optional
        Model of what is outside the library, in ``fit``.
    """

    found: tuple[Found, ...]
    fit: BaselineFit
    predictor: Predictor
    mismatch: Mismatch
    open_world: bool
    heldout: dict[str, tuple[float, float, int]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    free_form: OpenWorld | None = None

    @property
    def probability(self) -> dict[str, float]:
        """Of each class to be among what was left out, most probable first."""
        out: dict[str, float] = {}
        for found in self.found:
            for word, p in found.probability.items():
                out[word] = 1 - (1 - out.get(word, 0.0)) * (1 - p)
        named = out.pop(OUTSIDE_WORD, 0.0)
        sure = self.open_world and not any(
            f.effect.word == OUTSIDE_WORD for f in self.found
        )
        outside = max(0.9 if sure else OUTSIDE, named)
        if not self.found:
            return {OUTSIDE_WORD: 1.0} if self.open_world else {}
        scaled = {w: p * (1 - outside) for w, p in out.items()}
        scaled[OUTSIDE_WORD] = outside
        return dict(sorted(scaled.items(), key=lambda t: -t[1]))

    @property
    def tied(self) -> list[str]:
        """Classes that may be what was left out."""
        words = [w for f in self.found for w in f.tied]
        if self.open_world:
            words.append(OUTSIDE_WORD)
        return list(dict.fromkeys(words))

    def chi2dof(self) -> tuple[float, float]:
        """Chi-square over number of all values that were not fitted, before and after."""
        count = sum(n for *_, n in self.heldout.values())
        if not count:
            return np.nan, np.nan
        before, after = (sum(v[k] for v in self.heldout.values()) for k in (0, 1))
        return before / count, after / count

    @property
    def fails_in(self) -> tuple[str, ...]:
        """Channels that were not fitted and are described worse than without any effect.

        By more than :data:`FAILS`: by chance a parameter that was fitted costs 1.
        """
        return tuple(
            w for w, (before, after, _) in self.heldout.items() if after - before > FAILS
        )


def class_probabilities(
    ranking: Sequence[Rival], temperature: float = 1.0
) -> dict[str, float]:
    """Of each class in one place: evidence over the sum of all, variants of a class together."""
    if not ranking:
        return {}
    z = np.array([r.evidence for r in ranking]) / temperature
    # Variants share their class's prior.
    counts = {w: sum(r.word == w for r in ranking) for w in {r.word for r in ranking}}
    weights = np.exp(z - z.max()) / np.array([counts[r.word] for r in ranking])
    out: dict[str, float] = {}
    for rival, w in zip(ranking, weights / weights.sum(), strict=True):
        out[rival.word] = out.get(rival.word, 0.0) + float(w)
    return {w: p for w, p in out.items() if p > 1e-4}


def tied_classes(effect: Effect, ranking: Sequence[Rival]) -> tuple[str, ...]:
    """Classes that cannot be told from an effect, its own first."""
    own = next((r for r in ranking if r.effect.name == effect.name), None)
    words = [effect.word]
    if own is not None:
        for rival in ranking:
            close = 0.5 * (own.gain - rival.gain) < TIED
            if close or (_cosine(own, rival) > ALIKE and own.gain - rival.gain < 4 * TIED):
                words.append(rival.word)
    return tuple(dict.fromkeys(words))


def _cosine(one: Rival, other: Rival) -> float:
    a, b = one.template, other.template
    norm = np.sqrt((a @ a) * (b @ b))
    return float(abs(a @ b) / norm) if norm else 0.0
