"""Known image-charge devices come back within their errors from a_ij with noise.

``python -m validation.own_camera.camera_recovery [--mocks N] [-o OUT.ecsv]`` draws the parameters of a
device (200 um of silicon, 15 um pixels) from the priors of :mod:`bfsensor.fit.camera_fit`, computes its
a_ij at lags up to 4, multiplies each by 1 + 0.05 of a Gaussian number (what the model misses of real
devices, :data:`bfsensor.fit.camera_fit.MODEL_ERROR`), adds Gaussian noise of 1e-9 per electron (root
two more on the axes, twice as much for a_00, where mirrored lags are not averaged), and fits.  One row
for each mock: pulls (fitted minus true, in errors, of logarithms and logits) of parameters and of the
dipole, charge height over drift field; a_01 over the true one at a conversion depth that was not
measured; chi2.  As truths come from the priors, pulls of
all parameters have mean 0 and standard deviation 1 if the errors are right, also where priors determine
them.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from astropy.table import Table
from scipy.special import expit, logit

from bfsensor.fit.camera_areas import CameraAreas
from bfsensor.fit.camera_fit import (
    FIELD_GUESSED,
    MODEL_ERROR,
    PRIORS,
    CameraFit,
    fit_camera,
)
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.simulate.image_charge import area_changes
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "camera_recovery.ecsv"
COMMAND = "python -m validation.own_camera.camera_recovery"
SEED, LAGS, NOISE = 40211, 4, 1e-9
BASE = ImageCharge(
    0.5, 1.5, 2.5, 3.0, 3.0, thickness=200.0, pitch_x=15.0, pitch_y=15.0,
    drift_field=((0.0, 0.63), (200.0, 0.45)),
)  # fmt: skip


def draw_device(rng: np.random.Generator) -> tuple[ImageCharge, float]:
    """Draw a device from the priors, and the strength that its drift field gives."""
    height, row, column = (
        np.exp(rng.normal(*PRIORS[name]))
        for name in ("charge_height", "row_height", "column_height")
    )
    half = [
        expit(rng.normal(*PRIORS[f"half_width_{axis}"])) * BASE.pitch_x / 2 for axis in "xy"
    ]
    model = ImageCharge(
        height, height + row, height + column, *half, BASE.thickness, BASE.pitch_x,
        BASE.pitch_y, BASE.drift_field,
    )  # fmt: skip
    return model, float(np.exp(-rng.normal(0.0, FIELD_GUESSED)))


def make_mock(model: ImageCharge, strength: float, rng: np.random.Generator) -> CameraAreas:
    """a_ij of a device with the noise of a measurement and the scatter of real devices."""
    a = strength * area_changes(model, depth=BASE.thickness, reach=LAGS)[LAGS:, LAGS:]
    j, i = np.indices(a.shape)
    errors = NOISE * np.sqrt(np.where(i == 0, 2.0, 1.0) * np.where(j == 0, 2.0, 1.0))
    a = a * (1 + MODEL_ERROR * rng.normal(size=a.shape))
    return CameraAreas(a + errors * rng.normal(size=a.shape), errors, a == a, "mock")


def pulls(found: CameraFit, model: ImageCharge, strength: float) -> dict[str, float]:
    """Fitted minus true over the error, of the logarithms and logits that the fit varies."""
    fit, errors = found.fit, found.fit.parameter_errors
    out = {}
    for name in fit.names:
        value = fit.values[name]
        true = strength if name == "strength" else getattr(model, name)
        if name.startswith("half"):
            share, was = (2 * one / BASE.pitch_x for one in (value, true))
            slope = share * (1 - share) * BASE.pitch_x / 2
            out[name] = (logit(share) - logit(was)) * slope / errors[name]
        else:
            out[name] = np.log(value / true) * value / errors[name]
    dipole, spread = fit.dipole
    out["dipole"] = np.log(dipole / (strength * model.charge_height)) * dipole / spread
    return {name: round(float(pull), 3) for name, pull in out.items()}


@click.command(help=__doc__)
@click.option("--mocks", default=50, show_default=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), default=RESULTS)
def main(mocks: int, output: Path) -> None:
    """Draw, fit, print, write."""
    rng = np.random.default_rng(SEED)
    rows = []
    for n in range(mocks):
        model, strength = draw_device(rng)
        found = fit_camera(make_mock(model, strength, rng), base=BASE)
        rows.append({
            "mock": n, **pulls(found, model, strength), "chi2": round(found.chi2, 3),
            "degrees_of_freedom": round(found.degrees_of_freedom, 3),
            "error_scale": round(found.error_scale, 3),
            **{f"{name}_by": found.determined_by(name) for name in found.fit.names},
            "a01_at_15um": round(_ratio(found, model, strength), 4),
        })  # fmt: skip
    table = Table(rows)
    summary = {}
    for name in ("charge_height", "row_height", "column_height", "half_width_x",
                 "half_width_y", "strength", "dipole"):  # fmt: skip
        one = np.asarray(table[name], float)
        one = one[np.isfinite(one)]
        summary[name] = {"mean": round(float(one.mean()), 3), "sd": round(float(one.std()), 3),
                         "within_1": round(float(np.mean(np.abs(one) < 1)), 3),
                         "n": len(one)}  # fmt: skip
        click.echo(f"{name:16} {summary[name]}")
    reduced = float(np.sum(table["chi2"]) / np.sum(table["degrees_of_freedom"]))
    click.echo(f"chi2/n {reduced:.3f}")
    depth = np.asarray(table["a01_at_15um"])
    click.echo(
        f"a_01 fitted over true at 15 um: {depth.mean():.3f} +- {depth.std():.3f} a mock"
    )
    write_results(
        table, output, COMMAND, pulls=summary, chi2_per_degree=round(reduced, 4), seed=SEED
    )


def _ratio(found: CameraFit, model: ImageCharge, strength: float) -> float:
    """a_01 of the fit over the true one for light that converts 15 um above the gates."""
    true = strength * area_changes(model, depth=15.0, reach=1)[2, 1]
    return float(area_changes(found.model, depth=15.0, reach=1)[2, 1] / true)


if __name__ == "__main__":
    main()
