"""Large steps against scattering: width of the cloud, shares of the wells, and their cost.

``python -m validation.transport.transport widths|shares [--electrons N]``

widths
    Spread of electrons set free at the back of the ITL device without charge, plane by plane on
    their way down, by both engines and by Einstein's relation in the same field.
shares
    Electrons set free 1 um from a corner of a pixel next to one with 100,000 e- (the study
    in which large steps and scattering differed): the parts that reach the pixel itself, its
    neighbours, for steps of several lengths, for scattering with the free time of the place
    and of the start.  One row a variant.

Rows go to ``validation/results/transport_*.ecsv``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from astropy.table import Table

from bfsensor import Device
from bfsensor.direct.transport import PUBLISHED_DIFFUSION, Tracer, Transport
from bfsensor.simulate.mesh import make_mesh
from bfsensor.simulate.poisson import Electrostatics, Potential
from bfsensor.simulate.unit_cell import solve_unit_cell, tile
from validation.common.write_results import write_results

START = (4.0, 1.0, 95.0)
CHARGE = 1e5
VARIANTS = {
    "steps 0.5, 10 um": Transport(diffusion=1.0, part=0.5, longest=10.0),
    "steps 0.25, 5 um": Transport(diffusion=1.0),
    "steps 0.12, 3 um": Transport(diffusion=1.0, part=0.12, longest=3.0),
    "steps 0.06, 1.5 um": Transport(diffusion=1.0, part=0.06, longest=1.5, shortest=0.05),
    "scattering": Transport(diffusion=1.0, engine="scattering"),
    "scattering, time of the start": Transport(
        diffusion=1.0, engine="scattering", free_time="start"
    ),
    "published width, steps 0.25": Transport(diffusion=PUBLISHED_DIFFUSION),
    "published width, steps 0.06": Transport(
        diffusion=PUBLISHED_DIFFUSION, part=0.06, longest=1.5, shortest=0.05
    ),
    "published width, scattering": Transport(
        diffusion=PUBLISHED_DIFFUSION, engine="scattering"
    ),
    "published width, scattering, time of the start": Transport(
        diffusion=PUBLISHED_DIFFUSION, engine="scattering", free_time="start"
    ),
}
PLANES = (90.0, 80.0, 60.0, 40.0, 20.0, 10.0, 5.0)


def one_full_pixel() -> Potential:
    """Solve the ITL device with one charged pixel."""
    device = Device.load("itl_sta3800c")
    mesh = make_mesh(device, pixels=(8, 8), cells=16)
    solver = Electrostatics(device, mesh)
    charges = np.zeros(solver.pixel_shape)
    charges[0, 0] = CHARGE
    return solver.solve(charges, start=tile(solve_unit_cell(device, 0.0), mesh))


def keep(path: Path, rows: list[tuple], names: tuple[str, ...], command: str) -> None:
    """Append rows to what is there."""
    old = [tuple(r) for r in Table.read(path, format="ascii.ecsv")] if path.exists() else []
    write_results(Table(rows=[*old, *rows], names=names), path, command, added=True)


def find_shares(electrons: int, output: Path) -> None:
    """Parts of the electrons by the pixel they reach."""
    names = ("variant", "electrons", "own", "right", "top", "error_own", "cpu_us")
    done = (
        set(Table.read(output, format="ascii.ecsv")["variant"])
        if output.exists()
        else set()
    )
    tracer = Tracer(one_full_pixel())
    for variant, transport in VARIANTS.items():
        if variant in done:
            continue
        count = electrons if transport.engine == "steps" else electrons // 2
        tracer.trace([START], seed=1, transport=transport)  # compiled
        begin = time.process_time()
        pixels = [
            tracer.trace(
                np.tile(START, (n, 1)), seed=5417, transport=transport,
                numbers=np.arange(first, first + n),
            ).pixels
            for first in range(0, count, 50_000)
            for n in [min(50_000, count - first)]
        ]  # fmt: skip
        cpu = (time.process_time() - begin) / count * 1e6
        reached = np.concatenate(pixels)
        own, right, top = (
            float(np.mean((reached == place).all(1))) for place in ((0, 0), (1, 0), (0, 1))
        )
        row = (
            variant,
            count,
            own,
            right,
            top,
            np.sqrt(own * (1 - own) / count),
            round(cpu, 2),
        )
        keep(
            output,
            [row],
            names,
            f"python -m validation.transport.transport shares --electrons {electrons}",
        )
        print(f"{variant:48s} own {own:.5f} +- {row[5]:.5f}  right {right:.5f}  top {top:.5f}  "
              f"{cpu:.1f} us", flush=True)  # fmt: skip


def find_widths(electrons: int, output: Path) -> None:
    """Spread at planes of constant height, and what Einstein's relation gives there."""
    names = ("engine", "height_um", "sigma_x", "sigma_y", "error", "einstein", "electrons")
    device = Device.load("itl_sta3800c")
    potential = solve_unit_cell(device, 0.0)
    z = potential.mesh.z
    # In the bulk the field is along z: its mean over the pixel, kT / E summed on the way.
    field = np.diff(potential.phi.mean(axis=(1, 2))) / np.diff(z)
    middle = 0.5 * (z[1:] + z[:-1])
    kt = device.material.thermal_voltage(device.operating_point.temperature)
    tracer = Tracer(potential)
    for engine in ("steps", "scattering"):
        count = electrons if engine == "steps" else electrons // 10
        # Short steps: between the points of a path its own diffusion is not seen, and steps of
        # 1 um would lack 1.5 % of the width at 90 um.
        transport = Transport(diffusion=1.0, engine=engine, part=0.06, longest=0.25)  # type: ignore[arg-type]
        places: dict[float, list] = {plane: [] for plane in PLANES}
        for first in range(0, count, 1000):
            numbers = np.arange(first, min(first + 1000, count))
            starts = np.tile((0.0, 0.0, 95.0), (len(numbers), 1))
            traced = tracer.trace(
                starts, seed=66, numbers=numbers, transport=transport, keep_paths=True
            )
            for path in traced.paths:
                for plane in PLANES:
                    n = int(np.argmax(path[:, 2] < plane))
                    a, b = path[n - 1], path[n]
                    part = (a[2] - plane) / (a[2] - b[2])
                    places[plane].append(a[:2] + (b[:2] - a[:2]) * part)
        rows = []
        for plane in PLANES:
            sigma = np.std(places[plane], axis=0)
            fine = np.linspace(plane, 95.0, 4001)
            variance = np.trapezoid(2 * kt / -np.interp(fine, middle, field), fine)
            rows.append((engine, plane, *sigma, sigma[0] / np.sqrt(2 * count),
                         np.sqrt(variance), count))  # fmt: skip
            print(f"{engine:11s} z {plane:5.1f}  sigma {sigma[0]:.4f} {sigma[1]:.4f} +- "
                  f"{rows[-1][4]:.4f}  Einstein {np.sqrt(variance):.4f} um", flush=True)  # fmt: skip
        keep(
            output,
            rows,
            names,
            f"python -m validation.transport.transport widths --electrons {electrons}",
        )


def main() -> None:
    """Run one of the two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["widths", "shares"])
    parser.add_argument("--electrons", type=int)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    output = options.output or Path(f"validation/results/transport_{options.what}.ecsv")
    if options.what == "widths":
        find_widths(options.electrons or 12_000, output)
    else:
        find_shares(options.electrons or 400_000, output)


if __name__ == "__main__":
    main()
