"""Show: physics that a device's simulation leaves out, concealed and found again.

``python -m validation.explanation.concealed_physics [--keep FOLDER] [--again] [--only LABEL ...]``

The truth is a chip: the ITL device with doping, channel dose and back bias scattered about its card
(1.5 %, 1 %, 0.1 V), from tables at 32 cells a pixel with all physics.  The baseline is the card's
device, at 32 cells too, which lacks one piece in turn, its three quantities floating within those
spreads; templates are differences of tables at 32 cells too.  Recordings: covariances of flats to lags
of 4 at three levels, 500 pairs of 2048 x 4096 pixels in all at each condition (Bartlett's errors),
maps of a section of 256 x 256 pixels of their mean, and a ladder of 8 spots, sizes to 3e-4 pixel.  Four
conditions are fitted: 620 nm at -50 V, 950 nm, -40 V, and 10 K more; the fifth, with all three
changed, is held out.  Truth and fit share the closed forms from shifts to channels and
the mesh, not the chip.

Rows go to ``validation/results/concealed_physics.ecsv``, one after another: what is there is
not taken again.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import gettempdir
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor import Device
from bfsensor.device.condition import Condition
from bfsensor.device.parameters import change_parameter, parameter_value
from bfsensor.device.parts import Provenance
from bfsensor.device.quantities import quantities
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import NUMBERS, Axes, numbers_of
from bfsensor.diagnose.data.map_channels import MapChannels
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.detect.candidates import name_of
from bfsensor.diagnose.detect.locate import locate_mismatch
from bfsensor.diagnose.explain.stepwise import attribute
from bfsensor.diagnose.fit.baseline_fit import fit_baseline
from bfsensor.diagnose.fit.fitted_model import Model, compare_held_out
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.device_baseline import baseline_of_device
from bfsensor.diagnose.model.left_out_physics import (
    PIECES,
    physics_left_out,
)
from bfsensor.diagnose.model.map_predictions import shot_at
from bfsensor.diagnose.model.predictor import Predictor, used_channels
from bfsensor.effects.effect import Effect, Segment, Shot
from bfsensor.files import Cache
from bfsensor.measure.bartlett import bartlett_matrix
from bfsensor.response.edge_response import area_matrix
from validation.common.run_header import commit_here
from validation.common.write_results import write_results

RESULTS = "validation/results/concealed_physics.ecsv"
FIGURE = "validation/figures/concealed_physics.png"
COMMAND = "python -m validation.explanation.concealed_physics"
DEVICE = "itl_sta3800c"
REFERENCE = Condition(wavelength=620.0, back_bias=-50.0, temperature=173.0)
FITTED = (
    REFERENCE, dataclasses.replace(REFERENCE, wavelength=950.0),
    dataclasses.replace(REFERENCE, back_bias=-40.0),
    dataclasses.replace(REFERENCE, temperature=183.0),
)  # fmt: skip
HELD = Condition(wavelength=950.0, back_bias=-40.0, temperature=183.0)
LEVELS = 15_000.0, 40_000.0, 80_000.0
PAIRS, PIXELS = 500, 2048 * 4096
LAGS = 4
SELECT = 0.25
"""Part of the pairs that selects."""
NOISE = 5.0
SIDE = 256
RESPONSE = 0.005
"""Scatter of the pixels' response in maps."""
FLUXES = np.geomspace(4e4, 6e5, 8)
SIZE_ERROR, FLUX_ERROR = 3e-4, 1e-3
WIDTH = 1.0
SPREADS = {
    "silicon.background_doping": 0.036, "channel.implant[0].dose": 96.0,
    "operating_point.back_bias": 0.1,
}  # fmt: skip
"""Of what is known of the chip, in units of the card: 1.5 %, 1 %, 0.1 V."""


class Case(NamedTuple):
    """One row: what the baseline lacks or is wrong in, and what the truth has more."""

    label: str
    truth: str = ""
    value: float = np.nan
    lacks: tuple[str, ...] = ()
    card: Mapping[str, float] = MappingProxyType({})
    off: Mapping[str, float] = MappingProxyType({})
    extra: Mapping[str, float] = MappingProxyType({})
    chip: int = 1
    ladders: bool = False


RINGS = {
    "strength": 0.4,
    "period": 30.0,
    "xc": -220.0,
    "yc": 90.0,
    "chirp": 0.0,
    "phase": 0.2,
}

