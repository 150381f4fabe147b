"""Cost of the direct simulation of a spot, by step and by electron.

Run with ``python tests/benchmarks/bench_spots.py [--steps 6]``; prints CPU seconds of the first
steps of 80, what a spot takes by these, and its ratio to 62 s, the time of commit 230d927.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

from bfsensor.device.device import Device
from bfsensor.direct.spot_exposure import SpotPlan, simulate_spot

BEFORE, STEPS = 62.0, 80


def main() -> None:
    """Print the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=6)
    steps = parser.parse_args().steps
    plan = SpotPlan(Device.load("itl_sta3800c"))
    # The same charge in each step as in a whole spot.
    part = replace(plan, steps=steps, peak=plan.peak * steps / STEPS)
    simulate_spot(replace(part, steps=1, peak=1e3), 0)  # compiles
    began = time.process_time()
    simulate_spot(part, 0)
    each = (time.process_time() - began) / steps
    electrons = part.electrons / steps
    print(
        f"{each:.2f} CPU s a step of {electrons:.0f} electrons, {1e6 * each / electrons:.1f} us each"
    )
    print(
        f"a spot of {STEPS} steps: {STEPS * each:.0f} CPU s, "
        f"{STEPS * each / BEFORE:.2f} of {BEFORE:.0f} s"
    )


if __name__ == "__main__":
    main()
