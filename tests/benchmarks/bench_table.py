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
from bfsensor.response.periodic_images import PERIOD
from bfsensor.simulate.boundaries import find_boundaries
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from bfsensor.table.levels import solve_level
from bfsensor.table.table_plan import plan_table

PEER_CPU, PEER_MEMORY = 694.0, 1.78


def cpu() -> float:
    """CPU seconds of this process."""
    return time.process_time()


def memory_bandwidth() -> float:
    """Bytes a second of ``a = b + s c`` on one thread (STREAM triad, best of five)."""
    n = 8_000_000
    b, c, a = np.ones(n), np.ones(n), np.zeros(n)
    best = 0.0
    for _ in range(5):
        began = time.perf_counter()
        np.multiply(c, 3.0, out=a)
        np.add(a, b, out=a)
        best = max(best, 5 * 8 * n / (time.perf_counter() - began))
    return best


def bench(name: str, cells: int, bandwidth: float) -> dict[str, object]:
    """Solve and trace one level and the next one; compilation is done before."""
    device = Device.load(name)
    charges = np.zeros(1)
    began = cpu()
    mesh = make_mesh(device, pixels=(PERIOD, PERIOD), cells=cells)
    solver = Electrostatics(device, mesh)
    start = tile(solve_unit_cell(device, 0.0, cells=cells), mesh)
    charges = np.zeros(solver.pixel_shape)
    charges[0, 0] = 1e5
    setup = cpu() - began
    began, cycles = cpu(), solver.multigrid.cycles
    solution = solver.solve(charges, start=start)
    solve = cpu() - began
    cycles = solver.multigrid.cycles - cycles
    began = cpu()
    find_boundaries(solution, [5.0, 10.0, 20.0, 40.0, 100.0], reach=4, samples=24)
    trace = cpu() - began
    nodes = int(np.prod(mesh.shape))
    # One V(1,1) cycle, fine level, single precision: four half sweeps read and write the
    # solution and read the charge (12 bytes), residual 12, transfers 16; coarser levels a third
    # more. An iteration adds the operator and the vector updates in double precision, 120 bytes.
    moved = cycles * nodes * (4 / 3 * (4 * 12 + 12 + 16) + 120)
    return {
        "device": name, "cells": cells, "nodes": nodes, "setup_cpu_s": round(setup, 2),
        "solve_cpu_s": round(solve, 2), "trace_cpu_s": round(trace, 2), "cycles": cycles,
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
