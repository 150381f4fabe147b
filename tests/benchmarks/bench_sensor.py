"""Sensors against galsim.SiliconSensor: CPU seconds for the same photons, side by side.

Run ``OMP_NUM_THREADS=1 python tests/benchmarks/bench_sensor.py [--repeats 3] [-o OUT.ecsv]``
on a quiet machine; each case runs in a process of its own.  Prints the best of the repeats
and the spread, the ratio, and what the project asks for.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time

import numpy as np

CASES = {
    # name: (at most, aim) as ratio of CPU seconds to SiliconSensor
    "star 1e6": (1 / 3, 1 / 6),
    "star 1e7": (1 / 3, 1 / 6),
    "star 1e6, wavelengths and angles": (1 / 2, 1 / 4),
    "flat 512, 1e6 photons": (1 / 100, 1 / 300),
    "first accumulate 4096": (1 / 50, 1 / 200),
    "areas 2048": (1 / 20, 1 / 50),
}
SENSORS = ("galsim", "silicon", "brighter_fatter")


def make_sensor(which: str, threads: int = 1, nrecalc: float = 10_000):
    """Make one of the three sensors."""
    import galsim

    rng = galsim.UniformDeviate(31415)
    if which == "galsim":
        return galsim.SiliconSensor(rng=rng, nrecalc=nrecalc)
    import bfsensor

    if which == "silicon":
        sensor = bfsensor.SiliconSensor(rng=rng, nrecalc=nrecalc)
        sensor.threads = threads
        return sensor
    return bfsensor.BrighterFatterSensor(rng=rng, threads=threads, nrecalc=nrecalc)


def photons_for(case: str):
    """Photons and image of a case."""
    import galsim

    rng = np.random.default_rng(2718)
    if case.startswith(("star", "pooled")):
        count = 10_000_000 if "1e7" in case else 1_000_000
        x, y = rng.normal(0, 1, (2, count))
        extra = {}
        if "angles" in case:
            extra = {
                "dxdz": rng.normal(0, 0.1, count),
                "dydz": rng.normal(0, 0.1, count),
                "wavelength": rng.uniform(550, 690, count),
            }
        image = galsim.ImageF(64, 64)
        image.setCenter(0, 0)
        return galsim.PhotonArray(count, x, y, np.ones(count), **extra), image
    if case.startswith("flat"):
        x, y = rng.uniform(0.5, 512.5, (2, 1_000_000))
        return galsim.PhotonArray(len(x), x, y, np.ones(len(x))), galsim.ImageF(512, 512)
    if case.startswith("first"):
        photons = galsim.PhotonArray(1, np.array([9.0]), np.array([9.0]), np.ones(1))
        return photons, galsim.ImageF(4096, 4096)
    return None, galsim.ImageF(rng.poisson(5e4, (2048, 2048)).astype(np.float32))


def warm(sensor) -> None:
    """Compile and load everything once on a small image."""
    import galsim

    rng = np.random.default_rng(99)
    x, y = rng.normal(9, 1, (2, 1000))
    for extra in ({}, {"dxdz": x * 0, "dydz": x * 0, "wavelength": x * 0 + 600.0}):
        image = galsim.ImageF(17, 17)
        sensor.accumulate(galsim.PhotonArray(1000, x, y, np.ones(1000), **extra), image)
    # Small and large images are summed in different precision.
    for side in (17, 600):
        sensor.calculate_pixel_areas(galsim.ImageF(side, side))


def run(case: str, which: str, threads: int) -> dict[str, float]:
    """Measure one case once."""
    # Pooled: boundaries are renewed by hand alone, as imSim does it.
    sensor = make_sensor(which, threads, 0 if case.startswith("pooled") else 10_000)
    warm(sensor)
    photons, image = photons_for(case)
    image.array[...] += 0  # its pages are there
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, cpu = time.perf_counter(), time.process_time()
    if photons is None:
        sensor.calculate_pixel_areas(image)
    else:
        sensor.accumulate(photons, image)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    return {"cpu": cpu, "wall": wall, "bytes per pixel": grown / image.array.size}


def once(case: str, which: str, threads: int = 1) -> dict[str, float]:
    """Measure in a fresh process."""
    command = [sys.executable, __file__, "--one", case, which, str(threads)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "2"}
    text = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout
    return json.loads(text.splitlines()[-1])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", help="write the rows to an ECSV file")
    options = parser.parse_args()
    if options.one:
        case, which, threads = options.one
        print(json.dumps(run(case, which, int(threads))))
        return
    rows = []
    load = os.getloadavg()
    print(f"load {load}, {os.cpu_count()} cores, best of {options.repeats}")
    for case, (limit, aim) in CASES.items():
        best = {}
        for which in SENSORS:
            runs = [once(case, which) for _ in range(options.repeats)]
            cpu = [r["cpu"] for r in runs]
            best[which] = min(cpu)
            memory = min(r["bytes per pixel"] for r in runs)
            ratio = best[which] / best["galsim"]
            verdict = ""
            if which != "galsim":
                verdict = "aim" if ratio <= aim else "met" if ratio <= limit else "MISSED"
            print(
                f"{case:34s} {which:16s} {best[which]:8.4f} s (to {max(cpu):.4f})  "
                f"ratio 1/{1 / ratio:<7.1f} {verdict:6s} {memory:6.1f} B/pixel",
                flush=True,
            )
            rows.append((case, which, best[which], max(cpu), ratio, limit, aim, memory))
    for case in ("star 1e7", "pooled 1e7"):
        for which in SENSORS[1:]:
            one, two = (
                min(once(case, which, threads)["wall"] for _ in range(options.repeats))
                for threads in (1, 2)
            )
            print(
                f"two threads, {case:21s} {which:16s} {two:8.4f} s wall, {one / two:.2f} x"
            )
            rows.append((f"two threads, {case}", which, two, one, one / two, 1.7, 1.9, 0.0))
    if options.output:
        from astropy.table import Table

        from validation.common.write_results import write_results

        names = ("case", "sensor", "cpu_s", "cpu_s_worst", "ratio", "limit", "aim", "bytes")
        write_results(
            Table(rows=rows, names=names), options.output,
            f"python tests/benchmarks/bench_sensor.py --repeats {options.repeats}",
            load=[round(x, 2) for x in load],
        )  # fmt: skip


if __name__ == "__main__":
    main()
