r"""The image-charge engine fitted as LSST's pipeline does: to our tables, and to measured a_ij.

``python -m validation.image_charge.image_charge_fit [--device NAME ...] [-o OUT.ecsv]`` fits
heights, half sides, strength and offset (:mod:`bfsensor.fit.image_charge_fit`; uniform drift field,
light converting at the back surface) to

``table``: the differential response of a shipped table about 40,000 e-, all lags up to 4, each with
an error of 5 %, so that the residuals say how well seven parameters describe what Poisson's equation
gives: chi2 is then the sum of (ratio - 1)^2 / 0.05^2.

``measured``: a_ij of LSST's two vendors (``SHARED/reference/*_covariances_21oct19.csv``, Poisson_CCD
repository @ 876adb8), lags up to 8, with the published errors, which are not errors of the mean
(chi2 far below the number of lags): ``error_scale`` is what they are too large by.  a_00 was
computed from the sum of the others and is not fitted.

With the offset, and without it.  One row for each lag; parameters, their errors and the least chi2
over heights of the charge are in the header.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.device.device import Device
from bfsensor.device.shipped import tables_dir
from bfsensor.fit.image_charge_fit import ImageChargeFit, fit_image_charge
from bfsensor.fit.image_charge_problem import SCALES
from bfsensor.recording.tables.area_changes import read_area_changes
from bfsensor.simulate.charge_field import ImageCharge
from bfsensor.table.table import DistortionTable
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "image_charge_fit.ecsv"
COMMAND = "python -m validation.image_charge.image_charge_fit"
LEVEL = 40_000.0
"""Background [e-] about which a table's response is taken."""

STEP = 100.0
"""Charge over it [e-]."""

RELATIVE = 0.05
MEASURED = {"itl_sta3800c": "itl", "e2v_ccd250": "e2v"}


def table_response(name: str) -> NDArray[np.float64]:
    """a_ij of a shipped table, light converting at the back [1/e-], ``[j, i]``."""
    table = DistortionTable.read(tables_dir() / name / "table.fits")
    change = table.area_changes(
        charge=LEVEL + STEP, background=LEVEL, depth=table.thickness
    )
    area = table.pitch[0] * table.pitch[1]
    return change[table.reach :, table.reach :] / (STEP * area)


def base_of(name: str) -> ImageCharge:
    """Thickness, pitch and permittivity of a device; the rest is fitted."""
    device = Device.load(name)
    return ImageCharge(
        0.5, 1.4, 3.2, 1.5, 3.0, device.silicon.thickness, device.pixel.pitch_x,
        device.pixel.pitch_y, 0.5, device.material.permittivity_silicon,
    )  # fmt: skip


def fits_of(name: str, shared: Path) -> dict[tuple[str, str], ImageChargeFit]:
    """Fit a device's table and its measured a_ij, with an offset and without."""
    base = base_of(name)
    a = table_response(name)
    path = shared / "reference" / f"{MEASURED[name]}_covariances_21oct19.csv"
    found = read_area_changes(path)
    cases = {
        "table": (a, RELATIVE * np.abs(a), None),
        "measured": (found.a, found.errors, found.independent),
    }
    return {
        (source, kind): fit_image_charge(values, errors, base=base, used=used, free=free)
        for source, (values, errors, used) in cases.items()
        for kind, free in (("offset free", SCALES), ("no offset", ("strength",)))
    }


def _describe(name: str, source: str, kind: str, fit: ImageChargeFit) -> dict[str, Any]:
    """Header entry of a fit."""
    errors = fit.parameter_errors
    dipole, spread = fit.dipole
    return {
        "device": name, "source": source, "model": kind,
        **{n: f"{v:.4g} +- {errors[n]:.2g}" for n, v in fit.values.items()},
        "dipole": f"{dipole:.4g} +- {spread:.2g}",
        "chi2": round(fit.chi2, 3), "degrees": fit.degrees_of_freedom,
        "error_scale": round(fit.error_scale, 3), "at_bounds": list(fit.bounded),
        "profile": [
            [round(float(z), 3), round(float(c - fit.chi2), 3)]
            for z, c in zip(fit.profile_heights, fit.profile_chi2, strict=True)
        ],
    }  # fmt: skip


@click.command(help=__doc__)
@click.option("--device", "names", multiple=True, default=tuple(MEASURED), show_default=True,
              type=click.Choice(tuple(MEASURED)))  # fmt: skip
@click.option("--shared", type=click.Path(path_type=Path, exists=True, file_okay=False),
              default=Path("../shared"), show_default=True)  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path), default=RESULTS)
def main(names: tuple[str, ...], shared: Path, output: Path) -> None:
    """Fit, print, write."""
    rows, heads = [], []
    for name in names:
        for (source, kind), fit in fits_of(name, shared).items():
            heads.append(_describe(name, source, kind, fit))
            click.echo("\n" + ", ".join(f"{k} {v}" for k, v in heads[-1].items()))
            pull = fit.residuals / fit.errors
            for (j, i), value in np.ndenumerate(fit.a):
                rows.append({
                    "device": name, "source": source, "model": kind, "i": i, "j": j,
                    "fitted": bool(fit.used[j, i]), "a_1e-6": round(1e6 * float(value), 6),
                    "error_1e-6": round(1e6 * float(fit.errors[j, i]), 6),
                    "image_charge_1e-6": round(1e6 * float(fit.predicted[j, i]), 6),
                    "ratio": round(float(fit.ratio[j, i]), 4),
                    "pull": round(float(pull[j, i]), 3),
                })  # fmt: skip
            click.echo("  image charge over given, rows j, columns i:")
            for line in fit.ratio[:5, :5]:
                click.echo("    " + " ".join(f"{v:8.3f}" for v in line))
    write_results(Table(rows), str(output), COMMAND, fits=heads)


if __name__ == "__main__":
    main()
