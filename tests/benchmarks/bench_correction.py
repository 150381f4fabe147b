"""Cost of ``correct_table``: wall and CPU time and memory, by size of the image and reach of the table.

Run on a quiet machine: ``OMP_NUM_THREADS=1 python tests/benchmarks/bench_correction.py [--threads 2]``.
Each measurement is a process of its own that corrects an image of single precision, stars on a sky,
after a small one that compiles kernels and factors the table.  Prints the time of a profile's largest
parts, and ratios to what was asked for: 4 s wall and 1.2 GB for 4096 x 4096 pixels.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import resource
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np

from bfsensor import DistortionTable, correct_table

WALL, MEMORY = 4.0, 1.2e9
CASES = ((1024, 4), (2048, 4), (4096, 4), (4096, 2))
"""Sides of images and reaches of tables [pixel]."""


def table_of(device: str, reach: int) -> DistortionTable:
    """Table of a device whose edges farther than ``reach`` pixels do not move."""
    table = DistortionTable.load(device)
    away = table.reach - reach
    if away == 0:
        return table
    inner = slice(away, -away)
    return replace(
        table, reach=reach, corners=table.corners[:, :, :, inner, inner],
        horizontal=table.horizontal[:, :, :, inner, inner],
        vertical=table.vertical[:, :, :, inner, inner],
    )  # fmt: skip


def image_of(side: int) -> np.ndarray:
    """Stars of 60,000 e- on a sky of 2,000 e-, single precision."""
    rng = np.random.default_rng(7)
    image = rng.poisson(2000.0, (side, side)).astype(np.float32)
    image[20::53, 20::47] += 60_000.0
    return image


def measure(
    device: str, side: int, reach: int, threads: int, parts: bool
) -> dict[str, float]:
    """Correct an image of a side: seconds, and bytes of the process at most."""
    table = table_of(device, reach)
    correct_table(image_of(300), table, threads=threads)
    image = image_of(side)
    before = resource.getrusage(resource.RUSAGE_SELF)
    began = time.perf_counter()
    profile = cProfile.Profile()
    if parts:
        profile.enable()
    correct_table(image, table, threads=threads, out=np.empty(image.shape, np.float32))
    profile.disable()
    wall = time.perf_counter() - began
    after = resource.getrusage(resource.RUSAGE_SELF)
    if parts:
        pstats.Stats(profile, stream=sys.stderr).sort_stats("tottime").print_stats(6)
    return {
        "wall": wall, "bytes": 1024.0 * after.ru_maxrss,
        "cpu": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
    }  # fmt: skip


def main() -> None:
    """Print the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="itl_sta3800c")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--one", type=int, nargs=2, help="Side and reach, in this process.")
    parser.add_argument("--parts", action="store_true", help="Profile, of one thread.")
    options = parser.parse_args()
    if options.one:
        side, reach = options.one
        threads = 1 if options.parts else options.threads
        print(json.dumps(measure(options.device, side, reach, threads, options.parts)))
        return
    for side, reach in CASES:
        command = [sys.executable, __file__, "--device", options.device]
        command += ["--threads", str(options.threads), "--one", str(side), str(reach)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        found = json.loads(done.stdout.splitlines()[-1])
        rate = 1e6 * found["cpu"] / side**2
        print(
            f"side {side}, reach {reach}: {found['wall']:.2f} s wall, {found['cpu']:.2f} CPU s, "
            f"{rate:.2f} us a pixel, {found['bytes'] / 1e9:.2f} GB at most in the process; of what is "
            f"asked for 4096: wall {found['wall'] / WALL:.2f}, memory {found['bytes'] / MEMORY:.2f}"
        )


if __name__ == "__main__":
    main()
