"""Recordings of real sensors, explained: four figures and what is said of each.

``python -m validation.real.real_recordings SHARED`` (about a minute) runs, where the recordings are,

(a) flats of an SBIG camera: one run diagnosed, the other predicted (:mod:`validation.real.real_sbig`);
(b) tree rings at eight wavelengths and two back biases (:mod:`validation.real.real_rings`);
(c) spots on four segments of an ITL sensor (:mod:`validation.real.real_spots`);
(d) a_ij of ITL and E2V against tables (:mod:`validation.real.real_areas`);

prints each figure's file and its sentences, and writes ``validation/results/real_recordings.ecsv``:
a row for each number, with its error and what it is of, enough for
``validation/real/real_recordings.ipynb`` to draw the figures again without the recordings.  Where
mismatches lie, and false alarms: :mod:`validation.real.real_location`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.device.device import Device
from bfsensor.diagnose.model.table_baseline import BACK_BIAS, with_operating_point
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.recording.tables.area_changes import read_area_changes
from validation.common.write_results import write_results
from validation.real import real_areas, real_figures, real_rings, real_sbig, real_spots

RESULTS = Path(__file__).parents[1] / "results" / "real_recordings.ecsv"
COMMAND = "python -m validation.real.real_recordings SHARED"

Rows = list[dict[str, Any]]


def row(part: str, what: str, value: float, error: float = np.nan, **more: Any) -> dict:
    """One number: of which recording, what, and where (``at``, ``of``), with a remark in words."""
    blank = {"at": np.nan, "of": "", "said": ""}
    return {"part": part, "what": what, "value": value, "error": error, **blank, **more}


def explain_sbig(shared: Path) -> Rows:
    """(a): each run diagnosed by itself, the other held against it."""
    folder = shared / "recordings" / "sbig_flats"
    blocks = {run: real_sbig.measure_blocks(folder / run) for run in real_sbig.RUNS}
    out: Rows = []
    for fitted, other in (real_sbig.RUNS, real_sbig.RUNS[::-1]):
        found, carried, without = real_sbig.carry_with_range(blocks, fitted, other)
        more = {"of": f"{fitted} to {other}"}
        out += named("sbig", fitted, found)
        for which in ("before", "after"):
            out.append(row("sbig", f"chi2 {which}", carried.chi2(which), **more))
        out.append(row("sbig", "values", len(carried.levels), **more))
        out.append(row("sbig", "removed", carried.removed, **more))
        out += [row("sbig", "removed without a flat", v, **more) for v in without]
        for level, value, error, after in zip(
            carried.levels, carried.correlations, carried.errors, carried.after, strict=True
        ):
            out.append(row("sbig", "measured", value, error, at=level, **more))
            out.append(row("sbig", "predicted", after, at=level, **more))
    return out


def named(part: str, of: str, found: Diagnosis) -> Rows:
    """What a diagnosis says, and the effects that it names with their ties."""
    out = [row(part, "p", found.mismatch.p_value, of=of, said=found.said())]
    (square, dof), *_ = found.mismatch.chi2.values()
    out.append(row(part, "chi2", square, of=of, at=dof))
    told = found.attribution
    if told is None:
        return out
    (after, left), *_ = told.mismatch.chi2.values()
    out.append(row(part, "chi2 explained", after, of=of, at=left))
    for one in told.found:
        for name, value in one.effect.values.items():
            tied = ", ".join(one.tied[1:]) or "nothing"
            out.append(
                row(part, f"{one.effect.name} {name}", value, one.errors.get(name, np.nan),
                    of=of, said=f"tied to {tied}")
            )  # fmt: skip
    for word, probability in told.probability.items():
        if probability > 0.01:
            out.append(row(part, f"probability {word}", probability, of=of))
    return out


def explain_rings(shared: Path) -> Rows:
    """(b): amplitudes by wavelength and bias, and the depth and field that they ask for."""
    folder = shared / "recordings" / "bnl_treerings"
    names = [f"itl-098-{w}nm" for w in real_rings.WAVELENGTHS]
    found = real_rings.measure_amplitudes(
        real_rings.read_profiles(folder, names), real_rings.REFERENCE
    )
    device = Device.load("itl_sta3800c")
    fits = real_rings.fit_depths(found, device)
    out = [row("rings", "wave number", found.wave_number)]
    for n, w in enumerate(real_rings.WAVELENGTHS):
        out.append(row("rings", "amplitude", found.values[n], found.errors[n], at=w))
        out.append(row("rings", "predicted", fits["card"].predicted[n], at=w))
        if n != real_rings.REFERENCE:
            left = real_rings.fit_depths(found, device, without=n)["card"].predicted[n]
            out.append(
                row("rings", "left out, error %", 100 * (left / found.values[n] - 1),
                    100 * found.errors[n] / found.values[n], at=w)
            )  # fmt: skip
    for name, fit in fits.items():
        out.append(row("rings", "factor", fit.factor, fit.error, of=name))
        out += [row("rings", f"chi2 {k}", v, of=name) for k, v in fit.chi2.items()]
    low, high, best = real_rings.temperatures(found, device)
    out.append(row("rings", "temperature", best, 0.5 * (high - low), at=low))
    pair = real_rings.measure_amplitudes(
        real_rings.read_profiles(folder, ("e2v-260-0V", "e2v-260-70V")), 0
    )
    out.append(row("rings", "bias ratio", pair.values[1], pair.errors[1]))
    for doping in (0.0, 0.8, 1.6, 2.4):
        volts, error = real_rings.volts_of_gates(
            pair.values[1], pair.errors[1], doping, pair.wave_number
        )
        out.append(row("rings", "volts of the gates", volts, error, at=doping))
    return out


def explain_spots(shared: Path) -> Rows:
    """(c): which segment differs, and whether its gain explains that."""
    path = shared / "recordings" / "ucd_bf_kernel" / "spot_size_vs_flux_ITL029.csv"
    read = real_spots.read_spots(path)
    out: Rows = []
    for name, shared_off in (("all scatter", False), ("shared scatter taken off", True)):
        growth = real_spots.fit_growth(*read, shared=shared_off)
        told = real_spots.single_out(growth, shared=shared_off)
        for n, segment in enumerate(growth.segments):
            for k, axis in enumerate("xy"):
                out.append(
                    row("spots", f"slope {axis}", 100 * growth.slopes[n, k],
                        100 * growth.errors[n, k], of=f"{segment}, {name}")
                )  # fmt: skip
            out.append(
                row("spots", "stands out", told.decrease[n], of=f"{segment}, {name}")
            )
        for what in ("chi2_same", "chi2_gain", "p_gain", "p_single", "p_others"):
            out.append(row("spots", what, getattr(told, what), of=name))
        left = float(told.chi2_but.min())
        out.append(row("spots", "chi2 of the others", left, of=name))
    return out


def explain_areas(shared: Path) -> Rows:
    """(d): a_ij against tables, with the operating point as a candidate, and transposed."""
    out: Rows = []
    for kind, pair in real_areas.PAIRS.items():
        table = read_area_changes(shared / "reference" / f"{kind}_covariances_21oct19.csv")
        for name in (*real_areas.GALSIM[kind], *pair):
            found = real_areas.explain(table, real_areas.find(name))
            out += named("areas", f"{kind}: {name}", found)
        free = with_operating_point(*pair)
        out += named(
            "areas", f"{kind}: operating point free", real_areas.explain(table, free)
        )
        turned = real_areas.explain(real_areas.exchanged(table), real_areas.find(pair[1]))
        out += named("areas", f"{kind}: {pair[1]}, axes exchanged", turned)
        card = real_areas.explain(table, real_areas.find(pair[0]))
        out += lags("residual", kind, card.fit.residuals, card)
        free_found = real_areas.explain(table, free)
        out += lags(
            "residual explained", kind, free_found.accepted[1].residuals, free_found
        )
    table = read_area_changes(shared / "reference" / "e2v_covariances_21oct19.csv")
    keep = Path(gettempdir()) / "bfsensor_floating"
    whole = real_areas.with_device(*real_areas.PAIRS["e2v"], keep=keep)
    found = real_areas.explain(table, whole)
    out += named("areas", "e2v: device free", found)
    for name, pull in found.fit.pulls.items():
        out.append(row("areas", "pull", pull, of=f"e2v: device free, {name}"))
    for name in whole.units:
        value, error, square, p = real_areas.free_one(table, real_areas.only(whole, name))
        off = (value - whole.nominal[name]) / whole.spread[name]
        out.append(row("areas", "one parameter", value, error, at=square, of=name,
                       said=f"{off:+.1f} spreads from the card, p of what is left {p:.2g}"))  # fmt: skip
    return out


def lags(what: str, of: str, left: NDArray[np.float64], found: Diagnosis) -> Rows:
    """Residuals over errors by lag: 10 j + i."""
    (channel,) = found.fit.channels
    return [
        row("areas", what, float(z), at=10 * int(j) + int(i), of=of)
        for i, j, z in zip(channel.axes["i"], channel.axes["j"], left, strict=False)
    ]


PARTS: dict[str, Callable[[Path], Rows]] = {
    "sbig": explain_sbig, "rings": explain_rings, "spots": explain_spots, "areas": explain_areas,
}  # fmt: skip


def main() -> None:
    """Run all four, write rows and figures, print what they say."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("shared", type=Path)
    parser.add_argument(
        "--figures", type=Path, default=Path(gettempdir()) / "real_recordings"
    )
    given = parser.parse_args()
    table = Table([r for make in PARTS.values() for r in make(given.shared)])
    for name in ("value", "error", "at"):
        table[name].info.format = ".6g"
    write_results(table, RESULTS, COMMAND)
    given.figures.mkdir(parents=True, exist_ok=True)
    for name in PARTS:
        figure = real_figures.draw(name, table)
        figure.savefig(given.figures / f"{name}.png", dpi=110)
        print(f"\n{given.figures / name}.png", *real_figures.say(name, table), sep="\n  ")
    print(f"{table.meta['cpu_s']} CPU s; {BACK_BIAS} is the operating point's parameter")


if __name__ == "__main__":
    main()
