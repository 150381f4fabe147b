"""Conceal silicon physics in raw exposures of a simulated device, and diagnose them by the command.

``python -m validation.silicon.recordings make FOLDER --truths SEALED --count 3 --nulls 2 --seed 1``
draws devices with the scatter of their file, changes a quantity of all but the nulls, and writes
exposures: bias, dark, pairs of flats at eight levels, at three wavelengths and two back biases, and
spots at eight fluxes.  ``--direct`` builds the spots up electron by electron.  ``run FOLDER REPORTS``
diagnoses each with the device's file as baseline, and ``open FOLDER REPORTS SEALED --set NAME`` scores
them into ``validation/results/silicon_recordings.ecsv``.

What a truth shares with the predictor: flats are drawn pixel by pixel in steps with edges that move
(:mod:`validation.concealed.collect`, numpy of its own) by the Poisson solver's shifts on 64 cells at
two levels; readout is that of :mod:`validation.concealed.sensor`, which shares nothing.  Direct spots
share the solver of the field; their electrons drift and diffuse in the field of the charge collected.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter, device_parameters, parameter_value
from bfsensor.device.quantities import quantities
from bfsensor.direct.spot_exposure import Spot, SpotPlan, simulate_spot
from bfsensor.errors import BFSensorError
from bfsensor.response.edge_response import CHARGE, solve_response
from bfsensor.response.light import mixed
from validation.concealed import campaign
from validation.concealed.collect import Response, counts, transform
from validation.concealed.plan import SIZES, Exposure, Geometry, exposures_of
from validation.concealed.readout import Context
from validation.concealed.scene import Image, dithered_spots, spot_scene
from validation.concealed.sensor import VirtualSensor
from validation.silicon.__main__ import VOLTS, class_of, true_value
from validation.silicon.sealed_cases import committed_truth, diagnose_case, holds, keep_rows
from validation.silicon.truths import CELLS, GATES, changed

RESULTS = Path(__file__).parents[1] / "results" / "silicon_recordings.ecsv"
COMMAND = "python -m validation.silicon.recordings open FOLDER REPORTS SEALED"
Shifts = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Shifts of right and upper edges [pixel/e-]."""
SMALLEST, LARGEST = 3.0, 40.0
"""Range of the sizes of changes [typical changes].  Chosen: covariances of this size have errors some
twenty times those of tables of 300 pairs, so that a typical change cannot be seen."""
LOW, HIGH = 10_000.0, 60_000.0
"""Levels between and beyond which the response is taken as linear [e-].  Chosen: those of the flats'
filling; half of the span doubles what the mesh does to the slope."""
SECONDS = (1.0, 5.0, 10.0, 15.0, 20.0, 25.0, 32.0, 40.0)
"""Exposure times of flats [s] of 2000 e-/s, up to which devices of the file hold the charge."""
SPOT_SECONDS = (1.25, 3.75, 6.25, 8.75, 11.25, 13.75, 15.5, 17.5)
"""Exposure times of spots [s]: the brightest pixel reaches 80,000 e-."""
SPOTS, STEPS = 4, 40
"""Direct spots of a case, and steps of each.  Chosen: their growth is known to 1.5 %; twice as many
take twice the time and reach 1 %."""
PEAK, SIGMA = 97_000.0, 10.0
"""Brightest pixel [e-] and width of the light [um] of direct spots.  Chosen: 17 % beyond the brightest
spot of the nominal lamp, whose rate scatters by 2 % (cut at 2.5 times that), as do the spots; with 5 %
one case in five ends beyond the direct simulation."""
DESCRIPTION = """\
# recordings of a simulated device: what the headers cannot say
schema: bfsensor-campaign-1
sensor: {device}
manifest: manifest.ecsv
lamp_monitor: {{keyword: MONDIODE, relative_error: 2.0e-4}}
spots: {{grid_px: 30}}
keywords: {{gate_high: {{value: {high}}}, gate_low: {{value: {low}}}}}
"""


