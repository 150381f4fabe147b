"""Why the measured saturation lies below the full well of the device: causes, tried one by one.

``python -m validation.saturation.saturation_causes REFERENCE`` solves the barriers of a filled well
against its charge for the voltages of ``REFERENCE/sat_data_21oct19.csv``.  Cases (column ``case``):

- ``device``: two of three gates high, one pixel full, as the device is described.
- ``flat``: all pixels full.
- ``one gate``: one of three gates high, as in every other step of the transfer to the register;
  ``one gate, column``: three pixels in a column full, the middle one asked.
- ``..., 32 cells`` and ``64 cells``: finer meshes than 16 cells a pixel; ``one gate, -40 V``: another
  back bias; the last two at some of the voltages.
- ``PART x FACTOR``: the device with one part of its description changed, at some of the voltages.

One row a case and voltage in ``validation/results/saturation_causes.ecsv``: charges at which the
barrier along the column falls to 0.4, 0.7, 1.1 and 2.2 V; the barrier at the measured
level; the charge at which electrons touch the oxide (density there 1/1000 of the cloud's, nan where
they spill before).  0.7 V was chosen after the barriers at the measured levels had been seen.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from astropy.io import ascii as tables
from astropy.table import Table

from bfsensor import Device
from bfsensor.errors import ConvergenceError, DeviceError
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.simulate.well import barrier, surface_barrier
from validation.common.write_results import write_results
from validation.saturation.saturation import PERIOD, charge_at

RESULTS = "validation/results/saturation_causes.ecsv"
CRITERIA = (0.4, 0.7, 1.1, 2.2)
TOUCH = float(np.log(1e3))  # kT
SOME = ((-8.0, 0.0), (-8.0, 3.0), (-4.0, 4.0))
PARTS = ("channel dose", "surface charge", "channel depth", "gate oxide", "stop width")


def change(device: Device, part: str, factor: float) -> Device:
    """Give the device with one part of its description scaled."""
    channel = device.channel
    if part == "channel dose":
        implants = [dataclasses.replace(i, dose=factor * i.dose) for i in channel.implants]
    elif part == "channel depth":
        implants = [
            dataclasses.replace(i, peak=factor * i.peak, sigma=factor * i.sigma)
            for i in channel.implants
        ]
    elif part == "surface charge":
        return device.with_value(
            "channel.surface_charge", f"{factor * channel.surface_charge * 1e8} cm-2"
        )
    elif part == "gate oxide":
        return device.with_value("gate_oxide", f"{factor * device.gates.gate_oxide} um")
    else:
        return device.with_value(
            "channel_stop.width", f"{factor * device.channel_stop.width} um"
        )
    return dataclasses.replace(
        device, channel=dataclasses.replace(channel, implants=tuple(implants))
    )


def fill(solver: Electrostatics, filled: str, charge: float) -> np.ndarray:
    """Charge of each pixel [e-]; the domain holds a quarter, so (1, 0) is both neighbours."""
    wells = np.zeros(solver.pixel_shape)
    if filled == "all":
        wells[:] = charge
    else:
        wells[: 2 if filled == "column" else 1, 0] = charge
    return wells


def barrier_curves(
    device: Device, *, step: float, filled: str = "one", cells: int = 16, stop: float = 0.35
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Charges [e-], barriers along the column and to the oxide [V], until ``stop`` is passed.

    Past the spill charge a prescribed number of electrons has no place to be, and the
    solver says so, or that holes leave the stops for the back contact; the step is then halved,
    down to 1000 e-.
    """
    solver = Electrostatics(device, make_mesh(device, pixels=(PERIOD, PERIOD), cells=cells))
    start = tile(solve_unit_cell(device, 0.0, cells=cells), solver.mesh)
    charges, along, to_oxide = [], [], []
    charge = 0.0
    while step >= 1e3 and (not along or along[-1] > stop):
        try:
            potential = solver.solve(
                fill(solver, filled, charge), start=start, tolerance=1e-3
            )
        except (ConvergenceError, DeviceError):
            if not charges:
                raise
            charge -= 0.5 * step
            step *= 0.5
            continue
        charges.append(charge)
        along.append(barrier(potential))
        to_oxide.append(surface_barrier(potential))
        charge += step
    return np.array(charges), np.array(along), np.array(to_oxide)


def at_voltages(device: Device, low: float, high: float) -> Device:
    """Give the device with other parallel voltages."""
    return device.with_operating_point(gate_low=f"{low} V", gate_high=f"{high} V")


def list_cases() -> Iterator[tuple[str, Device, dict[str, object], bool]]:
    """Name, device, how to solve it, and whether at all voltages."""
    device = Device.load("itl_sta3800c")
    single = device.with_value("collecting_phases", "1")
    yield "device", device, {}, True
    yield "one gate", single, {}, True
    yield "one gate, column", single, {"filled": "column"}, True
    yield "flat", device, {"filled": "all"}, True
    yield "device, 32 cells", device, {"cells": 32}, True
    yield "one gate, column, 32 cells", single, {"filled": "column", "cells": 32}, True
    yield "one gate, column, 64 cells", single, {"filled": "column", "cells": 64}, False
    yield "one gate, -40 V", single.with_value("back_bias", "-40 V"), {}, False
    for part in PARTS:
        for factor in (0.9, 1.1):
            yield f"{part} x {factor}", change(device, part, factor), {}, False


def main() -> None:
    """Solve what is missing and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reference", type=Path)
    parser.add_argument("-o", "--output", default=RESULTS)
    options = parser.parse_args()
    measured = tables.read(options.reference / "sat_data_21oct19.csv", comment="#")
    path = Path(options.output)
    rows = (
        [tuple(r) for r in Table.read(path, format="ascii.ecsv")] if path.exists() else []
    )
    done = {r[:3] for r in rows}
    names = ("case", "gate_low_V", "gate_high_V", "measured_e",
             *(f"barrier_{v}_V" for v in CRITERIA), "barrier_at_measured_V",
             "touch_e", "touch_barrier_V", "cpu_s")  # fmt: skip
    for case, device, how, everywhere in list_cases():
        for point in measured:
            low, high, level = (
                float(point[n]) for n in ("Vpar_lo_V", "Vpar_hi_V", "sat_level_e")
            )
            if (case, low, high) in done or not (everywhere or (low, high) in SOME):
                continue
            begin = time.process_time()
            here = at_voltages(device, low, high)
            step = float(np.clip(level / 5, 4e3, 25e3))
            charges, along, to_oxide = barrier_curves(here, step=step, **how)  # type: ignore[arg-type]
            kt = here.material.thermal_voltage(here.operating_point.temperature)
            touch = charge_at(charges, to_oxide, TOUCH * kt)
            # Past the spill charge the cloud flows under the low gates: no touch there.
            touch = touch if np.interp(touch, charges, along) > CRITERIA[0] else np.nan
            row = (
                case, low, high, level,
                *(round(charge_at(charges, along, v), 1) for v in CRITERIA),
                round(float(np.interp(level, charges, along)), 4), round(touch, 1),
                round(float(np.interp(touch, charges, along)), 4),
                round(time.process_time() - begin, 1),
            )  # fmt: skip
            rows.append(row)
            write_results(
                Table(rows=rows, names=names),
                path,
                "python -m validation.saturation.saturation_causes REFERENCE",
                added=True,
            )
            print(*row, flush=True)


if __name__ == "__main__":
    main()
