"""A mismatch of measured a_ij that rests on one value: tested by leaving each value out."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import numpy as np

from bfsensor.diagnose.data.channels import PER_ELECTRON
from bfsensor.diagnose.detect.candidate_screen import Rival, Screen
from bfsensor.diagnose.detect.candidates import candidates_of, rank, seen_of, tellable
from bfsensor.diagnose.detect.locate import Mismatch, locate_mismatch
from bfsensor.diagnose.detect.model_error import charge
from bfsensor.diagnose.explain.attribution import TIED, Attribution
from bfsensor.diagnose.explain.nonparametric import Columns, FreeFit, explain_outside
from bfsensor.diagnose.explain.pursuit import Dictionary
from bfsensor.diagnose.explain.terms import SINGLE, Family, Scene, lag_family
from bfsensor.diagnose.fit.baseline_fit import BaselineFit, fit_baseline
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.effect_parameters import fitted
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.errors import ConvergenceError


def explain_single_value(
    predictor: Predictor, fit: BaselineFit, mismatch: Mismatch, *, seed: int = 1
) -> Attribution | None:
    """Describe a mismatch that one value of a table causes alone.

    The value whose change explains most is left out: that of one table, or of a lag in all tables, as a
    gain that is wrong for all acts on a_00 alone.  If nothing stands out without it, and no effect of
    the library explains the others better than noise does, then no physics has been seen: one value
    differs from the baseline.  Effects that would explain it, such as area that
    is gained beyond the table's lags where a_00 is too negative, are listed.  A lag that is off in all
    tables was seen more than once: an effect with one parameter that describes it as well as the value
    does, such as memory of the last pixel for a_10, is asked first.  Effects with more parameters, such
    as coupling, can imitate an a_00 of a wrong gain.

    Parameters
    ----------
    predictor : Predictor
        Model of the baseline.
    fit : BaselineFit
        Its fit to tables of a_ij.
    mismatch : Mismatch
        Residuals of that fit that stand out.
    seed : int
        Seed of the noise draws.

    Returns
    -------
    Attribution or None
        With one nonparametric term for the value; None where other values stand out as well, or
        an effect is seen in them or describes a lag of all tables, or the channels are no a_ij.
    """
    if any(c.unit != PER_ELECTRON for c in fit.channels) or len(fit.channels) != 1:
        return None
    model = Model(predictor, fit)
    family = lag_family(Scene(model))
    assert family is not None and family.group == SINGLE
    best = Dictionary(family, fit).choose()
    if best is None:
        return None
    own = best.terms[0]
    channel = fit.channels[0]
    kept = channel.take(~np.isin(np.arange(len(channel)), own.where["rows"]))
    without = fit_baseline(predictor, [kept])
    left = locate_mismatch(without, seed=seed)
    if left.detected or _any_effect(Model(predictor, without), left):
        return None
    choice = Dictionary(
        Family(SINGLE, (own,), family.words, tried=len(family.terms)), fit
    ).choose()
    if choice is None:
        return None
    after = model.with_columns(Columns([own]))
    free = FreeFit(
        after, (choice,), {SINGLE: choice.score}, locate_mismatch(after.fit, seed=seed)
    )
    kinds = tellable(candidates_of(predictor.baseline), predictor, fit.channels)
    ranking = rank(Screen(predictor, fit, seen_of(mismatch)), kinds)
    if len(own.where["rows"]) > 1 and _as_simple(model, ranking, after, choice.z[0] ** 2):
        return None
    told = explain_outside(model, mismatch, ranking, free=free, seed=seed)
    if told is None:
        return None
    world, last = told
    # Chosen: effects that take more than half of the value's chi-square are listed; at a quarter,
    # effects of other lags that merely touch it would be, too.
    same = [
        r.effect.name for r in ranking if r.gain > 0.5 * choice.z[0] ** 2 and not r.refuted
    ]
    notes = (
        [
            f"would explain this value as well, which no other value supports: {', '.join(same)}"
        ]
        if same
        else []
    )
    return Attribution(
        found=(),
        fit=last.fit,
        predictor=last.predictor,
        mismatch=free.mismatch,
        open_world=True,
        notes=tuple(notes),
        free_form=world,
    )


def _as_simple(model: Model, ranking: Sequence[Rival], after: Model, gain: float) -> bool:
    """Whether an effect with one parameter describes a lag of all tables as well as a free value does.

    Both are fitted with all else: screens are linear, and missed 1 % of the gain of a memory of 34
    standard deviations.  Effects that take less than half by the screen are not fitted.
    """
    for rival in ranking:
        if len(fitted(rival.effect)) > 1 or rival.refuted or rival.gain < 0.5 * gain:
            continue
        with contextlib.suppress(ConvergenceError):
            if model.with_effects([rival.effect]).fit.total < after.fit.total + 2 * TIED:
                return True
    return False


def _any_effect(model: Model, mismatch: Mismatch) -> bool:
    """Whether an effect of the library gains more than noise gives as many parameters."""
    kinds = tellable(
        candidates_of(model.predictor.baseline), model.predictor, model.fit.channels
    )
    screen = Screen(model.predictor, model.fit, seen_of(mismatch))
    ranking = rank(screen, kinds)
    return any(r.gain > charge(len(fitted(r.effect)), len(kinds)) for r in ranking)
