"""Conceal silicon physics in tables of a_ij, diagnose them by the command, and score what it says.

``python -m validation.silicon make FOLDER --truths SEALED --count 24 --nulls 12 --seed 1`` draws devices
with the scatter of the file of ``--device`` and writes a folder a case: a table of a_ij for each of two
back biases and two wavelengths.  Truths go to SEALED, and their SHA-256 to FOLDER/commitment.json.
With ``--engine BINARY`` half of the cases whose changes Poisson_CCD has are its own.
``run FOLDER REPORTS`` diagnoses each by ``bfsensor diagnose`` with the device's file as baseline.
``open FOLDER REPORTS SEALED --set NAME`` scores them into ``validation/results/silicon_cases.ecsv``.
``ladder FOLDER --truths SEALED`` makes a case for each of the ten quantities that change the a_ij most,
by 1.5, 3 and 4.5 of its uncertainties, nothing else scattered.  ``run --shared`` starts each case with
the solutions of the nominal device that another one has made, which are the same for all.

Cases: one change of a quantity, a third of them two; a fifth a change that no piece describes; a
seventh signal that moves between pixels after collection, which is no silicon.  Sizes are log-uniform
from 0.5 (``--smallest``) to 15 typical changes.  Engines are those of :mod:`validation.silicon.truths`.
Projected SNR: length of the change in errors after all quantities with an uncertainty have
adapted within their priors, linearly.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter, device_parameters, parameter_value
from bfsensor.device.quantities import quantities
from bfsensor.errors import BFSensorError
from bfsensor.response.edge_response import solve_response
from validation.silicon.sealed_cases import committed_truth, diagnose_case, holds, keep_rows
from validation.silicon.truths import (
    BLUR,
    DOTS,
    ECHO,
    GAIN,
    GATES,
    IMAGE_CHARGE,
    LEVEL,
    MEMORY,
    MOVED,
    POISSON_CCD,
    areas,
    by_image_charges,
    by_poisson_ccd,
    changed,
    noise_matrix,
    read_out,
)

RESULTS = Path(__file__).parents[1] / "results" / "silicon_cases.ecsv"
COMMAND = "python -m validation.silicon open FOLDER REPORTS SEALED"
WAVELENGTHS = (620.0, 950.0)
SMALLEST, LARGEST = 0.5, 15.0
"""Range of the sizes of changes [typical changes].  Chosen: from invisible to far beyond the prior."""
PROGRAM = "poisson_ccd"
"""Name of the engine Poisson_CCD in truths and rows."""
VOLTS = {"operating_point.back_bias": 1.0, "operating_point.gate_high": 0.3}
"""Typical changes of voltages [V], of which device files state no uncertainty."""
SIZES, QUANTITIES, SMALL = (1.5, 3.0, 4.5), 10, 1e-3
"""Of the ladder: sizes and step of derivatives [uncertainties], and number of quantities.  Chosen: the
sizes within and beyond what a prior allows; twice as many quantities are twice as many cases."""
OUTSIDE = {DOTS: -10_000.0, ECHO: 3.5e-5, GAIN: 6e-4}
"""Typical changes that no piece describes: dose of dots [e/um2], share of the signal that arrives late,
relative error of the gain.  Chosen for a projected SNR of 2.5; that of dots is not known."""
READOUT = {BLUR: 7e-5, MEMORY: 2.5e-4}
"""Typical shares of the signal that move between pixels.  Chosen for the same projected SNR."""
CLASSES = {
    BLUR: "interpixel_coupling", MEMORY: "electronic_memory",
    **dict.fromkeys(OUTSIDE, "outside_library"),
}  # fmt: skip
"""Class of report.json of changes that are no quantity of a device."""
SHARES = {BLUR: "ax", MEMORY: "alpha"}
"""Parameters of report.json that hold the shares of a signal that moves."""


def draw_case(
    rng: np.random.Generator,
    device: Device,
    null: bool,
    other: str,
    smallest: float = SMALLEST,
) -> dict[str, Any]:
    """Draw the device's scatter and the concealed changes; sizes in internal units.

    Half of the cases whose changes the engine ``other`` has are its own.  No change is smaller than
    ``smallest`` typical changes.
    """
    known = device_parameters(device)
    scatter = {
        k: float(np.clip(rng.standard_normal(), -2, 2)) * s for k, s in known.items()
    }
    if null:
        return {"scatter": scatter, "change": {}, "engine": "poisson", "outside": False}
    outside, moved = rng.random(2) < (1 / 5, 1 / 6)
    special = dict(OUTSIDE if outside else READOUT if moved else {})
    if device.channel_stop.dots is not None:
        # Of a device with dots other dots are a change of its own quantities.
        special.pop(DOTS, None)
    typical = special or {**known, **VOLTS, GATES: 1.0}
    engine = "poisson"
    if not special and other != "poisson" and rng.random() < 0.5:
        engine = other
        typical = {k: v for k, v in typical.items() if engine_has(engine, k)}
    number = 2 if not special and rng.random() < 1 / 3 else 1
    names = rng.choice(sorted(typical), size=number, replace=False)
    change = {}
    for name in names:
        size = np.exp(rng.uniform(np.log(smallest), np.log(LARGEST)))
        sign = 1.0 if name in CLASSES else rng.choice([-1.0, 1.0])
        change[str(name)] = float(sign * size * typical[name])
        if name == GATES:
            change[GATES] = float(rng.choice([-1.0, 1.0]))
    return {
        "scatter": scatter,
        "change": change,
        "engine": engine,
        "outside": bool(outside),
    }


def engine_has(engine: str, quantity: str) -> bool:
    """Whether an engine has a quantity of which it can solve changes."""
    return quantity in (POISSON_CCD if engine == PROGRAM else IMAGE_CHARGE)


def tables_of(
    device: Device,
    case: Mapping[str, Any],
    biases: tuple[float, ...],
    binary: Path | None = None,
    known: dict[str, NDArray[np.float64]] | None = None,
) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """a_ij of the concealed device without and with the change, by bias and wavelength.

    ``binary`` is Poisson_CCD, for cases of that engine, and ``known`` what it has solved.
    """
    plain, full = [], []
    allowed = quantities(device)
    for name in case["change"].keys() & allowed.keys():
        moved = case["change"][name] + case["scatter"].get(name, 0.0)
        value = parameter_value(device, name) + moved
        if not allowed[name].low <= value <= allowed[name].high:
            raise ValueError(f"{name} = {value:g} is beyond what device files allow")
    own = device.operating_point.back_bias
    for bias in biases:
        here = change_parameter(device, "operating_point.back_bias", bias - own)
        here = changed(here, case["scatter"])
        if case["engine"] == PROGRAM:
            if binary is None:
                raise ValueError(f"cases of the engine {PROGRAM} need its binary")
            solved = {} if known is None else known
            pair = by_poisson_ccd(binary, here, case["change"], WAVELENGTHS, solved)
            plain += pair[0]
            full += pair[1]
            continue
        before = areas(here, WAVELENGTHS)
        after = before
        if case["engine"] == "image charge":
            after = [
                a * by_image_charges(here, case["change"], w)
                for a, w in zip(before, WAVELENGTHS, strict=True)
            ]
        elif case["change"].keys() - {GAIN, *MOVED}:
            after = areas(changed(here, case["change"]), WAVELENGTHS)
        for name in case["change"].keys() & {GAIN, *MOVED}:
            after = [read_out(a, name, case["change"][name]) for a in after]
        plain += before
        full += after
    return plain, full


def write_case(
    folder: Path,
    a: list[NDArray[np.float64]],
    biases: tuple[float, ...],
    rng: np.random.Generator,
) -> None:
    """Write the tables of a case with noise."""
    folder.mkdir(parents=True)
    places = [(b, w) for b in biases for w in WAVELENGTHS]
    for (bias, wavelength), values in zip(places, a, strict=True):
        matrix = noise_matrix(values)
        noisy = values + rng.multivariate_normal(np.zeros(values.size), matrix).reshape(
            values.shape
        )
        errors = np.sqrt(np.diag(matrix)).reshape(values.shape)
        rows = ["i_serial,j_parallel,cov_per_e,err_per_e"]
        for (j, i), value in np.ndenumerate(noisy):
            rows.append(f"{i},{j},{value:.6e},{errors[j, i]:.4e}")
        name = f"a_{abs(bias):.0f}_{wavelength:.0f}.csv"
        (folder / name).write_text("\n".join(rows) + "\n")


def whitened_change(
    plain: list[NDArray[np.float64]],
    full: list[NDArray[np.float64]],
    baseline: Mapping[str, Any],
    biases: tuple[float, ...],
) -> float:
    """Projected SNR of a change, with the derivatives and spreads of a baseline's file."""
    parts, slopes, errors = [], [], []
    for n, (bias, w) in enumerate((b, w) for b in biases for w in WAVELENGTHS):
        parts.append((full[n] - plain[n]).ravel())
        errors.append(np.sqrt(np.diag(noise_matrix(plain[n]))))
        near = min(
            (k for k in baseline if k.startswith("derivatives_")),
            key=lambda k: _off(k.removeprefix("derivatives_"), w, bias),
        )
        own = []
        for name, spread in baseline["spread_1sigma"].items():
            kx, ky = (np.array(baseline[near][name][k]) for k in ("dkx", "dky"))
            whole = kx - np.roll(kx, 1, 1) + ky - np.roll(ky, 1, 0)
            m = len(whole) // 2
            side = plain[n].shape[0]
            own.append(spread * whole[m : m + side, m : m + side].ravel())
        slopes.append(np.array(own).T)
    error = np.concatenate(errors)
    d = np.concatenate(parts) / error
    matrix = np.concatenate(slopes) / error[:, None]
    inner = np.eye(matrix.shape[1]) + matrix.T @ matrix
    return float(
        np.sqrt(max(d @ d - (d @ matrix) @ np.linalg.solve(inner, matrix.T @ d), 0.0))
    )


