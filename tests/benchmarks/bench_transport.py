"""CPU time an electron takes to its well, in large steps and from collision to collision.

Run ``OMP_NUM_THREADS=1 python tests/benchmarks/bench_transport.py [--repeats 5]`` on a quiet
machine; prints the best of the repeats, the spread, and a digest of where the electrons ended,
which a change that is none to the physics leaves alone.
"""

from __future__ import annotations

import argparse
import hashlib
import time

import numpy as np

from bfsensor.device.device import Device
from bfsensor.direct.transport import Tracer, Transport
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics

CASES = {
    "steps": (20_000, Transport()),
    "steps, back absorbs": (20_000, Transport(back_absorption=0.5)),
    "steps, no diffusion": (20_000, Transport(diffusion=0.0)),
    "scattering": (100, Transport(engine="scattering")),
}


def main() -> None:
    """Trace and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    device = Device.load("itl_sta3800c")
    mesh = make_mesh(device, pixels=(5, 5), cells=8, symmetric=False)
    tracer = Tracer(Electrostatics(device, mesh).solve(20_000.0))
    rng = np.random.default_rng(5150)
    for name, (count, transport) in CASES.items():
        starts = np.column_stack([rng.uniform(-20, 20, (count, 2)), np.full(count, 95.0)])
        tracer.trace(starts[:10], seed=1, transport=transport)
        spent = []
        for _ in range(options.repeats):
            begin = time.process_time()
            found = tracer.trace(starts, seed=77, transport=transport)
            spent.append((time.process_time() - begin) / count * 1e6)
        digest = hashlib.sha256(
            found.positions.tobytes() + found.fates.tobytes()
        ).hexdigest()
        print(
            f"{name:22} {min(spent):10.3f} us an electron (to {max(spent):.3f}), {digest[:12]}"
        )


if __name__ == "__main__":
    main()
