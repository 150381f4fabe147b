"""Cost of what a fit is made of: a device with all derivatives, and the same on a finer mesh.

Run with ``python tests/benchmarks/bench_fit.py [DEVICE]``; prints CPU seconds, and what a fit of five
rounds with twelve draws from the posterior takes of them beside 182 s, the time of commit 230d927.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from bfsensor.device.condition import Condition
from bfsensor.device.device import Device
from bfsensor.device.quantities import choose_priors
from bfsensor.fit.finer_mesh import DRAWN, FINER, REFINE_Z
from bfsensor.fit.full_solutions import solve_shifts
from bfsensor.fit.linear_response import Linearise

BEFORE = 182.0
ROUNDS, DRAWS = 5, 12


def timed(call, *args, **options) -> float:
    """CPU seconds of a call."""
    began = time.process_time()
    call(*args, **options)
    return time.process_time() - began


def main() -> None:
    """Print the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("device", nargs="?", default="itl_sta3800c_60")
    device = Device.load(parser.parse_args().device)
    priors, at = choose_priors(device, ("all",)), (Condition(),)
    means = np.array([prior.mean for prior in priors])
    Linearise(device, priors[:1], at, cells=8)(means[:1])  # compiles
    one = timed(Linearise(device, priors, at, cells=16), means)
    fine = timed(solve_shifts, device, priors, means, at, cells=FINER, refine_z=REFINE_Z)
    print(
        f"{device.name}: {len(priors)} quantities with derivatives on 16 cells: {one:.1f} CPU s"
    )
    drawn = timed(solve_shifts, device, priors, means, at, cells=DRAWN, refine_z=REFINE_Z)
    print(f"solution on {FINER} cells: {fine:.1f}, on {DRAWN}: {drawn:.1f} CPU s")
    whole = ROUNDS * (one + fine) + (1 + DRAWS) * drawn
    print(
        f"{ROUNDS} rounds and {DRAWS} draws: {whole:.0f} CPU s, {whole / BEFORE:.2f} of {BEFORE:.0f} s"
    )


if __name__ == "__main__":
    main()