class DeviceSensor(VirtualSensor):
    """Virtual sensor whose edges move as those of a solved device.

    Parameters
    ----------
    geometry : Geometry
        Pixels and amplifiers.
    device : Device
        Device, at each back bias of ``biases``.
    biases : tuple of float
        Back biases [V].
    seed : int
        Seed of the chip, the lamp and all noise.
    spots : sequence of Spot, optional
        Spots by the direct simulation at the first back bias; without, spots are collected as flats.
    """

    def __init__(
        self,
        geometry: Geometry,
        device: Device,
        biases: tuple[float, ...],
        *,
        seed: int,
        spots: tuple[Spot, ...] = (),
    ):
        super().__init__(geometry, seed=seed)
        self.solved = device
        self.biases = biases
        self.spots = spots
        if spots:
            widths = empty_widths(spots, device.pixel.pitch_x)
            self.lamp = dataclasses.replace(self.lamp, spot_widths=widths)

    def _response(self, context: Context) -> Response:
        condition = (context.exposure.wavelength, context.exposure.back_bias)
        if condition not in self._responses:
            low, high = shifts_at(self.solved, *condition)
            self._responses[condition] = linear_response(low, high, self.geometry.pixels)
        return self._responses[condition]

    def _charge(self, context: Context) -> Image:
        if context.exposure.kind != "SPOT" or not self.spots:
            return super()._charge(context)
        exposure, pixels = context.exposure, self.geometry.pixels
        places, fluxes = dithered_spots(pixels, context.stream("spots"))
        fluxes = fluxes * self.lamp.spot_rate * exposure.seconds * self._brightness
        rng = context.stream("phases")
        which = rng.integers(len(self.spots), size=len(places))
        mirrored = rng.random((len(places), 2)) < 0.5
        pitch = self.solved.pixel.pitch_x
        centres = np.array([spot.centre for spot in self.spots])[which] / pitch
        middles = np.rint(places).astype(int)
        places = middles + np.where(mirrored, -centres, centres)
        light = spot_scene(places, fluxes, self.lamp.spot_widths, pixels).light
        for (x, y), flux, n, (flip_x, flip_y) in zip(
            middles, fluxes, which, mirrored, strict=True
        ):
            moved = moved_charge(self.spots[n], flux)
            moved = moved[:: -1 if flip_y else 1, :: -1 if flip_x else 1]
            half = len(moved) // 2
            light[y - half : y + half + 1, x - half : x + half + 1] += moved
        charge = counts(light * self._efficiency, context.stream("shot noise"))
        return charge.astype(np.float32)


def moved_charge(spot: Spot, flux: float) -> NDArray[np.float32]:
    """Charge [e-] that the field of the collected charge has moved when ``flux`` e- have come."""
    came = np.concatenate([[0], spot.off.sum(axis=(1, 2))])
    if flux > came[-1]:
        raise ValueError(f"spot of {flux:.0f} e-: the direct simulation ends at {came[-1]}")
    n = int(np.clip(np.searchsorted(came, flux), 1, len(came) - 1))
    moved = np.concatenate([np.zeros_like(spot.on[:1]), spot.on - spot.off])
    part = (flux - came[n - 1]) / (came[n] - came[n - 1])
    return np.asarray((1 - part) * moved[n - 1] + part * moved[n], np.float32)


def empty_widths(spots: tuple[Spot, ...], pitch: float) -> tuple[float, float]:
    """Widths in x and y [pixel] of spots in the empty sensor, without the pixels'."""
    variances = []
    for spot in spots:
        image = spot.off[-1] / spot.off[-1].sum()
        at = np.arange(len(image)) - len(image) // 2
        row = []
        for axis, centre in zip((0, 1), spot.centre, strict=True):
            along = image.sum(axis=axis)
            row.append(float(along @ (at - centre / pitch) ** 2) - 1 / 12)
        variances.append(row)
    x, y = np.sqrt(np.mean(variances, axis=0))
    return float(x), float(y)


@functools.lru_cache(maxsize=8)
def _solved(device: Device, bias: float) -> tuple[Any, Any, float]:
    """Responses of a device at both levels."""
    device = change_parameter(
        device, "operating_point.back_bias", bias - device.operating_point.back_bias
    )
    low, high = (solve_response(device, level=at, cells=CELLS) for at in (LOW, HIGH))
    return low, high, device.operating_point.temperature


def shifts_at(device: Device, wavelength: float, bias: float) -> tuple[Shifts, Shifts]:
    """Shifts of edges [pixel/e-] at both levels."""
    low, high, kelvin = _solved(device, bias)
    return tuple(mixed(r.kx, r.ky, r.depths, wavelength, kelvin) for r in (low, high))  # type: ignore[return-value]


def linear_response(low: Shifts, high: Shifts, pixels: int) -> Response:
    """Response whose shifts per electron are linear in the charge of the source.

    Shifts by ``k Q + e Q (1 - Q / t)`` have the derivative ``k + e (1 - 2 Q / t)``.
    """
    # Any value gives the same shifts.
    turning = 5.0e4
    kernels = []
    for at_low, at_high in zip(low, high, strict=True):
        slope = (at_high - at_low) / (HIGH - LOW)
        empty = at_low - slope * (LOW + CHARGE / 2)
        extra = -slope * turning / 2
        kernels += [transform(empty - extra, pixels), transform(extra, pixels)]
    kx, extra_kx, ky, extra_ky = kernels
    return Response(kx, ky, extra_kx=extra_kx, extra_ky=extra_ky, turning=turning)


