"""Shift of pixel boundaries against the distance from a guard ring, beside DECam's template.

``python -m validation.edges.edge_shift RECORDINGS`` solves the edge of two sensors: of
``validation/edges/decam_like.toml`` for several voltages of its guard ring (none fitted: none of
them describes the template), and of ``itl_sta3800c`` with a ring of 50 um beside silicon that
nothing depletes.  RECORDINGS is the folder with ``decam_pixmappy/astroedges1.yaml``.  Files
in ``validation/results``:

``edge_shift.ecsv``: shifts and areas against distance, and on a mesh of half the width;
``edge_depth.ecsv``: the shift by height of conversion, beside the law that the sensor uses;
``edge_template.ecsv``: the template;
``edge_template_fits.ecsv``: what our shifts explain of it, and its lengths beside ours;
``edge_sensor.ecsv``: stars and flats drawn by ``BrighterFatterSensor`` with the map of the ITL
sensor's two edges, beside what went in.
"""

from __future__ import annotations

import argparse
import dataclasses
import re
import time
from pathlib import Path

import galsim
import numpy as np
from astropy.table import Table
from scipy.special import ndtr

from bfsensor import BrighterFatterSensor, Device, ShiftMap
from bfsensor.device.parts import Edge, EdgeStrip
from bfsensor.sensor.drift_field import solve_drift
from bfsensor.simulate.edge_field import front_plane, solve_edge
from bfsensor.simulate.edge_shift import EdgeShift, trace_edge
from validation.common.write_results import write_results

RESULTS = Path("validation/results")
DECAM = Path(__file__).with_name("decam_like.toml")
VOLTAGES = {"decam_like": (0.0, 5.0, 10.0, 14.0, 20.0, 40.0), "itl_sta3800c": (4.0, 20.0)}
NEAREST = 40  # pixels that are written
DETECTED = 20  # pixels: ArgStart of the template, median of 61 sensors
STAR, PHOTONS = 0.8, 80_000  # pixel; photons at each of so many places in a pixel:
OFFSETS = (np.arange(12) + 0.5) / 12 - 0.5
STAR_DISTANCES = {
    4.0: (5.0, 6.0, 7.0, 8.0, 10.0, 15.0),
    20.0: (7.0, 8.0, 9.0, 10.0, 12.0, 15.0),
}
FLAT = (48, 70)
FLAT_PHOTONS = 12_000_000
DEPTHS = {"decam_like": 250.0, "itl_sta3800c": 100.0}


def device_with_ring(name: str, voltage: float) -> Device:
    """A sensor with a guard ring at a voltage, and silicon beyond that nothing holds."""
    if name == "decam_like":
        device = Device.load(DECAM)
        assert device.edge is not None
        ring, beyond = device.edge.strips
        strips: tuple[EdgeStrip, ...] = (dataclasses.replace(ring, voltage=voltage), beyond)
    else:
        device = Device.load(name)
        strips = (EdgeStrip(50.0, voltage, "none"), EdgeStrip(300.0))
    return dataclasses.replace(device, edge=Edge("x", strips), provenance={})


def solve_all(refine: int = 0) -> dict[tuple[str, float], EdgeShift]:
    """Shifts of all sensors and voltages at many heights."""
    out = {}
    for name, voltages in VOLTAGES.items():
        front = front_plane(device_with_ring(name, voltages[0]))
        depths = DEPTHS[name] * np.arange(0.05, 1.001, 0.05)
        for voltage in voltages:
            edge = solve_edge(device_with_ring(name, voltage), front=front, refine=refine)
            out[name, voltage] = trace_edge(edge, depths)
    return out


def read_template(recordings: Path) -> np.ndarray:
    """DECam's one template: pixels from its start, shift [pixel] away from the edge."""
    text = (recordings / "decam_pixmappy" / "astroedges1.yaml").read_text()
    # A list of numbers for each edge: not worth a YAML reader.
    found = re.search(r"N1/low:.*?ArgStep: ([\d.]+).*?Values: \[(.*?)\]", text, re.DOTALL)
    assert found is not None
    values = np.array([float(v) for v in found[2].split(",")])
    # The first and the last node are zeros by construction (pixmappy, class Piecewise).
    return np.column_stack([float(found[1]) * np.arange(len(values)), values])[1:-1]


def explain(template: np.ndarray, shift: EdgeShift, start: float) -> tuple[float, float]:
    """Shares of the template's square that our shift explains.

    As it is; and times a free factor plus a free mean and slope, of what mean and slope
    alone leave.
    """
    x, y = template.T
    model = np.interp(x + start, shift.distances / shift.pitch, shift.pixel_shifts[-1])
    line = np.column_stack([np.ones_like(x), x])

    def left(basis: np.ndarray) -> float:
        return float(np.sum((y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]) ** 2))

    free = 1 - left(np.column_stack([line, model])) / left(line)
    return 1 - float(np.sum((y - model) ** 2) / np.sum(y**2)), free


