"""Stars and flats drawn by the sensor, corrected with what LSST's formats hold of its own table.

``python -m validation.correction.correction_round_trip stars|flats|show [--device NAME]``

The table is exported as a kernel and as a distortion matrix, written, read back and applied to
images that the sensor drew from that very table: what is left is what the corrections lack.

stars
    Gaussian stars of several peaks, from the same photons with and without the effect; growth of
    the second moments before and after every correction, a row a star in
    ``validation/results/correction_round_trip.ecsv``.
flats
    Flats by areas; covariances before and after, a row a flat in ``correction_flats.ecsv``.

Rows that are there are not made again; ``show`` prints what they say.  The causes are separated by
``validation.correction.correction_causes``.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path

import click
import galsim
import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray

from bfsensor import BrighterFatterSensor, DistortionTable
from bfsensor.device.shipped import tables_dir
from bfsensor.measure.correct import correct_edges, correct_kernel
from bfsensor.recording.tables.lsst_datasets import BrighterFatterKernel, DistortionMatrix
from bfsensor.sensor.flats import draw_flat
from bfsensor.sensor.table_correction import correct_table
from bfsensor.table.lsst_format import make_distortion_matrix, make_kernel, solve_kernel
from bfsensor.table.quadrant_shifts import QuadrantShifts, quadrant_shifts
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results"
STARS, FLATS = RESULTS / "correction_round_trip.ecsv", RESULTS / "correction_flats.ecsv"
COMMAND = "python -m validation.correction.correction_round_trip"
SIDE = 31
SIGMAS = (1.0, 1.5, 2.5)
PEAKS = (20e3, 40e3, 60e3, 80e3, 100e3, 120e3)
UNIT = 50e3
BAND = np.arange(920.0, 1051.0, 5.0)
"""Wavelengths [nm] that stand for the y band, equally many photons each."""
RECALC = 500.0
"""Electrons between renewals of the boundaries.  Chosen: with the usual 10,000 they lag behind the
charge by 2 % of that in the smallest star, by which corrections would seem to take too much; with twice
as many the lag is 0.2 %."""
FLAT_KERNEL = 80e3
LEVELS = (25e3, 50e3, 80e3)
FLAT_SIDE, BORDER, LAGS = 768, 10, 4
FLAT_STEP = 500.0
"""Charge [e-] between areas of a flat.  Chosen: n steps make covariances too small by 1 / n^2, 0.04 %
at the lowest level; with twice as much by 0.16 %."""
SENSORS = {
    "whole": {},
    "linear": {"charge_response": False, "background": False},
    "y light": {},
    "no diffusion": {
        "charge_response": False,
        "background": False,
        "diffusion_factor": 0.0,
    },
}
Correction = Callable[[NDArray], NDArray]


@lru_cache(maxsize=4)
def table_of(device: str) -> DistortionTable:
    """Give a built-in table."""
    return DistortionTable.read(tables_dir() / device / "table.fits")


def export(device: str, folder: Path) -> tuple[BrighterFatterKernel, DistortionMatrix]:
    """Write both formats and read them: what a pipeline would have of the table."""
    table = table_of(device)
    # The sensor's shifts end with the table, and so do these.
    surface = quadrant_shifts(table, tail_slope=None)
    band = quadrant_shifts(table, tail_slope=None, wavelengths=BAND)
    kernel = make_kernel(surface, {"C00": 1.5})
    matrix = make_distortion_matrix(
        surface, {"C00": 1.5}, filters={"y": band}, thickness=table.thickness,
        pitch=table.pitch[0],
    )  # fmt: skip
    kernel.write(folder / "bfk.fits", overwrite=True)
    matrix.write(folder / "matrix.fits", overwrite=True)
    return (
        BrighterFatterKernel.read(folder / "bfk.fits"),
        DistortionMatrix.read(folder / "matrix.fits"),
    )


@lru_cache(maxsize=4)
def corrections(device: str) -> dict[str, Correction]:
    """Give the corrections by name."""
    with tempfile.TemporaryDirectory() as folder:
        kernels, matrix = export(device, Path(folder))
    columns = matrix.columns
    kernel, north, east = kernels.columns["KERNEL"][0], columns["A_N"][0], columns["A_E"][0]
    # The second lag axis of a filter's shifts is x as well.
    north_y, east_y = (columns[f"A_{side}_BY_FILTER"][0, 0] for side in "NE")
    areas_y = QuadrantShifts(north_y, east_y).areas
    tail = quadrant_shifts(table_of(device))
    half_full = quadrant_shifts(table_of(device), background=50e3, tail_slope=None)
    flat = expected(device, FLAT_KERNEL, linear=False)
    flat[0, 0] -= FLAT_KERNEL

    def by_edges(upper: NDArray, right: NDArray) -> Correction:
        return lambda image: correct_edges(image, upper, right)

    def by_kernel(k: NDArray, **options: object) -> Correction:
        return lambda image: correct_kernel(image, k, **options)

    return {
        "none": lambda image: image,
        "edges": by_edges(north, east),
        "kernel": by_kernel(kernel),
        "kernel, once": by_kernel(kernel, threshold=np.inf),
        "kernel, expanded": by_kernel(kernel, conserving=False),
        "edges, transposed": by_edges(east.T, north.T),
        "kernel, transposed": by_kernel(kernel.T),
        "edges, y band": by_edges(north_y, east_y),
        "kernel, y band": by_kernel(solve_kernel(areas_y)),
        "edges, with tail": by_edges(*tail),
        "edges, at 50 ke-": by_edges(*half_full),
        "kernel, flats of 80 ke-": by_kernel(solve_kernel(flat / FLAT_KERNEL**2)),
        "table": partial(correct_table, table=table_of(device), surroundings=0.0),
        "table, y band": partial(
            correct_table, table=table_of(device), surroundings=0.0, wavelengths=BAND
        ),
    }


# -- stars -----------------------------------------------------------------------------


def photons_of(sigma: float, peak: float, seed: int, *, band: bool) -> galsim.PhotonArray:
    """Photons of a star somewhere in the middle pixel."""
    rng = np.random.default_rng([seed, int(peak), int(100 * sigma)])
    place = np.random.default_rng([seed, 5077]).random(2) - 0.5
    x, y = rng.normal(0, sigma, (2, rng.poisson(peak * 2 * np.pi * sigma**2)))
    photons = galsim.PhotonArray(len(x), x + place[0], y + place[1], np.ones(len(x)))
    if band:
        photons.wavelength = rng.choice(BAND, len(x))
    return photons


def draw(sensor: str, device: str, strength: float, photons, seed: int) -> NDArray:
    """Draw a star; what is not drawn is the same for all strengths."""
    camera = BrighterFatterSensor(
        table=table_of(device), strength=strength, rng=galsim.BaseDeviate(seed), nrecalc=RECALC,
        **SENSORS[sensor],
    )  # fmt: skip
    image = galsim.ImageD(SIDE, SIDE)
    image.setCenter(0, 0)
    camera.accumulate(photons, image)
    return image.array


def moments(pixels: NDArray) -> tuple[float, float]:
    """Second moments in x and y [pixel^2]."""
    at = np.arange(len(pixels)) - len(pixels) // 2
    out = []
    for profile in (pixels.sum(0), pixels.sum(1)):
        total = profile.sum()
        out.append(float(profile @ at**2 / total - (profile @ at / total) ** 2))
    return out[0], out[1]


def growth(pixels: NDArray, without: NDArray) -> NDArray:
    """Growth of both second moments [%]."""
    return 100 * (np.divide(moments(pixels), moments(without)) - 1)


def star_row(device: str, sensor: str, sigma: float, peak: float, seed: int) -> dict:
    """Draw one star with and without the effect and correct it every way."""
    began = time.process_time()
    photons = photons_of(sigma, peak, seed, band=sensor == "y light")
    on, off = (draw(sensor, device, strength, photons, seed) for strength in (1.0, 0.0))
    row: dict[str, object] = {
        "device": device, "sensor": sensor, "sigma": sigma, "peak": peak, "seed": seed,
        "variance_off": float(np.mean(moments(off))),
    }  # fmt: skip
    for name, correct in corrections(device).items():
        row[f"x {name}"], row[f"y {name}"] = growth(correct(on), off)
    row["cpu_s"] = round(time.process_time() - began, 2)
    return row


def slope(peaks: NDArray, growths: NDArray) -> float:
    """Slope [% per 50,000 e-] of a line through the origin."""
    return float(UNIT * (peaks @ growths) / (peaks @ peaks))


def residuals(
    rows: Table, sensor: str, sigma: float, name: str, axis: str
) -> tuple[float, float, float]:
    """What a correction leaves of the slope [%], its error, and the slope before it.

    Errors from the stars: what the correction leaves is compared star by star.
    """
    rows = rows[(rows["sensor"] == sensor) & (rows["sigma"] == sigma)]
    pairs = []
    for seed in sorted(set(rows["seed"])):
        part = rows[rows["seed"] == seed]
        peaks = np.array(part["peak"])
        pairs.append([slope(peaks, np.array(part[f"{axis} {n}"])) for n in ("none", name)])
    before, after = np.transpose(pairs)
    left = after.mean() / before.mean()
    error = np.std(after - left * before, ddof=1) / np.sqrt(len(pairs)) / before.mean()
    return 100 * float(left), 100 * float(error), float(before.mean())


# -- flats -----------------------------------------------------------------------------


def expected(device: str, level: float, *, linear: bool, steps: int = 40) -> NDArray:
    r"""Covariances [e-^2] that areas give flats, by lag in y and x.

    :math:`d\tilde C / d\mu = 1 + 2 \tilde a(\mu)\, \tilde C` in Fourier space.
    """
    return np.fft.ifft2(spectra(device, level, linear=linear, steps=steps)[0]).real[:8, :8]


@lru_cache(maxsize=32)
def spectra(
    device: str, level: float, *, linear: bool, steps: int = 40
) -> tuple[NDArray, NDArray]:
    r"""Spectrum of a flat [e-^2], and by how much it answers a faint pattern of the light.

    The pattern grows with the light, up to the level :math:`\mu_1`:
    :math:`d\tilde R / d\mu = 1 / \mu_1 + \tilde a(\mu)\, \tilde R`.
    """
    n, step = 32, level / steps
    spectrum, answer = np.zeros((2, n, n))
    for k in range(steps):
        a = _areas(device, 0.0 if linear else (k + 0.5) * step)
        lag = np.minimum(np.arange(n), n - np.arange(n))
        wide = np.zeros((n // 2 + 1,) * 2)
        wide[: len(a), : len(a)] = a
        grown = step * np.fft.fft2(wide[np.ix_(lag, lag)]).real
        spectrum = spectrum * np.exp(2 * grown) + step * _mean_growth(2 * grown)
        answer = answer * np.exp(grown) + step / level * _mean_growth(grown)
    return spectrum, answer


@lru_cache(maxsize=1)
def _areas(device: str, background: float) -> NDArray:
    """Area changes [1/e-] of a quadrant on a background [e-]; linear spectra ask for one alone."""
    return quadrant_shifts(table_of(device), background=background, tail_slope=None).areas


def _mean_growth(exponent: NDArray) -> NDArray:
    """Mean of exp(t exponent) for t from 0 to 1."""
    small = np.abs(exponent) < 1e-12
    return np.where(small, 1.0, np.expm1(exponent) / np.where(small, 1.0, exponent))


def left_by_paths(device: str, level: float, *, linear: bool) -> NDArray:
    r"""Part [%] of what areas give flats that an exact correction leaves, by lag in y and x.

    Two pixels with equal charges at the end had different ones on the way there: what came early acted
    for longer.  A correction knows the charge at the end and takes it for proportional to the time, as
    that of light that does not change is.  The rest, :math:`\tilde C / \tilde R^2 - \mu`, about
    :math:`(\tilde a \mu)^2 \mu / 12`, is noise.
    """
    spectrum, answer = spectra(device, level, linear=linear)
    left = np.fft.ifft2(spectrum / answer**2 - level).real
    given = np.fft.ifft2(spectrum - level).real
    return 100 * (left / given)[: LAGS + 1, : LAGS + 1]


def covariances(image: NDArray) -> NDArray:
    """Covariances [e-^2] by lag in y and x, mean of both diagonals, inside the border."""
    inner = image[BORDER:-BORDER, BORDER:-BORDER]
    d = inner - inner.mean()
    ny, nx = d.shape
    out = np.empty((LAGS + 1, LAGS + 1))
    for j in range(LAGS + 1):
        for i in range(LAGS + 1):
            up = (d[: ny - j, : nx - i] * d[j:, i:]).mean()
            down = (d[j:, : nx - i] * d[: ny - j, i:]).mean()
            out[j, i] = 0.5 * (up + down)
    return out


FLAT_CORRECTIONS = (
    "none", "edges", "kernel", "kernel, once", "edges, transposed", "edges, at 50 ke-",
    "kernel, flats of 80 ke-", "table",
)  # fmt: skip


def flat_row(device: str, sensor: str, level: float, seed: int) -> dict:
    """Draw one flat and measure its covariances before and after."""
    began = time.process_time()
    camera = BrighterFatterSensor(table=table_of(device), **SENSORS[sensor])
    flat = draw_flat(
        camera, (FLAT_SIDE, FLAT_SIDE), level, step=FLAT_STEP,
        rng=galsim.BaseDeviate(seed + int(level)), dtype=np.float64,
    ).array  # fmt: skip
    row: dict[str, object] = {
        "device": device, "sensor": sensor, "level": level, "seed": seed,
        "mean": float(flat.mean()),
    }  # fmt: skip
    for name in FLAT_CORRECTIONS:
        row[name] = covariances(corrections(device)[name](flat)).ravel()
    row["cpu_s"] = round(time.process_time() - began, 2)
    return row


def flat_residuals(
    rows: Table, device: str, sensor: str, level: float, name: str
) -> tuple[NDArray, NDArray]:
    """What a correction leaves of what the areas added [%], by lag, and errors.

    Of what was taken away relative to what areas give: most shot noise cancels.
    """
    part = rows[(rows["sensor"] == sensor) & (rows["level"] == level)]
    model = expected(device, level, linear=sensor == "linear")[: LAGS + 1, : LAGS + 1]
    model[0, 0] -= level
    taken = np.array(part["none"]) - np.array(part[name])
    left = 100 * (1 - taken.reshape(len(part), LAGS + 1, LAGS + 1) / model)
    return left.mean(0), left.std(0, ddof=1) / np.sqrt(len(part))


# -- command ---------------------------------------------------------------------------


def _append(path: Path, key: dict, make: Callable[[], dict]) -> None:
    old = Table.read(path, format="ascii.ecsv") if path.exists() else None
    if old is not None:
        found = np.ones(len(old), bool)
        for name, value in key.items():
            found &= old[name] == value
        if found.any():
            return
    row = make()
    new = Table(rows=[tuple(row.values())], names=tuple(row))
    if old is not None:
        new = vstack([old, new], metadata_conflicts="silent")
    write_results(new, path, COMMAND, added=True)


@click.command(help=__doc__)
@click.argument("what", type=click.Choice(["stars", "flats", "show"]))
@click.option("--device", default="itl_sta3800c")
@click.option("--count", default=6, help="Stars of each kind, or flats.")
@click.option("--folder", default=str(RESULTS))
def main(what: str, device: str, count: int, folder: str) -> None:
    """Take rows, or print what they say."""
    stars, flats = (Path(folder) / path.name for path in (STARS, FLATS))
    if what == "stars":
        for seed in range(9101, 9101 + count):
            for sensor in SENSORS:
                for sigma in SIGMAS if sensor in ("whole", "linear") else (1.5,):
                    for peak in PEAKS:
                        key = {"device": device, "sensor": sensor, "sigma": sigma,
                               "peak": peak, "seed": seed}  # fmt: skip
                        _append(stars, key, lambda k=key: star_row(**k))
    elif what == "flats":
        for seed in range(9501, 9501 + count):
            for sensor in ("whole", "linear"):
                for level in LEVELS:
                    key = {"device": device, "sensor": sensor, "level": level, "seed": seed}
                    _append(flats, key, lambda k=key: flat_row(**k))
    else:
        show(stars, flats, device)


def show(stars: Path, flats: Path, device: str) -> None:
    """Print residuals."""
    rows = Table.read(stars, format="ascii.ecsv")
    rows = rows[rows["device"] == device]
    for sensor, sigma in sorted({(str(r["sensor"]), float(r["sigma"])) for r in rows}):
        for name in corrections(device):
            text = f"{sensor:8s} sigma {sigma} {name:24s}"
            for axis in "xy":
                left, error, before = residuals(rows, sensor, sigma, name, axis)
                text += f"  {axis} {left:7.2f} +- {error:.2f} % of {before:.3f}"
            print(text)
    rows = Table.read(flats, format="ascii.ecsv")
    rows = rows[rows["device"] == device]
    lags = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
    for sensor in ("whole", "linear"):
        for level in LEVELS:
            exact = left_by_paths(device, level, linear=sensor == "linear")
            text = " ".join(f"({i},{j}) {exact[j, i]:6.1f}     " for i, j in lags)
            print(f"{sensor:7s} {level:6.0f} {'exact correction':24s} {text}")
            for name in FLAT_CORRECTIONS[1:]:
                left, error = flat_residuals(rows, device, sensor, level, name)
                text = " ".join(
                    f"({i},{j}) {left[j, i]:6.1f}+-{error[j, i]:.1f}" for i, j in lags
                )
                print(f"{sensor:7s} {level:6.0f} {name:24s} {text}")


if __name__ == "__main__":
    main()