def _off(key: str, wavelength: float, bias: float) -> float:
    w, b = (float(part) for part in key.replace("m", "-").split("_"))
    return 1e3 * abs(b - bias) + abs(w - wavelength)


@click.group()
def main() -> None:
    """Conceal silicon physics, diagnose it, and score what is said."""


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--truths", type=click.Path(path_type=Path), required=True)
@click.option("--count", default=24, show_default=True)
@click.option("--nulls", default=12, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--device", default="itl_sta3800c", show_default=True)
@click.option(
    "--other", type=click.Choice(["image charge", "poisson"]), default="image charge",
    show_default=True, help="Engine of half of the cases; 'poisson' for none.",
)  # fmt: skip
@click.option(
    "--engine",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Program Poisson_CCD, which then is the engine of half of the cases.",
)
@click.option("--alone", is_flag=True, help="Draw no cases but nulls of another engine.")
@click.option(
    "--smallest", type=click.FloatRange(0, LARGEST, min_open=True), default=SMALLEST,
    show_default=True, help="Smallest size of a change [typical changes].",
)  # fmt: skip
def make(
    folder: Path, truths: Path, count: int, nulls: int, seed: int, device: str, other: str,
    engine: Path | None, alone: bool, smallest: float,
) -> None:  # fmt: skip
    """Make cases that are not there yet."""
    if engine is not None:
        other = PROGRAM
    solved: dict[str, NDArray[np.float64]] = {}
    card = Device.load(device)
    own = float(card.operating_point.back_bias)
    biases = (own, own + 15.0)
    truths.mkdir(parents=True, exist_ok=True)
    for n in range(count + nulls):
        place = folder / f"case_{n:03d}"
        if place.exists():
            continue
        for attempt in range(100):
            rng = np.random.default_rng([seed, n, attempt])
            case = draw_case(rng, card, n >= count, other, smallest)
            if alone and n < count and case["engine"] != other:
                continue
            try:
                plain, full = tables_of(card, case, biases, engine, solved)
            except (BFSensorError, ValueError):
                # Not every draw is a device that is depleted and holds the charge.
                continue
            break
        _write(place, truths, case, plain, full, biases, rng, device, seed)
    _commit(folder, truths)


def _write(
    place: Path,
    truths: Path,
    case: dict[str, Any],
    plain: list[NDArray[np.float64]],
    full: list[NDArray[np.float64]],
    biases: tuple[float, ...],
    rng: np.random.Generator,
    device: str,
    seed: int,
) -> None:
    """Write a case and its truth."""
    write_case(place, full, biases, rng)
    case |= {"device": device, "seed": seed, "biases": biases}
    case |= {"plain": [a.tolist() for a in plain], "full": [a.tolist() for a in full]}
    (truths / f"{place.name}.json").write_text(json.dumps(case))
    click.echo(f"{place.name}")


def _commit(folder: Path, truths: Path) -> None:
    """Write the sums of all truths beside the cases."""
    sums = {
        p.name: hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(truths.glob("*.json"))
    }
    (folder / "commitment.json").write_text(json.dumps(sums, indent=1))


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--truths", type=click.Path(path_type=Path), required=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--device", default="itl_sta3800c", show_default=True)
def ladder(folder: Path, truths: Path, seed: int, device: str) -> None:
    """Make cases of one quantity at a time, by some of its uncertainties."""
    card = Device.load(device)
    own = float(card.operating_point.back_bias)
    biases = (own, own + 15.0)
    truths.mkdir(parents=True, exist_ok=True)
    known = device_parameters(card)
    steps = [
        (change_parameter(card, name, SMALL * s), SMALL * s) for name, s in known.items()
    ]
    found = solve_response(card, level=LEVEL, cells=16, changed=steps)
    sizes = {}
    for (name, spread), dkx, dky in zip(known.items(), found.dkx, found.dky, strict=True):
        x, y = spread * dkx[-1], spread * dky[-1]
        sizes[name] = float(np.linalg.norm(x - np.roll(x, 1, 1) + y - np.roll(y, 1, 0)))
    allowed = quantities(card)
    n = 0
    for name in sorted(sizes, key=lambda q: -sizes[q])[:QUANTITIES]:
        for size in SIZES:
            place = folder / f"case_{n:03d}"
            n += 1
            if place.exists():
                continue
            rng = np.random.default_rng([seed, n])
            for sign in rng.permutation([-1.0, 1.0]):
                change = {name: float(sign * size * known[name])}
                case = {
                    "scatter": {},
                    "change": change,
                    "engine": "poisson",
                    "outside": False,
                }
                value = parameter_value(card, name) + change[name]
                if not allowed[name].low <= value <= allowed[name].high:
                    continue
                try:
                    plain, full = tables_of(card, case, biases)
                except (BFSensorError, ValueError):
                    # No such device, or it is not depleted: the other sign.
                    continue
                _write(place, truths, case, plain, full, biases, rng, device, seed)
                break
    _commit(folder, truths)


