"""A diagnosis: measure, fit the baseline, locate what is left, say it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2 as chi2_distribution

import bfsensor
from bfsensor.diagnose.baseline import Baseline
from bfsensor.diagnose.extract import Measured, Source, measure_channels
from bfsensor.diagnose.locate import ALARM, Mismatch, locate_mismatch
from bfsensor.diagnose.mismatch import BaselineFit, fit_baseline
from bfsensor.diagnose.predict import Predictor, used_channels

SCHEMA = "bfsensor-diagnosis-1"
FITTED = ("fit", "select")
NAMES = {
    "flat_cov": "covariances of flats", "flat_mean": "mean of flats against the lamp",
    "flat_map": "flats against position", "serial_overscan": "serial overscan",
    "parallel_overscan": "parallel overscan", "bias_cov": "noise in readout order",
    "bias_level": "bias levels", "dark_map": "darks", "spot": "spots",
    "amp_cross": "amplifiers against one another", "code_hist": "converter codes",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What recordings and baseline say of one another.

    Attributes
    ----------
    campaign : str
        Its name.
    baseline : str
        What predicted.
    measured : Measured
        The channels.
    fit : BaselineFit
        The baseline with all that may float.
    mismatch : Mismatch
        What is left, and how unlikely that is.
    heldout : float
        Chi-square over degrees of freedom of the fold that was not fitted; nan without one.
    notes : tuple of str
        What was set aside, warned of or assumed.
    """

    campaign: str
    baseline: str
    measured: Measured
    fit: BaselineFit
    mismatch: Mismatch
    heldout: float
    notes: tuple[str, ...] = ()

    @property
    def gain(self) -> float:
        """Mean gain of the amplifiers [e-/ADU]."""
        count = len(self.measured.amplifiers)
        return float(np.mean(self.fit.values[:count]))

    def location(self) -> dict[str, Any]:
        """Where the mismatch is, as report.json has it; empty lists where nothing was found."""
        out: dict[str, Any] = {
            "channels": [], "lags": [], "flux_e": [], "x": [], "y": [], "amps": [],
            "wavelength": [], "exposures": [],
        }  # fmt: skip
        if not self.mismatch.detected:
            return out
        # Of all that stands out most is shadow of the same: the parts are what makes it up.
        parts = self.mismatch.parts
        out["channels"] = list(
            dict.fromkeys(f.word for f in parts or self.mismatch.findings)
        )
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
            out[key] = [int(v) for v in best[key].where[key]] if key in best else [0, size]
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

    def _all_flux(self, words: list[str]) -> list[float]:
        """Lowest and highest flux [e-] of the first of channels that has any."""
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
        """Give the diagnosis in two or three plain sentences."""
        m = self.mismatch
        if not m.detected:
            parts = [
                "Nothing stands out: the largest of all statistics has a family-wise p of "
                f"{m.p_value:.2g}.",
                f"{len(self.fit.residuals)} values in {len(m.chi2)} channels were held against the "
                "baseline; what these recordings cannot see is not excluded.",
            ]  # fmt: skip
        else:
            first = m.findings[0]
            others = [NAMES[w] for w in self.location()["channels"] if w != first.word]
            parts = [
                f"The recordings differ from the baseline (family-wise p {m.p_value:.2g}), most in "
                f"the {NAMES[first.word]} ({first.family}, {abs(first.z):.1f} standard deviations)."
            ]  # fmt: skip
            if others:
                parts.append(f"It is also seen in: {', '.join(others)}.")
        far = {k: v for k, v in self.fit.pulls.items() if abs(v) > 3}
        if far:
            text = ", ".join(f"{k} {v:+.1f}" for k, v in far.items())
            parts.append(f"Device parameters off the card, in units of its spread: {text}.")
        return " ".join(parts)

    def to_report(self) -> dict[str, Any]:
        """Contents of report.json."""
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
            "effects": [],
            "class_probability": {},
            "equivalence_class": [],
            "open_world": False,
            "location": self.location(),
            "recommended_recordings": [],
            "heldout": {"chi2dof_before": _finite(self.heldout), "chi2dof_after": None},
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
                for f in self.mismatch.findings[:50]
            ],
            "parameters": fitted,
            "exposures": dict(self.measured.counts),
            "notes": list(self.notes),
            "said": self.said(),
        }  # fmt: skip


def diagnose(
    source: Source,
    baseline: Baseline,
    *,
    campaign: str = "",
    seed: int = 1,
    notes: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
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
    """
    measured = measure_channels(source, progress=progress)
    predictor = Predictor(measured, baseline)
    fit = fit_baseline(predictor, used_channels(measured.channels, FITTED))
    return Diagnosis(
        campaign=campaign,
        baseline=baseline.name,
        measured=measured,
        fit=fit,
        mismatch=locate_mismatch(fit, seed=seed),
        heldout=held_out(predictor, fit, measured),
        notes=(*notes, *measured.notes, *fit.notes),
    )


def held_out(predictor: Predictor, fit: BaselineFit, measured: Measured) -> float:
    """Chi-square over number of the values that were not fitted, all parameters as fitted."""
    values = dict(zip(fit.names, fit.values, strict=True))
    point = fit.values[: len(predictor.names)]
    square, number = 0.0, 0
    for channel in used_channels(measured.channels, ("held-out",)):
        predicted = predictor.predict(channel, point)
        for name, column in predictor.linear(channel).items():
            predicted = predicted + values.get(name, 0.0) * column
        left = channel.whiten(channel.values - predicted)
        square += float(left @ left)
        number += len(channel)
    return square / number if number else np.nan


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _plain(where: dict[str, Any]) -> dict[str, Any]:
    """Tuples as lists, numpy's numbers as Python's."""

    def plain(v: Any) -> Any:
        if isinstance(v, list | tuple):
            return [plain(x) for x in v]
        return v.item() if isinstance(v, np.generic) else v

    return {k: plain(v) for k, v in where.items()}
