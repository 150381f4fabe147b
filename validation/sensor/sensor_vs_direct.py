"""The sensor against the direct simulation: the same light, each engine on minus off.

``python -m validation.sensor.sensor_vs_direct FOLDER [--device itl_sta3800c] [--peak 150000]
[--steps 40]`` reads the spots that ``bfsensor spots DEVICE --peak ... --steps ... -o FOLDER`` built
up, sends photons from the same places through :class:`bfsensor.BrighterFatterSensor` with its
table, once as it is and once with all shifts off (the same diffusion), and compares growth and
moved electrons at 20,000, 80,000 and 150,000 e- in the peak.  One row a level and axis is appended
to ``validation/results/sensor_vs_direct.ecsv``, the moved electrons go beside it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import galsim
import numpy as np
from astropy.table import Table

from bfsensor import BrighterFatterSensor, Device
from bfsensor.direct.spot_exposure import Spot, SpotPlan, spot_electrons
from bfsensor.measure.growth import measure_growth
from validation.common.write_results import write_results

LEVELS = (20e3, 80e3, 150e3)
CENTRAL = 5


def draw(
    plan: SpotPlan, spot: Spot, electrons: int, name: str, strength: float
) -> np.ndarray:
    """Image of the first electrons of a spot through the sensor."""
    _, starts = spot_electrons(plan, spot.number, np.arange(electrons))
    pitch = np.array([plan.device.pixel.pitch_x, plan.device.pixel.pitch_y])
    x, y = (starts[:, :2] / pitch).T
    # GalSim's pixels have their centres at whole numbers, as the spot's array.
    image = galsim.ImageF(plan.pixels, plan.pixels)
    image.setCenter(0, 0)
    sensor = BrighterFatterSensor(
        name, rng=galsim.BaseDeviate(4000 + spot.number), strength=strength,
        conversion_depth=plan.device.silicon.thickness - plan.conversion_height,
        diffusion=plan.transport.width_in(plan.device),
    )  # fmt: skip
    sensor.accumulate(galsim.PhotonArray(electrons, x, y, np.ones(electrons)), image)
    return image.array.astype(float)


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--device", default="itl_sta3800c")
    parser.add_argument("--peak", type=float, default=150_000.0)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument(
        "-o", "--output", default="validation/results/sensor_vs_direct.ecsv"
    )
    options = parser.parse_args()
    plan = SpotPlan(Device.load(options.device), peak=options.peak, steps=options.steps)
    spots = [Spot.read(p) for p in sorted(options.folder.glob(f"spot_{plan.key}_*.fits"))]
    if len(spots) < 2:
        raise SystemExit(
            f"{options.folder}: {len(spots)} spots of this plan; two are needed"
        )
    edges = plan.step_ends
    path = Path(options.output)
    rows = (
        [tuple(r) for r in Table.read(path, format="ascii.ecsv")] if path.exists() else []
    )
    for level in LEVELS:
        if level > plan.peak * 1.01:
            continue
        step = round(level / plan.peak * plan.steps) - 1
        count = int(edges[step + 1])
        direct_on, direct_off = (
            np.array([getattr(s, name)[step] for s in spots], float)[:, None]
            for name in ("on", "off")
        )
        sensor_on, sensor_off = (
            np.array([draw(plan, s, count, options.device, strength) for s in spots])[
                :, None
            ]
            for strength in (1.0, 0.0)
        )
        direct, sensor = (
            measure_growth(a, b)
            for a, b in ((direct_on, direct_off), (sensor_on, sensor_off))
        )
        # The same light: what differs between the engines is their diffusion's noise.
        gap = ((direct_on - direct_off) - (sensor_on - sensor_off))[:, 0]
        half, c = CENTRAL // 2, plan.pixels // 2
        gap = gap[:, c - half : c + half + 1, c - half : c + half + 1].reshape(
            len(spots), -1
        )
        # Spot by spot all pixels share errors; the sum of squares of the means is held
        # against what signs at random give.
        observed = float((gap.mean(0) ** 2).sum())
        rng = np.random.default_rng(3)
        chance = np.mean([
            ((gap * rng.choice([-1.0, 1.0], (len(spots), 1))).mean(0) ** 2).sum() >= observed
            for _ in range(2000)
        ])  # fmt: skip
        moved = np.abs((direct_on - direct_off).mean(0)).sum() / 2
        differ = float(np.abs(gap.mean(0)).sum() / 2)
        print(f"{options.device}, level {level:.0f} e-, {len(spots)} spots: moved {moved:.0f} e-, the "
              f"engines differ by {differ:.0f} (p = {chance:.3f})")  # fmt: skip
        for n, axis in enumerate("xy"):
            ratio = sensor.slope[n] / direct.slope[n]
            error = ratio * np.hypot(
                direct.slope_error[n] / direct.slope[n],
                sensor.slope_error[n] / sensor.slope[n],
            )
            rows.append((options.device, level, axis, len(spots), direct.slope[n],
                         direct.slope_error[n], sensor.slope[n], sensor.slope_error[n], ratio,
                         error, moved, differ, float(chance)))  # fmt: skip
            print(f"  {axis}: direct {direct.slope[n]:.4f} +- {direct.slope_error[n]:.4f}  sensor "
                  f"{sensor.slope[n]:.4f} +- {sensor.slope_error[n]:.4f} % per 50,000 e-  ratio "
                  f"{ratio:.3f} +- {error:.3f}", flush=True)  # fmt: skip
    names = ("device", "level", "axis", "spots", "direct", "direct_error", "sensor",
             "sensor_error", "ratio", "ratio_error", "moved", "differ", "p")  # fmt: skip
    write_results(
        Table(rows=rows, names=names),
        path,
        "python -m validation.sensor.sensor_vs_direct FOLDER",
        added=True,
    )


if __name__ == "__main__":
    main()
