"""Matched filters of the library's effects, beside the scans that assume no effect.

An effect that changes many values a little is detected by its own template long before any scan,
which sums a few of these values, sees a part of it.  The statistic is the projection of whitened
residuals on a unit template, of unit variance under noise.  Scans (thousands of templates) and
filters (a few hundred) are compared with the same draws of noise, each effect's filters a family.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from bfsensor.diagnose.detect.candidate_screen import Screen
from bfsensor.diagnose.detect.candidates import (
    candidates_of,
    further,
    name_of,
    seen_of,
    tellable,
)
from bfsensor.diagnose.detect.locate import ALARM, FAMILY, Finding, Known, Locator, Mismatch
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.effects.family import EffectFamily

LOOKED = 1e4
"""Number of independent waves that maps are searched for; the p-value of an effect that starts at a
detected fringe is multiplied by it (Bonferroni's correction).  Chosen, to be derived from the size
of the maps: with 2e4 such an effect needs 1.4 more in chi-square (2 ln 2) for the same p-value."""

SURE = 1e-4
"""Family-wise probability by the scans alone below which matched filters are not evaluated, to save
time: the p-value is then doubled (Bonferroni's correction for scans and filters).  Chosen: with
2e-4, campaigns between 1e-4 and 2e-4, detected in any case, would report the doubled value, too."""


def locate_effects(
    predictor: Predictor,
    fit: BaselineFit,
    kinds: Sequence[EffectFamily] | None = None,
    *,
    seed: int = 1,
) -> Mismatch:
    """Find what noise does not explain, by scans and by matched filters of the library together.

    Filters are the templates at the starting points of the effects, which do not depend on the
    data.  Effects that start at fringes detected in maps do depend on them: they are fitted, and
    their p-value is multiplied by the number of waves searched for (:data:`LOOKED`).

    Parameters
    ----------
    predictor, fit : Predictor, BaselineFit
        The baseline, fitted.
    kinds : sequence of type, optional
        Candidates; by default all of the baseline.  Effects that are in the fit are left out.
    seed : int
        Seed of the draws of noise.

    Returns
    -------
    Mismatch
    """
    locator = Locator(fit, seed=seed)
    mismatch = locator.locate()
    if mismatch.p_value < SURE:
        # Bonferroni's bound for the smaller of two families' p-values.
        return replace(mismatch, p_value=2 * mismatch.p_value)
    kinds = _candidates(predictor, fit, kinds)
    screen = Screen(predictor, fit, seen_of(mismatch))
    mismatch = locator.with_library(known_shapes(screen, kinds)).locate()
    return _with_sighted(screen, kinds, mismatch)


def alarms_of(predictor: Predictor, fit: BaselineFit, *, seed: int = 1) -> dict[str, float]:
    """Deviates above which :func:`locate_effects` alarms, by family: :meth:`Locator.alarms`."""
    screen = Screen(predictor, fit)
    shapes = known_shapes(screen, _candidates(predictor, fit))
    return Locator(fit, seed=seed).with_library(shapes).alarms()


def _candidates(
    predictor: Predictor, fit: BaselineFit, kinds: Sequence[EffectFamily] | None = None
) -> Sequence[EffectFamily]:
    """Effects that these channels can constrain and that are not in the fit yet."""
    if kinds is None:
        kinds = candidates_of(predictor.baseline)
    kinds = tellable(kinds, predictor, fit.channels)
    return further(kinds, predictor.effects_at(fit.values[: len(predictor.names)]))


def known_shapes(screen: Screen, kinds: Sequence[EffectFamily]) -> list[Known]:
    """Matched filters of effects at all their starting points, which do not depend on the data."""
    unseen = replace(screen.predictor.layout, sightings=())
    out = []
    for kind in kinds:
        signed = any(p.signed for p in kind.parameters if p.amplitude)
        for shape in screen.shapes(kind, unseen):
            word = _channel_of(screen.fit, shape)
            out.append(Known(name_of(kind), word, shape.astype(np.float32), signed))
    return out


def _with_sighted(
    screen: Screen, kinds: Sequence[EffectFamily], mismatch: Mismatch
) -> Mismatch:
    """Add effects that start at fringes detected in maps, their p-values corrected for the search."""
    if not screen.predictor.layout.sightings:
        return mismatch
    for kind in (k for k in kinds if "patterns" in k.needs):
        rival = screen.best(screen.tried(kind)[:1])
        # Negative evidence: parameters far outside their plausible ranges can follow any noise.
        if rival is None or rival.refuted or rival.evidence < 0:
            continue
        p = float(chi2.sf(rival.gain, max(len(fitted(rival.effect)), 1)))
        p = min(p * trials_of(kind, screen), 1.0)
        if p < mismatch.p_value:
            findings = mismatch.findings
            if p < ALARM:
                z, word = (
                    float(np.sqrt(rival.gain)),
                    _channel_of(screen.fit, rival.template),
                )
                findings = (
                    Finding(FAMILY, word, z, p, {"effect": name_of(kind)}),
                    *findings,
                )
            mismatch = replace(mismatch, p_value=p, findings=findings)
    return mismatch


def trials_of(kind: EffectFamily, screen: Screen) -> float:
    """Number of independent trials of a kind of effect that starts at detected fringes."""
    return max(len(kind.starts(screen.predictor.layout, screen.seen)), 1) * LOOKED


def _channel_of(fit: BaselineFit, shape: NDArray[np.floating]) -> str:
    """Name of the channel that holds most of a template's square."""
    squares = shape[: len(fit.residuals)] ** 2
    return max(
        dict.fromkeys(c.word for c in fit.channels),
        key=lambda w: float(squares[fit.of(w)].sum()),
    )
