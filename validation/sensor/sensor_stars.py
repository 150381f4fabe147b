"""Stars, filled pixels and image edges through the sensors.

``python -m validation.sensor.sensor_stars ladder|depth|edges [--device NAME] [--stars N]``

ladder
    Stars of sigma = 1 pixel with 10,000 e- in the peak up to nearly full, on no sky and on
    20,000 e- of sky, drawn from the same photons with and without the effect, by
    galsim.SiliconSensor with a table exported from ours, by our sensor with that table alone
    (the same physics), and by our sensor with the whole table.  One row a star.
depth
    The part of uniform light that a pixel with 100,000 e- captures, by height of conversion.
edges
    The area of a pixel with 100,000 e- at each edge of an image.

Rows are appended to ``validation/results/sensor_*.ecsv``; what is there is not done again.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import galsim
import numpy as np
from astropy.table import Table, vstack

from bfsensor import BrighterFatterSensor, DistortionTable, SiliconSensor
from bfsensor.device.device import Device
from bfsensor.device.shipped import tables_dir
from bfsensor.table.build import build_table
from bfsensor.table.galsim_format import write_galsim
from bfsensor.table.table_plan import plan_table
from validation.common.write_results import write_results

RESULTS = Path(__file__).parents[1] / "results"
SIDE, STAMP = 21, 6
SIGMA = 1.0
PEAKS = (10e3, 30e3, 60e3, 90e3, 120e3, 150e3)
SKY = 20e3
CHARGE = 1e5
IN_PEAK = 0.14663  # part of a Gaussian of sigma = 1 pixel in its central pixel
HIGH = "itl -60 V, +4 V"


@lru_cache(maxsize=4)
def table_of(device: str) -> DistortionTable:
    """Give a built-in table, or solve the point that reaches 200,000 e-."""
    if device != HIGH:
        return DistortionTable.read(tables_dir() / device / "table.fits")
    point = Device.load("itl_sta3800c_60").with_value("gate_high", "4 V")
    plan = plan_table(
        point, charges=[0.0, 10e3, 50e3, 100e3, 150e3, 200e3], backgrounds=[0.0, 20e3, 60e3],
        accuracy=0.02,
    )  # fmt: skip
    return build_table(plan)


@lru_cache(maxsize=4)
def one_level(device: str) -> DistortionTable:
    """Keep one charge on no background from the back surface: what GalSim's files hold."""
    table = table_of(device)
    moved = table.displacements(charge=CHARGE, depth=float(table.depths[-1]))
    return replace(
        table, charges=np.array([CHARGE]), backgrounds=np.zeros(1),
        depths=table.depths[-1:], full_well=float("nan"),
        corners=moved.corners[None, None, None],
        horizontal=moved.horizontal[None, None, None],
        vertical=moved.vertical[None, None, None],
    )  # fmt: skip


def export(table: DistortionTable, folder: str, *, height: float | None = None) -> str:
    """Write a table for GalSim; ``height`` is where light without wavelengths converts."""
    stem = str(Path(folder) / f"table_{height}")
    if Path(stem + ".cfg").exists():
        return stem
    write_galsim(table, stem, charge=CHARGE, depth=float(table.depths[-1]), overwrite=True)
    if height is not None:
        cfg = Path(stem + ".cfg")
        lines = [
            f"SensorThickness = {height + 1.0}"
            if line.startswith("SensorThickness")
            else line
            for line in cfg.read_text().splitlines()
        ]
        cfg.write_text("\n".join(lines) + "\n")
    return stem


def make_sensor(variant: str, device: str, folder: str, strength: float, seed: int):
    """Make one of the sensors that are compared."""
    rng = galsim.BaseDeviate(seed)
    table = table_of(device)
    if variant == "galsim":
        return galsim.SiliconSensor(
            name=export(table, folder), rng=rng, diffusion_factor=0.0, qdist=4,
            nrecalc=1000.0, strength=max(strength, 1e-9),
        )  # fmt: skip
    options = {
        "same physics": {"table": one_level(device), "diffusion_factor": 0.0},
        "whole table": {"diffusion_factor": 0.0},
        "no background": {"diffusion_factor": 0.0, "background": False},
        "no charge response": {"diffusion_factor": 0.0, "charge_response": False},
        "with diffusion": {},
    }[variant]
    return BrighterFatterSensor(rng=rng, strength=strength, **{"table": table, **options})


