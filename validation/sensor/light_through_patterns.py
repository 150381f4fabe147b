"""Origins of light under tree rings and maps, flats through rings, and areas at all depths.

``python -m validation.sensor.light_through_patterns positions|flats|colours [--photons N]``

positions
    Where electrons come from whose boundaries rings and maps have shifted, by the kernels of the
    sensors and by the two-dimensional iteration that they replace.
flats
    Uniform light through tree rings onto charge, photon by photon, against the areas that
    ``calculate_pixel_areas`` gives: chi-square per pixel, and without the rings in the areas.
colours
    Uniform light that converts at each depth of a table and between them, around a filled pixel,
    against the areas of the table: chi-square of the pixels that its reach holds.

Rows are written to ``validation/results/light_positions.ecsv``, ``light_flats.ecsv`` and
``light_colours.ecsv``.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import galsim
import numpy as np
from astropy.table import Table

from bfsensor import BrighterFatterSensor, DistortionTable, ShiftMap, SiliconSensor
from bfsensor._kernels import photons as kernels
from bfsensor._kernels.compile_options import from_python
from bfsensor._kernels.photons import Light
from bfsensor.device.shipped import tables_dir
from bfsensor.sensor.base import EngineSensor
from bfsensor.sensor.shift_maps import make_pattern, sample_rings
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results"
COMMAND = "python -m validation.sensor.light_through_patterns"
CENTRE = (-2048.0, -2048.0)
SIDE = 512
SKY = 2e4
CHARGE = 1e5
DEVICES = ("itl_sta3800c", "e2v_ccd250")
CHUNK = 2_000_000
FAINT = 1e-6
"""Electrons of a photon, so few that all of them leave the boundaries where they are."""


def rings(kind: str = "one") -> Any:
    """Radial shifts of 0.26 pixel: one cosine, or 20 on 2,700 points as LSST's are given."""
    if kind == "one":
        return galsim.SiliconSensor.simple_treerings(0.26, 47.0, r_max=8000.0)
    rng = np.random.default_rng(1123)
    period, phase = rng.uniform(18, 80, 20), rng.uniform(0, 2 * np.pi, 20)
    radius = np.linspace(0, 8000.0, 2700)
    waves = np.sin(2 * np.pi * radius[:, None] / period + phase).sum(axis=1)
    return galsim.LookupTable(radius, 0.26 * waves / np.abs(waves).max())


def smooth_map() -> ShiftMap:
    """Shifts up to 0.1 pixel that vary within tens of pixels, with noise of 0.001 pixel."""
    rng = np.random.default_rng(40009)
    wave = np.add.outer(np.sin(np.arange(301) / 5.0), np.cos(np.arange(301) / 4.0))
    return ShiftMap(0.05 * wave + rng.uniform(-1e-3, 1e-3, wave.shape), -0.03 * wave)


def guard_ring() -> ShiftMap:
    """Shifts next to the edge of a sensor, where pixels are up to 1.6 times too large."""
    falling = -1.5 * np.exp(-np.arange(60) / 4.0)
    return ShiftMap.from_edges((300, 300), x_low=falling, y_high=falling)


# -- positions -----------------------------------------------------------------------------------


def positions(count: int) -> Table:
    """Compare origins by the kernels with those of the iteration."""
    land, find_origin, fixed_shift = map(
        from_python, (kernels.land, kernels.find_origin, kernels.fixed_shift)
    )
    rows = []
    sensor = BrighterFatterSensor(diffusion_factor=0.0)
    medium, factor = sensor._physics.medium, sensor._factor
    rng = np.random.default_rng(5150)
    nothing = np.zeros(0)
    for name, ring, fixed in (
        ("rings", rings(), None), ("rings of 20 cosines", rings("many"), None),
        ("map", None, smooth_map()), ("guard ring", None, guard_ring()),
        ("rings and map", rings(), smooth_map()),
    ):  # fmt: skip
        sampled = None if ring is None else sample_rings(ring)
        pattern = make_pattern(sampled, CENTRE, factor, fixed, (0.5, 0.5))
        x, y = rng.uniform(5, 295, (2, count))
        waves = rng.uniform(400, 1000, count)
        light = Light(x, y, np.ones(count), nothing, nothing, waves)
        out = (np.empty(count), np.empty(count), np.empty(count, np.float32))
        words = np.empty(count, np.uint32)
        zero = np.uint32(0)
        land(light, medium, pattern, 0, count, 0, zero, zero, 0.0, 0.0, *out, words)
        apart, left, moved = [], [], []
        for n in np.flatnonzero(out[2] >= 0):
            part = float(out[2][n]) / medium.thickness
            px, py = find_origin(pattern, x[n], y[n], part)
            dx, dy = fixed_shift(pattern, out[0][n], out[1][n], part)
            apart.append(np.hypot(out[0][n] - px, out[1][n] - py))
            left.append(np.hypot(out[0][n] + dx - x[n], out[1][n] + dy - y[n]))
            moved.append(np.hypot(px - x[n], py - y[n]))
        rows.append({
            "pattern": name, "photons": len(apart), "largest_shift": max(moved),
            "largest_difference": max(apart), "largest_left": max(left),
        })  # fmt: skip
        print(rows[-1], flush=True)
    return Table(rows)


# -- flats ---------------------------------------------------------------------------------------