CASES = (
    Case("control 1"),
    *(
        Case(label, f"silicon_physics:{piece.variant}", np.nan, card={piece.quantity: -piece.step})
        for label, piece in zip(("free holes", "side diffusion"), PIECES, strict=False)
    ),
    Case("levels", "bf_nonlinear:simulated", 1.0, lacks=("levels",)),
    Case("depths", "bf_chromatic:simulated", 1.0, lacks=("depths",)),
    Case("diffusion", "lateral_diffusion:simulated", 1.0, extra={"strength": 1.0}),
    Case("diffusion, ladders everywhere", "lateral_diffusion:simulated", 1.0,
         extra={"strength": 1.0}, ladders=True),
    Case("rings", "tree_rings:simulated", RINGS["strength"], extra=RINGS),
    Case("edge", "edge_rolloff:simulated", 0.02, extra={"strength": 0.02}),
    Case("dose", "device_parameter:channel.implant[0].dose", 0.0,
         off={"channel.implant[0].dose": 8.0}),
    Case("voltage", "device_parameter:operating_point.back_bias", 0.0,
         off={"operating_point.back_bias": -10.0}),
    Case("control 2", chip=2),
    Case("control 3", chip=3),
)  # fmt: skip
"""``off`` in spreads; ``value`` of parameters of the card is the chip's own."""


def card(changes: Mapping[str, float]) -> Device:
    """The device of the card with what is known of it, quantities changed by so much."""
    device = Device.load(DEVICE)
    device = dataclasses.replace(
        device, provenance={k: Provenance(uncertainty=v) for k, v in SPREADS.items()}
    )
    for name, by in changes.items():
        device = change_parameter(device, name, by)
    return device


def chip(case: Case) -> tuple[Device, dict[str, float]]:
    """A chip: the card with its quantities scattered, and off where the case says so."""
    rng = np.random.default_rng([6031, case.chip])
    by = {k: float(np.clip(rng.standard_normal(), -2, 2)) * v for k, v in SPREADS.items()}
    for name, spreads in case.off.items():
        by[name] = spreads * SPREADS[name]
    return card(by), by


def empty_channels(truth: Baseline, ladders: bool) -> list[Channel]:
    """Covariances and spots, values still 0, with the errors that such recordings have."""
    out = []
    parts = [(c, f) for c in FITTED for f in ("fit", "select")] + [(HELD, "held-out")]
    j, i = (index.ravel() for index in np.indices((LAGS + 1, LAGS + 1)))
    for condition, fold in parts:
        share = {"fit": 1 - SELECT, "select": SELECT}.get(fold, 1.0)
        axes, blocks = Axes(), []
        for n, level in enumerate(LEVELS):
            axes.add(len(i), condition, i=i, j=j, amp=0, level=level, time=float(n + 1))
            one = Channel("flat_cov", np.zeros(len(i)), (np.eye(len(i)),),
                          {**dict.fromkeys(("amp", "time"), np.zeros(len(i))), "i": i, "j": j,
                           "level": np.full(len(i), level),
                           **{k: np.full(len(i), v)
                              for k, v in zip(NUMBERS, numbers_of(condition), strict=True)}},
                          "adu2")  # fmt: skip
            c = _plain(truth).predict(one, _plain(truth).start).reshape(LAGS + 1, LAGS + 1)
            counts = np.full(c.shape, share * PAIRS / len(LEVELS) * PIXELS)
            blocks.append(bartlett_matrix(c, counts))
        size = len(LEVELS) * len(i)
        out.append(
            Channel("flat_cov", np.zeros(size), tuple(blocks), axes.columns(), "adu2", fold)
        )
    # Of light and temperature that no fitted ladder has the width is not known.
    for condition in FITTED if ladders else (REFERENCE,):
        for fold, chosen in (
            ("fit", (0, 1, 3, 5, 7)),
            ("select", (2, 6)),
            ("held-out", (4,)),
        ):
            axes, errors = Axes(), []
            for n in chosen:
                for what in ("sigma_x", "sigma_y", "flux"):
                    axes.add(1, condition, what=what, light=FLUXES[n], flux=FLUXES[n],
                             time=1.0, background=0.0, exposure=n, hours=0.0)  # fmt: skip
                    errors.append(FLUX_ERROR * FLUXES[n] if what == "flux" else SIZE_ERROR)
            out.append(
                Channel("spot", np.zeros(len(errors)), tuple(np.square(errors)[:, None, None]),
                        axes.columns(), "", fold)
            )  # fmt: skip
    return out


_PLAIN = Cache()


def _plain(truth: Baseline) -> Predictor:
    """Predictor of covariances alone."""

    def make() -> Predictor:
        axes = Axes()
        axes.add(1, REFERENCE, i=0, j=0, amp=0, level=1e4, time=1.0)
        one = Channel("flat_cov", np.zeros(1), (np.eye(1),), axes.columns(), "adu2")
        return Predictor(_measured([one], (), {}), truth)

    return _PLAIN.get(truth, make)


