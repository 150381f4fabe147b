"""Full well of the ITL device against the measured saturation, over its parallel voltages.

``python -m validation.saturation.saturation REFERENCE`` solves the barrier between one filled pixel
and its empty neighbour in the column against the charge, for the voltages of
``REFERENCE/sat_data_21oct19.csv``, and finds the charge at which it falls to 1.1 V (the published
criterion), to 0.4 V (the thermionic estimate at 173 K) and to the device's own, 2.2 V (fitted to the
seven levels at Vpl = -8 V, Vph = 0 to 3 V).  One row a voltage: ``validation/results/saturation.ecsv``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from astropy.io import ascii as tables
from astropy.table import Table
from scipy.interpolate import PchipInterpolator

from bfsensor import Device
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.simulate.well import barrier
from validation.common.write_results import write_results

CRITERIA = (0.4, 1.1, 2.2)
CELLS, PERIOD = 16, 4


def barrier_curve(device: Device) -> tuple[np.ndarray, np.ndarray]:
    """Barrier [V] against charge [e-], down to 0.3 V."""
    solver = Electrostatics(device, make_mesh(device, pixels=(PERIOD, PERIOD), cells=CELLS))
    start = tile(solve_unit_cell(device, 0.0, cells=CELLS), solver.mesh)
    charges, heights = [], []
    for charge in np.arange(0.0, 6.01e5, 25e3):
        wells = np.zeros(solver.pixel_shape)
        wells[0, 0] = charge
        heights.append(barrier(solver.solve(wells, start=start, tolerance=1e-3)))
        charges.append(charge)
        if heights[-1] < 0.3:
            break
    return np.array(charges), np.array(heights)


def charge_at(charges: np.ndarray, heights: np.ndarray, volts: float) -> float:
    """Charge at which the barrier has fallen to ``volts``; 0 or nan beyond the curve."""
    if heights[0] <= volts:
        return 0.0
    if heights.min() > volts:
        return np.nan
    falling = np.minimum.accumulate(heights)
    keep = np.concatenate([[True], np.diff(falling) < 0])
    return float(PchipInterpolator(-falling[keep], charges[keep])(-volts))


def main() -> None:
    """Solve what is missing and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reference", type=Path)
    parser.add_argument("-o", "--output", default="validation/results/saturation.ecsv")
    options = parser.parse_args()
    measured = tables.read(options.reference / "sat_data_21oct19.csv", comment="#")
    path = Path(options.output)
    rows = (
        [tuple(r) for r in Table.read(path, format="ascii.ecsv")] if path.exists() else []
    )
    done = {(r[0], r[1]) for r in rows}
    names = ("gate_low_V", "gate_high_V", "measured_e", *(f"barrier_{v}_V" for v in CRITERIA),
             "barrier_at_measured_V", "cpu_s")  # fmt: skip
    for point in measured:
        low, high, level = (
            float(point[n]) for n in ("Vpar_lo_V", "Vpar_hi_V", "sat_level_e")
        )
        if (low, high) in done:
            continue
        begin = time.process_time()
        device = Device.load("itl_sta3800c").with_value("gate_low", f"{low} V")
        device = device.with_value("gate_high", f"{high} V")
        charges, heights = barrier_curve(device)
        wells = [charge_at(charges, heights, v) for v in CRITERIA]
        here = float(np.interp(level, charges, heights))
        cpu = round(time.process_time() - begin, 1)
        rows.append((low, high, level, *wells, here, cpu))
        write_results(
            Table(rows=rows, names=names),
            path,
            "python -m validation.saturation.saturation REFERENCE",
            added=True,
        )
        print(
            f"Vpl {low:5.1f}  Vph {high:4.1f}  measured {level:8.0f}  at 0.4, 1.1, 2.2 V "
            + " ".join(f"{w:8.0f} ({w / level:.3f})" for w in wells)
            + f"  barrier there {here:.2f} V",
            flush=True,
        )


if __name__ == "__main__":
    main()
