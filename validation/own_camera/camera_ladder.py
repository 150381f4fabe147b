"""Stars drawn with HSC's fitted table grow with flux, and its kernel takes the growth out again.

``python -m validation.own_camera.camera_ladder RECORDINGS [--stars N] [-o OUT.ecsv]`` draws Moffat stars
(beta 3, FWHM 0.7 arcsec, 0.168 arcsec a pixel) of 1e4 to 4e6 electrons with galsim through
``BrighterFatterSensor("hsc_hamamatsu")``, and the same photons through the sensor without the effect
(``strength=0``).  Widths in x and y are those of adaptive moments.  The bright image is then corrected
with the kernel itself, which was never fitted to stars, as pipelines do
(:func:`bfsensor.measure.correct.correct_kernel`).  One row for each star and flux.
"""

from __future__ import annotations

from pathlib import Path

import click
import galsim
import numpy as np
from astropy.table import Table

from bfsensor import BrighterFatterSensor
from bfsensor.measure.correct import correct_kernel
from validation.common.write_results import write_results
from validation.own_camera.hsc_kernel import NAME, read_kernel

RESULTS = Path(__file__).parents[1] / "results" / "camera_ladder.ecsv"
COMMAND = "python -m validation.own_camera.camera_ladder RECORDINGS"
FLUXES = (1e5, 5e5, 1e6, 2e6, 4e6)
SIDE, SCALE, SEED = 61, 0.168, 7731


def widths(image: galsim.Image) -> tuple[float, float]:
    """Widths in x and y [pixel], by adaptive moments."""
    found = image.FindAdaptiveMom(guess_sig=2.0)
    size, e1 = found.moments_sigma, found.observed_shape.e1
    # moments_sigma is det^(1/4); e1 = (Ixx - Iyy) / (Ixx + Iyy), and e2 is small.
    shape = ((1 + e1) / (1 - e1)) ** 0.25
    return float(size * shape), float(size / shape)


def draw(flux: float, strength: float, seed: int) -> galsim.Image:
    """Draw a star; the photons are the same with and without the effect."""
    sensor = BrighterFatterSensor(
        NAME, strength=strength, rng=galsim.BaseDeviate(seed + 1), full_well=np.inf
    )
    star = galsim.Moffat(beta=3, fwhm=0.7, flux=flux)
    return star.drawImage(
        nx=SIDE, ny=SIDE, scale=SCALE, method="phot", sensor=sensor, poisson_flux=False,
        rng=galsim.BaseDeviate(seed), dtype=float,
    )  # fmt: skip


@click.command(help=__doc__)
@click.argument("recordings", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--stars", type=click.IntRange(min=2), default=8, show_default=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), default=RESULTS)
def main(recordings: Path, stars: int, output: Path) -> None:
    """Draw, measure, correct, print, write."""
    kernel = read_kernel(recordings)
    rows = []
    for flux in FLUXES:
        for n in range(stars):
            seed = SEED + 100 * n
            with_effect, without = draw(flux, 1.0, seed), draw(flux, 0.0, seed)
            mended = galsim.Image(
                correct_kernel(with_effect.array, kernel), scale=SCALE, dtype=float
            )
            row = {
                "flux": flux,
                "star": n,
                "peak": round(float(with_effect.array.max()), 1),
            }
            for name, image in (
                ("without", without),
                ("with", with_effect),
                ("corrected", mended),
            ):
                for axis, width in zip("xy", widths(image), strict=True):
                    row[f"{name}_{axis}"] = round(width, 6)
            rows.append(row)
    table = Table(rows)
    summary = []
    for flux in FLUXES:
        part = table[table["flux"] == flux]
        one: dict[str, float] = {
            "flux": flux,
            "peak": round(float(np.mean(part["peak"])), 0),
        }
        for axis in "xy":
            start = np.asarray(part[f"without_{axis}"])
            one[f"width_{axis}"] = round(float(np.mean(part[f"with_{axis}"])), 4)
            for name in ("with", "corrected"):
                change = 100 * (np.asarray(part[f"{name}_{axis}"]) / start - 1)
                error = change.std(ddof=1) / np.sqrt(len(change))
                one[f"{name}_{axis}_%"] = round(float(change.mean()), 4)
                one[f"{name}_{axis}_error_%"] = round(float(error), 4)
        summary.append(one)
        click.echo(", ".join(f"{k} {v:g}" for k, v in one.items()))
    write_results(table, output, COMMAND, ladder=summary)


if __name__ == "__main__":
    main()
