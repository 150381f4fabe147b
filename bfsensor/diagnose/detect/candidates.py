"""Candidate effects: which exist, which touch the deviating channels, and their ranking."""

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
from bfsensor.effects.family import EffectFamily
from bfsensor.effects.library import LIBRARY
from bfsensor.effects.quantum_yield import BLUEST
from bfsensor.errors import ConvergenceError

CLOSE = 40.0
"""Difference in chi-square gain from the best candidate, below which a candidate is fitted again
jointly with all parameters; at least 2 % of the best gain.  Chosen, to be derived from the error
that screening makes by its linearisation of the other parameters: with 80, and 4 %, more
candidates are fitted jointly, up to five in all."""

HOPELESS, RAISED = 3.0, 8.0
"""Chi-square gain of a candidate's best starting point below which its shape is not fitted, and
largest factor by which a fit of the shape is taken to raise a gain.  Measured on 574 fits of 30
development campaigns of another bench: 99 % raised it by less than 5.4;
three of one campaign raised it by 20 to 28 and took less than 1 % of what stood out there."""

AGAIN = 2.0
"""The same of a candidate whose shape was fitted before, to residuals of fewer effects.  Chosen: with 4,
the screens of strong mismatches take up to twice as long."""

PULLED = 3.0
"""Distance of a device parameter from its nominal value, in units of its prior's width, above which
named hypotheses about the baseline are fitted jointly.  Chosen, to be derived: by chance at most
0.3 % of parameters are as far; with 6, exchanged axes that pull the device by less are missed."""

REFITTED = 5
"""Largest number of candidates that are fitted again jointly.  Chosen, to be derived: with 10
the joint fits of one step take up to twice as long."""


def candidates_of(baseline: Baseline) -> tuple[EffectFamily, ...]:
    """All candidates for a baseline: the library of effects, and the device's own parameters."""
    own = device_parameters(
        baseline.derivatives_by_condition(), baseline.spread, baseline.nominal,
        units=baseline.units, bounds=baseline.bounds,
    )  # fmt: skip
    return (*LIBRARY, *own, *baseline.pieces)


def tellable(
    kinds: Sequence[EffectFamily], predictor: Predictor, channels: Sequence[Channel]
) -> list[EffectFamily]:
    """Candidates that these recordings can constrain.

    Reduced recordings have no pixels, a_ij of one level say nothing of a dependence on the signal,
    and photons of red light make one electron each: effects that need them are left out.
    """
    pixels = bool(predictor.layout.segments)
    levels = any(
        c.unit != PER_ELECTRON or len(np.unique(c.axes["level"])) > 1 for c in channels
    )
    blue = any(
        c.word == "flat_cov"
        and c.unit != PER_ELECTRON
        and bool((np.asarray(c.axes["wavelength"], float) < BLUEST).any())
        for c in channels
    )
    known = ("pixels", pixels), ("levels", levels), ("blue", blue)
    lacking = {word for word, there in known if not there}
    return [k for k in kinds if not lacking & set(k.needs)]


def name_of(kind: EffectFamily) -> str:
    """Name of a class of effect, with its variant where there are several: 'word:variant'."""
    return f"{kind.word}:{kind.variant}" if kind.variant else kind.word


def concerned(kinds: Sequence[EffectFamily], *seen: Mismatch) -> list[EffectFamily]:
    """Candidates that change any channel in which a finding was made."""
    words = {f.word for mismatch in seen for f in mismatch.findings}
    words |= set(DEVICE_SEEN) if DEVICE in words else set()
    return [k for k in kinds if words & set(k.touches)]


def further(kinds: Sequence[EffectFamily], effects: Sequence[Effect]) -> list[EffectFamily]:
    """Candidates that are not yet in the model."""
    there = {e.name for e in effects}
    return [k for k in kinds if name_of(k) not in there]