def _measured(
    channels: Sequence[Channel], sightings: Sequence[Any], maps: dict[Any, Any]
) -> MeasuredChannels:
    """A campaign of one amplifier, gain 1."""
    shots = tuple(
        Shot("flat", n, 1.0, *numbers_of(c), 0.0, LEVELS[1])
        for n, c in enumerate((*FITTED, HELD))
    )
    rng = np.random.default_rng(77)
    spots = sum(
        int((c.axes["what"] == "sigma_x").sum()) for c in channels if c.word == "spot"
    )
    return MeasuredChannels(
        channels=tuple(channels), amplifiers=("all",), gains=(1.0,), read_noise=(NOISE,),
        phases=tuple(rng.uniform(-0.5, 0.5, (64, 2)) for _ in range(spots)), columns=(SIDE,),
        flips=((False, False),), origins=((0, 0),), shape=(SIDE, SIDE),
        segments=(Segment(0, 0, SIDE, SIDE),), shots=shots, maps=maps,
        sightings=tuple(sightings), counts={"flat": 2 * PAIRS * len(shots)},
    )  # fmt: skip


def take_maps(
    truth: Baseline, effects: Sequence[Effect], rng: np.random.Generator
) -> tuple[list[Channel], tuple[Any, ...], dict[Any, Any]]:
    """Maps of the mean of all flats of a condition, in pixels, as they are measured."""
    layout = Predictor(_measured([], (), {}), truth).layout
    longest = dict.fromkeys((*FITTED, HELD), 1.0)
    amplifiers = [(slice(0, SIDE), slice(0, SIDE))]
    own = RESPONSE * rng.standard_normal((SIDE, SIDE))
    y, x = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    light = 0.01 * x - 0.02 * y**2
    channels: list[Channel] = []
    maps: dict[Any, Any] = {}
    sightings: tuple[Any, ...] = ()
    for fold, conditions in (("fit", FITTED), ("held-out", (HELD,))):
        made = MapChannels((SIDE, SIDE), longest, fold, amplifiers)
        for condition in conditions:
            image = (1 + own + _evened(truth, effects, condition, layout)) * (1 + light)
            image = image / image.mean() - 1
            sigma = 1 / np.sqrt(LEVELS[1] * PAIRS)
            pair = [
                (image + sigma * rng.standard_normal(image.shape)).astype(np.float32)
                for _ in range(2)
            ]
            made.add_pair(condition, 1.0, pair[0], pair[1], 0.0, LEVELS[1])
        found = made.channels()
        channels += found
        maps |= {(fold, name): shares for name, shares in made.shares().items()}
        sightings = sightings or made.sightings
    return channels, sightings, maps


def _evened(
    truth: Baseline, effects: Sequence[Effect], condition: Condition, layout: Any
) -> NDArray[np.float64]:
    """Pattern of the pixels' areas, evened out by the charge that it makes uneven."""
    shot = shot_at(layout, condition, "flat", 1.0)
    total = np.zeros((SIDE, SIDE))
    for effect in effects:
        moved = effect.displacements(shot, layout)
        if moved is not None:
            total += np.diff(moved[0], axis=1) + np.diff(moved[1], axis=0)
    if not total.any():
        return total
    a = area_matrix(*truth.at(condition)[0])
    wide = np.zeros((SIDE, SIDE))
    at = np.arange(len(a)) - len(a) // 2
    wide[np.ix_(at, at)] = a
    power = np.fft.rfft2(wide).real * LEVELS[1]
    small = np.abs(power) < 1e-9
    left = np.where(small, 1.0, np.expm1(power) / np.where(small, 1.0, power))
    return np.fft.irfft2(np.fft.rfft2(total) * left, s=total.shape)


def record(
    truth: Baseline, effects: Sequence[Effect], case: Case, *, noisy: bool
) -> MeasuredChannels:
    """Take all recordings of a chip."""
    rng = np.random.default_rng([6032, CASES.index(case)])
    found, sightings, maps = take_maps(truth, effects, rng)
    blank = [*empty_channels(truth, case.ladders), *found]
    # Predictors take the spots' first widths from what was measured.
    for n, one in enumerate(blank):
        if one.word == "spot":
            start = np.where(one.axes["what"] == "flux", 0.0, WIDTH)
            blank[n] = dataclasses.replace(one, values=start)
    measured = _measured(blank, sightings, maps)
    predictor = Predictor(measured, truth, [e for e in effects if "spot" in e.touches])
    out = []
    for one in blank:
        if one.word == "flat_map":
            if not noisy:
                told = Predictor(measured, truth, effects)
                one = dataclasses.replace(one, values=told.predict(one, told.start))
            out.append(one)
            continue
        values = predictor.predict(one, predictor.start)
        if one.word == "spot":
            values = values + np.where(one.axes["what"] == "flux", one.axes["light"], 0.0)
        if noisy:
            values = values + one.unwhiten(rng.standard_normal(len(one)))
        out.append(dataclasses.replace(one, values=values))
    return dataclasses.replace(measured, channels=tuple(out))


