"""Whether an effect of the library stands out where the scans, made for no effect, see nothing.

Thousands of shapes are scanned; a few hundred are the library's own, and an effect that shows in
many places at once is found by its own shape long before any scan sees a part of it.  Both are
held against the same draws of noise, each effect's shapes a family.
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
from bfsensor.effects.effect import Effect

LOOKED = 1e4
"""Waves that maps are searched for; starts that such sightings give are charged with all."""

SURE = 1e-4
"""Probability by the scans alone below which no other shape is asked."""


def locate_effects(
    predictor: Predictor,
    fit: BaselineFit,
    kinds: Sequence[type[Effect]] | None = None,
    *,
    seed: int = 1,
) -> Mismatch:
    """Find what noise does not explain, by scans and by the library's own shapes together.

    Shapes are those at the places where fits of the effects begin, whatever the data.  Effects
    that begin at waves that were seen in maps are fitted, and charged for all waves that might
    have been (:data:`LOOKED`): noise hardly ever makes one of them the smallest probability.

    Parameters
    ----------
    predictor, fit : Predictor, BaselineFit
        The baseline, fitted.
    kinds : sequence of type, optional
        Candidates; by default all of the baseline.  Effects that are there are none.
    seed : int
        Of the draws of noise.
    """
    locator = Locator(fit, seed=seed)
    mismatch = locator.locate()
    if mismatch.p_value < SURE:
        # Of two families; which of them is the closer one is known here.
        return replace(mismatch, p_value=2 * mismatch.p_value)
    kinds = _candidates(predictor, fit, kinds)
    screen = Screen(predictor, fit, seen_of(mismatch))
    mismatch = locator.with_library(known_shapes(screen, kinds)).locate()
    return _with_sighted(screen, kinds, mismatch)


def alarms_of(predictor: Predictor, fit: BaselineFit, *, seed: int = 1) -> dict[str, float]:
    """Deviates from which :func:`locate_effects` alarms, by family: :meth:`Locator.alarms`."""
    screen = Screen(predictor, fit)
    shapes = known_shapes(screen, _candidates(predictor, fit))
    return Locator(fit, seed=seed).with_library(shapes).alarms()


def _candidates(
    predictor: Predictor, fit: BaselineFit, kinds: Sequence[type[Effect]] | None = None
) -> Sequence[type[Effect]]:
    """Effects that are sought: those that these channels can tell, and are not there yet."""
    if kinds is None:
        kinds = candidates_of(predictor.baseline)
    kinds = tellable(kinds, predictor, fit.channels)
    return further(kinds, predictor.effects_at(fit.values[: len(predictor.names)]))


def known_shapes(screen: Screen, kinds: Sequence[type[Effect]]) -> list[Known]:
    """Shapes of effects at all places where their fits begin, whatever the data show."""
    unseen = replace(screen.predictor.layout, sightings=())
    out = []
    for kind in kinds:
        signed = any(p.signed for p in kind.parameters if p.amplitude)
        for shape in screen.shapes(kind, unseen):
            word = _channel_of(screen.fit, shape)
            out.append(Known(name_of(kind), word, shape.astype(np.float32), signed))
    return out


def _with_sighted(
    screen: Screen, kinds: Sequence[type[Effect]], mismatch: Mismatch
) -> Mismatch:
    """What effects say that begin at waves that were seen in maps."""
    if not screen.predictor.layout.sightings:
        return mismatch
    for kind in (k for k in kinds if k.from_sightings):
        rival = screen.best(screen.tried(kind)[:1])
        # Beyond plausible ranges a shape may follow anything.
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


def trials_of(kind: type[Effect], screen: Screen) -> float:
    """Places at which a kind that begins at sighted waves is tried."""
    return max(len(kind.starts(screen.predictor.layout, screen.seen)), 1) * LOOKED


def _channel_of(fit: BaselineFit, shape: NDArray[np.floating]) -> str:
    """Channel in which a shape shows most."""
    squares = shape[: len(fit.residuals)] ** 2
    return max(
        dict.fromkeys(c.word for c in fit.channels),
        key=lambda w: float(squares[fit.of(w)].sum()),
    )