def halving(x: np.ndarray, y: np.ndarray) -> float:
    """Distance over which a profile falls from its largest value to half of it."""
    top = int(np.argmax(np.abs(y)))
    share = y[top:] / y[top]
    below = int(np.argmax(share < 0.5))
    part = (share[below - 1] - 0.5) / (share[below - 1] - share[below])
    return float(x[top + below - 1] + part * (x[top + below] - x[top + below - 1]) - x[top])


def sensor_with(low: EdgeShift | None, high: EdgeShift | None) -> BrighterFatterSensor:
    """The ITL sensor with edges as a fixed map and nothing else that moves boundaries."""
    edges = ShiftMap.from_edges(
        FLAT,
        x_low=None if low is None else low.pixel_shifts[-1],
        x_high=None if high is None else high.pixel_shifts[-1],
    )
    return BrighterFatterSensor(
        "itl_sta3800c", strength=0.0, shift_map=edges, rng=galsim.BaseDeviate(7001)
    )


def draw(
    sensor: BrighterFatterSensor, x: np.ndarray, y: np.ndarray, seed: int
) -> np.ndarray:
    """Image of photons at given places; a seed gives the same diffusion to all sensors."""
    sensor.updateRNG(galsim.BaseDeviate(seed))
    photons = galsim.PhotonArray(len(x), x, y)
    photons.flux = 1.0
    image = galsim.ImageD(FLAT[1], FLAT[0])
    sensor.accumulate(photons, image)
    return image.array


def draw_stars(
    sensor: BrighterFatterSensor,
    plain: BrighterFatterSensor,
    distance: float,
    *,
    high: bool,
) -> np.ndarray:
    """Displacements of a star away from the edge [pixel] at evenly spread places in a pixel.

    The same photons with and without the map.
    """
    found = []
    columns = np.arange(FLAT[1]) + 1.0
    for batch, offset in enumerate(OFFSETS):
        seed = [8117, batch, int(distance), high]
        rng = np.random.default_rng(seed)
        away = distance + offset + STAR * rng.normal(size=PHOTONS)
        x = FLAT[1] + 0.5 - away if high else away + 0.5
        y = 0.5 * FLAT[0] + STAR * rng.normal(size=PHOTONS)
        diffusion = int(rng.integers(1, 2**31))
        centres = [
            draw(s, x, y, diffusion).sum(0) @ columns / PHOTONS for s in (sensor, plain)
        ]
        found.append((centres[0] - centres[1]) * (-1 if high else 1))
    return np.array(found)


def expect_stars(shift: EdgeShift, distance: float, diffusion: float) -> np.ndarray:
    """Displacements [pixel] of stars of the width they have when their electrons land.

    From their shares between the boundaries, moved and not: what a pixel collects counts at
    the middle of the pixel, which alone displaces a star by 1/12 of the bend of the shifts.
    """
    depth = DEPTHS["itl_sta3800c"] - 1.0
    moved = [np.interp(depth, shift.depths, s) for s in shift.pixel_shifts.T]
    numbers = np.arange(len(moved))

    def centroids(boundaries: np.ndarray) -> np.ndarray:
        offsets = boundaries - (distance + OFFSETS[:, None])
        shares = np.diff(ndtr(offsets / np.hypot(STAR, diffusion)), axis=1)
        return shares @ (numbers[:-1] + 0.5) / shares.sum(axis=1)

    return centroids(numbers + np.array(moved)) - centroids(numbers.astype(float))