@main.command()
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.argument("reports", type=click.Path(path_type=Path))
@click.option("--device", default="itl_sta3800c", show_default=True)
@click.option("--shared", is_flag=True, help="Start with the solutions of another case.")
def run(folder: Path, reports: Path, device: str, shared: bool) -> None:
    """Diagnose all cases that have no report yet."""
    made = None
    for place in sorted(folder.glob("case_*")):
        out = reports / place.name
        if (out / "report.json").exists():
            made = out
            continue
        if shared and made is not None and not out.exists():
            out.mkdir(parents=True)
            for name in (*made.glob("baseline_*.json"), made / "solutions"):
                copy = shutil.copytree if name.is_dir() else shutil.copy
                copy(name, out / name.name)
        made = out
        given, at = [], []
        for table in sorted(place.glob("a_*.csv")):
            _, bias, wavelength = table.stem.split("_")
            given.append(str(table))
            state = f"back_bias=-{bias}V,wavelength={wavelength}nm,level=40000"
            at += ["--at", f"{table.stem}:{state}"]
        diagnose_case([*given, *at], device, out)


@main.command("open")
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
@click.argument("reports", type=click.Path(exists=True, path_type=Path))
@click.argument("truths", type=click.Path(exists=True, path_type=Path))
@click.option("--set", "name", required=True, help="Name of the set in the rows.")
def open_(folder: Path, reports: Path, truths: Path, name: str) -> None:
    """Score all cases that have a report."""
    sums = json.loads((folder / "commitment.json").read_text())
    rows = []
    for place in sorted(folder.glob("case_*")):
        path = truths / f"{place.name}.json"
        truth = committed_truth(path, sums[path.name])
        if (reports / place.name / "report.json").exists():
            rows.append(score(name, place.name, truth, reports))
    keep_rows(rows, RESULTS, COMMAND, name)


