"""The result of a diagnosis: measured channels, fit, mismatch, effects, as data and in sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2 as chi2_distribution

import bfsensor
from bfsensor.diagnose.data.measure_channels import (
    MeasuredChannels,
)
from bfsensor.diagnose.detect.locate import ALARM, Finding, Mismatch
from bfsensor.diagnose.detect.scans import DEVICE, DEVICE_SEEN
from bfsensor.diagnose.explain.attribution import Attribution
from bfsensor.diagnose.explain.location import place_effects
from bfsensor.diagnose.fit.baseline_fit import BaselineFit
from bfsensor.diagnose.model.device_baseline import far_from_solution
from bfsensor.diagnose.model.predictor import Predictor, used_channels
from bfsensor.diagnose.plan.advice import RecordingPlan
from bfsensor.diagnose.plan.gaps import find_untested
from bfsensor.diagnose.report.attribution_words import reported, said_of
from bfsensor.diagnose.report.class_words import NAMES, SCAN_WORDS, said_family_p
from bfsensor.diagnose.report.device_words import (
    FittedQuantity,
    fitted_quantities,
    said_farthest,
)
from bfsensor.diagnose.report.headlines import headlines

SCHEMA = "bfsensor-diagnosis-1"
"""Name of report.json's layout, under its key 'schema'."""

FARTHEST, OF_EACH = 50, 10
"""Findings that report.json lists: the 50 farthest of all, and at least the 10 farthest of each channel.
Chosen: with twice as many the file grows by some 10 kB, and no result changes."""