def rank(screen: Screen, kinds: Sequence[EffectFamily]) -> list[Rival]:
    """Best fit of each kind of effect, by decreasing evidence."""
    starts = sorted((t for t in map(screen.tried, kinds) if t), key=lambda t: -t[0][0])
    found: list[Rival] = []
    best = 0.0
    for tried in starts:
        again = tried[0][1].family in screen.before
        rival = screen.best(tried, least=max(HOPELESS, best / (AGAIN if again else RAISED)))
        if rival is not None:
            found.append(rival)
            best = max(best, rival.gain)
    return sorted(found, key=lambda r: -r.evidence)


def with_hypotheses(
    model: Model, kinds: Sequence[EffectFamily], ranking: Sequence[Rival]
) -> list[Rival]:
    """Fit named hypotheses about the baseline jointly, if a device parameter is far from nominal.

    Device parameters that imitate a mistake in the baseline, such as exchanged axes, hide it from
    a screen that is linear about their fitted values.  In a joint fit with the hypothesis they
    return to their nominal values.

    Parameters
    ----------
    model : Model
        The fit so far.
    kinds : sequence of type
        Candidates.
    ranking : sequence of Rival
        Their ranking by the screen.

    Returns
    -------
    ranking : list of Rival
        With the named hypotheses as fitted jointly, by decreasing evidence.
    """
    pulled = any(abs(v) > PULLED for v in model.fit.pulls.values())
    named = [k for k in kinds if k in NAMED] if pulled else []
    out = [r for r in ranking if r.effect.family not in named]
    for kind in named:
        start = kind({p.name: 0.5 * (p.low + p.high) for p in kind.parameters})
        try:
            other = model.with_effects((*model.effects, start))
        except ConvergenceError:
            continue
        gain = model.fit.total - other.fit.total
        # A hypothesis may have priors of its own: only values are compared.
        template = np.zeros(len(model.fit.left))
        template[: len(model.fit.residuals)] = model.fit.residuals - other.fit.residuals
        out.append(Rival(other.effects[-1], gain, 0.5 * gain - OCCAM, template))
    return sorted(out, key=lambda r: -r.evidence)


def refine(
    model: Model, ranking: Sequence[Rival], models: dict[Effect, Model]
) -> list[Rival]:
    """Fit the candidates closest to the best again, jointly with all parameters.

    Parameters
    ----------
    model : Model
        The fit so far.
    ranking : sequence of Rival
        Ranking by the screen, not empty.
    models : dict of Effect to Model
        Where the joint fits are put, by the candidate as fitted.

    Returns
    -------
    ranking : list of Rival
        With gains and evidences of the joint fits, by decreasing evidence; a candidate whose
        joint fit does not converge keeps those of the screen.
    """
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
            models[other.effects[-1]] = other
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
    """Give an effect in a ranking the gain of its joint fit, if the screen found a smaller one.

    Parameters
    ----------
    ranking : sequence of Rival
        Candidates, the effect among them.
    effect : Effect
        With its fitted parameters.
    gain : float
        Decrease of the chi-square by its joint fit.

    Returns
    -------
    ranking : list of Rival
        By decreasing evidence.
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
    """Chi-square gain that the best of all candidates reaches by noise with probability ALARM.

    Parameters
    ----------
    screen : Screen
        Of the fit.
    ranking : sequence of Rival
        Candidates with their templates.
    seed : int
        Seed of the draws.
    draws : int
        Number of draws of noise, a multiple of 50.

    Returns
    -------
    gain : float
        Infinite without any template.
    """
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
    # Templates are fixed in the draws.  Each fitted shape parameter gains 1 on average by
    # following the noise (a chi-square of one degree of freedom); 2 is one more in its tail.
    return float(np.quantile(np.concatenate(largest), 1 - ALARM)) + 2.0 * extra


def seen_of(mismatch: Mismatch) -> list[dict[str, Any]]:
    """Findings of the scans, largest deviate first, as mappings that effects take starts from."""
    parts = [*mismatch.parts, *mismatch.findings[:200]]
    return [{**p.where, "word": p.word, "z": p.z, "family": p.family} for p in parts]
