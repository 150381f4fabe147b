"""Jobs of ``bench_sensor.py``: photons, images and sensors, and one measurement of each."""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

OURS = ("silicon", "brighter_fatter")
ALL = ("galsim", *OURS)
CENTRE = (-2048.0, -2048.0)
"""Centre of the tree rings [pixel], outside all images as on most sensors of a camera."""
POOLS = 20
"""Calls of the pooled sequence, each with 1e6 photons."""


@dataclass(frozen=True)
class Job:
    """One row of the table: who runs it, and what is asked of whom.

    ``asked`` holds at least and aim of each sensor; they bound ``bounded``: the ratio of CPU
    seconds to ``galsim.SiliconSensor`` ("ratio"), our CPU seconds ("cpu_s"), bytes a pixel beside the
    image ("bytes") or the gain in time by two threads ("speed-up").
    """

    asked: dict[str, tuple[float, float]]
    sensors: tuple[str, ...] = ALL
    bounded: str = "ratio"


def _faster(least: tuple[float, float], aim: tuple[float, float]) -> Job:
    """Job to be so many times as fast as GalSim, by our sensor."""
    pairs = zip(OURS, least, aim, strict=True)
    return Job({name: (1 / low, 1 / high) for name, low, high in pairs})


def _below(
    bounded: str, least: tuple[float, float], aim: tuple[float, float], sensors=OURS
):
    """Job whose CPU seconds, bytes or gain by threads are asked for."""
    return Job(dict(zip(OURS, zip(least, aim, strict=True), strict=True)), sensors, bounded)


JOBS = {
    "star 1e6": _faster((6, 5), (9, 8)),
    "star 1e7": _faster((5.5, 5), (9, 8)),
    "star 1e6, rings": _faster((4, 3.5), (6, 5)),
    "star 1e7, rings": _faster((4, 3.5), (6, 5)),
    "star 1e6, rings of 20 cosines": _faster((4, 3.5), (6, 5)),
    "star 1e6, wavelengths and angles": _faster((5, 4), (6, 6)),
    "star 1e6, rings, wavelengths and angles": _faster((3.5, 3), (5, 4)),
    "200 stamps of 1e3 photons": _faster((4, 3.5), (6, 6)),
    "spread over 8192": _below("cpu_s", (0.3, 0.6), (0.1, 0.1)),
    "areas 2048": _faster((75, 40), (100, 100)),
    "areas 2048, rings": _faster((40, 25), (100, 100)),
    "areas 2048, rings of 20 cosines": _faster((40, 25), (100, 100)),
    "flat 512, 1e6 photons": _faster((250, 150), (300, 300)),
    "first accumulate 4096": _faster((450, 400), (450, 400)),
    "first accumulate 4096, filled": _below("bytes", (8, 8), (8, 8)),
    "field 1000": Job(
        {"silicon": (1, 1 / 1.6), "brighter_fatter": (1, 1 / 1.4)}, (*ALL, "plain")
    ),
    "pools 4096": _faster((5, 5), (8, 8)),
    "two threads, star 1e7": _below("speed-up", (1.7, 1.7), (1.9, 1.9)),
    "two threads, pooled 1e7": _below("speed-up", (1.7, 1.7), (1.9, 1.9)),
    "cold first star": _below("cpu_s", (12, 12), (5, 5), ALL),
}
"""All jobs by the name of their rows."""

PARTS = {
    "pools 4096": ("pools 4096, slowest later pool", (1 / 2, 1 / 2)),
    "field 1000": ("field 1000, sensor's share", (0.4, 0.4)),
}
"""Rows that follow from a job: their names and the ratio asked for."""


def make_rings(case: str) -> Any:
    """Radial shifts [pixel] of a job; ``None`` without rings.

    Those of 20 cosines have the periods, the size and the growth with radius of LSST's sensors, on
    2,700 points in 8,000 pixels, of which some periods have only six.
    """
    import galsim

    if "cosines" in case:
        rng = np.random.default_rng(1123)
        period = rng.uniform(18, 80, 20)
        phase = rng.uniform(0, 2 * np.pi, 20)
        radius = np.linspace(0, 8000.0, 2700)
        waves = np.sin(2 * np.pi * radius[:, None] / period + phase) * period / (2 * np.pi)
        shifts = 0.01 * (0.002 + 4e-17 * radius**4) * waves.sum(axis=1)
        return galsim.LookupTable(radius, shifts)
    if "rings" in case or case.startswith(("pools", "field")):
        return galsim.SiliconSensor.simple_treerings(0.26, 47.0, r_max=8000.0)
    return None


def make_sensor(which: str, case: str = "", threads: int = 1) -> Any:
    """Make the sensor of a job."""
    import galsim

    # Where light is pooled, boundaries are renewed by hand alone, as imSim does it.
    options: dict[str, Any] = {
        "rng": galsim.UniformDeviate(31415),
        "nrecalc": 0 if "pool" in case else 10_000,
    }
    rings = make_rings(case)
    if rings is not None:
        options |= {"treering_func": rings, "treering_center": galsim.PositionD(*CENTRE)}
    if which == "plain":
        return galsim.Sensor()
    if which == "galsim":
        return galsim.SiliconSensor(**options)
    import bfsensor

    kind = bfsensor.SiliconSensor if which == "silicon" else bfsensor.BrighterFatterSensor
    sensor = kind(**options)
    sensor.threads = threads
    return sensor