NO_PLAN = RecordingPlan()
"""Plan without any advice."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Comparison of a campaign's recordings with a baseline, as :func:`diagnose` returns it.

    Attributes
    ----------
    campaign : str
        Name of the campaign.
    baseline : str
        Name or path of the baseline that predicted the recordings.
    measured : MeasuredChannels
        Channels measured in the recordings.
    fit : BaselineFit
        Fit of the baseline's free parameters (gains, lamp, device) without any effect.
    mismatch : Mismatch
        Residuals of that fit that stand out, with their family-wise p-values.
    heldout : float
        Chi-square over degrees of freedom of the held-out fold, which was not fitted; nan
        without one.
    notes : tuple of str
        Exposures set aside, warnings and assumptions.
    read : int
        Number of the first ``notes`` that come from reading the recordings.
    attribution : Attribution, optional
        Effects found in the mismatch; None where nothing stands out, or none were sought.
    plan : RecordingPlan
        Recordings that would separate the classes these ones do not distinguish.
    predictor : Predictor, optional
        Model that ``fit`` belongs to.

    Examples
    --------
    >>> from bfsensor.diagnose import diagnose_measured
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from bfsensor.diagnose import free_baseline, measure_reduced
    >>> from bfsensor.recording.tables.area_changes import AreaChangeTable
    >>> a = np.zeros((3, 3)); a[0, 0], a[0, 1], a[1, 0] = -1.4e-6, 3e-7, 4e-7
    >>> errors, independent = np.full((3, 3), 1e-8), np.ones((3, 3), bool)
    >>> table = AreaChangeTable(Path("drawn"), a, errors, independent)
    >>> baseline = free_baseline()
    >>> measured = measure_reduced(table, reach=baseline.reach)
    >>> result = diagnose_measured(measured, baseline, campaign="drawn")
    >>> result.to_report()["detected"], result.location()["lags"]
    (False, [])
    """

    campaign: str
    baseline: str
    measured: MeasuredChannels
    fit: BaselineFit
    mismatch: Mismatch
    heldout: float
    notes: tuple[str, ...] = ()
    read: int = 0
    attribution: Attribution | None = None
    plan: RecordingPlan = NO_PLAN
    predictor: Predictor | None = None

    @property
    def accepted(self) -> tuple[Predictor | None, BaselineFit]:
        """Predictor and fit with the effects found, or those of the baseline without attribution."""
        of = self.attribution or self
        return of.predictor, of.fit

    @property
    def quantities(self) -> list[FittedQuantity]:
        """Fitted quantities of the device with all effects found, the farthest from nominal first."""
        predictor, fit = self.accepted
        return [] if predictor is None else fitted_quantities(fit, predictor.baseline)

    @property
    def gain(self) -> float:
        """Mean fitted gain of the amplifiers [e-/ADU]; nan for a recording without amplifiers."""
        count = len(self.measured.amplifiers)
        return float(np.mean(self.fit.values[:count])) if count else np.nan

    def location(self) -> dict[str, Any]:
        """Locate the mismatch: channels, lags, fluxes [e-], columns, rows, amplifiers, exposures.

        Returns
        -------
        dict
            The key 'location' of report.json: 'channels', 'lags' (x, y) [pixel], 'flux_e' [e-],
            'x' and 'y' (first and one past the last column and row, from 0), 'amps' (counted from
            1), 'wavelength' [nm], 'exposures'; empty lists where nothing was detected.
        """
        out: dict[str, Any] = {
            "channels": [], "lags": [], "flux_e": [], "x": [], "y": [], "amps": [],
            "wavelength": [], "exposures": [],
        }  # fmt: skip
        if not self.mismatch.detected:
            return out
        if self.attribution is not None:
            count = len(self.measured.amplifiers)
            placed = place_effects(self.attribution, self.fit, self.measured.shape, count)
            if placed is not None:
                return placed
        # Most findings are templates correlated with the few that make up the residuals: these
        # parts come first.  Templates of different channels are not correlated, so a channel
        # without a part is represented by its farthest finding.
        found = [f for f in self.mismatch.findings if f.family != "chi-square"]
        seen = {p.word for p in self.mismatch.parts}
        others = {f.word: f for f in reversed(found) if f.word not in seen}
        parts = [*self.mismatch.parts, *list(others.values())[::-1]]
        words = dict.fromkeys(f.word for f in (*parts, *self.mismatch.findings))
        there = {c.word for c in self.fit.channels}
        shown = [w for word in words for w in (DEVICE_SEEN if word == DEVICE else (word,))]
        out["channels"] = [w for w in dict.fromkeys(shown) if w in there]
        best: dict[str, Any] = {}
        for part in parts:
            for key in part.where:
                best.setdefault(key, part)
        lags = [p for part in parts for p in part.where.get("lags", ())]
        out["lags"] = [list(p) for p in dict.fromkeys(lags)]
        if "level" in best:
            part = best["level"]
            scale = 1.0 if part.word == "spot" else self.gain
            out["flux_e"] = [float(v) * scale for v in part.where["level"]]
        else:
            out["flux_e"] = self._all_flux(out["channels"])
        ny, nx = self.measured.shape
        for key, size in (("x", nx), ("y", ny)):
            if key in best:
                out[key] = [int(v) for v in best[key].where[key]]
            elif size:
                out[key] = [0, size]
        count = len(self.measured.amplifiers)
        amps: set[int] = set()
        for part in parts:
            amp = part.where.get("amp", "all")
            amps |= set(range(1, count + 1)) if amp == "all" else {int(amp) + 1}
            if "other" in part.where:
                amps.add(int(part.where["other"]) + 1)
        out["amps"] = sorted(amps) or list(range(1, count + 1))
        if "condition" in best:
            out["wavelength"] = [float(best["condition"].where["condition"].split("/")[0])]
        if "exposure" in best:
            out["exposures"] = [int(v) for v in best["exposure"].where["exposure"]]
        return out

    def _heldout(self) -> dict[str, Any]:
        """Chi-square per value of the held-out recordings, without and with effects, by channel."""
        out: dict[str, Any] = {
            "chi2dof_before": _finite(self.heldout), "chi2dof_after": None,
            "values": sum(map(len, used_channels(self.measured.channels, ("held-out",)))),
            "channels": {},
        }  # fmt: skip
        told = self.attribution
        if told is not None and (told.found or told.free_form is not None):
            out["chi2dof_after"] = _finite(told.chi2dof()[1])
        if self.attribution is not None:
            out["fails_in"] = list(self.attribution.fails_in)
            out["channels"] = {
                word: {"before": b / n, "after": a / n, "values": n}
                for word, (b, a, n) in self.attribution.heldout.items()
                if n
            }
        return out

    def _all_flux(self, words: list[str]) -> list[float]:
        """Lowest and highest flux [e-] in the first of the channels that has a flux or level axis."""
        for word in words:
            name, scale = ("flux", 1.0) if word == "spot" else ("level", self.gain)
            held = [
                c.axes[name] for c in self.fit.channels if c.word == word and name in c.axes
            ]
            if held:
                both = scale * np.concatenate(held).astype(float)
                return [float(both.min()), float(both.max())]
        return []

    def said(self) -> str:
        """Summarise the diagnosis in a few sentences, as printed and at the top of report.html.

        Returns
        -------
        str
            The key 'said' of report.json.
        """
        m = self.mismatch
        if not m.detected:
            parts = [
                "Nothing stands out: noise alone gives a deviation as large as the largest of all "
                f"tests with a probability (family-wise p) of {said_family_p(m.p_value)}.",
                f"{len(self.fit.residuals):,} values in {len(m.chi2)} channels were compared with the "
                "baseline; effects that these recordings are not sensitive to are not excluded.",
            ]  # fmt: skip
        else:
            first = m.findings[0]
            others = self._elsewhere(first)
            first_said = headlines(self.attribution) if self.attribution else ""
            parts = [first_said] if first_said else []
            parts += [
                "The recordings differ from the baseline (family-wise p "
                f"{said_family_p(m.p_value)}), most in the {NAMES[first.word]} "
                f"({SCAN_WORDS.get(first.family, first.family)}: {abs(first.z):.1f} standard "
                "deviations)."
            ]
            if others:
                parts.append(f"It is also seen in: {', '.join(others)}.")
            if self.attribution is not None:
                parts += said_of(self.attribution)
        predictor, fit = self.accepted
        if predictor is not None and not far_from_solution(predictor.baseline, fit.pulls):
            parts += [said for said in [said_farthest(self.quantities)] if said]
        return " ".join(parts)

    def _elsewhere(self, first: Finding) -> list[str]:
        """Other channels with findings, each with the lags of its farthest one."""
        out = []
        for word in self.location()["channels"]:
            own = [f for f in self.mismatch.findings if f.word == word]
            lags = next((f for f in own if "lags" in f.where), None)
            if word != first.word:
                out.append(NAMES[word] + (f" ({_said_lags(lags)})" if lags else ""))
        return out

    def to_report(self) -> dict[str, Any]:
        """Make the contents of report.json, as a dictionary of plain Python types.

        Returns
        -------
        dict
            Keys of the layout named by its key 'schema'.
        """
        fitted = {
            name: {"value": float(v), "error": float(e)}
            for name, v, e in zip(
                self.fit.names, self.fit.values, self.fit.errors, strict=True
            )
            if not name.startswith(("map ", "spot ", "light ", "dark "))
        }
        return {
            "schema": SCHEMA,
            "campaign": self.campaign,
            "version": bfsensor.__version__,
            "baseline": self.baseline,
            "detected": bool(self.mismatch.detected),
            "p_value": self.mismatch.p_value,
            "p_chi2": self.mismatch.p_chi2,
            "p_scans": self.mismatch.p_scans,
            "alarm": ALARM,
            **reported(self.attribution),
            "location": self.location(),
            "converged": bool(self.fit.converged and self.accepted[1].converged),
            "cosmetics": [c.to_report() for c in self.measured.cosmetics],
            "recommended_recordings": self.plan.said(),
            "plan": self.plan.to_report(),
            "not_tested": [u.to_report() for u in find_untested(self.measured)],
            "heldout": self._heldout(),
            "channels": {
                word: {"chi2": s, "dof": d, "p_value": float(chi2_distribution.sf(s, d))}
                for word, (s, d) in self.mismatch.chi2.items()
            },
            "parts": [
                {"family": f.family, "channel": f.word, "z": f.z, "p_value": f.p_value,
                 "where": _plain(f.where)}
                for f in self.mismatch.parts
            ],
            "findings": [
                {"family": f.family, "channel": f.word, "z": f.z, "p_value": f.p_value,
                 "where": _plain(f.where)}
                for f in _shown(self.mismatch.findings)
            ],
            "parameters": fitted,
            "device": [q.to_report() for q in self.quantities],
            "exposures": dict(self.measured.counts),
            "unlike_flats": [
                {k: float(v) for k, v in vars(p).items()} | {"rises": bool(p.rises)}
                for p in self.measured.unlike
            ],
            "notes": list(self.notes),
            "said": self.said(),
        }  # fmt: skip


def _shown(findings: Sequence[Finding]) -> list[Finding]:
    """Farthest findings of all and of each channel, so that one channel does not fill the list."""
    out, count = [], Counter[str]()
    for n, finding in enumerate(findings):
        count[finding.word] += 1
        if n < FARTHEST or count[finding.word] <= OF_EACH:
            out.append(finding)
    return out


def _said_lags(finding: Finding) -> str:
    lags = finding.where["lags"]
    text = f"lag ({lags[0][0]}, {lags[0][1]})" if len(lags) == 1 else f"{len(lags)} lags"
    return f"{text}, {finding.z:+.1f} standard deviations"


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _plain(where: dict[str, Any]) -> dict[str, Any]:
    """Copy a mapping for JSON: tuples as lists, numpy scalars as Python numbers."""

    def plain(v: Any) -> Any:
        if isinstance(v, list | tuple):
            return [plain(x) for x in v]
        return v.item() if isinstance(v, np.generic) else v

    return {k: plain(v) for k, v in where.items()}