def score(name: str, case: str, truth: Mapping[str, Any], reports: Path) -> dict[str, Any]:
    """One row: what was concealed, what was said."""
    folder = reports / case
    report = json.loads((folder / "report.json").read_text())
    cost = json.loads((folder / "cost.json").read_text())
    (baseline,) = folder.glob("baseline_*.json")
    device = Device.load(truth["device"])
    plain, full = ([np.array(a) for a in truth[k]] for k in ("plain", "full"))
    snr = whitened_change(
        plain, full, json.loads(baseline.read_text()), tuple(truth["biases"])
    )
    named = [next(iter(e["parameters"]), e["class"]) for e in report["effects"]]
    values = {k: v for e in report["effects"] for k, v in e["parameters"].items()}
    inside = []
    for quantity in truth["change"]:
        known = values.get(SHARES.get(quantity, quantity))
        if known is not None and "lo95" in known:
            inside.append(holds(known, true_value(device, truth, quantity)))
    classes = {class_of(q) for q in truth["change"]}
    # A signal that moves is no quantity, and is named by its class.
    moved = {CLASSES[q] for q in truth["change"] if q in MOVED}
    first = bool(named) and (
        named[0] in truth["change"] or report["effects"][0]["class"] in moved
    )
    heldout = report["heldout"]
    return {
        "set": name, "case": case, "engine": truth["engine"], "outside": truth["outside"],
        "concealed": " + ".join(truth["change"]) or "nothing",
        "size": " ".join(f"{v:.4g}" for v in truth["change"].values()), "snr": snr,
        "detected": bool(report["detected"]), "p": float(report["p_value"]),
        "named": " + ".join(named) or "nothing", "first": first,
        "in_class": bool(classes & set(report["equivalence_class"])),
        "class_size": len(report["equivalence_class"]), "open_world": bool(report["open_world"]),
        "inside95": sum(inside), "intervals": len(inside), **farthest(truth, report),
        "before": float(heldout.get("chi2dof_before") or np.nan),
        "after": float(heldout.get("chi2dof_after") or np.nan),
        "cpu_s": float(cost["cpu_s"]), "commit": cost["commit"],
    }  # fmt: skip


