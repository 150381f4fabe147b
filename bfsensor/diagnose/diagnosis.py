"""Run a diagnosis: measure channels, fit the baseline, locate and explain residuals, plan recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from bfsensor.checkpoints import Checkpoints
from bfsensor.diagnose.data.channels import PER_ELECTRON, step_of
from bfsensor.diagnose.data.exposure_info import Source
from bfsensor.diagnose.data.measure_channels import MeasuredChannels, measure_channels
from bfsensor.diagnose.detect.locate import Mismatch, locate_mismatch
from bfsensor.diagnose.detect.matched_filters import locate_effects
from bfsensor.diagnose.detect.silicon_or_readout import find_symmetry
from bfsensor.diagnose.explain.attribution import Attribution
from bfsensor.diagnose.explain.single_value import explain_single_value
from bfsensor.diagnose.explain.stepwise import attribute
from bfsensor.diagnose.fit.baseline_fit import (
    BaselineFit,
    fit_bounded,
    held_out,
)
from bfsensor.diagnose.fit.error_scale import scale_errors
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.device_baseline import STRAIGHT, expand_at, far_from_solution
from bfsensor.diagnose.model.device_solver import OXIDES
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.diagnose.model.unknown_level import NAME as LEVEL_NAME
from bfsensor.diagnose.model.unknown_level import float_unknown_level
from bfsensor.diagnose.plan.advice import RecordingPlan, plan
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.effects.changed_device import ChangedDevice
from bfsensor.errors import ConvergenceError, DeviceError
from bfsensor.response.edge_response import LEVEL

EXPANDED = 4
"""Largest number of times that a device is solved at its fitted quantities.  Chosen: each takes some
4 CPU seconds a back bias, and devices two spreads off in many quantities take two; with 8, one that is
hard to predict takes a minute more."""


# Threads of the linear algebra take 1.7 times the CPU seconds and no less time: matrices are small.
@threadpool_limits.wrap(limits=1, user_api="blas")
def diagnose(
    source: Source,
    baseline: Baseline,
    *,
    campaign: str = "",
    seed: int = 1,
    notes: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
    explain: bool = True,
    keep: Checkpoints | None = None,
) -> Diagnosis:
    """Compare a campaign's recordings with a baseline, and explain the mismatch.

    Parameters
    ----------
    source : Source
        Exposures in order of time, such as a :class:`CampaignSource`.
    baseline : Baseline
        Boundary shifts that the simulation predicts, from :func:`find_baseline` and others.
    campaign : str
        Name of the campaign, for the report.
    seed : int
        Seed of the noise draws that p-values come from; the same seed gives the same result.
    notes : sequence of str
        Warnings from reading the recordings, for the report.
    progress : callable, optional
        Called with (exposures done, exposures in all).
    explain : bool
        Whether to find effects that explain a mismatch, and recordings to take next; without it
        the mismatch is only located, which is much faster.
    keep : Checkpoints, optional
        Where finished stages are stored and, after an interruption, read.

    Returns
    -------
    Diagnosis
        Fit, mismatch, effects found and advice.

    Raises
    ------
    MeasurementError
        No exposure can be used, or no channel can be measured in them.

    Examples
    --------
    Diagnose a folder of recordings against a shipped device::

        from bfsensor.recording.campaign.campaign import read_campaign

        source = CampaignSource(read_campaign("recordings/"))
        print(diagnose(source, find_baseline("itl_sta3800c")).said())
    """
    keep = keep or Checkpoints(None)
    measured = keep.get("channels", lambda: measure_channels(source, progress=progress))
    return diagnose_measured(
        measured,
        baseline,
        campaign=campaign,
        seed=seed,
        notes=notes,
        explain=explain,
        keep=keep,
    )


@threadpool_limits.wrap(limits=1, user_api="blas")
def diagnose_measured(
    measured: MeasuredChannels,
    baseline: Baseline,
    *,
    campaign: str = "",
    seed: int = 1,
    notes: Sequence[str] = (),
    explain: bool = True,
    scaled: bool = True,
    keep: Checkpoints | None = None,
) -> Diagnosis:
    """Compare measured channels with a baseline, and explain the mismatch.

    Parameters
    ----------
    measured : MeasuredChannels
        From :func:`bfsensor.diagnose.measure_channels` or
        :func:`bfsensor.diagnose.measure_reduced`.
    baseline : Baseline
        Boundary shifts that the simulation predicts.
    campaign : str
        Name of the campaign, for the report.
    seed : int
        Seed of the noise draws that p-values come from.
    notes : sequence of str
        Warnings from reading the recordings, for the report.
    explain : bool
        Whether to find effects that explain a mismatch, as for :func:`diagnose`.
    scaled : bool
        Whether stated errors of a_ij that the scatter of far lags contradicts are scaled by it.
    keep : Checkpoints, optional
        As for :func:`diagnose`.

    Returns
    -------
    Diagnosis
        Fit, mismatch, effects found and advice.

    Examples
    --------
    Diagnose area changes a_ij [1/e-] that conserve area:

    >>> from pathlib import Path
    >>> import numpy as np
    >>> from bfsensor.diagnose import free_baseline, measure_reduced
    >>> from bfsensor.recording.tables.area_changes import AreaChangeTable
    >>> a = np.zeros((3, 3)); a[0, 0], a[0, 1], a[1, 0] = -1.4e-6, 3e-7, 4e-7
    >>> errors, independent = np.full((3, 3), 1e-8), np.ones((3, 3), bool)
    >>> table = AreaChangeTable(Path("drawn"), a, errors, independent)
    >>> baseline = free_baseline()
    >>> measured = measure_reduced(table, reach=baseline.reach)
    >>> diagnose_measured(measured, baseline).mismatch.detected
    False
    """
    keep = keep or Checkpoints(None)
    stated = _predictable(measured, baseline)
    measured = scale_errors(stated, baseline) if scaled else stated
    baseline = float_unknown_level(measured, baseline)
    # Channels are stored with their fit again, so that both are the same objects when read.
    measured, predictor, fit, mismatch = keep.get(
        "located", lambda: _located(measured, baseline, seed, explain)
    )
    more = [
        *_of_free(measured, baseline, fit),
        *_of_level(baseline, fit),
        *_as_stated(stated, measured, baseline, seed),
        *(_symmetries(fit) if mismatch.detected else []),
    ]
    attribution, advised = None, RecordingPlan()
    if mismatch.detected and explain:
        try:
            attribution = keep.get(
                "explained", lambda: _explained(predictor, fit, mismatch, seed)
            )
            found = attribution
            attribution = keep.get(
                "solved beside effects",
                lambda: _solved_beside(measured, predictor.baseline, found, seed),
            )
        except ConvergenceError as error:
            more.append(f"the mismatch is located, but not explained: {error}")
        else:
            more += attribution.notes
            advised = plan(attribution)
            more += advised.notes
    last = (predictor.baseline, fit)
    if attribution is not None:
        last = (attribution.predictor.baseline, attribution.fit)
    more += [*_not_expanded(*last), *_as_one_film(*last)]
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


def _located(
    measured: MeasuredChannels, baseline: Baseline, seed: int, explain: bool
) -> tuple[MeasuredChannels, Predictor, BaselineFit, Mismatch]:
    """Channels, the baseline's predictor and fit, and the residuals of the fit that stand out.

    A device is solved at its fitted quantities and fitted again, so that a straight line through its
    response is not taken for other physics.
    """
    predictor, fit = fit_bounded(measured, baseline)
    for _ in range(EXPANDED):
        again = _expanded(baseline, fit)
        if again is None:
            break
        baseline = again
        predictor, fit = fit_bounded(measured, baseline)
    if explain:
        return measured, predictor, fit, locate_effects(predictor, fit, seed=seed)
    return measured, predictor, fit, locate_mismatch(fit, seed=seed)


def _explained(
    predictor: Predictor, fit: BaselineFit, mismatch: Mismatch, seed: int
) -> Attribution:
    """Explain a mismatch by one value that is off, or by effects."""
    single = explain_single_value(predictor, fit, mismatch, seed=seed)
    return single or attribute(predictor, fit, mismatch, seed=seed)


def _solved_beside(
    measured: MeasuredChannels, baseline: Baseline, attribution: Attribution, seed: int
) -> Attribution:
    """Explanation with the device solved at its quantities as fitted beside the effects.

    Without the effects other quantities were fitted, and far from those a straight line through the
    device's response is wrong by more than the errors.  Effects of the device itself were solved beside
    all quantities already.  What is given is returned where the same effects do not fit better.
    """
    found = attribution.found
    if not found or any(isinstance(f.effect, ChangedDevice) for f in found):
        return attribution
    solved = _expanded(baseline, attribution.fit)
    if solved is None:
        return attribution
    try:
        predictor, fit = fit_bounded(measured, solved)
        mismatch = locate_effects(predictor, fit, seed=seed)
        if not mismatch.detected:
            return attribution
        other = _explained(predictor, fit, mismatch, seed)
    except ConvergenceError:
        # A note says that the device is far from where it was solved.
        return attribution
    same = {f.effect.name for f in other.found} == {f.effect.name for f in found}
    return other if same and other.fit.total < attribution.fit.total else attribution


def _not_expanded(baseline: Baseline, fit: BaselineFit) -> list[str]:
    """Note on a device that is predicted by derivatives far from where it was solved."""
    if not far_from_solution(baseline, fit.pulls):
        return []
    return [
        "fitted quantities of the device are more than "
        f"{STRAIGHT:g} of their uncertainties from where it was solved, as no such device could be "
        f"solved or {EXPANDED} solutions did not settle: a curved response may look like other physics, "
        "and no quantity is stated"
    ]


def _as_one_film(baseline: Baseline, fit: BaselineFit) -> list[str]:
    """Note on a field oxide that is fitted thinner than the gate oxide, and solved as thick as that."""
    if baseline.solver is None:
        return []
    change = {n: fit.pulls[n] * baseline.spread[n] for n in OXIDES if n in fit.pulls}
    gate, field = (baseline.solver.nominal(n) + change.get(n, 0.0) for n in OXIDES)
    if not change or field >= gate:
        return []
    return [
        f"the field oxide is fitted as {field:.3g} um, thinner than the gate oxide of {gate:.3g} um, "
        "which no device has: it was solved as thick as the gate oxide; do not rely on its value"
    ]


def _expanded(baseline: Baseline, fit: BaselineFit) -> Baseline | None:
    """Baseline solved at its fitted quantities; None where that is no other one."""
    if not far_from_solution(baseline, fit.pulls):
        return None
    pulls = {n: fit.pulls[n] for n in baseline.units if n in fit.pulls}
    try:
        return expand_at(baseline, pulls)
    except (DeviceError, ConvergenceError):
        return None


def _predictable(measured: MeasuredChannels, baseline: Baseline) -> MeasuredChannels:
    """Set channels aside that the nominal baseline cannot predict at all, and name them in a note."""
    predictor, kept, notes = Predictor(measured, baseline), [], []
    for channel in measured.channels:
        try:
            finite = np.isfinite(predictor.predict(channel, predictor.start)).all()
            why = "" if finite else "its prediction is not finite"
        except ConvergenceError as error:
            why = str(error)
        if why:
            notes.append(f"{channel.word} ({channel.fold}) set aside: {why}")
        else:
            kept.append(channel)
    if not notes:
        return measured
    return replace(measured, channels=tuple(kept), notes=(*measured.notes, *notes))


def _of_level(baseline: Baseline, fit: BaselineFit) -> list[str]:
    """Note on a level of flats that no table states."""
    if LEVEL_NAME not in fit.pulls:
        return []
    errors = dict(zip(fit.names, fit.errors, strict=True))
    spread = baseline.spread[LEVEL_NAME]
    level = LEVEL + fit.pulls[LEVEL_NAME] * spread
    return [
        f"no table states the level of its flats: {level:.0f} +- "
        f"{errors[f'device {LEVEL_NAME}'] * spread:.0f} e- was fitted; state it with --at level=, for a "
        "wrong a_00 can look like another level"
    ]


def _as_stated(
    stated: MeasuredChannels, measured: MeasuredChannels, baseline: Baseline, seed: int
) -> list[str]:
    """Note on the p-value with the errors as stated, where they were scaled."""
    pairs = zip(stated.channels, measured.channels, strict=True)
    if all(np.array_equal(a.errors, b.errors) for a, b in pairs):
        return []
    found = locate_mismatch(fit_bounded(stated, baseline)[1], seed=seed)
    return [f"with the errors as stated the family-wise p is {found.p_value:.2g}"]


def _symmetries(fit: BaselineFit) -> list[str]:
    """Note on the symmetries of the a_ij that deviate from the baseline."""
    parts = zip(fit.channels, fit.starts, strict=False)
    left = [c.unwhiten(fit.residuals[start : start + len(c)]) for c, start in parts]
    predicted = [c.values - r for c, r in zip(fit.channels, left, strict=True)]
    found = find_symmetry(fit.channels, left, predicted)
    return [] if found is None else [found.said()]


def _of_free(measured: MeasuredChannels, baseline: Baseline, fit: BaselineFit) -> list[str]:
    """Notes on the free a_ij of a baseline without a device, and on flats of too few levels."""
    if not baseline.not_below:
        return []
    errors = dict(zip(fit.names, fit.errors, strict=True))
    text = ", ".join(
        f"{n} {fit.pulls[n] * baseline.spread[n]:.2g} +- "
        f"{errors[f'device {n}'] * baseline.spread[n]:.1g}" if n in fit.pulls else f"{n} held at 0"
        for n in baseline.not_below
    )  # fmt: skip
    out = [f"fitted area changes a_ij [1/e-]: {text}"]
    flats = [c for c in measured.channels if c.word == "flat_cov"]
    levels = {float(v) for c in flats for v in step_of(c.axes)}
    if len(levels) < 2 and not any(c.unit == PER_ELECTRON for c in flats):
        out.append(
            "flats at fewer than two levels: these do not separate other positive covariances of near "
            "neighbours from the brighter-fatter effect, nor the gain from its a_00"
        )
    return out
