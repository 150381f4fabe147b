"""Candidates for what a fit leaves: which there are, which are concerned, which explain most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.detect.candidate_screen import OCCAM, Rival, Screen
from bfsensor.diagnose.detect.locate import ALARM, Mismatch
from bfsensor.diagnose.detect.scans import DEVICE, DEVICE_SEEN
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.exchanged_axes import NAMED
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.device_parameter import device_parameters
from bfsensor.effects.effect import Effect
from bfsensor.effects.library import LIBRARY
from bfsensor.errors import ConvergenceError

CLOSE = 40.0
"""Difference in gain from the best up to which rivals are fitted again with all parameters."""

HOPELESS, FAR = 3.0, 0.05
"""Gain of a candidate's best start below which it is not fitted on, and as a part of the best of
all starts: a fit of its shape makes it a few times as much, not twenty times."""

PULLED = 3.0
"""Distance of a device parameter from its card, in its spread, that is far."""

REFITTED = 5
"""Most rivals that are."""


def candidates_of(baseline: Baseline) -> tuple[type[Effect], ...]:
    """Candidates for what a baseline leaves out: the library, and its card's parameters."""
    own = device_parameters(
        baseline.derivatives_by_condition(), baseline.spread, baseline.nominal
    )
    return (*LIBRARY, *own, *baseline.pieces)


def tellable(
    kinds: Sequence[type[Effect]], predictor: Predictor, channels: Sequence[Channel]
) -> list[type[Effect]]:
    """Candidates that the recordings can tell: reduced ones lack pixels, a_ij alone the level."""
    pixels = bool(predictor.layout.segments)
    levels = any(c.unit != PER_ELECTRON for c in channels)
    return [k for k in kinds if (pixels or not k.of_pixels) and (levels or not k.of_levels)]


def name_of(kind: type[Effect]) -> str:
    """Class, and variant where there are several."""
    return f"{kind.word}:{kind.variant}" if kind.variant else kind.word


def concerned(kinds: Sequence[type[Effect]], *seen: Mismatch) -> list[type[Effect]]:
    """Candidates that touch any channel in which something stands out."""
    words = {f.word for mismatch in seen for f in mismatch.findings}
    words |= set(DEVICE_SEEN) if DEVICE in words else set()
    return [k for k in kinds if words & set(k.touches)]


def further(kinds: Sequence[type[Effect]], effects: Sequence[Effect]) -> list[type[Effect]]:
    """Candidates that are not there already."""
    there = {e.name for e in effects}
    return [k for k in kinds if name_of(k) not in there]


def rank(screen: Screen, kinds: Sequence[type[Effect]]) -> list[Rival]:
    """Best of each kind, greatest evidence first."""
    starts = [screen.tried(kind) for kind in kinds]
    best = max((t[0][0] for t in starts if t), default=0.0)
    least = max(HOPELESS, FAR * best)
    found = [screen.best(t, least=least) for t in starts]
    return sorted((r for r in found if r is not None), key=lambda r: -r.evidence)


def with_hypotheses(
    model: Model, kinds: Sequence[type[Effect]], ranking: Sequence[Rival]
) -> list[Rival]:
    """Fit named hypotheses anew, where device parameters have been pulled far off the card.

    Parameters that imitate a mistake in the baseline hide it from a fit that is linear about
    them: exchanged axes are then exchanged back.  In the full fit they return to the card.
    """
    pulled = any(abs(v) > PULLED for v in model.fit.pulls.values())
    named = [k for k in kinds if k in NAMED] if pulled else []
    out = [r for r in ranking if type(r.effect) not in named]
    for kind in named:
        start = kind({p.name: 0.5 * (p.low + p.high) for p in kind.parameters})
        try:
            other = model.with_effects((*model.effects, start))
        except ConvergenceError:
            continue
        gain = model.fit.total - other.fit.total
        template = model.fit.left - other.fit.left
        out.append(Rival(other.effects[-1], gain, 0.5 * gain - OCCAM, template))
    return sorted(out, key=lambda r: -r.evidence)


def refine(model: Model, ranking: Sequence[Rival]) -> list[Rival]:
    """Fit the closest of a ranking again with all parameters, beyond the first order."""
    best = max(r.gain for r in ranking)
    out = []
    close = [r for r in ranking if best - r.gain < max(CLOSE, 0.02 * best)][:REFITTED]
    for rival in ranking:
        if any(rival is r for r in close) and len(close) > 1:
            try:
                other = model.with_effects((*model.effects, rival.effect))
            except ConvergenceError:
                out.append(rival)
                continue
            gain = model.fit.total - other.fit.total
            out.append(
                Rival(
                    other.effects[-1], gain, rival.evidence + 0.5 * (gain - rival.gain),
                    rival.template, rival.select, rival.share,
                )
            )  # fmt: skip
        else:
            out.append(rival)
    return sorted(out, key=lambda r: -r.evidence)


def with_fitted(ranking: Sequence[Rival], effect: Effect, gain: float) -> list[Rival]:
    """Give an effect that was fitted the gain of its fit, where the search for it ended lower.

    Parameters
    ----------
    ranking : sequence of Rival
        Candidates in its place.
    effect : Effect
        As fitted.
    gain : float
        Decrease of the chi-square by it.
    """
    out = [
        replace(r, effect=effect, gain=gain, evidence=r.evidence + 0.5 * (gain - r.gain))
        if r.effect.name == effect.name and r.gain < gain
        else r
        for r in ranking
    ]
    return sorted(out, key=lambda r: -r.evidence)


def threshold(
    screen: Screen, ranking: Sequence[Rival], *, seed: int, draws: int = 400
) -> float:
    """Gain that noise alone gives the best of all candidates once in a hundred times."""
    templates = np.array([
        r.template / np.sqrt(r.template @ r.template)
        for r in ranking if r.template @ r.template > 0
    ])  # fmt: skip
    extra = max((len(fitted(r.effect)) for r in ranking), default=1) - 1
    if not len(templates):
        return np.inf
    rng = np.random.default_rng(seed)
    largest = []
    for _ in range(draws // 50):
        noise = rng.standard_normal((50, templates.shape[1]))
        largest.append(((noise @ templates.T) ** 2).max(1))
    # Shapes that are fitted follow the noise: each takes about one of it more.
    return float(np.quantile(np.concatenate(largest), 1 - ALARM)) + 2.0 * extra


def seen_of(mismatch: Mismatch) -> list[dict[str, Any]]:
    """What the scans found, farthest first, as effects take it."""
    parts = [*mismatch.parts, *mismatch.findings[:200]]
    return [{**p.where, "word": p.word, "z": p.z, "family": p.family} for p in parts]
