"""Cost of a table level: CPU time, memory, accuracy, bytes moved against the machine's.

Run with ``python tests/benchmarks/bench_table.py [--cells 32] [-o results.ecsv]``; prints
ratios to the peer (Poisson_CCD: 694 CPU s and 1.78 GB for one level of 9 x 9 pixels and 32
vertices a side, 325 s of them for a potential that is not converged; measured on a
2-core AMD EPYC).
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from astropy.table import Table

from bfsensor.device.device import Device
from bfsensor.response.light import conversion_depths
from bfsensor.response.periodic_images import PERIOD
from bfsensor.simulate.boundaries import find_boundaries
from bfsensor.simulate.pixel_array import PixelArray
from bfsensor.table.levels import solve_level
from bfsensor.table.table_plan import plan_table

PEER_CPU, PEER_MEMORY = 694.0, 1.78


def cpu() -> float:
    """CPU seconds of this process."""
    return time.process_time()


def memory_bandwidth() -> float:
    """Bytes a second of ``a = a + b`` in single precision on one thread, best of five."""
    n = 16_000_000
    a, b = np.ones(n, np.float32), np.ones(n, np.float32)
    best = 0.0
    for _ in range(5):
        began = time.perf_counter()
        np.add(a, b, out=a)
        best = max(best, 3 * 4 * n / (time.perf_counter() - began))
    return best


def bench(name: str, cells: int, bandwidth: float) -> dict[str, object]:
    """Solve and trace one level, and the next of the same array; compilation is done before."""
    device = Device.load(name)
    began = cpu()
    array = PixelArray(device, period=PERIOD, cells=cells)
    array.unit(0.0)
    setup = cpu() - began
    mesh, solver = array.mesh, array.solver
    began, cycles = cpu(), solver.multigrid.cycles
    solution = array.solve(1e5, 0.0)
    solve = cpu() - began
    cycles = solver.multigrid.cycles - cycles
    began = cpu()
    # The first of a table's depths is where nothing moves.
    find_boundaries(solution, conversion_depths(device)[1:], reach=4, samples=24)
    trace = cpu() - began
    # A table solves all levels of a background on one array, whose memory is touched by then.
    began = cpu()
    following = array.solve(8e4, 0.0)
    next_solve = cpu() - began
    began = cpu()
    find_boundaries(following, conversion_depths(device)[1:], reach=4, samples=24)
    next_trace = cpu() - began
    nodes = int(np.prod(mesh.shape))
    # One V(1,1) cycle in single precision: on the way down and up a level reads charge and pivots and
    # writes the solution, which it reads before on the way up (32 bytes); coarser levels a third more;
    # 24 to pack charge and unpack the solution.  The start from coarser arrays is not counted.  An
    # iteration adds the operator and the vector updates in double precision, 120 bytes.
    moved = cycles * nodes * (4 / 3 * 32 + 24 + 120)
    return {
        "device": name, "cells": cells, "nodes": nodes, "setup_cpu_s": round(setup, 2),
        "solve_cpu_s": round(solve, 2), "trace_cpu_s": round(trace, 2),
        "next_solve_cpu_s": round(next_solve, 2), "next_trace_cpu_s": round(next_trace, 2),
        "cycles": cycles,
        "newton": len(solution.history), "iteration_error_V": f"{solution.error_volts:.1e}",
        "GB_moved": round(moved / 1e9, 2), "share_of_bandwidth": round(moved / solve / bandwidth, 3),
        "peak_GB": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 3),
        "peer_cpu_ratio": round(PEER_CPU / (solve + trace), 0),
    }  # fmt: skip


def main() -> None:
    """Print the benchmark, and append it to an ECSV file where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cells", type=int, nargs="*", default=[16, 24, 32])
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    began = cpu()
    tiny = plan_table(
        Device.load("itl_sta3800c"),
        charges=[5e4],
        backgrounds=[0.0],
        depths=[95.0],
        accuracy=0.05,
    )
    solve_level(tiny, 5e4, 0.0)
    print(f"first call with compilation or its cache: {cpu() - began:.1f} CPU s")
    bandwidth = memory_bandwidth()
    print(f"memory bandwidth, one thread: {bandwidth / 1e9:.1f} GB/s")
    rows = [
        bench(name, cells, bandwidth)
        for cells in args.cells
        for name in ("itl_sta3800c", "e2v_ccd250")
    ]
    table = Table(rows)
    print("\n".join(table.pformat(max_width=-1)))
    print(f"peer: {PEER_CPU:.0f} CPU s and {PEER_MEMORY} GB a level, not converged")
    if args.output:
        from validation.common.write_results import write_results

        write_results(table, args.output, "python tests/benchmarks/bench_table.py")


if __name__ == "__main__":
    main()