def exposures(size: str, biases: tuple[float, ...], dithers: int) -> list[Exposure]:
    """Exposures of a campaign of this size at the device's voltages; spots at the first alone."""
    plan = dataclasses.replace(
        SIZES[size], flat_seconds=SECONDS, spot_seconds=SPOT_SECONDS, dithers=dithers
    )
    usual = Exposure("BIAS", 0, 0.0, 0.0)
    out = []
    for e in exposures_of(plan):
        own = e.back_bias == usual.back_bias
        plain = own and (e.wavelength, e.temperature) == (
            usual.wavelength,
            usual.temperature,
        )
        if e.withheld or (e.kind == "SPOT" and not plain):
            continue
        out.append(dataclasses.replace(e, back_bias=biases[0] if own else biases[1]))
    return out


def draw(
    rng: np.random.Generator, device: Device, null: bool, smallest: float = SMALLEST
) -> dict[str, Any]:
    """Draw the device's scatter and one concealed change [internal units]."""
    known = device_parameters(device)
    scatter = {
        k: float(np.clip(rng.standard_normal(), -2, 2)) * s for k, s in known.items()
    }
    change: dict[str, float] = {}
    if not null:
        typical = {**known, **VOLTS, GATES: 1.0}
        name = str(rng.choice(sorted(typical)))
        size = np.exp(rng.uniform(np.log(smallest), np.log(LARGEST)))
        change[name] = float(rng.choice([-1.0, 1.0]) * size * typical[name])
        if name == GATES:
            change[name] = float(np.sign(change[name]))
    return {"scatter": scatter, "change": change, "engine": "poisson", "outside": False}


def device_of(device: Device, case: Mapping[str, Any]) -> Device:
    """Concealed device; raises ValueError where a device file does not allow it."""
    allowed = quantities(device)
    for name in case["change"].keys() & allowed.keys():
        value = parameter_value(device, name)
        value += case["change"][name] + case["scatter"].get(name, 0.0)
        if not allowed[name].low <= value <= allowed[name].high:
            raise ValueError(f"{name} = {value:g} is beyond what device files allow")
    return changed(changed(device, case["scatter"]), case["change"])


