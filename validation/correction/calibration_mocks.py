"""Errors of a calibration, carried to the growth of stars, cover the true growth.

``python -m validation.correction.calibration_mocks [--mocks N]`` draws image-charge devices from the
priors of :mod:`bfsensor.fit.camera_fit` and their measured a_ij, as
``validation.own_camera.camera_recovery`` does (noise and 5 % of scatter about the model), fits them, and
compares the growth of a star with a sigma of 1.5 pixel by the fit with the true one.  A row a mock:
what a correction by the fit leaves of the true growth [%], its error by the fit, the part of it that is
noise, and the factor on the number of flat pairs that would halve the error.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from astropy.table import Table

from bfsensor.fit.camera_fit import fit_camera
from bfsensor.fit.correction_error import correction_error, star_growth
from validation.common.write_results import write_results
from validation.own_camera.camera_recovery import BASE, draw_device, make_mock

RESULTS = Path(__file__).parents[1] / "results" / "calibration_mocks.ecsv"
COMMAND = "python -m validation.correction.calibration_mocks"
SEED, SIGMA = 61544, 1.5


def mock_row(number: int) -> dict[str, object]:
    """Draw, measure and fit one device."""
    rng = np.random.default_rng([SEED, number])
    model, strength = draw_device(rng)
    found = fit_camera(make_mock(model, strength, rng), base=BASE)
    known = correction_error(found, sigma=SIGMA)
    true = star_growth(model, depth=BASE.thickness, sigma=SIGMA, strength=strength)
    row: dict[str, object] = {"mock": number}
    for n, axis in enumerate("xy"):
        # What a correction with the fitted table leaves of the true growth.
        row[f"left_{axis}"] = 100 * (1 - known.growth[n] / float(true[n]))
        row[f"error_{axis}"] = 100 * known.error[n]
        row[f"noise_{axis}"] = 100 * known.noise[n]
    row["pairs"] = known.pairs
    return row


def coverage(rows: Table) -> dict[str, float]:
    """Part of the true growths within 1 and 1.96 errors [%], over both axes, and rms pull."""
    pulls = np.concatenate([rows[f"left_{a}"] / rows[f"error_{a}"] for a in "xy"])
    return {
        "within_68": round(100 * float(np.mean(np.abs(pulls) < 1)), 1),
        "within_95": round(100 * float(np.mean(np.abs(pulls) < 1.96)), 1),
        "mean_pull": round(float(np.mean(pulls)), 3),
        "rms_pull": round(float(np.sqrt(np.mean(pulls**2))), 3),
    }


@click.command(help=__doc__)
@click.option("--mocks", default=50, show_default=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), default=RESULTS)
def main(mocks: int, output: Path) -> None:
    """Draw, fit, print, write."""
    rows = Table(rows=[mock_row(n) for n in range(mocks)])
    found = coverage(rows)
    click.echo(str(found))
    write_results(rows, output, COMMAND, coverage=found, seed=SEED)


if __name__ == "__main__":
    main()
