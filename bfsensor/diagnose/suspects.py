"""Whether an effect of the library stands out where the scans, made for no effect, see nothing.

Thousands of shapes are scanned; a hundred are the library's own, and an effect that shows in many
places at once is found by its own shape long before any scan sees a part of it.  What is found is
charged with all that was tried: with each start, with the parameters that were fitted, with every
kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from bfsensor.diagnose.locate import ALARM, FAMILY, Finding, Mismatch
from bfsensor.diagnose.mismatch import BaselineFit
from bfsensor.diagnose.predict import Predictor, fitted
from bfsensor.diagnose.ranking import candidates_of, further, seen_of
from bfsensor.diagnose.screen import Rival, Screen
from bfsensor.effects.effect import Effect

LOOKED = 1e4
"""Waves that maps are searched for; starts that such sightings give are charged with all."""

CLOSEST = 3
"""Kinds whose parameters are fitted."""


def suspect_effects(
    predictor: Predictor,
    fit: BaselineFit,
    mismatch: Mismatch,
    kinds: Sequence[type[Effect]] | None = None,
) -> Mismatch:
    """Hold the library's own shapes against what a fit leaves, beside the scans.

    The smaller of both family-wise probabilities counts, for two families of tests
    (Sidak: 1 - (1 - p)^2).

    Parameters
    ----------
    predictor, fit : Predictor, BaselineFit
        The baseline, fitted.
    mismatch : Mismatch
        What the scans found.
    kinds : sequence of type, optional
        Candidates; by default all of the baseline.  Effects that are there are none.

    Returns
    -------
    Mismatch
        With the probability of both, and a finding of that family where that is what stands out.
    """
    both = 1 - (1 - mismatch.p_value) ** 2
    if mismatch.p_value < ALARM / 2:
        return replace(mismatch, p_value=max(both, mismatch.p_value))
    if kinds is None:
        kinds = candidates_of(predictor.baseline)
    if not predictor.layout.segments:
        kinds = [k for k in kinds if not k.of_pixels]
    there = predictor.effects_at(fit.values[: len(predictor.names)])
    found = _likeliest(Screen(predictor, fit, seen_of(mismatch)), further(kinds, there))
    if found is None or found[0] >= mismatch.p_value:
        return replace(mismatch, p_value=both)
    p, rival = found
    both = 1 - (1 - p) ** 2 if p > 1e-6 else 2 * p
    findings = mismatch.findings
    if both < ALARM:
        z = float(np.sqrt(rival.gain))
        told = Finding(
            FAMILY, _channel_of(fit, rival), z, both, {"effect": rival.effect.name}
        )
        findings = (told, *findings)
    return replace(mismatch, p_value=both, findings=findings)


def _likeliest(screen: Screen, kinds: Sequence[type[Effect]]) -> tuple[float, Rival] | None:
    """Kind that noise is least likely to give, and how likely that any kind is so unlikely."""
    starts = []
    for kind in kinds:
        tried = screen.tried(kind)
        if tried:
            starts.append((kind, tried))
    judged = []
    for kind, tried in sorted(starts, key=lambda s: -s[1][0][0])[:CLOSEST]:
        rival = screen.best(tried[:1])
        if rival is None or rival.refuted:
            continue
        charged = trials_of(kind, screen)
        p = float(chi2.sf(rival.gain, max(len(fitted(rival.effect)), 1))) * charged
        judged.append((min(p, 1.0), rival))
    if not judged:
        return None
    p, rival = min(judged, key=lambda j: j[0])
    many = len(starts)
    return (1 - (1 - p) ** many if p > 1e-9 else p * many), rival


def trials_of(kind: type[Effect], screen: Screen) -> float:
    """Places at which a kind is tried."""
    layout = screen.predictor.layout
    count = float(max(len(kind.starts(layout, screen.seen)), 1))
    return count * (LOOKED if kind.from_sightings and layout.sightings else 1.0)


def _channel_of(fit: BaselineFit, rival: Rival) -> str:
    """Channel in which a candidate shows most."""
    n = len(fit.residuals)
    squares = rival.template[:n] ** 2
    return max(
        dict.fromkeys(c.word for c in fit.channels),
        key=lambda w: float(squares[fit.of(w)].sum()),
    )