@click.group()
def main() -> None:
    """Conceal silicon physics in raw exposures, diagnose them, and score what is said."""


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--truths", type=click.Path(path_type=Path), required=True)
@click.option("--count", default=3, show_default=True)
@click.option("--nulls", default=2, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--size", type=click.Choice(["T", "S", "M"]), default="S", show_default=True)
@click.option("--dithers", default=3, show_default=True, help="Exposures of spots a flux.")
@click.option("--device", default="itl_sta3800c", show_default=True)
@click.option("--direct", is_flag=True, help="Build spots up electron by electron.")
@click.option(
    "--smallest", type=click.FloatRange(0, LARGEST, min_open=True), default=SMALLEST,
    show_default=True, help="Smallest size of a change [typical changes].",
)  # fmt: skip
def make(
    folder: Path, truths: Path, count: int, nulls: int, seed: int, size: str, dithers: int,
    device: str, direct: bool, smallest: float,
) -> None:  # fmt: skip
    """Make campaigns that are not there yet."""
    card = Device.load(device)
    own = float(card.operating_point.back_bias)
    biases = (own, own + 15.0)
    for n in range(count + nulls):
        place = folder / f"case_{n:03d}"
        if place.exists():
            continue
        for attempt in range(100):
            rng = np.random.default_rng([seed, n, attempt])
            case = draw(rng, card, n >= count, smallest)
            try:
                concealed = device_of(card, case)
                for bias in biases:
                    shifts_at(concealed, 620.0, bias)
                spots: tuple[Spot, ...] = ()
                if direct:
                    plan = SpotPlan(
                        concealed, peak=PEAK, sigma=SIGMA, steps=STEPS, wavelength=620.0
                    )
                    spots = tuple(simulate_spot(plan, k) for k in range(SPOTS))
            except (BFSensorError, ValueError):
                # Not every draw is a device that is depleted and holds the charge.
                continue
            break
        else:
            raise click.ClickException(f"case {n}: no device in 100 draws")
        case["engine"] = "direct spots" if direct else "poisson"
        case |= {"device": device, "seed": seed, "size": size, "attempt": attempt}
        number = int(np.random.default_rng([seed, n, attempt, 1]).integers(2**31))
        _write(place, truths, case, concealed, biases, number, dithers, spots)


def _write(
    place: Path, truths: Path, case: dict[str, Any], concealed: Device,
    biases: tuple[float, ...], number: int, dithers: int, spots: tuple[Spot, ...],
) -> None:  # fmt: skip
    """Write the exposures beside, rename them, and write the truth."""
    beside = place.with_name(f"{place.name}.part")
    beside.mkdir(parents=True, exist_ok=True)
    geometry = Geometry(SIZES[case["size"]].pixels)
    sensor = DeviceSensor(geometry, concealed, biases, seed=number, spots=spots)
    rows = [
        campaign._write_exposure(beside, place.name, geometry, sensor.take(exposure))
        for exposure in exposures(case["size"], biases, dithers)
    ]
    campaign._write_manifest(beside / "manifest.ecsv", rows)
    point = concealed.operating_point
    (beside / "campaign.yaml").write_text(
        DESCRIPTION.format(device=case["device"], high=point.gate_high, low=point.gate_low)
    )
    os.replace(beside, place)
    truth = {**case, **sensor.truth(), "biases": biases}
    campaign.seal(place, truth, truths)
    click.echo(place.name)


@main.command()
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.argument("reports", type=click.Path(path_type=Path))
@click.option("--device", default="itl_sta3800c", show_default=True)
def run(folder: Path, reports: Path, device: str) -> None:
    """Diagnose all campaigns that have no report yet."""
    for place in sorted(p for p in folder.glob("case_???") if p.is_dir()):
        out = reports / place.name
        if (out / "report.json").exists():
            continue
        diagnose_case([str(place)], device, out)


@main.command("open")
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.argument("reports", type=click.Path(exists=True, path_type=Path))
@click.argument("truths", type=click.Path(exists=True, path_type=Path))
@click.option("--set", "name", required=True, help="Name of the set in the rows.")
def open_(folder: Path, reports: Path, truths: Path, name: str) -> None:
    """Score all campaigns that have a report."""
    known = json.loads((folder / "commitments.json").read_text())
    rows = []
    for place in sorted(p for p in folder.glob("case_???") if p.is_dir()):
        truth = committed_truth(truths / f"{place.name}.json", known[place.name])
        if (reports / place.name / "report.json").exists():
            rows.append(score(name, place.name, truth, reports))
    keep_rows(rows, RESULTS, COMMAND, name)


def score(name: str, case: str, truth: Mapping[str, Any], reports: Path) -> dict[str, Any]:
    """One row: what was concealed, what was said."""
    folder = reports / case
    report = json.loads((folder / "report.json").read_text())
    cost = json.loads((folder / "cost.json").read_text())
    device = Device.load(truth["device"])
    named = [next(iter(e["parameters"]), e["class"]) for e in report["effects"]]
    values = {k: v for e in report["effects"] for k, v in e["parameters"].items()}
    inside = [
        holds(values[q], true_value(device, truth, q))
        for q in truth["change"]
        if "lo95" in values.get(q, {})
    ]
    classes = {class_of(q) for q in truth["change"]}
    heldout = report["heldout"]
    return {
        "set": name, "case": case, "engine": truth["engine"], "exposures": truth["size"],
        "concealed": " + ".join(truth["change"]) or "nothing",
        "size": " ".join(f"{v:.4g}" for v in truth["change"].values()),
        "area": centre_change(device, truth),
        "detected": bool(report["detected"]), "p": float(report["p_value"]),
        "named": " + ".join(named) or "nothing",
        "first": bool(named) and named[0] in truth["change"],
        "in_class": bool(classes & set(report["equivalence_class"])),
        "class_size": len(report["equivalence_class"]), "open_world": bool(report["open_world"]),
        "inside95": sum(inside), "intervals": len(inside),
        "before": float(heldout.get("chi2dof_before") or np.nan),
        "after": float(heldout.get("chi2dof_after") or np.nan),
        "cpu_s": float(cost["cpu_s"]), "commit": cost["commit"],
    }  # fmt: skip


def centre_change(device: Device, truth: Mapping[str, Any]) -> float:
    """Change of a_00 [%] by what was concealed, on 16 cells."""
    centres = []
    for change in ({}, truth["change"]):
        here = device_of(device, {**truth, "change": change})
        found = solve_response(here, cells=16)
        kx, ky = mixed(
            found.kx, found.ky, found.depths, 620.0, here.operating_point.temperature
        )
        n = len(kx) // 2
        centres.append(kx[n, n] - kx[n, n - 1] + ky[n, n] - ky[n - 1, n])
    return float(100 * (centres[1] / centres[0] - 1))


if __name__ == "__main__":
    main()
