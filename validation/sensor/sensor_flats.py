"""Covariances of flats drawn photon by photon, beside those the table implies.

``python -m validation.sensor.sensor_flats [--device NAME] [--images N] [--level E] [--side PIXELS]``
draws flats with the effect and, from the same photons and random numbers, without it.  The
difference of the covariances has a much smaller error than either.  Each image is a row of
``validation/results/sensor_flats.ecsv``; images that are there already are not drawn again.

``predict`` gives the covariances that the table's areas imply: charge follows areas, areas
follow charge, and the differential response belongs to the background reached.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import galsim
import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray

from bfsensor import BrighterFatterSensor, DistortionTable
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results" / "sensor_flats.ecsv"
LAGS = 4
BORDER = 8
CHUNK = 2_000_000
COMMAND = "python -m validation.sensor.sensor_flats"


def draw(device: str, strength: float, side: int, level: float, seed: int) -> NDArray:
    """Draw one flat; the seed fixes photons and random numbers, whatever the strength."""
    sensor = BrighterFatterSensor(
        device, strength=strength, rng=galsim.BaseDeviate(seed), diffusion_factor=0.0
    )
    rng = np.random.default_rng(seed)
    image = galsim.ImageD(side, side)
    count = rng.poisson(level * side * side)
    done = 0
    while done < count:
        n = min(CHUNK, count - done)
        x, y = rng.random((2, n)) * side + 0.5
        photons = galsim.PhotonArray(n, x, y, np.ones(n))
        sensor.accumulate(photons, image, resume=done > 0)
        done += n
    return image.array


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


def predict(table: DistortionTable, level: float, *, steps: int = 40) -> NDArray:
    r"""Covariances that the areas at the back surface imply, by lag in y and x.

    With the differential response :math:`a(\mu)` [1/e-] about the level :math:`\mu`,
    :math:`d\tilde C / d\mu = 1 + 2 \tilde a(\mu)\, \tilde C` in Fourier space.
    """
    n = 32
    area = table.pitch[0] * table.pitch[1]
    depth = float(table.depths[-1])
    spectrum = np.zeros((n, n))
    step = level / steps
    for k in range(steps):
        background = (k + 0.5) * step
        a = table.area_changes(
            charge=background + 100.0, background=background, depth=depth
        ) / (100.0 * area)
        # The sensor's shifts end with the table: the next ring of pixels gains what the
        # table's pixels lose, for shifted boundaries only share charge out anew.
        r = table.reach + 1
        wide = np.zeros((n, n))
        ring = np.ones((2 * r + 1, 2 * r + 1))
        ring[1:-1, 1:-1] = 0.0
        wide[: 2 * r + 1, : 2 * r + 1] = np.pad(a, 1) - a.sum() * ring / ring.sum()
        wide = np.fft.fft2(np.roll(wide, (-r, -r), (0, 1))).real
        exponent = 2 * wide * step
        small = np.abs(exponent) < 1e-12
        ratio = np.expm1(exponent) / np.where(small, 1.0, exponent)
        spectrum = spectrum * np.exp(exponent) + step * np.where(small, 1.0, ratio)
    return np.fft.ifft2(spectrum).real[: LAGS + 1, : LAGS + 1]


def measure(table: Table, device: str) -> tuple[NDArray, NDArray, float]:
    """Mean covariances due to the effect and their errors, and the mean level.

    Few images scatter as they like: no lag's error is taken smaller than the median of the lags.
    """
    rows = table[table["device"] == device]
    level = float(rows["mean"].mean())
    on = np.array(rows["with_effect"]).reshape(len(rows), LAGS + 1, LAGS + 1)
    off = np.array(rows["without"]).reshape(len(rows), LAGS + 1, LAGS + 1)
    difference = on - off
    error = difference.std(axis=0, ddof=1) / np.sqrt(len(rows))
    return difference.mean(axis=0), np.maximum(error, np.median(error)), level


def main() -> None:
    """Draw flats, one row each, and print what is there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="itl_sta3800c")
    parser.add_argument("--images", type=int, default=8)
    parser.add_argument("--level", type=float, default=80000.0)
    parser.add_argument("--side", type=int, default=160)
    parser.add_argument("-o", "--output", default=str(RESULTS))
    options = parser.parse_args()
    path = Path(options.output)
    for seed in range(7001, 7001 + options.images):
        rows = Table.read(path, format="ascii.ecsv") if path.exists() else None
        if rows is not None and np.any(
            (rows["device"] == options.device) & (rows["seed"] == seed)
        ):
            continue
        began = time.process_time()
        flats = [draw(options.device, s, options.side, options.level, seed) for s in (1, 0)]
        row = Table(
            {
                "device": [options.device],
                "seed": [seed],
                "side": [options.side],
                "mean": [flats[0][BORDER:-BORDER, BORDER:-BORDER].mean()],
                "with_effect": [covariances(flats[0]).ravel()],
                "without": [covariances(flats[1]).ravel()],
                "cpu_s": [round(time.process_time() - began, 1)],
            }
        )
        # Another device may have written meanwhile.
        rows = Table.read(path, format="ascii.ecsv") if path.exists() else None
        whole = row if rows is None else vstack([rows, row], metadata_conflicts="silent")
        write_results(whole, path, COMMAND, added=True)
        print(f"{options.device} {seed}: {row['cpu_s'][0]} CPU s", flush=True)
    table = Table.read(path, format="ascii.ecsv")
    for device in sorted(set(table["device"])):
        found, error, level = measure(table, device)
        folder = Path(__file__).parents[2] / "tables" / device / "table.fits"
        model = predict(DistortionTable.read(folder), level)
        model[0, 0] -= level
        print(f"{device}: a_ij = C_ij / level^2 [1e-6 / e-] at {level:.0f} e-")
        for j, i in (
            (0, 0),
            (0, 1),
            (1, 0),
            (1, 1),
            (0, 2),
            (2, 0),
            (1, 2),
            (2, 1),
            (2, 2),
        ):
            scale = 1e6 / level**2
            print(
                f"  ({i},{j}) {found[j, i] * scale:8.4f} +- {error[j, i] * scale:.4f}  "
                f"table {model[j, i] * scale:8.4f}  "
                f"pull {(found[j, i] - model[j, i]) / error[j, i]:5.1f}"
            )


if __name__ == "__main__":
    main()
