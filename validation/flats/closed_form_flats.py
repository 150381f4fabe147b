"""The closed form of flats against flats of the sensor, lag by lag, and Bartlett's errors.

``python -m validation.flats.closed_form_flats [--pairs N] [--side PIXELS]`` draws pairs of flats
from the shipped tables' areas at three levels and measures their covariances as the diagnosis does;
each pair is a row of ``validation/results/closed_form_flats.ecsv``, and pairs that are there are
not drawn again.  The sensor knows nothing of the closed form: areas follow the charge that has
come, step by step, background and all, Poisson number by Poisson number.

``predict`` gives the closed form as the diagnosis uses it: the response that counts for each
level, of a parabola through three backgrounds of the table.  ``predict_constant`` keeps one response for
all levels.  ``predict_ladder`` integrates the equation with the table's own response at each level.
"""

from __future__ import annotations

import argparse
import time
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import galsim
import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from bfsensor import BrighterFatterSensor, DistortionTable
from bfsensor.device.condition import Condition
from bfsensor.device.shipped import tables_dir
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.flat_predictions import flat_covariances_of
from bfsensor.diagnose.model.table_baseline import baseline_of_table
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.measure.flat_pairs import flat_covariances
from bfsensor.response.edge_response import area_matrix
from bfsensor.sensor.flats import draw_flat
from validation.common.write_results import write_results
from validation.sensor.sensor_flats import predict as integrate

RESULTS = Path(__file__).parents[1] / "results" / "closed_form_flats.ecsv"
COMMAND = "python -m validation.flats.closed_form_flats"
DEVICES = "itl_sta3800c", "e2v_ccd250"
LEVELS = 20_000.0, 50_000.0, 80_000.0
LAGS = 4
STEPS = 25
"""Steps of a flat: the correlations due to the effect lack 1 / 625 of themselves."""


def draw_pair(device: str, level: float, seed: int, *, side: int = 512) -> Table:
    """Draw a pair of flats and measure it: one row."""
    begin = time.process_time()
    sensor = BrighterFatterSensor(device, rng=galsim.BaseDeviate(seed))
    flats = [
        draw_flat(
            sensor, (side, side), level, step=level / STEPS, rng=galsim.BaseDeviate(seed + k),
            dtype=np.float64,
        ).array
        for k in (0, 500_000)
    ]  # fmt: skip
    found = flat_covariances(*flats, lags=LAGS)
    return Table(
        {
            "device": [device],
            "level": [level],
            "seed": [seed],
            "side": [side],
            "mean": [found.level],
            "covariances": [found.covariances.ravel()],
            "counts": [found.pairs.ravel()],
            "cpu_s": [round(time.process_time() - begin, 2)],
        }
    )


@lru_cache(maxsize=2)
def baseline_of(device: str) -> Baseline:
    """Baseline of a shipped table, kept."""
    return baseline_of_table(device)


def predict(device: str, level: float) -> NDArray[np.float64]:
    """Closed form of the diagnosis, indexed [j, i] [e-^2]; light of 400 nm, as the flats'."""
    baseline = baseline_of(device)
    here = Condition(wavelength=400.0)
    a = baseline.flat_areas(here, None, np.array([level]))
    return flat_covariances_of(a, [level], lags=LAGS)[0]


def predict_constant(device: str, level: float) -> NDArray[np.float64]:
    """The same with one response, that at the middle of the baseline's levels."""
    baseline = baseline_of(device)
    a = area_matrix(*baseline.at(Condition(wavelength=400.0))[0])
    return flat_covariances_of(a, [level], lags=LAGS)[0]


def predict_ladder(device: str, level: float) -> NDArray[np.float64]:
    """The same equation with the table's response at each level of the way."""
    return integrate(table_of(device), level)


class Comparison(NamedTuple):
    """Pairs of one device and level against a prediction.

    ``mean``, ``error`` (Bartlett's, of the mean) and ``matrix``: measured; ``chi2`` over all 25
    lags with their correlations; ``scatter``: of pairs over Bartlett's error, by lag.
    """

    level: float
    mean: NDArray[np.float64]
    error: NDArray[np.float64]
    matrix: NDArray[np.float64]
    scatter: NDArray[np.float64]
    pairs: int

    def chi2(self, model: NDArray) -> float:
        """Of all lags, correlated as Bartlett says."""
        d = (self.mean - model).ravel()
        return float(d @ np.linalg.solve(self.matrix, d))

    def pulls(self, model: NDArray) -> NDArray[np.float64]:
        """Differences over errors, [j, i]."""
        return np.asarray((self.mean - model) / self.error)


def compare(rows: Table) -> Comparison:
    """Average the pairs of one device and level."""
    shape = (len(rows), LAGS + 1, LAGS + 1)
    values = np.array(rows["covariances"]).reshape(shape)
    counts = np.array(rows["counts"], float).reshape(shape)
    mean = values.mean(0)
    matrix = bartlett_matrix(mean, counts.sum(0))
    single = np.sqrt(np.diag(bartlett_matrix(mean, counts.mean(0)))).reshape(mean.shape)
    return Comparison(
        level=float(rows["mean"].mean()),
        mean=mean,
        error=np.sqrt(np.diag(matrix)).reshape(mean.shape),
        matrix=matrix,
        scatter=values.std(0, ddof=1) / single,
        pairs=len(rows),
    )


def table_of(device: str) -> DistortionTable:
    """The shipped table of a device."""
    return DistortionTable.read(tables_dir() / device / "table.fits")


def main() -> None:
    """Draw what is missing and print what is there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=16)
    parser.add_argument("--side", type=int, default=512)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    path: Path = options.output
    for seed in range(9001, 9001 + options.pairs):
        for device in DEVICES:
            for number, level in enumerate(LEVELS):
                own = seed + 10_000 * number
                rows = Table.read(path, format="ascii.ecsv") if path.exists() else None
                if rows is not None and np.any(
                    (rows["device"] == device)
                    & (rows["level"] == level)
                    & (rows["seed"] == own)
                ):
                    continue
                row = draw_pair(device, level, own, side=options.side)
                whole = (
                    row
                    if rows is None
                    else vstack([rows, row], metadata_conflicts="silent")
                )
                write_results(whole, path, COMMAND, added=True)
        print(f"{seed}: done", flush=True)
    rows = Table.read(path, format="ascii.ecsv")
    for device in DEVICES:
        for level in LEVELS:
            found = compare(rows[(rows["device"] == device) & (rows["level"] == level)])
            for name, model in (
                ("closed form", predict),
                ("one response", predict_constant),
                ("ladder", predict_ladder),
            ):
                values = model(device, found.level)
                square = found.chi2(values)
                n = values.size
                print(
                    f"{device} {level:.0f} e-, {found.pairs} pairs, {name}: chi2/dof "
                    f"{square / n:.2f} (p {chi2_distribution.sf(square, n):.2g}); pulls (0,0) "
                    f"{found.pulls(values)[0, 0]:.1f}, (1,0) {found.pulls(values)[0, 1]:.1f}, "
                    f"(0,1) {found.pulls(values)[1, 0]:.1f}, (1,1) {found.pulls(values)[1, 1]:.1f}"
                )
            print(
                f"   scatter of pairs over Bartlett: {np.sqrt((found.scatter**2).mean()):.3f}"
            )


if __name__ == "__main__":
    main()