def check_sensor(shifts: dict[tuple[str, float], EdgeShift]) -> Table:
    """Stars and a flat through the sensor beside what went in."""
    low, high = shifts["itl_sta3800c", 20.0], shifts["itl_sta3800c", 4.0]
    sensor, plain = sensor_with(low, high), sensor_with(None, None)
    device = Device.load("itl_sta3800c")
    drift = solve_drift(sensor.table.device_text, 173.0, float(sensor.table.depths[1]))
    variance = np.interp(DEPTHS["itl_sta3800c"] - 1.0, drift.heights, drift.variance)
    diffusion = device.diffusion * float(np.sqrt(variance)) / device.pixel.pitch_x
    rows = []
    for voltage, shift in ((20.0, low), (4.0, high)):
        for distance in STAR_DISTANCES[voltage]:
            found = draw_stars(sensor, plain, distance, high=voltage == 4.0)
            expected = expect_stars(shift, distance, diffusion)
            error = np.std(found - expected, ddof=1) / np.sqrt(len(OFFSETS))
            rows.append(("star", voltage, distance, found.mean(), error, expected.mean()))
    rng = np.random.default_rng(4409)
    width = FLAT[1] + 24.0
    x = 0.5 - 12.0 + width * rng.uniform(size=FLAT_PHOTONS)
    y = 0.5 - 4.0 + (FLAT[0] + 8.0) * rng.uniform(size=FLAT_PHOTONS)
    level = FLAT_PHOTONS / width * FLAT[0] / (FLAT[0] + 8.0)
    counts = draw(sensor, x, y, 12).sum(0) / level
    areas = sensor.calculate_pixel_areas(galsim.ImageD(FLAT[1], FLAT[0])).array.mean(0)
    for voltage, shift in ((20.0, low), (4.0, high)):
        step = 1 if voltage == 20.0 else -1
        size = 1 + shift.area_changes[-1]
        for n in range(FLAT[1] // 2):
            at, error = n + 0.5, np.sqrt(size[n] / level)
            rows.append(("flat", voltage, at, counts[::step][n], error, size[n]))
            rows.append(("area", voltage, at, areas[::step][n], 0.0, size[n]))
    return Table(
        rows=rows,
        names=("kind", "voltage_V", "distance_pixel", "found", "error", "expected"),
    )


def main() -> None:
    """Solve, draw, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path)
    options = parser.parse_args()
    command = "python -m validation.edges.edge_shift RECORDINGS"
    begin = time.process_time()
    shifts, finer = solve_all(), solve_all(refine=1)
    rows, heights = [], []
    for (name, voltage), shift in shifts.items():
        fine = finer[name, voltage].pixel_shifts[-1]
        for n in range(NEAREST + 1):
            area = shift.area_changes[-1][n] if n < NEAREST else np.nan
            rows.append((name, voltage, n, shift.pixel_shifts[-1][n], fine[n], area))
        text = device_with_ring(name, voltage)
        plain = dataclasses.replace(text, edge=None).to_toml()
        law = solve_drift(plain, text.operating_point.temperature, 0.0)
        for k, depth in enumerate(shift.depths):
            relative = shift.shifts[k, [1, 3, 8, 16]] / shift.shifts[-1, [1, 3, 8, 16]]
            bulk = float(np.interp(depth, law.heights, law.ripple))
            heights.append((name, voltage, depth, *relative, bulk))
    names = (
        "sensor",
        "voltage_V",
        "pixels",
        "shift_pixel",
        "half_mesh_pixel",
        "area_change",
    )
    write_results(Table(rows=rows, names=names), RESULTS / "edge_shift.ecsv", command)
    names = (
        "sensor",
        "voltage_V",
        "height_um",
        "at_1",
        "at_3",
        "at_8",
        "at_16",
        "bulk_law",
    )
    write_results(
        Table(rows=heights, names=names), str(RESULTS / "edge_depth.ecsv"), command
    )

    template = read_template(options.recordings)
    write_results(
        Table(template, names=("pixels_from_start", "shift_pixel")),
        str(RESULTS / "edge_template.ecsv"), command,
        source="gbernstein/pixmappy @ 2c912e2, data/astroedges1.yaml (BSD), N1/low; the first and "
        "last node, zero by construction, left out; ArgStart 15 to 27, median 20",
    )  # fmt: skip
    rows = []
    for (name, voltage), shift in shifts.items():
        if name != "decam_like":
            continue
        starts = np.arange(0.0, 41.0)
        free = [explain(template, shift, start) for start in starts]
        best = int(np.argmax([f[1] for f in free]))
        x = shift.distances / shift.pitch
        tail = halving(x[DETECTED:], shift.pixel_shifts[-1][DETECTED:])
        rows.append((
            voltage, *free[DETECTED], starts[best], free[best][1], tail, halving(*template[5:].T)
        ))  # fmt: skip
    names = ("voltage_V", "explained_at_20", "explained_at_20_free", "best_start",
             "explained_best_free", "halving_pixel", "template_halving_pixel")  # fmt: skip
    fits = Table(rows=rows, names=names)
    write_results(fits, str(RESULTS / "edge_template_fits.ecsv"), command)
    fits.pprint_all()
    table = check_sensor(shifts)
    write_results(table, str(RESULTS / "edge_sensor.ecsv"), command)
    for kind in ("star", "flat"):
        chosen = table[table["kind"] == kind]
        pull = (chosen["found"] - chosen["expected"]) / chosen["error"]
        print(
            f"{kind}: chi2 {np.sum(pull**2):.1f} of {len(pull)}, worst {np.abs(pull).max():.2f}"
        )
    table[table["kind"] == "star"].pprint_all()
    print(f"{time.process_time() - begin:.0f} CPU s")


if __name__ == "__main__":
    main()