def run(case: Case, keep: Path) -> dict[str, Any]:
    """Conceal one case and diagnose it."""
    begin = time.process_time()
    biases = sorted({c.back_bias for c in (*FITTED, HELD)})
    own, by = chip(case)
    truth = _as_card(
        baseline_of_device(own, back_biases=_about(own, biases), warming=True, keep=keep),
        biases,
    )  # fmt: skip
    device = card(case.card)
    baseline = baseline_of_device(
        device, parameters=list(SPREADS), back_biases=biases, lacks=case.lacks, warming=True,
        keep=keep,
    )  # fmt: skip
    pieces = physics_left_out(device, baseline, keep=keep)
    baseline = dataclasses.replace(baseline, pieces=pieces)
    effects: list[Effect] = []
    value = case.value
    if case.extra:
        like = physics_left_out(own, truth, keep=keep)
        kind = next(k for k in like if name_of(k) == case.truth)
        effects = [kind(case.extra)]
    if case.off:
        name = next(iter(case.off))
        value = quantities(own)[name].number(parameter_value(own, name))
    elif case.card:
        (name,) = case.card
        value = quantities(own)[name].number(parameter_value(own, name))
    made = time.process_time()
    clean = record(truth, effects, case, noisy=False)
    predictor = Predictor(clean, baseline)
    bare = fit_baseline(predictor, used_channels(clean.channels, ("fit", "select")))
    # The chip's own scatter costs the true model its priors.
    scatter = sum((by[n] / SPREADS[n]) ** 2 for n in SPREADS if n not in case.off)
    snr = float(np.sqrt(max(bare.total - scatter, 0.0)))
    measured = record(truth, effects, case, noisy=True)
    predictor = Predictor(measured, baseline)
    fit = fit_baseline(predictor, used_channels(measured.channels, ("fit", "select")))
    mismatch = locate_mismatch(fit, seed=1)
    row: dict[str, Any] = {
        "case": case.label, "truth": case.truth or "nothing", "snr": snr,
        "snr_flat_cov": np.sqrt(bare.chi2()["flat_cov"][0]),
        "snr_flat_map": np.sqrt(bare.chi2()["flat_map"][0]),
        "snr_spot": np.sqrt(bare.chi2()["spot"][0]),
        "detected": mismatch.detected, "p": mismatch.p_value, "named": "", "probability": np.nan,
        "tied": "", "parameter": "", "value": np.nan, "low95": np.nan, "high95": np.nan,
        "true_value": value, "open_world": False,
    }  # fmt: skip
    base = Model(predictor, fit)
    told = compare_held_out(base, base)
    if mismatch.detected:
        found = attribute(predictor, fit, mismatch)
        told = found.heldout
        row["open_world"] = found.open_world
        row["named"] = " + ".join(f.effect.name for f in found.found)
        if found.found:
            first = found.found[0]
            parameter = first.effect.amplitudes()[0]
            interval = first.intervals()[parameter]
            row |= {
                "probability": first.probability.get(first.effect.word, np.nan),
                "tied": " ".join(w for w in first.tied if w != first.effect.word),
                "parameter": parameter, "value": interval["value"],
                "low95": interval.get("lo95", np.nan), "high95": interval.get("hi95", np.nan),
            }  # fmt: skip
    count = sum(n for *_, n in told.values())
    row |= {
        "held_before": sum(v[0] for v in told.values()) / count,
        "held_after": sum(v[1] for v in told.values()) / count,
        "held_values": count,
        "verdict": verdict(row),
        "tables_s": made - begin, "cpu_s": time.process_time() - begin,
    }  # fmt: skip
    return row


def verdict(row: dict[str, Any]) -> str:
    """Judge a row: right, of the right class, tied with it, wrong, not visible."""
    if row["truth"] == "nothing":
        return "wrong" if row["detected"] else "right"
    if not row["detected"]:
        return "not visible" if row["snr"] < 5 else "wrong"
    names = row["named"].split(" + ")
    if names[0] == row["truth"] and not row["open_world"]:
        return "right" if len(names) == 1 else "right, and more"
    word = row["truth"].partition(":")[0]
    first = names[0].partition(":")[0]
    if word == first and not row["open_world"]:
        return "right class"
    return "tied" if word in row["tied"].split() else "wrong"


