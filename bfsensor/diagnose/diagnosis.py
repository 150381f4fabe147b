"""A diagnosis: measure, fit the baseline, locate what is left, explain it, plan what to take."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bfsensor.diagnose.data.channels import PER_ELECTRON
from bfsensor.diagnose.data.measure_channels import (
    MeasuredChannels,
    Source,
    measure_channels,
)
from bfsensor.diagnose.detect.locate import locate_mismatch
from bfsensor.diagnose.detect.matched_filters import locate_effects
from bfsensor.diagnose.explain.stepwise import attribute
from bfsensor.diagnose.fit.baseline_fit import (
    BaselineFit,
    fit_bounded,
    held_out,
)
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.plan.advice import RecordingPlan, plan
from bfsensor.diagnose.report.diagnosis_result import Diagnosis


def diagnose(
    source: Source,
    baseline: Baseline,
    *,
    campaign: str = "",
    seed: int = 1,
    notes: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
    explain: bool = True,
) -> Diagnosis:
    """Hold a campaign's recordings against a baseline.

    Parameters
    ----------
    source : Source
        The exposures.
    baseline : Baseline
        What the simulation predicts.
    campaign : str
        Its name.
    seed : int
        Of the draws of noise that p-values come from.
    notes : sequence of str
        What reading had to say, for the report.
    progress : callable, optional
        Called with (exposures done, exposures in all).
    explain : bool
        Look for what explains a mismatch, beyond where it is.

    Returns
    -------
    Diagnosis
    """
    measured = measure_channels(source, progress=progress)
    return diagnose_measured(
        measured, baseline, campaign=campaign, seed=seed, notes=notes, explain=explain
    )


def diagnose_measured(
    measured: MeasuredChannels,
    baseline: Baseline,
    *,
    campaign: str = "",
    seed: int = 1,
    notes: Sequence[str] = (),
    explain: bool = True,
) -> Diagnosis:
    """Hold channels that are measured already against a baseline; see :func:`diagnose`.

    Parameters
    ----------
    measured : MeasuredChannels
        From :func:`bfsensor.diagnose.measure_channels` or
        :func:`bfsensor.diagnose.measure_reduced`.
    baseline, campaign, seed, notes, explain
        As for :func:`diagnose`.

    Returns
    -------
    Diagnosis
    """
    predictor, fit = fit_bounded(measured, baseline)
    more = _of_free(measured, baseline, fit)
    if explain:
        mismatch = locate_effects(predictor, fit, seed=seed)
    else:
        mismatch = locate_mismatch(fit, seed=seed)
    attribution, advised = None, RecordingPlan()
    if mismatch.detected and explain:
        attribution = attribute(predictor, fit, mismatch, seed=seed)
        more += attribution.notes
        advised = plan(attribution)
        more += advised.notes
    return Diagnosis(
        campaign=campaign,
        baseline=baseline.name,
        measured=measured,
        fit=fit,
        mismatch=mismatch,
        heldout=held_out(predictor, fit, measured),
        notes=(*notes, *measured.notes, *fit.notes, *more),
        read=len(notes),
        attribution=attribution,
        plan=advised,
        predictor=predictor,
    )


def _of_free(measured: MeasuredChannels, baseline: Baseline, fit: BaselineFit) -> list[str]:
    """What floats without a device behind it, and what few levels leave open of that."""
    if not baseline.not_below:
        return []
    errors = dict(zip(fit.names, fit.errors, strict=True))
    text = ", ".join(
        f"{n} {fit.pulls[n] * baseline.spread[n]:.2g} +- "
        f"{errors[f'device {n}'] * baseline.spread[n]:.1g}" if n in fit.pulls else f"{n} held at 0"
        for n in baseline.not_below
    )  # fmt: skip
    out = [f"a_ij that float, per electron: {text}"]
    flats = [c for c in measured.channels if c.word == "flat_cov"]
    levels = {float(v) for c in flats for v in c.axes["time"]}
    if len(levels) < 2 and not any(c.unit == PER_ELECTRON for c in flats):
        out.append(
            "flats at fewer than two levels: a positive covariance of near neighbours cannot be told "
            "from the brighter-fatter effect, nor the gain from its a_00"
        )
    return out
