"""What each piece of silicon physics does to flats and spots, and how large it is, from solved fields.

``python -m validation.silicon.pieces`` writes ``validation/results/silicon_pieces.ecsv``, from which the
page docs/concepts/silicon_pieces.md takes its numbers and figures.  Rows: change of a_ij [%] by lag and
condition, of the growth of spots of 1 pixel [%], and the length of the change over that of all a_ij
[%]; for diffusion the growth of its variance with charge, from the solved field and by electrons that
are traced one by one; for odd and even columns, arriving clouds and a dead layer what the page states.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.device import silicon
from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.diagnose.model.cached_response import walk
from bfsensor.diagnose.model.device_baseline import VOLTAGES
from bfsensor.diagnose.model.device_solver import COARSE, PHASES, DeviceSolver
from bfsensor.diagnose.model.left_out_physics import PIECES
from bfsensor.diagnose.model.spot_predictions import predict_spots
from bfsensor.direct.transport import Tracer, Transport
from bfsensor.effects.charge_diffusion import charge_diffusion, landing
from bfsensor.effects.effect import Layout, Shot
from bfsensor.effects.quantum_yield import REFERENCE, extra_electrons
from bfsensor.effects.simulated_physics import DiffusionWidths
from bfsensor.errors import ConvergenceError, DeviceError
from bfsensor.response.edge_response import area_matrix
from bfsensor.response.light import conversion_weights
from bfsensor.sensor.drift_field import solve_drift
from bfsensor.simulate.edge_field import front_plane
from bfsensor.simulate.pixel_array import PixelArray
from bfsensor.typing import Edges
from bfsensor.units import VACUUM_PERMITTIVITY
from validation.common.write_results import RESULTS, write_results

FILE = RESULTS / "silicon_pieces.ecsv"
COMMAND = "python -m validation.silicon.pieces"
ITL, E2V = "itl_sta3800c", "e2v_ccd250"
USUAL = (620.0, -50.0)
CONDITIONS = (USUAL, (950.0, -50.0), (620.0, -30.0), (950.0, -30.0))
"""Wavelengths [nm] and back biases [V]."""
LAGS = 4
GROWTH = 5.0
"""Growth of the variance that figures show [% per 1e5 e-]."""
FRONT = 6.0
"""Height above which drift is along z [um]: below, the field of the wells takes electrons sideways."""
SPOT = (1.0, 1.0)
FLUXES = np.array([1e5, 8e5])
PERIOD = 8
SIGMA = 10.0
"""Width of the light of spots that the direct simulation builds up [um]."""
Array = NDArray[np.float64]


class Rows:
    """Rows of the results."""

    names = "piece", "what", "device", "at", "i", "j", "value", "error", "unit"

    def __init__(self) -> None:
        self.rows: list[tuple[Any, ...]] = []

    def add(
        self, piece: str, what: str, value: float, unit: str = "%", *, device: str = ITL,
        at: str = "", i: int = 0, j: int = 0, error: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a row, and print it."""
        row = (piece, what, device, at, i, j, float(value), float(error), unit)
        self.rows.append(row)
        print(*row, flush=True)

    def add_areas(
        self, piece: str, at: str, old: Array, new: Array, *, device: str = ITL
    ) -> None:
        """Add the changes of a_ij and their length [%]."""
        reach = len(new) // 2
        old = np.pad(old, reach - len(old) // 2)
        change = new - old
        self.add(piece, "length", 100 * np.sqrt((change**2).sum() / (old**2).sum()), at=at,
                 device=device)  # fmt: skip
        for j in range(LAGS):
            for i in range(LAGS):
                there = reach + j, reach + i
                value = 100 * change[there] / old[there]
                self.add(piece, "a_ij", value, at=at, i=i, j=j, device=device)

    def add_spots(
        self, piece: str, old: Edges, new: Edges, growth: float = 0.0, *, device: str = ITL
    ) -> None:
        """Add the changes of the growth of spots [%]."""
        plain, changed = slopes(old), slopes(new, growth)
        for axis, one, two in zip("xy", plain, changed, strict=True):
            value = 100 * (two / one - 1)
            self.add(piece, f"spot_{axis}", value, at=named(USUAL), device=device)


def named(condition: tuple[float, float]) -> str:
    """Condition in words."""
    return f"{condition[0]:g} nm, {condition[1]:g} V"


def slopes(edges: Edges, growth: float = 0.0, sigma: tuple[float, float] = SPOT) -> Array:
    """Growth of spots in x and y [pixel/e-]."""
    phases = np.array([[-0.4, 0.1], [-0.1, -0.4], [0.1, 0.4], [0.4, -0.1]])
    found = predict_spots(*edges, sigma=sigma, phases=phases, fluxes=FLUXES, growth=growth)
    return np.array([np.diff(found[f"sigma_{a}"])[0] for a in "xy"]) / np.diff(FLUXES)[0]


def device_pieces(
    rows: Rows, name: str, steps: Sequence[tuple[str, str, float]], *, either: bool = False
) -> None:
    """Quantities of a device's file, gates and voltages: (piece, dotted name, step).

    ``either``: the step is made to the other side where there is no such device.
    """
    device = Device.load(name)
    biases = tuple(dict.fromkeys(b for _, b in CONDITIONS))
    waves = tuple(dict.fromkeys(w for w, _ in CONDITIONS))
    solver = DeviceSolver(device.to_toml(), biases, waves, False, True)
    kelvin = device.operating_point.temperature
    plain = {}
    for bias in biases:
        walked = walk(solver.device_with({}, bias), cells=COARSE)
        plain |= {(w, bias): walked.edges(w, kelvin) for w in waves}
    for piece, quantity, step in steps:
        value = solver.nominal(quantity) + step
        try:
            moved = solver.moved(quantity, value)
        except (DeviceError, ConvergenceError):
            if not either:
                raise
            value = solver.nominal(quantity) - step
            moved = solver.moved(quantity, value)
        by, unit = value - solver.nominal(quantity), solver.unit(quantity)
        rows.add(piece, "step", by, unit, at=quantity, device=name)
        for condition, change in moved.edges:
            old = plain[condition]
            new = old[0] + change[0], old[1] + change[1]
            areas = area_matrix(*old), area_matrix(*new)
            rows.add_areas(piece, named(condition), *areas, device=name)
            if condition == USUAL:
                rows.add_spots(piece, old, new, device=name)


def widths(device: Device) -> DiffusionWidths:
    """Variance of diffusion as the device's file has it [pixel^2]."""
    kelvin, held = device.operating_point.temperature, []
    own = device.operating_point.back_bias
    for wave, bias in (*CONDITIONS, (400.0, USUAL[1])):
        here = change_parameter(device, "operating_point.back_bias", bias - own)
        drift = solve_drift(here.to_toml(), kelvin, front_plane(here).height)
        mean = float(conversion_weights(drift.heights, wave, kelvin) @ drift.variance)
        area = device.pixel.pitch_x * device.pixel.pitch_y
        held.append(((wave, bias), device.diffusion**2 * mean / area))
    return DiffusionWidths(tuple(held), kelvin)


def charge_diffusion_in(rows: Rows, device: Device) -> None:
    """Template of charge-dependent diffusion in a_ij and spots."""
    layout = Layout((64, 64), (), reference=(*USUAL, device.operating_point.temperature))
    effect = charge_diffusion(widths(device))({"growth": GROWTH})
    kelvin = device.operating_point.temperature
    rows.add("charge_diffusion", "step", GROWTH, "% per 1e5 e-")
    for condition in CONDITIONS:
        here = change_parameter(
            device, "operating_point.back_bias", condition[1] - USUAL[1]
        )
        old = walk(here, cells=COARSE).edges(condition[0], kelvin)
        shot = Shot("flat", 0, 1.0, *condition, kelvin)
        new = effect.edges(*old, shot, layout)
        rows.add_areas(
            "charge_diffusion", named(condition), area_matrix(*old), area_matrix(*new)
        )
        if condition == USUAL:
            growth = effect.diffusion_growth(shot, layout)
            rows.add_spots("charge_diffusion", old, new, growth)


def variance_of(potential: Any, kt: float) -> Array:
    """Variance of diffusion along z above each node by Einstein's relation [um^2]."""
    z = potential.mesh.z
    middle, step = 0.5 * (z[1:] + z[:-1]), np.diff(z)
    field = -np.diff(potential.phi, axis=0) / step[:, None, None]
    above = middle >= FRONT
    return np.asarray(2 * kt * (step[above, None, None] / field[above]).sum(0))


def expected_growth(rows: Rows, name: str, bias: float, charge: float = 5e4) -> None:
    """Growth of the variance with charge in one pixel, and in all, from the solved field."""
    device = Device.load(name)
    own = device.operating_point.back_bias
    device = change_parameter(device, "operating_point.back_bias", bias - own)
    kt = device.material.thermal_voltage(device.operating_point.temperature)
    array = PixelArray(device, period=PERIOD, cells=COARSE)
    empty, full = array.solve(0.0, 0.0), array.solve(charge, 0.0)
    before, after = variance_of(empty, kt), variance_of(full, kt)
    change = 100 * (after - before) / before.mean() * 1e5 / charge
    half = COARSE // 2
    by_lag = np.array([[_pixel(change, i, j, half) for i in range(PERIOD // 2)]
                       for j in range(PERIOD // 2)])  # fmt: skip
    # Spots hold the charge exp(-d^2 / 4 sigma^2) of their own pixel at the distance d, on average.
    lags = np.arange(1 - PERIOD // 2, PERIOD // 2)
    near = np.exp(-((lags * device.pixel.pitch_x) ** 2) / (4 * SIGMA**2))
    there = by_lag[abs(lags)[:, None], abs(lags)]
    at = f"{bias:g} V"
    parts = (
        ("expected, centre of the charged pixel", change[0, 0]),
        ("expected, charged pixel", by_lag[0, 0]),
        ("expected, neighbour in x", by_lag[0, 1]),
        ("expected, spots of 10 um", near @ there @ near),
    )
    for what, value in parts:
        rows.add("charge_diffusion", what, value, "% per 1e5 e-", device=name, at=at)
    even = array.unit_solver.solve(charge, start=array.unit(0.0).phi)
    one = array.unit_solver.solve(0.0)
    flat = (
        100
        * (variance_of(even, kt).mean() / variance_of(one, kt).mean() - 1)
        * 1e5
        / charge
    )
    rows.add(
        "charge_diffusion", "expected, all pixels", flat, "% per 1e5 e-", device=name, at=at
    )
    rows.add(
        "charge_diffusion", "width", device.diffusion * np.sqrt(before.mean()), "um",
        device=name, at=at,
    )  # fmt: skip


def _pixel(change: Array, i: int, j: int, half: int) -> float:
    """Mean over a pixel of a field on a mesh whose first node is the centre of the charged one."""

    def share(n: int) -> tuple[slice, Array]:
        nodes = slice(max(0, (2 * n - 1) * half), (2 * n + 1) * half + 1)
        weights = np.ones(nodes.stop - nodes.start)
        weights[[0, -1]] = 0.5
        return nodes, weights / weights.sum()

    (rows, down), (columns, across) = share(j), share(i)
    return float(down @ change[rows, columns] @ across)


def traced_growth(rows: Rows, electrons: int) -> None:
    """The same by electrons traced one by one in the changed field, beside fixed diffusion."""
    device = Device.load(ITL)
    array = PixelArray(device, period=PERIOD, cells=COARSE)
    rng = np.random.default_rng(2213)
    half, height = 16.0, device.silicon.thickness - 5.0
    starts = np.full((electrons, 3), height)
    # Around the right edge of the charged pixel, along x; all rows are alike for the flat.
    starts[:, 0] = 5 + half * (
        2 * (np.arange(electrons) + rng.random(electrons)) / electrons - 1
    )
    starts[:, 1] = rng.uniform(-5, 5, electrons)
    around = np.full((electrons, 3), height)
    around[:, :2] = rng.uniform(-half, half, (electrons, 2))
    empty = Tracer(array.solve(0.0, 0.0))
    flat = Tracer(array.solve(1e5, 1e5))
    before, after = (
        (t.trace(starts, seed=2214).pixels[:, 0] >= 1).astype(float) for t in (empty, flat)
    )
    u = starts[:, 0] - 5

    def moment(right: Array) -> Array:
        """Terms of the variance of a step that is washed out."""
        return -4 * half * u * (right - (u > 0))

    variance = moment(before).mean()
    change = moment(after) - moment(before)
    rows.add(
        "charge_diffusion", "traced, all pixels", 100 * change.mean() / variance, "% per 1e5 e-",
        error=100 * change.std() / np.sqrt(electrons) / variance, at="-50 V",
    )  # fmt: skip
    first = around.copy()
    first[:, :2] += np.sqrt(variance) * rng.standard_normal((electrons, 2))
    still = Transport(diffusion=0.0)
    for charge in (2e4, 8e4):
        full = Tracer(array.solve(charge, 0.0))
        lost = []
        for places, transport in ((around, Transport()), (first, still)):
            inside = [
                (t.trace(places, seed=2215, transport=transport).pixels == 0)
                .all(1)
                .astype(float)
                for t in (full, empty)
            ]
            lost.append(inside[1] - inside[0])
        ratio = lost[1].sum() / lost[0].sum()
        error = ratio * np.sqrt(sum((p**2).sum() / p.sum() ** 2 for p in lost))
        rows.add(
            "charge_diffusion", "area lost, diffused first over in the field", ratio, "",
            error=error, at=f"{charge:g} e-",
        )  # fmt: skip


def puzzle(rows: Rows, device: Device) -> None:
    """Growth of spots by the expected diffusion, and the one that direct over sensor would take."""
    kelvin = device.operating_point.temperature
    old = walk(device, cells=COARSE, backgrounds=(0.0, 25e3, 50e3)).edges(None, kelvin)
    layout = Layout((64, 64), (), reference=(*USUAL, kelvin))
    effect = charge_diffusion(widths(device))({"growth": 1.0})
    shot = Shot("spot", 0, 1.0, *USUAL, kelvin)
    # Width of spots of 10 um with diffusion, in pixels of 10 um.
    sigma = (float(np.hypot(SIGMA, 4.24) / 10),) * 2
    new = effect.edges(*old, shot, layout)
    grown = slopes(new, effect.diffusion_growth(shot, layout), sigma) / slopes(
        old, 0.0, sigma
    )
    each = 100 * (grown.mean() - 1)
    rows.add("charge_diffusion", "growth of spots of 10 um by 1 %", each)
    measured = Table.read(RESULTS / "sensor_vs_direct.ecsv", format="ascii.ecsv")
    growth = Table.read(RESULTS / "boundary_growth.ecsv", format="ascii.ecsv")
    for level in (20e3, 80e3, 150e3):
        here = growth[growth["level"] == level]
        table, direct = (here[here["source"] == s][0] for s in ("table", "8 cells"))
        found = []
        for r in measured[(measured["device"] == ITL) & (measured["level"] == level)]:
            # What the mesh of the direct simulation does to growth is taken out.
            over = table[r["axis"]] / direct[r["axis"]] / r["ratio"]
            found.append((over - 1, over * r["ratio_error"] / r["ratio"]))
        value, error = np.array(found).T
        weight = error**-2 / (error**-2).sum()
        gap, known = 100 * (weight @ value), 100 / np.sqrt((error**-2).sum())
        rows.add("charge_diffusion", "direct over sensor, less 1", gap, error=known,
                 at=f"{level:g} e-")  # fmt: skip
        rows.add("charge_diffusion", "growth that would explain it", gap / each, "% per 1e5 e-",
                 error=known / each, at=f"{level:g} e-")  # fmt: skip


def yields(rows: Rows, device: Device) -> None:
    """Published yields, and what they do to flats."""
    variance = dict(widths(device).held)[400.0, USUAL[1]]
    shared = landing(2 * variance, 16)
    for wave in np.arange(340.0, 465.0, 5.0):
        p = float(extra_electrons(wave))
        f = 2 * p / (1 + p)
        at = f"{wave:g} nm"
        rows.add("quantum_yield", "extra", 100 * p, at=at)
        rows.add("quantum_yield", "all lags", 100 * f, at=at)
        rows.add("quantum_yield", "variance", 100 * f * shared[0] ** 2, at=at)
        if wave in (REFERENCE, 400.0):
            for j in range(LAGS):
                for i in range(LAGS):
                    value = 100 * f * shared[i] * shared[j]
                    rows.add("quantum_yield", "covariance", value, at=at, i=i, j=j)


def columns(rows: Rows, device: Device, side: int = 16, level: float = 1e5) -> None:
    """Channel stops of alternating dose: edges between columns move alternately more and less."""
    kelvin = device.operating_point.temperature
    kx, ky = (k[1:-1, 1:-1] for k in walk(device, cells=COARSE).edges(USUAL[0], kelvin))

    def response(part: float) -> Array:
        reach = len(kx) // 2
        out = np.zeros((side, side, side, side))
        factor = 1 + part * (-1.0) ** np.arange(side)
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                right, upper = kx[reach + dy, reach + dx], ky[reach + dy, reach + dx]
                for y in range(side):
                    for x in range(side):
                        there = (y + dy) % side, (x + dx) % side
                        shift = right * factor[there[1]]
                        out[(*there, y, x)] += shift + upper
                        out[there[0], (there[1] + 1) % side, y, x] -= shift
                        out[(there[0] + 1) % side, there[1], y, x] -= upper
        return out.reshape(side**2, side**2)

    def covariances(a: Array, steps: int = 400) -> Array:
        c, one, dm = np.zeros_like(a), np.eye(side**2), level / steps
        for _ in range(steps):
            # The trapezoidal rule, by one correction.
            slope = one + a @ c + c @ a.T
            ahead = c + dm * slope
            c = c + 0.5 * dm * (slope + one + a @ ahead + ahead @ a.T)
        return c.reshape((side,) * 4)

    def lag(c: Array, i: int, j: int, first: int, step: int = 2) -> float:
        return float(np.mean([c[y, x, (y + j) % side, (x + i) % side]
                              for y in range(side) for x in range(first, side, step)]))  # fmt: skip

    plain, part = covariances(response(0.0)), 0.1
    for one in (part, 2 * part):
        changed = covariances(response(one))
        worst = max(
            abs(lag(changed, i, j, 0, 1) - lag(plain, i, j, 0, 1))
            / abs(lag(plain, 1, 0, 0, 1)) for i in range(4) for j in range(4)
        )  # fmt: skip
        at = f"edges {100 * one:g} % more and less"
        rows.add("columns", "largest change of a covariance over C_10", 100 * worst, at=at)
        apart = lag(changed, 1, 0, 0) - lag(changed, 1, 0, 1)
        mean = lag(plain, 1, 0, 0, 1)
        rows.add(
            "columns", "C_10 of even columns less that of odd", 100 * apart / mean, at=at
        )
    # Columns whose widths differ: their charge evens out.
    a = response(0.0)
    light = 1 + 1e-3 * np.tile((-1.0) ** np.arange(side), side)
    charge, dm = np.zeros(side**2), level / 400
    for _ in range(400):
        charge = charge + dm * (light + a @ charge)
    seen = np.tile((-1.0) ** np.arange(side), side) @ charge / charge.sum() / 1e-3
    rows.add("columns", "pattern of widths at 1e5 e- over that at 0", 100 * seen)


def arriving(rows: Rows, device: Device) -> None:
    """Electrons that drift at the same time above a pixel, and how far one pushes another."""
    drift = solve_drift(
        device.to_toml(), device.operating_point.temperature, front_plane(device).height
    )
    above = drift.heights >= FRONT
    field = drift.field[above]
    speed = silicon.mobility(field, device.operating_point.temperature) * field
    seconds = float((drift.heights[1] / speed).sum())
    rows.add("clouds", "drift time", 1e9 * seconds, "ns")
    for rate in (1e5, 1e9):
        rows.add("clouds", "electrons in flight", rate * seconds, "", at=f"{rate:g} e-/s")
    # An electron one pixel away all the way down.
    push = 1 / (4 * np.pi * 11.7 * VACUUM_PERMITTIVITY * device.pixel.pitch_x**2)
    rows.add("clouds", "push", 1e3 * float((push / field).sum() * drift.heights[1]), "nm")


def dead_layer(rows: Rows, device: Device, layer: float = 0.1) -> None:
    """A dead layer at the back: light that is lost, and a_ij of what converts below it."""
    kelvin = device.operating_point.temperature
    walked = walk(device, cells=COARSE)
    length = float(silicon.absorption_length(400.0, kelvin))
    rows.add("dead_layer", "light lost", 100 * (1 - np.exp(-layer / length)), at="400 nm")
    one, two = (area_matrix(walked.kx[0, n], walked.ky[0, n]) for n in (-2, -1))
    change = (one - two) / (walked.depths[-1] - walked.depths[-2]) * layer
    n = len(two) // 2
    for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)):
        value = 100 * change[n + j, n + i] / two[n + j, n + i]
        rows.add("dead_layer", "a_ij", value, at="400 nm", i=i, j=j)


def parts(rows: Rows, electrons: int) -> Iterator[None]:
    """All parts in turn."""
    device = Device.load(ITL)
    yield arriving(rows, device)
    yield dead_layer(rows, device)
    yield columns(rows, device)
    yield yields(rows, device)
    for name, bias in ((ITL, -50.0), (ITL, -60.0), (E2V, -50.0)):
        yield expected_growth(rows, name, bias)
    yield charge_diffusion_in(rows, device)
    yield puzzle(rows, device)
    yield traced_growth(rows, electrons)
    quantities = [(p.variant, p.quantity, p.step) for p in PIECES]
    yield device_pieces(rows, ITL, quantities, either=True)
    voltages = [(name.partition(".")[2], name, by) for name, by in VOLTAGES.items()]
    yield device_pieces(rows, ITL, voltages)
    # With one gate ITL's silicon is not depleted at -50 V.
    gates = [("fewer_gates", PHASES, -1.0), ("more_gates", PHASES, 1.0)]
    yield device_pieces(rows, E2V, gates)


def main() -> None:
    """Calculate all rows and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--electrons", type=int, default=1_000_000)
    parser.add_argument("-o", "--output", type=Path, default=FILE)
    options = parser.parse_args()
    rows = Rows()
    for _ in parts(rows, options.electrons):
        pass
    write_results(Table(rows=rows.rows, names=Rows.names), options.output, COMMAND)


if __name__ == "__main__":
    main()