def _about(own: Device, biases: Sequence[float]) -> list[float]:
    """Back biases of a chip whose own is off: off by as much at each."""
    off = own.operating_point.back_bias - REFERENCE.back_bias
    return [b + off for b in biases]


def _as_card(truth: Baseline, biases: Sequence[float]) -> Baseline:
    """The chip's shifts by what its card says of the back bias."""

    def told(held: Any) -> Any:
        return {(w, min(biases, key=lambda b: abs(b - v))): e for (w, v), e in held.items()}

    wavelength, bias = truth.reference
    nearest = min(biases, key=lambda b: abs(b - bias))
    return dataclasses.replace(
        truth, edges=told(truth.edges), slopes=told(truth.slopes), bends=told(truth.bends),
        warming=told(truth.warming), held=told(truth.held), reference=(wavelength, nearest),
    )  # fmt: skip


def draw(table: Table, path: str) -> None:
    """Draw all rows: how visible, how much of what is held out is explained, what was found."""
    import matplotlib.pyplot as plt

    colours = {"right": "tab:green", "right class": "tab:green", "tied": "tab:olive",
               "right, and more": "tab:olive", "not visible": "tab:gray",
               "wrong": "tab:red"}  # fmt: skip
    fig, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 4.6), sharey=True)
    for n, row in enumerate(table):
        colour = colours[row["verdict"]]
        left.barh(n, max(row["snr"], 0.1), color=colour)
        middle.plot([row["held_before"], row["held_after"]], [n, n], "-", color=colour)
        middle.plot(row["held_before"], n, "o", mfc="w", color=colour)
        middle.plot(row["held_after"], n, "o", color=colour)
        # Of a class's other law the parameter is another.
        if np.isfinite(row["value"]) and row["verdict"] != "right class":
            scaled = [row[k] / row["true_value"] for k in ("value", "low95", "high95")]
            right.plot(scaled[1:], [n, n], "-", color=colour)
            right.plot(scaled[0], n, "o", color=colour)
    left.set_yticks(range(len(table)), [f"{r['case']}: {r['verdict']}" for r in table])
    left.invert_yaxis()
    left.axvline(5, color="k", ls=":")
    left.set(xscale="log", xlabel="projected SNR (dotted: 5)")
    middle.axvline(1, color="k", ls=":")
    middle.set(
        xscale="log", xlabel="chi2 / values of the condition not fitted\n(open: before)"
    )
    right.axvline(1, color="k", ls=":")
    right.set(xlim=(0.94, 1.06), xlabel="parameter over truth, 95 % interval")
    fig.tight_layout()
    fig.savefig(path, dpi=120)
    plt.close(fig)


def main() -> None:
    """Run what is not there yet and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep", type=Path, default=Path(gettempdir()) / "bfsensor_walks")
    parser.add_argument(
        "--again", action="store_true", help="take rows again that are there"
    )
    parser.add_argument(
        "--only", nargs="*", default=[], help="labels; rows of others stay as they are"
    )
    given = parser.parse_args()
    labels = [case.label for case in CASES]
    if unknown := sorted(set(given.only) - set(labels)):
        parser.error(f"--only {', '.join(unknown)}: not among {', '.join(labels)}")
    path = Path(RESULTS)
    rows: dict[str, dict[str, Any]] = {}
    if path.exists():
        there = Table.read(path, format="ascii.ecsv", fill_values=[])
        for row in there:
            # Rows of one file may be of several commits.
            found = dict(zip(there.colnames, row, strict=True))
            rows[found["case"]] = {"commit": there.meta["commit"], **found}
    for case in CASES:
        wanted = not given.only or case.label in given.only
        if not wanted or (case.label in rows and not given.again):
            continue
        rows[case.label] = {"commit": commit_here(), **run(case, given.keep)}
        print(
            {
                k: float(f"{v:.4g}") if isinstance(v, float) else v
                for k, v in rows[case.label].items()
            },
            flush=True,
        )
        table = Table([rows[label] for label in labels if label in rows])
        for column in table.columns.values():
            if column.dtype.kind == "f":
                column.info.format = ".4g"
        total = round(float(np.sum(table["cpu_s"])), 1)
        write_results(table, RESULTS, COMMAND, added=True, cpu_s=total, pairs=PAIRS)
        draw(table, FIGURE)


if __name__ == "__main__":
    main()
