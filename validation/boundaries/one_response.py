"""The a_ij of one device as fit, diagnosis, sweep and exported table give them, by colour of the light.

``python -m validation.boundaries.one_response`` solves two devices on 16 cells a pixel at 40,000 e- for
each who asks, and a_00 in two bands, LSST's y and u as boxes of 970 to 1060 and 340 to 390 nm: of the
devices and, with the same light, of image charges by numpy, the kind of model behind Rubin's figure.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
from astropy.table import Table

from bfsensor.device.device import Device
from bfsensor.device.silicon import absorption_length
from bfsensor.diagnose.model.cached_response import walk
from bfsensor.response.edge_response import (
    CHARGE,
    LEVEL,
    REACH,
    area_matrix,
    solve_response,
)
from bfsensor.response.light import conversion_weights
from bfsensor.sweeps.points import SweepPoint, solve_point
from bfsensor.table.build import build_table
from bfsensor.table.quadrant_shifts import quadrant_shifts
from bfsensor.table.table_plan import plan_table
from bfsensor.typing import FloatArray
from validation.common.write_results import RESULTS, write_results
from validation.concealed.card import NOMINAL
from validation.concealed.electrostatics import edge_shifts

DEVICES = ("itl_sta3800c", "e2v_ccd250")

CELLS, KELVIN = 16, 173.0

LIGHTS = (None, 870.0, 950.0, 1000.0)
"""Wavelengths [nm]; None: all light converts at the back surface."""

LAGS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 2))

BANDS = {"y": (970.0, 1060.0), "u": (340.0, 390.0)}
"""Bands of equal numbers of photons at each wavelength between two [nm]."""

NEAR = slice(REACH + 1, REACH + 4)


def asked(device: Device) -> dict[str, Callable[[float | None], FloatArray]]:
    """a_ij [1/e-] at lags from (0, 0) to (2, 2) by light, from each who asks for them."""
    fit, diagnosis = solve_response(device, cells=CELLS), walk(device, cells=CELLS)
    sweep = solve_point(SweepPoint(device.to_toml(), LEVEL, 0.0, CELLS))
    table = build_table(
        plan_table(
            device, charges=[LEVEL, LEVEL + CHARGE], backgrounds=[LEVEL], accuracy=0.05
        )
    )

    def exported(light: float | None) -> FloatArray:
        return quadrant_shifts(
            table, background=LEVEL, wavelengths=None if light is None else [light],
            temperature=KELVIN, lags=3, tail_slope=None,
        ).areas  # fmt: skip

    return {
        "fit": lambda light: area_matrix(*fit.edges(light, KELVIN))[NEAR, NEAR],
        "diagnosis": lambda light: area_matrix(*diagnosis.edges(light, KELVIN))[NEAR, NEAR],
        "sweep": lambda light: sweep.in_light(light, KELVIN)[0],
        "table": exported,
    }


def in_band(
    a: Callable[[float], float], thickness: float, low: float, high: float
) -> float:
    """a_00 [1/e-] in a band from that at a wavelength [nm], weighted with the light that converts."""
    waves = np.linspace(low, high, 31)
    converts = -np.expm1(-thickness / np.asarray(absorption_length(waves, KELVIN), float))
    return float(converts @ [a(w) for w in waves] / converts.sum())


def by_image_charges(wavelength: float) -> float:
    """a_00 [1/e-] of image charges between two planes, the device of :mod:`validation.concealed`."""
    length = float(absorption_length(wavelength, KELVIN))
    kx, ky = map(np.asarray, edge_shifts(NOMINAL, length, NOMINAL["vbb"])[:2])
    return float(area_matrix(kx, ky)[len(kx) // 2, len(ky) // 2])


def rows_of(name: str) -> list[dict[str, Any]]:
    """Rows of one device: value, and its ratio to the fit's, by who asks, light and lag."""
    device = Device.load(name)
    who = asked(device)
    rows = []
    for light in LIGHTS:
        wanted = who["fit"](light)
        for word, give in who.items():
            for i, j in LAGS:
                value = float(give(light)[j, i])
                rows.append({
                    "device": name, "light": "back" if light is None else f"{light:g} nm",
                    "who": word, "i": i, "j": j, "a_per_e": value,
                    "over_fit": value / float(wanted[j, i]),
                })  # fmt: skip
    found = solve_response(device, cells=CELLS)
    a = area_matrix(found.kx, found.ky)[:, REACH + 1, REACH + 1]

    def in_light(wavelength: float) -> float:
        return float(conversion_weights(found.depths, wavelength, KELVIN) @ a)

    rows.append(_of_bands(name, "fit", in_light, device.silicon.thickness))
    return rows


def _of_bands(
    name: str, who: str, a: Callable[[float], float], thickness: float
) -> dict[str, Any]:
    """Row of a_00 in y, and over that in u."""
    y, u = (in_band(a, thickness, *band) for band in BANDS.values())
    return {
        "device": name, "light": "y over u", "who": who, "i": 0, "j": 0, "a_per_e": y,
        "over_fit": y / u,
    }  # fmt: skip


def main() -> None:
    """Solve, print and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    rows = [row for name in DEVICES for row in rows_of(name)]
    rows.append(_of_bands("image charges", "numpy", by_image_charges, NOMINAL["thickness"]))
    table = Table(rows)
    table["a_per_e"].info.format = ".5e"
    table["over_fit"].info.format = ".5f"
    table.pprint(max_lines=-1, max_width=-1)
    path = RESULTS / "one_response.ecsv"
    write_results(table, path, "python -m validation.boundaries.one_response")


if __name__ == "__main__":
    main()
