"""Conceal charge-dependent diffusion and quantum yield in tables of covariances, and diagnose them.

``python -m validation.silicon.pieces_found FOLDER`` makes a table of covariances a case, at two back
biases and three wavelengths, lets ``bfsensor diagnose`` answer it with ITL's device as baseline, and
writes ``validation/results/silicon_pieces_found.ecsv``.  What an effect changes is calculated here, by
numerical integration over electrons that land and step by step in the level; the covariances without
effects are the baseline's, whose errors are not the question.  Noise: Bartlett's matrix of 20 pairs of
2^22 pixels.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy.special import ndtr

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.diagnose.data.exposure_info import condition_at
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.flat_predictions import flat_covariances_of
from bfsensor.diagnose.model.open_baseline import simulate_baseline
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.response.light import conversion_weights
from bfsensor.sensor.drift_field import solve_drift
from bfsensor.simulate.edge_field import front_plane
from validation.common.write_results import RESULTS, write_results

DEVICE = "itl_sta3800c"
BIASES, WAVES = (-50.0, -30.0), (400.0, 620.0, 950.0)
LEVELS = (1.5e4, 4e4, 7e4, 1e5)
PIXELS, PAIRS = 2**22, 20
SIDE, LAGS, STEPS = 32, 5, 300
Array = NDArray[np.float64]


class Case(NamedTuple):
    """Case: growth of the variance [% per 1e5 e-], electrons of a photon of 400 nm beyond one."""

    name: str
    growth: float = 0.0
    extra: float = 0.0


CASES = (
    Case("null 1"), Case("null 2"), Case("diffusion, 15 %", 15.0), Case("diffusion, 5 %", 5.0),
    Case("diffusion, 0.5 %", 0.5), Case("two electrons", extra=0.0115),
)  # fmt: skip


def landed(variance: float) -> Array:
    """Fraction of electrons of uniform light that land at each lag, of a periodic array."""
    places = (np.arange(2000) + 0.5) / 2000 - 0.5
    edges = np.arange(-4, 4) + 0.5
    below = ndtr((edges - places[:, None]) / np.sqrt(variance)).mean(axis=0)
    line = np.zeros(SIDE)
    line[np.arange(-4, 5)] = np.diff(np.concatenate([[0.0], below, [1.0]]))
    return np.outer(line, line)


def spectrum(areas: Array) -> Array:
    """Spectrum of area changes, lag (0, 0) in the middle."""
    n = len(areas) // 2
    wide = np.zeros((SIDE, SIDE))
    lags = np.arange(-n, n + 1)
    np.add.at(wide, np.ix_(lags % SIDE, lags % SIDE), areas)
    return np.asarray(np.fft.rfft2(wide).real)


def grown(areas: Array, level: float, source: Array | float) -> Array:
    """Covariances of a flat that grows in steps, each with the noise of its electrons."""
    c, step = np.zeros_like(areas), level / STEPS
    for _ in range(STEPS):
        c = (c * (1 + areas * step) + source * step) / (1 - areas * step)
    return np.asarray(np.fft.irfft2(c, s=(SIDE, SIDE))[:LAGS, :LAGS])


def variances(device: Device) -> dict[tuple[float, float], float]:
    """Variance of diffusion [pixel^2] by wavelength and back bias."""
    kelvin, out = device.operating_point.temperature, {}
    for bias in BIASES:
        by = bias - device.operating_point.back_bias
        here = change_parameter(device, "operating_point.back_bias", by)
        drift = solve_drift(here.to_toml(), kelvin, front_plane(here).height)
        for wave in WAVES:
            mean = float(conversion_weights(drift.heights, wave, kelvin) @ drift.variance)
            out[wave, bias] = device.diffusion**2 * mean / device.pixel.pitch_x**2
    return out


def make(case: Case, baseline: Baseline, path: Path) -> float:
    """Write the table of a case; signal to noise of what is concealed, nothing fitted."""
    device = Device.load(DEVICE)
    width, kelvin = variances(device), device.operating_point.temperature
    rng = np.random.default_rng([2216, CASES.index(case)])
    rows, snr = [], 0.0
    for (wave, bias), v in width.items():
        weaker = width[620.0, bias] / width[620.0, -50.0]
        more = (landed(1.001 * v) - landed(v)) / 1e-3 * 1e-7 * case.growth * weaker
        p = case.extra if wave == WAVES[0] else 0.0
        pairs = 2 * p / (1 + p) * np.fft.rfft2(landed(2 * v)).real
        for level in LEVELS:
            where = condition_at((wave, bias, kelvin))
            a = baseline.flat_areas(where, {}, np.array([level])).reshape(
                -1, *baseline.edges[wave, bias][0].shape
            )
            plain = flat_covariances_of(a, [level], lags=LAGS - 1)[0]
            own = spectrum(a[0])
            change = grown(own + np.fft.rfft2(more).real, level, 1 + pairs) - grown(
                own, level, 1.0
            )
            noise = bartlett_matrix(
                plain + change, np.full(plain.shape, float(PIXELS * PAIRS))
            )
            snr += float((change.ravel() ** 2 / np.diag(noise)).sum())
            values = (plain + change).ravel()
            values += np.linalg.cholesky(noise) @ rng.standard_normal(values.size)
            for n, value in enumerate(values):
                rows.append(("A", level, n % LAGS, n // LAGS, value, np.sqrt(noise[n, n]), PIXELS,
                             PAIRS, wave, bias))  # fmt: skip
    names = ("amp", "mu_e", "i", "j", "cov", "sigma", "npix", "npair", "wavelength", "vbb")
    Table(rows=rows, names=names).write(path, format="ascii.ecsv", overwrite=True)
    return float(np.sqrt(snr))


def diagnose(table: Path, out: Path, nominal: Path) -> dict[str, object]:
    """Diagnose a table by the command, with the nominal device's solutions; its report."""
    shutil.copytree(nominal, out, dirs_exist_ok=True)
    words = [sys.executable, "-m", "bfsensor", "diagnose", str(table)]
    subprocess.run([*words, "--baseline", DEVICE, "-o", str(out)], check=True)
    found: dict[str, object] = json.loads((out / "report.json").read_text())
    return found


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
def main(folder: Path) -> None:
    """Make all cases in FOLDER, diagnose them and write the rows."""
    folder.mkdir(parents=True, exist_ok=True)
    nominal = folder / "nominal"
    baseline = simulate_baseline(DEVICE, ("all",), list(BIASES), keep=nominal)
    rows = []
    for case in CASES:
        name = case.name.replace(" ", "_").replace(",", "").replace("%", "percent")
        snr = make(case, baseline, folder / f"{name}.ecsv")
        told = diagnose(folder / f"{name}.ecsv", folder / name, nominal)
        effects: list[dict[str, object]] = told["effects"]  # type: ignore[assignment]
        named = " + ".join(f"{e['class']}:{e.get('variant', '')}" for e in effects)
        first: dict[str, float] = {}
        if effects:
            first = next(iter(effects[0]["parameters"].values()))  # type: ignore[attr-defined]
        values = [first.get(k, np.nan) for k in ("value", "lo68", "hi68")]
        rows.append((case.name, case.growth, case.extra, snr, told["detected"], told["p_value"],
                     named, *values))  # fmt: skip
        print(*rows[-1], flush=True)
    names = ("case", "growth", "extra_400", "snr", "detected", "p", "named", "value", "low68",
             "high68")  # fmt: skip
    write_results(
        Table(rows=rows, names=names), RESULTS / "silicon_pieces_found.ecsv",
        "python -m validation.silicon.pieces_found FOLDER",
    )  # fmt: skip


if __name__ == "__main__":
    main()