def make_photons(case: str, x: np.ndarray, y: np.ndarray, rng: Any) -> Any:
    """Photons at positions, with wavelengths and angles where the job has them."""
    import galsim

    extra = {}
    if "angles" in case:
        extra = {
            "dxdz": rng.normal(0, 0.1, len(x)),
            "dydz": rng.normal(0, 0.1, len(x)),
            "wavelength": rng.uniform(550, 690, len(x)),
        }
    return galsim.PhotonArray(len(x), x, y, np.ones(len(x)), **extra)


def make_calls(case: str) -> tuple[list[tuple[Any, Any, dict[str, Any]]], Any]:
    """List the calls of ``accumulate`` as (photons, image, options); and the image to look at."""
    import galsim

    rng = np.random.default_rng(2718)
    if "stamps" in case:
        calls = []
        for _ in range(200):
            image = galsim.ImageF(32, 32)
            image.setCenter(0, 0)
            calls.append((make_photons(case, *rng.normal(0, 1, (2, 1000)), rng), image, {}))
        return calls, calls[0][1]
    if case.startswith("pools"):
        image = galsim.ImageF(4096, 4096)
        places = rng.uniform(20, 4076, (400, 2))
        share = rng.pareto(1.0, 400) + 1
        calls = []
        for n in range(POOLS):
            star = rng.choice(400, 1_000_000, p=share / share.sum())
            x, y = (places[star] + rng.normal(0, 1.6, (1_000_000, 2))).T.copy()
            more = {"resume": n > 0, "recalc": n > 0}
            calls.append((make_photons(case, x, y, rng), image, more))
        return calls, image
    sides = {"spread": 8192, "flat": 512, "first": 4096, "cold": 33}
    side = next((n for words, n in sides.items() if case.startswith(words)), 64)
    image = galsim.ImageF(side, side)
    if case.startswith(("spread", "flat")):
        x, y = rng.uniform(0.5, side + 0.5, (2, 1_000_000))
    elif case.startswith("first"):
        x, y = np.full((2, 1), 9.0)
        if "filled" in case:
            for (
                row
            ) in image.array:  # one by one: the largest memory so far is compared with
                row[...] = rng.poisson(1000, side)
    else:
        count = 10_000_000 if "1e7" in case else 100_000 if "cold" in case else 1_000_000
        image.setCenter(0, 0)
        x, y = rng.normal(0, 1, (2, count))
    return [(make_photons(case, x, y, rng), image, {})], image


def warm(sensor: Any) -> None:
    """Compile and load everything once on small images."""
    import galsim

    rng = np.random.default_rng(99)
    x, y = rng.normal(9, 1, (2, 1000))
    for case in ("", "angles"):
        image = galsim.ImageF(17, 17)
        sensor.accumulate(make_photons(case, x, y, rng), image)
        sensor.accumulate(make_photons(case, x, y, rng), image, resume=True, recalc=True)
    # Small and large images are summed in different precision.
    for side in (17, 600):
        sensor.calculate_pixel_areas(galsim.ImageF(side, side))


def measure(case: str, which: str, threads: int) -> dict[str, Any]:
    """Measure one job once: CPU and clock [s], bytes a pixel, CPU of each call."""
    if case.startswith("field"):
        return _whole_field(case, which)
    sensor = make_sensor(which, case, threads)
    if case.startswith("cold"):
        (call,), _ = make_calls(case)
        sensor.accumulate(call[0], call[1])
        return {"cpu": time.process_time(), "wall": 0.0, "bytes": 0.0}
    warm(sensor)
    if case.startswith("areas"):
        import galsim

        charge = np.random.default_rng(2718).poisson(5e4, (2048, 2048))
        image = galsim.ImageF(charge.astype(np.float32))
        calls = [(None, image, {})]
    else:
        calls, image = make_calls(case)
    image.array[...] += 0  # its pages are there
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    parts = []
    began = time.perf_counter()
    for photons, where, options in calls:
        cpu = time.process_time()
        if photons is None:
            sensor.calculate_pixel_areas(where)
        else:
            sensor.accumulate(photons, where, **options)
        parts.append(time.process_time() - cpu)
    wall = time.perf_counter() - began
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    return {
        "cpu": sum(parts), "wall": wall, "bytes": grown / image.array.size,
        "parts": parts if case.startswith("pools") else [],
    }  # fmt: skip


def _whole_field(case: str, which: str) -> dict[str, Any]:
    """Run the configuration, and count all CPU seconds of this process from its start."""
    import galsim

    began = time.perf_counter()
    config = galsim.config.ReadConfig(str(Path(__file__).with_name("sensor_field.yaml")))[0]
    kinds = {"plain": "Simple", "brighter_fatter": "BrighterFatter"}
    sensor: dict[str, Any] = {"type": kinds.get(which, "Silicon")}
    if which in OURS:
        config["modules"] = ["bfsensor" if which == OURS[1] else "bfsensor.as_silicon"]
        galsim.config.ImportModules(config)
    if which != "plain":
        sensor["treering_func"] = make_rings(case)
        sensor["treering_center"] = {"type": "XY", "x": CENTRE[0], "y": CENTRE[1]}
    config["image"]["sensor"] = sensor
    galsim.config.BuildImage(config)
    return {
        "cpu": time.process_time(),
        "wall": time.perf_counter() - began,
        "bytes": 0.0,
    }
