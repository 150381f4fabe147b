"""A device whose quantity floats, proven on recordings of a device that is off its card.

``python -m validation.explanation.floating_devices SHARED [--draws 40] [--keep FOLDER]``: a_ij to
lags of 4 from our table of a device with one quantity two spreads from its card, noise drawn from
the errors of ``SHARED/reference/*_covariances_21oct19.csv`` times a factor, a_00 set by the sum of
the others as it is there.  Each draw is diagnosed as a reduced recording by the device of the card,
with that quantity floating, and without.  Also drawn: the device of the card itself, the quantity
floating.

The prior draws what is found towards the card: of a truth of t spreads that the recording alone
would tell to 1 / sqrt(S) spreads it leaves t S / (1 + S) on the mean, with an error of
1 / sqrt(1 + S).  ``free`` is what the recording alone says, value / (1 - error^2), with its own
error; its pulls about the truth have mean 0 and scatter 1 where all is right.  Tables of the
truth have 32 cells a pixel, derivatives 16 as they always do.

Rows go to ``validation/results/floating_devices.ecsv``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import gettempdir

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor import Device
from bfsensor.device.condition import Condition
from bfsensor.device.parameters import change_parameter, device_parameters
from bfsensor.diagnose.data.reduced_channels import StatedTable, measure_reduced
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.open_baseline import simulate_baseline
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.recording.tables.area_changes import AreaChangeTable, read_area_changes
from bfsensor.response.edge_response import LEVEL
from validation.common.write_results import write_results

RESULTS = "validation/results/floating_devices.ecsv"
LAGS = 5
SHIFT = 2.0
"""Of the truth from the card [spreads]."""

CASES = (
    ("e2v_ccd250_70", "e2v", "channel.implant[0].dose", 1.0),
    ("e2v_ccd250_70", "e2v", "channel_stop.width", 1.0),
    ("e2v_ccd250_70", "e2v", "silicon.thickness", 0.25),
    ("itl_sta3800c_60", "itl", "channel.implant[0].dose", 0.25),
)
"""Device, published table whose errors are taken, quantity, and factor of the errors."""

ANY = Condition()


def areas_of(
    baseline: Baseline, shift: dict[str, float] | None = None
) -> NDArray[np.float64]:
    """Give a_ij [1/e-] at lags from (0, 0) on, indexed [j, i], of quantities changed by so much."""
    plane = baseline.areas_on(ANY, shift, LEVEL)
    n = len(plane) // 2
    return plane[n : n + LAGS, n : n + LAGS]


def shifted_areas(
    device: Device, name: str, shift: float, keep: Path
) -> NDArray[np.float64]:
    """Give a_ij of our own table of a device with one quantity changed [spreads]."""
    by = shift * device_parameters(device)[name]
    keep.mkdir(parents=True, exist_ok=True)
    path = keep / f"{device.name}_{name}_{shift:g}.toml"
    path.write_text(change_parameter(device, name, by).to_toml())
    return areas_of(simulate_baseline(path, (), (), keep=keep))


def draw_table(
    areas: NDArray[np.float64], errors: NDArray[np.float64], rng: np.random.Generator
) -> AreaChangeTable:
    """Draw a published table: independent noise, a_00 set so that all lags add up to nothing."""
    a = areas + errors * rng.standard_normal(areas.shape)
    fold = np.where(np.arange(LAGS) > 0, 2, 1)
    a[0, 0] -= (np.outer(fold, fold) * a).sum()
    independent = np.ones(a.shape, bool)
    independent[0, 0] = False
    return AreaChangeTable(Path("drawn"), a, errors, independent)


def diagnose_drawn(
    areas: NDArray[np.float64], errors: NDArray[np.float64], baseline: Baseline, seed: int
) -> Diagnosis:
    """Draw and diagnose once."""
    table = draw_table(areas, errors, np.random.default_rng(seed))
    measured = measure_reduced([StatedTable(table, level=LEVEL)], reach=LAGS - 1)
    return diagnose_measured(measured, baseline, seed=seed, explain=False)


def row_of(found: Diagnosis, name: str, truth: float) -> dict[str, float]:
    """What one diagnosis says of the quantity and of what is left."""
    row = {"p": found.mismatch.p_value, "detected": found.mismatch.detected}
    (square, dof) = found.mismatch.chi2["flat_cov"]
    row |= {"chi2": square, "dof": dof}
    if name in found.fit.pulls:
        value = found.fit.pulls[name]
        error = float(found.fit.errors[found.fit.names.index(f"device {name}")])
        free = value / (1 - error**2)
        free_error = error / np.sqrt(1 - error**2)
        row |= {"value": value, "error": error, "free": free, "free_error": free_error,
                "free_pull": (free - truth) / free_error}  # fmt: skip
    return row


def prove(
    floating: Baseline,
    name: str,
    shifted: NDArray[np.float64],
    errors: NDArray[np.float64],
    draws: int,
) -> list[dict]:
    """Draw recordings of a shifted device and of the card's, and diagnose them.

    Parameters
    ----------
    floating : Baseline
        Of the card, with the quantity floating.
    name : str
        The quantity.
    shifted : ndarray
        a_ij of the device that is :data:`SHIFT` spreads off [1/e-], indexed [j, i].
    errors : ndarray
        Of a_ij; that at (0, 0) is not used.
    draws : int
        Recordings of either device.

    Returns
    -------
    list of dict
        Means over the draws, a row for each device and each fit.  'strength': S, the squared
        length of a spread's change in errors.  'bent': length of what the change is other
        than twice that, in errors.
    """
    errors = errors.copy()
    errors[0, 0] = errors[0, 1]
    white = np.where(np.indices(errors.shape).any(0), 1 / errors, 0.0)
    card = areas_of(floating)
    step = (areas_of(floating, {name: floating.spread[name]}) - card) * white
    bent = (shifted - card) * white - SHIFT * step
    rows = []
    for truth, areas in ((SHIFT, shifted), (0.0, card)):
        for word, baseline in (("floating", floating), ("held", floating.without([name]))):
            found = [
                row_of(diagnose_drawn(areas, errors, baseline, seed), name, truth)
                for seed in range(9100, 9100 + draws)
            ]
            whole = {k: np.array([f[k] for f in found], float) for k in found[0]}
            row = {
                "quantity": name, "truth": truth, "fit": word, "draws": draws,
                "strength": float((step**2).sum()),
                "bent": float(np.sqrt((bent**2).sum())) if truth else 0.0,
                "detected": int(whole["detected"].sum()),
                "p_median": float(np.median(whole["p"])), "p_least": float(whole["p"].min()),
                "p_largest": float(whole["p"].max()),
                "chi2_over_dof": float(whole["chi2"].sum() / whole["dof"].sum()),
            }  # fmt: skip
            for key in ("value", "error", "free", "free_error", "free_pull"):
                row[key] = float(whole[key].mean()) if key in whole else np.nan
            for key in ("value", "free_pull"):
                row[f"{key}_scatter"] = (
                    float(whole[key].std(ddof=1)) if key in whole else np.nan
                )
            rows.append(row)
    return rows


def main() -> None:
    """Prove all cases and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument(
        "--keep", type=Path, default=Path(gettempdir()) / "bfsensor_floating"
    )
    given = parser.parse_args()
    rows = []
    for device, kind, name, factor in CASES:
        path = given.shared / "reference" / f"{kind}_covariances_21oct19.csv"
        errors = factor * read_area_changes(path).errors[:LAGS, :LAGS]
        floating = simulate_baseline(device, (name,), (), keep=given.keep)
        shifted = shifted_areas(Device.load(device), name, SHIFT, given.keep)
        for row in prove(floating, name, shifted, errors, given.draws):
            rows.append({"device": device, "errors": f"{factor:g} x {kind}"} | row)
            print(
                {k: round(v, 3) if isinstance(v, float) else v for k, v in rows[-1].items()}
            )
    table = Table(rows)
    for column in table.columns.values():
        if column.dtype.kind == "f":
            column.info.format = ".4g"
    command = (
        f"python -m validation.explanation.floating_devices SHARED --draws {given.draws}"
    )
    write_results(table, RESULTS, command, background_e=LEVEL)


if __name__ == "__main__":
    main()