def star(peak: float, sky: float, seed: int):
    """Photons of a star on a sky, in any order."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0, SIGMA, (2, rng.poisson(peak / IN_PEAK)))
    if sky > 0:
        u, v = (rng.random((2, rng.poisson(sky * SIDE**2))) - 0.5) * SIDE
        order = rng.permutation(len(x) + len(u))
        x, y = np.concatenate([x, u])[order], np.concatenate([y, v])[order]
    return galsim.PhotonArray(len(x), x, y, np.ones(len(x)))


def moments(image: galsim.Image, sky: float) -> tuple[float, float, float]:
    """Widths in x and y [pixel] and highest pixel of a star in its stamp, less the sky."""
    middle = slice(SIDE // 2 - STAMP, SIDE // 2 + STAMP + 1)
    pixels = image.array[middle, middle] - sky
    at = np.arange(-STAMP, STAMP + 1)
    total = pixels.sum()
    mx, my = (pixels.sum(0) @ at) / total, (pixels.sum(1) @ at) / total
    sx = np.sqrt(pixels.sum(0) @ at**2 / total - mx**2)
    sy = np.sqrt(pixels.sum(1) @ at**2 / total - my**2)
    return float(sx), float(sy), float(pixels.max())


def ladder(device: str, variants: list[str], stars: int, path: Path) -> None:
    """Draw the stars that are not there yet."""
    peaks = (*PEAKS, 180e3, 200e3) if device == HIGH else PEAKS
    with tempfile.TemporaryDirectory() as folder:
        for sky in (0.0, SKY):
            for seed in range(8101, 8101 + stars):
                for peak in peaks:
                    photons = None
                    for variant in variants:
                        if sky > 0 and variant == "with diffusion":
                            continue
                        key = {
                            "device": device, "variant": variant, "sky": sky, "peak": peak,
                            "seed": seed,
                        }  # fmt: skip
                        if _has(path, key):
                            continue
                        if photons is None:
                            photons = star(peak, sky, seed + int(peak))
                        began = time.process_time()
                        sizes = []
                        for strength in (1.0, 0.0):
                            sensor = make_sensor(variant, device, folder, strength, seed)
                            image = galsim.ImageD(SIDE, SIDE)
                            image.setCenter(0, 0)
                            sensor.accumulate(photons, image)
                            sizes.append(moments(image, sky))
                        (sx, sy, top), (sx0, sy0, top0) = sizes
                        row = {
                            **key, "sx": sx, "sy": sy, "top": top, "sx_off": sx0,
                            "sy_off": sy0, "top_off": top0,
                            "cpu_s": round(time.process_time() - began, 2),
                        }  # fmt: skip
                        _append(path, row, f"python -m validation.sensor.sensor_stars ladder "
                                f"--device '{device}'")  # fmt: skip
            print(device, sky, flush=True)


def slopes(table: Table, device: str, variant: str, sky: float, *, top: float = 125e3):
    """Growth [% per 50,000 e- of the peak] in x and y, with errors from the stars.

    A line through the origin up to ``top`` electrons, one for each star.
    """
    rows = table[
        (table["device"] == device) & (table["variant"] == variant) & (table["sky"] == sky)
    ]
    out = []
    for axis in "xy":
        each = []
        for seed in sorted(set(rows["seed"])):
            part = rows[(rows["seed"] == seed) & (rows["peak"] < top)]
            growth = 100 * (part[f"s{axis}"] / part[f"s{axis}_off"] - 1)
            peak = np.array(part["top_off"])
            each.append(5e4 * (peak @ growth) / (peak @ peak))
        mean = float(np.mean(each))
        out.append((mean, float(np.std(each, ddof=1) / np.sqrt(len(each)))))
    return out


def captured(sensor, count: int, seed: int) -> tuple[float, float]:
    """Area [nominal] of a pixel with 100,000 e- for uniform light, and its error."""
    side = 9
    image = galsim.ImageD(side, side)
    image.array[4, 4] = CHARGE
    rng = np.random.default_rng(seed)
    done = 0
    while done < count:
        n = min(4_000_000, count - done)
        x, y = rng.random((2, n)) * side + 0.5
        sensor.accumulate(galsim.PhotonArray(n, x, y, np.ones(n)), image, resume=done > 0)
        done += n
    electrons = image.array[4, 4] - CHARGE
    return float(electrons * side**2 / count), float(np.sqrt(electrons) * side**2 / count)


def depth(device: str, count: int, path: Path) -> None:
    """Captured areas by height of conversion: table, ours, GalSim and GalSim on our engine."""
    table = table_of(device)
    for height in (3.0, 5.0, 10.0, 20.0, 40.0, 80.0, 99.0):
        key = {"device": device, "height_um": height}
        if _has(path, key):
            continue
        row: dict[str, object] = dict(key)
        row["table"] = 1 + float(
            table.area_changes(charge=CHARGE, depth=height)[table.reach, table.reach]
            / np.prod(table.pitch)
        )
        row["tanh"] = 1 + (row_top(table) - 1) * float(np.tanh(height / 12.0))
        with tempfile.TemporaryDirectory() as folder:
            stem = export(table, folder, height=height)
            quiet = {"nrecalc": 0.0, "diffusion_factor": 0.0}
            sensors = {
                "ours": BrighterFatterSensor(
                    table=table, conversion_depth=table.thickness - height,
                    # What is captured must not spill.
                    rng=galsim.BaseDeviate(91), full_well=np.inf, **quiet,
                ),
                "galsim": galsim.SiliconSensor(
                    stem, rng=galsim.BaseDeviate(92), qdist=4, **quiet
                ),
                "silicon": SiliconSensor(stem, rng=galsim.BaseDeviate(93), qdist=4, **quiet),
            }  # fmt: skip
            for name, sensor in sensors.items():
                row[name], row[name + "_error"] = captured(sensor, count, 517)
        _append(
            path, row, f"python -m validation.sensor.sensor_stars depth --device {device}"
        )
        print(row, flush=True)


def row_top(table: DistortionTable) -> float:
    """Area of the filled pixel [nominal] for light from the back surface."""
    change = table.area_changes(charge=CHARGE, depth=float(table.depths[-1]))
    return 1 + float(change[table.reach, table.reach] / np.prod(table.pitch))


def edges(device: str, path: Path) -> None:
    """Areas of a filled pixel at the four edges of an image."""
    table = table_of(device)
    side = 11
    places = {"left": (5, 0), "right": (5, 10), "bottom": (0, 5), "top": (10, 5)}
    with tempfile.TemporaryDirectory() as folder:
        stem = export(table, folder)
        sensors = {
            "ours": BrighterFatterSensor(table=one_level(device)),
            "galsim": galsim.SiliconSensor(stem, qdist=4),
            "silicon": SiliconSensor(stem, qdist=4),
        }
        for edge, at in {"inside": (5, 5), **places}.items():
            if _has(path, {"device": device, "edge": edge}):
                continue
            row: dict[str, object] = {"device": device, "edge": edge}
            for name, sensor in sensors.items():
                image = galsim.ImageD(side, side)
                image.array[at] = CHARGE
                row[name] = float(sensor.calculate_pixel_areas(image).array[at])
            _append(
                path,
                row,
                f"python -m validation.sensor.sensor_stars edges --device {device}",
            )
            print(row, flush=True)


def _has(path: Path, key: dict) -> bool:
    if not path.exists():
        return False
    table = _read(str(path), path.stat().st_mtime_ns)
    found = np.ones(len(table), bool)
    for name, value in key.items():
        found &= table[name] == value
    return bool(found.any())


@lru_cache(maxsize=2)
def _read(path: str, changed: int) -> Table:
    return Table.read(path, format="ascii.ecsv")


def _append(path: Path, row: dict, command: str) -> None:
    new = Table(rows=[tuple(row.values())], names=tuple(row))
    if path.exists():
        old = Table.read(path, format="ascii.ecsv")
        new = vstack([old, new], metadata_conflicts="silent")
    write_results(new, path, command, added=True)


def main() -> None:
    """Run one of the three."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("ladder", "depth", "edges"))
    parser.add_argument("--device", default="itl_sta3800c")
    parser.add_argument("--stars", type=int, default=6)
    parser.add_argument("--photons", type=int, default=20_000_000)
    parser.add_argument("--folder", default=str(RESULTS))
    options = parser.parse_args()
    path = Path(options.folder) / f"sensor_{options.what}.ecsv"
    if options.what == "ladder":
        variants = ["galsim", "same physics", "whole table", "with diffusion"]
        if options.device != HIGH:
            variants += ["no background", "no charge response"]
        ladder(options.device, variants, options.stars, path)
        table = Table.read(path, format="ascii.ecsv")
        for sky in (0.0, SKY):
            for variant in variants:
                if sky > 0 and variant == "with diffusion":
                    continue
                (x, dx), (y, dy) = slopes(table, options.device, variant, sky)
                print(
                    f"{options.device:16s} sky {sky:6.0f} {variant:18s} "
                    f"x {x:.4f} +- {dx:.4f}  y {y:.4f} +- {dy:.4f} % per 50,000 e-"
                )
    elif options.what == "depth":
        depth(options.device, options.photons, path)
    else:
        edges(options.device, path)


if __name__ == "__main__":
    main()
