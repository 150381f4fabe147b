"""Strong signals, and recordings that the baseline cannot predict, end with a report."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np
import pytest

from bfsensor.diagnose import diagnosis
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.fit.baseline_fit import UNSETTLED, fit_baseline
from bfsensor.diagnose.fit.gauss_newton import Steps
from bfsensor.errors import ConvergenceError
from bfsensor.inference import mixed_model
from bfsensor.inference.trust_region import minimise
from tests.diagnose.fit.test_gauss_newton import Halo, channel
from tests.virtual import Effect, Range, make_effect, measure_virtual, virtual_baseline


class Dust(Effect):
    """Ten round dust spots of up to a few per cent, the same in all exposures."""

    word = "dust"
    variants: ClassVar = {"": {"depth": Range(1e-3, 0.1, amplitude=True)}}

    def light(self, scene, context):
        rng = np.random.default_rng(417)
        y, x = np.indices(scene.light.shape)
        for _ in range(10):
            cx, cy = rng.uniform(0, x.shape[1]), rng.uniform(0, x.shape[0])
            width = rng.uniform(3.0, 9.0)
            shadow = np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / width**2)
            scene.scale(1 - self.parameters["depth"] * rng.uniform(0.2, 1.0) * shadow)


def test_a_fit_that_does_not_converge_gives_its_best_point(monkeypatch):
    monkeypatch.setattr(mixed_model, "minimise", partial(minimise, evaluations=4))
    halo, one = Halo((0.3, 20.0)), channel((0.02, 3.0))
    fit = fit_baseline(halo, [one])
    assert not fit.converged and UNSETTLED in fit.notes
    assert np.isfinite(fit.values).all() and np.isfinite(fit.residuals).all()
    start = Steps(halo, [one])
    start.stay(halo.start)
    assert fit.residuals @ fit.residuals < start.solved.left @ start.solved.left
    monkeypatch.undo()
    assert fit_baseline(halo, [one]).converged


def test_a_channel_that_cannot_be_predicted_is_set_aside():
    measured = measure_virtual(seed=7102)
    dark = [
        Channel(c.word, c.values, c.blocks, dict(c.axes) | {"flux": -c.axes["flux"]}, c.unit, c.fold)
        if c.word == "spot" else c
        for c in measured.channels
    ]  # fmt: skip
    found = diagnose_measured(replace(measured, channels=tuple(dark)), virtual_baseline())
    assert not found.mismatch.detected
    assert "spot" not in found.mismatch.chi2 and "flat_cov" in found.mismatch.chi2
    assert sum("spot" in n and "set aside" in n for n in found.notes) == len(
        [c for c in dark if c.word == "spot"]
    )


def test_a_mismatch_without_explanation_is_reported(fitted_loss, monkeypatch):
    def fail(*args, **kwargs):
        raise ConvergenceError("nothing can be predicted there")

    monkeypatch.setattr(diagnosis, "attribute", fail)
    found = diagnose_measured(fitted_loss[0], virtual_baseline())
    assert found.mismatch.detected and found.attribution is None
    assert any("not explained: nothing can be predicted" in n for n in found.notes)
    assert found.to_report()["detected"]


STRONG = {
    "tearing": [("tearing", {"amp": 0.15, "length": 3.0, "column": 0.5}, "")],
    "rings and fringes": [
        (
            "tree_rings",
            {"amp": 0.02, "period": 18.0, "xc": -60.0, "yc": 300.0, "chirp": 0.0},
            "",
        ),
        ("fringing", {"amp": 0.01, "period": 30.0}, ""),
    ],
    "dust": [],
}


@pytest.mark.slow
@pytest.mark.parametrize("case", STRONG)
def test_strong_signals_end_with_a_report(case):
    effects = [make_effect(*args) for args in STRONG[case]] or [Dust({"depth": 0.05})]
    measured = measure_virtual(seed=7103, effects=effects)
    found = diagnose_measured(measured, virtual_baseline())
    report = found.to_report()
    assert report["detected"] and report["effects"] and report["said"]
    assert any(f.word == "flat_map" for f in found.mismatch.findings)