def farthest(truth: Mapping[str, Any], report: Mapping[str, Any]) -> dict[str, Any]:
    """Place of the first concealed quantity in the report's list of the device, from 1, and its gain.

    ``below``: what the first of the list gains above it.  0, nan: the list does not have it.
    """
    names = [q["name"] for q in report["device"]]
    wanted = next(iter(truth["change"]), "")
    if wanted not in names:
        return {"place": 0, "gain": np.nan, "below": np.nan}
    own = report["device"][names.index(wanted)]["gain"]
    first = report["device"][0]["gain"]
    return {"place": names.index(wanted) + 1, "gain": own, "below": first - own}


def true_value(device: Device, truth: Mapping[str, Any], name: str) -> float:
    """Value of a concealed quantity, in the unit of device files, or share of a signal that moves."""
    if name in SHARES:
        return float(truth["change"][name])
    if name == GATES:
        return float(device.gates.collecting_phases + truth["change"][name])
    own = parameter_value(device, name) + truth["scatter"].get(name, 0.0)
    return quantities(device)[name].number(own + truth["change"][name])


def class_of(name: str) -> str:
    """Class of report.json that a concealed change belongs to."""
    silicon = (
        "hole_quasi_fermi_level",
        "side_diffusion",
        "surface_charge",
        "collecting_phases",
    )
    if name in CLASSES:
        return CLASSES[name]
    return "silicon_physics" if name.endswith(silicon) else "device_parameter"


if __name__ == "__main__":
    main()
