"""Measured a_ij of LSST's two vendors against tables: what the diagnosis names, and its ties.

``SHARED/reference/{itl,e2v}_covariances_21oct19.csv`` (Poisson_CCD repository @ 876adb8), held
against GalSim's shipped tables and ours.  A table of our devices knows one operating point;
:func:`bfsensor.diagnose.model.table_baseline.with_operating_point` lets it move on the line to that of a
second table of the same device card, so that *another operating point* stands among the candidates
as a parameter of the device.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bfsensor.device.device import Device
from bfsensor.device.parameters import parameter_value
from bfsensor.diagnose.data.reduced_channels import measure_reduced
from bfsensor.diagnose.detect.candidates import candidates_of
from bfsensor.diagnose.detect.locate import locate_mismatch
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from bfsensor.diagnose.fit.fitted_model import Model
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.open_baseline import simulate_baseline
from bfsensor.diagnose.model.table_baseline import baseline_of_table, with_operating_point
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.effects.changed_device import Quantity
from bfsensor.errors import ConvergenceError
from bfsensor.recording.tables.area_changes import AreaChangeTable

PAIRS = {"itl": ("itl_sta3800c", "itl_sta3800c_60"), "e2v": ("e2v_ccd250", "e2v_ccd250_70")}
"""Two tables of one device card, at two operating points."""

GALSIM = {
    "itl": ("lsst_itl_50_32", "lsst_itl_32"),
    "e2v": ("lsst_e2v_50_32", "lsst_e2v_32"),
}
"""GalSim's: -50 V and -60 V, gates as well."""


CARD = (
    "silicon.thickness", "silicon.background_doping", "gates.gate_oxide",
    "channel.implant[0].dose", "channel_stop.dots.height", "channel_stop.dots.implant[0].dose",
    "operating_point.hole_quasi_fermi_level",
)  # fmt: skip
"""Of the E2V card, the quantities with the widest say in the areas."""


def exchanged(table: AreaChangeTable) -> AreaChangeTable:
    """The table with its axes exchanged, as real pipelines had them."""
    return AreaChangeTable(table.path, table.a.T, table.errors.T, table.independent.T)


def explain(table: AreaChangeTable, baseline: Baseline) -> Diagnosis:
    """Diagnose measured a_ij, with what explains them."""
    return diagnose_measured(measure_reduced(table, reach=baseline.reach), baseline)


def find(name: str) -> Baseline:
    """A table as a baseline with nothing that floats."""
    return baseline_of_table(name)


def with_device(name: str, other: str, *, keep: Path) -> Baseline:
    """Operating point and quantities of the device card float together.

    Derivatives by the card's quantities are simulated at 16 cells a pixel (40 CPU s; kept).
    """
    device = Device.load(name)
    card = simulate_baseline(name, CARD, (), keep=keep)
    line = with_operating_point(name, other)
    return replace(
        line,
        name=f"{name}, operating point and card free",
        derivatives={**line.derivatives, **card.derivatives},
        spread={**line.spread, **card.spread},
        nominal={**line.nominal, **{n: parameter_value(device, n) for n in CARD}},
        units={**line.units, **card.units},
        accuracy=card.accuracy,
    )


def only(baseline: Baseline, name: str) -> Baseline:
    """The baseline with one of its parameters."""
    return baseline.without([n for n in baseline.derivatives if n != name])


def free_one(
    table: AreaChangeTable, baseline: Baseline
) -> tuple[float, float, float, float]:
    """One parameter of the device without its prior: value, error, chi-square, p-value that is left."""
    (name,) = baseline.derivatives
    predictor, fit = fit_bounded(measure_reduced(table, reach=baseline.reach), baseline)
    kind = next(
        k for k in candidates_of(baseline)
        if isinstance(getattr(k, "template", None), Quantity) and k.template.name == name
    )  # fmt: skip
    models = []
    for start in kind.starts(predictor.layout):
        try:
            models.append(Model(predictor, fit).with_effects([kind(start)]))
        except ConvergenceError:
            continue
    if not models:
        raise ConvergenceError(f"{name}: no fit converged", [])
    best = min(models, key=lambda m: m.fit.total)
    left = locate_mismatch(best.fit, seed=1)
    square, _ = left.chi2["flat_cov"]
    return best.effects[0][name], best.errors(0)[name], square, left.p_value