def uniform(sensor: EngineSensor, image: galsim.Image, count: int, rng: Any) -> float:
    """Shine uniform light on an image and 4 pixels around it; returns the photons per pixel."""
    ny, nx = image.array.shape
    done = 0
    while done < count:
        n = min(CHUNK, count - done)
        x = rng.uniform(image.xmin - 4.5, image.xmax + 4.5, n)
        y = rng.uniform(image.ymin - 4.5, image.ymax + 4.5, n)
        light = galsim.PhotonArray(n, x, y, np.full(n, FAINT))
        # Renewed boundaries are the same ones, but by edges that are evaluated once for all.
        sensor.accumulate(light, image, resume=done > 0, recalc=done > 0)
        done += n
    return count / ((nx + 8) * (ny + 8))


def flats(count: int) -> Table:
    """Compare counts of uniform light through rings with areas."""
    rows = []
    for name, kind in (
        ("SiliconSensor", SiliconSensor),
        ("BrighterFatterSensor", BrighterFatterSensor),
    ):
        for which in ("one", "many"):
            sensor = kind(
                rng=galsim.BaseDeviate(7103), nrecalc=0, diffusion_factor=0.0,
                treering_func=rings(which), treering_center=galsim.PositionD(*CENTRE),
            )  # fmt: skip
            rng = np.random.default_rng(7104)
            image = galsim.ImageD(rng.poisson(SKY, (SIDE, SIDE)).astype(float))
            areas = sensor.calculate_pixel_areas(image).array
            plain = kind(nrecalc=0).calculate_pixel_areas(image).array
            before = image.array.copy()
            per_pixel = uniform(sensor, image, count, rng)
            found = (image.array - before) / FAINT
            chi2 = [float(np.mean((found - per_pixel * a) ** 2 / (per_pixel * a)))
                    for a in (areas, plain)]  # fmt: skip
            rows.append({
                "sensor": name, "rings": which, "photons": count, "chi2_per_pixel": chi2[0],
                "error": float(np.sqrt(2 / found.size)), "chi2_without_rings": chi2[1],
            })  # fmt: skip
            print(rows[-1], flush=True)
    return Table(rows)


# -- colours -------------------------------------------------------------------------------------


def around(sensor: EngineSensor, count: int, seed: int, reach: int) -> tuple[Any, float]:
    """Counts of the pixels around a filled one, and photons per pixel."""
    side = 2 * reach + 9
    image = galsim.ImageD(side, side)
    image.setCenter(0, 0)
    image[0, 0] = CHARGE
    per_pixel = uniform(sensor, image, count, np.random.default_rng(seed))
    image[0, 0] -= CHARGE
    return image[galsim.BoundsI(-reach, reach, -reach, reach)].array / FAINT, per_pixel


def at_height(sensor: SiliconSensor, height: float) -> SiliconSensor:
    """Let light convert at a height, for which SiliconSensor has no option."""
    physics = sensor._physics
    path = physics.medium.thickness - height
    sensor._physics = replace(physics, medium=physics.medium._replace(surface_path=path))
    return sensor


def colours(count: int) -> Table:
    """Compare captured light with areas at each depth of a table and between them."""
    rows = []
    for device in DEVICES:
        table = DistortionTable.read(tables_dir() / device / "table.fits")
        depths = np.asarray(table.depths, float)
        heights = np.sort(np.concatenate([depths, np.sqrt(depths[:-1] * depths[1:])]))
        area = table.pitch[0] * table.pitch[1]
        for height in heights[heights > 0]:
            sensor = BrighterFatterSensor(
                table=table, nrecalc=0, diffusion_factor=0.0, full_well=np.inf,
                conversion_depth=table.thickness - height, rng=galsim.BaseDeviate(9402),
            )  # fmt: skip
            areas = 1 + table.area_changes(charge=CHARGE, depth=float(height)) / area
            rows.append(_colour(device, height, areas, sensor, count))
    for height in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 99.0):
        sensor = SiliconSensor(
            nrecalc=0, diffusion_factor=0.0, rng=galsim.BaseDeviate(9402)
        )
        # Shifts are linear in the charge, and scale with the height as GalSim documents.
        image = galsim.ImageD(9, 9)
        image.setCenter(0, 0)
        image[0, 0] = CHARGE * np.tanh(height / 12.0)
        areas = sensor.calculate_pixel_areas(image).array
        rows.append(
            _colour("SiliconSensor", height, areas, at_height(sensor, height), count)
        )
    return Table(rows)


def _colour(name: str, height: float, areas: Any, sensor: EngineSensor, count: int) -> dict:
    """Row of one sensor and height."""
    found, per_pixel = around(sensor, count, 9403 + round(100 * height), len(areas) // 2)
    expected = per_pixel * areas
    chi2 = float(np.sum((found - expected) ** 2 / expected))
    middle = len(areas) // 2
    row = {
        "sensor": name, "height_um": float(height), "captured": found[middle, middle] / per_pixel,
        "error": float(np.sqrt(areas[middle, middle] / per_pixel)),
        "table": float(areas[middle, middle]), "chi2": chi2, "pixels": areas.size,
        "chi2_without_effect": float(np.sum((found - per_pixel) ** 2 / per_pixel)),
    }  # fmt: skip
    print(row, flush=True)
    return row


def main() -> None:
    """Run one comparison and write its rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("positions", "flats", "colours"))
    parser.add_argument("--photons", type=int, help="of each row")
    parser.add_argument(
        "-o", "--output", help="default: validation/results/light_WHAT.ecsv"
    )
    options = parser.parse_args()
    made, count = {
        "positions": (positions, 100_000), "flats": (flats, 160_000_000),
        "colours": (colours, 40_000_000),
    }[options.what]  # fmt: skip
    path = options.output or RESULTS / f"light_{options.what}.ecsv"
    write_results(made(options.photons or count), path, f"{COMMAND} {options.what}")


if __name__ == "__main__":
    main()
