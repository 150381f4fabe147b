"""The concealed challenge at channel level: trials by the hundred, without files between.

``python -m validation.challenge.concealed_trials take [--count 500] [--work FOLDER]``

Each trial draws nothing (30 %), one effect of the library (42 %), two or three (16 %) or one outside
it (12 %) with a chip, lamp and noise of its own, from the generator's pixels; amplitudes are such that
the projected SNR is even in its logarithm from 3 to 30 (of several, the faintest so, the others
between it and 30).  What amplitude that is tells ``validation.challenge.trial_amplitudes``: by its
calibration where the amplitude is the only parameter, else by a twin pair with the effect's own
parameters. An effect that cannot be so strong within its range is as strong as its range allows:
``capped``, with the SNR it has.  The truth is written to WORK/truths and its hash to
WORK/commitments.json before the trial is diagnosed; the report goes to WORK/reports.  A row with
truth, report and scores is added to ``validation/results/challenge_trials.ecsv``.

Ended at any moment, the same command goes on; two of them (``--part 0/2``, ``--part 1/2``) share the
work.  ``show`` scores what is there anew; ``snr`` finds the projected SNRs of campaigns made at
pixel level, from their truths, for ``python -m validation.concealed open --more``.
"""

from __future__ import annotations

import hashlib
import json
import secrets
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from astropy.table import Table
from tqdm import tqdm

from bfsensor.diagnose.data.measure_channels import measure_channels
from bfsensor.diagnose.detect.matched_filters import alarms_of
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.fit.baseline_fit import fit_bounded
from validation.challenge.trial_amplitudes import (
    Amplitudes,
    at_seed,
    headroom,
    read_amplitudes,
    take_like,
    take_signal,
)
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.common.write_results import write_results
from validation.concealed.campaign import seal
from validation.concealed.effect import Effect
from validation.concealed.effects_silicon import DeviceParameter, Saturation
from validation.concealed.library import KNOWN, draw_effect, make_effect
from validation.concealed.misses import print_misses
from validation.concealed.opening import (
    Opened,
    add_results,
    from_row,
    to_row,
    write_summary,
)
from validation.concealed.rows import locked, read_rows
from validation.concealed.score import Score
from validation.concealed.submit import digest, read_json, write_json
from validation.concealed.tally import print_lines, tally

RESULTS = Path(__file__).parents[1] / "results" / "challenge_trials.ecsv"
ALARMS = RESULTS.with_name("challenge_alarms.ecsv")
COMMAND = "python -m validation.challenge.concealed_trials"
MIX = {"null": 150, "outside": 60, "several": 80, "single": 210}
FAINTEST, STRONGEST = 3.0, 30.0
"""Projected SNRs between which effects are drawn."""

QUIET = 100.0
"""Square that noise may add to one chip's difference, a sixteenth of that of an SNR of 40."""

Calibration = Mapping[tuple[str, str], Amplitudes]


class Set(NamedTuple):
    """An effect with its amplitude set, and the projected SNR that this gives."""

    effect: Effect
    snr: float
    capped: bool
    flux: Mapping[str, tuple[float, float]]


def kinds(seed: int) -> list[str]:
    """Return the kinds of all trials, mixed so that any first part has all of them."""
    every = [kind for kind, count in MIX.items() for _ in range(count)]
    return [every[k] for k in np.random.default_rng([seed, 1]).permutation(len(every))]


def _calibrated(calibration: Calibration, effect: Effect) -> Amplitudes:
    key = (effect.word, effect.variant)
    if key not in calibration:
        raise ValueError(
            f"no calibration of {' '.join(key).strip()}: "
            "run python -m validation.challenge.trial_amplitudes"
        )
    return calibration[key]


def _one_amplitude(effect: Effect) -> bool:
    """Whether an effect has nothing but its amplitude."""
    return len(effect.parameters) == 1


def _twin(effect: Effect, told: Amplitudes) -> tuple[float, float, Any]:
    """Factor of an effect at the top of its range that was taken, its SNR, its fluxes.

    The twin of one chip, in the channels that its class shows in and less the noise that it
    leaves there; where that is not well below the signal, twins of two chips: an effect's own
    shape may be one that no channel shows (a wrong bit of the converter beyond those counted).
    """
    factor = min(told.high, 1.0)
    one = told.noise < QUIET
    for turn in range(3):
        try:
            strong = effect.scaled(factor)
            found = (
                take_like(strong, told.shown, told.noise) if one else take_signal(strong)
            )
            if one and found.snr**2 < 4 * told.noise and factor == 1.0:
                found = take_signal(strong)
        except ValueError:
            factor /= 2
            continue
        # or far fainter than the class's middle: once more, stronger
        if found.snr > 15 or factor == 1.0 or turn == 2:
            return factor, found.snr, found.flux
        factor = min(1.0, factor * 30 / max(found.snr, 1.0))
    raise ValueError(f"{effect.truth()}: changes what is measured, at every amplitude")


def set_amplitude(effect: Effect, snr: float, calibration: Calibration) -> Set:
    """Return the effect with the amplitude that gives a projected SNR, or the largest below it."""
    told = _calibrated(calibration, effect)
    top = effect.scaled(headroom(effect))
    factor, at, flux = told.high, told.snr_high, told.flux
    if not _one_amplitude(effect):
        factor, at, flux = _twin(top, told)
    if at <= 0:
        return Set(top, 0.0, True, {})
    wanted = factor * (snr / at) ** (1 / told.power)
    if wanted > 1.0:
        return Set(top, float(at * factor**-told.power), True, flux)
    return Set(top.scaled(float(wanted)), snr, False, flux)


def snr_of(effect: Effect, calibration: Calibration, size: str = "S") -> float:
    """Projected SNR of an effect in a campaign of a size, wherever its amplitude is."""
    told = _calibrated(calibration, effect)
    room = headroom(effect)
    factor, at = told.high, told.snr_high
    if size != "S":
        strong = effect.scaled(room).scaled(factor)
        at = take_signal(strong, size).snr
    elif not _one_amplitude(effect):
        factor, at, _ = _twin(effect.scaled(room), told)
    return float(at * (1 / room / factor) ** told.power)


def score_now(row: Mapping[str, Any], calibration: Calibration) -> Score:
    """Score a row by the SNRs that effects with nothing but an amplitude have in today's channels.

    Truths tell those of when they were drawn, by the calibration of then; effects with more
    parameters had twins of their own.
    """
    score = from_row(row)
    effects = [effect_of(e) for e in json.loads(row["truth_json"])["effects"]]
    told = [
        snr_of(e, calibration) if _one_amplitude(e) and not isinstance(e, Saturation) else s
        for e, s in zip(effects, score.snr, strict=True)
    ]
    return replace(score, snr=tuple(told))


def draw_truth(number: int, seed: int, calibration: Calibration) -> dict[str, Any]:
    """Draw one trial: what is left out, how strong, and the seed of chip, lamp and noise."""
    kind = kinds(seed)[number % sum(MIX.values())]
    rng = np.random.default_rng([seed, 2, number])
    count = {"null": 0, "several": 3 if rng.random() < 1 / 3 else 2}.get(kind, 1)
    words = [str(w) for w in rng.choice(np.array(KNOWN), size=count, replace=False)]
    if kind == "outside":
        words = ["outside_library"]
    own = int(rng.integers(2**62))
    faintest = float(FAINTEST * (STRONGEST / FAINTEST) ** rng.random())
    effects: list[dict[str, Any]] = []
    where: dict[str, Any] = {}
    for k, word in enumerate(words):
        snr = (
            faintest if k == 0 else float(faintest * (STRONGEST / faintest) ** rng.random())
        )
        drawn = draw_effect(word, rng)
        found = set_amplitude(drawn, snr, calibration)
        effect = at_seed(found.effect, own)
        told = effect.truth() | {"snr": round(found.snr, 4), "capped": found.capped}
        if isinstance(effect, Saturation):
            # so steep in amplitude that only the chip's own twins tell
            told["snr"] = round(_own_snr(found.effect, own, calibration), 4)
        effects.append(told)
        where = {"flux": {k: list(v) for k, v in found.flux.items()}}
    salt = hashlib.sha256(f"{seed} {number} salt".encode()).hexdigest()[:32]
    return {
        "campaign": f"trial_{number:04d}", "effects": effects, "size": "S", "amplifiers": 2,
        "where": where if count == 1 else {}, "seed": own, "salt": salt,
    }  # fmt: skip


def _own_snr(effect: Effect, seed: int, calibration: Calibration) -> float:
    told = _calibrated(calibration, effect)
    return take_like(effect, told.shown, told.noise, seed).snr


def effect_of(told: Mapping[str, Any]) -> Effect:
    """Make the effect that a truth tells."""
    word, values = told["class"], dict(told["parameters"])
    variant = told.get("variant", "")
    if word == DeviceParameter.word:
        variant = next(iter(values))
    return make_effect(word, values, variant)


def diagnose_trial(truth: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, float]]:
    """Take a trial's campaign in memory and diagnose it; gives report and cost."""
    begin = time.process_time()
    effects = [effect_of(e) for e in truth["effects"]]
    source = VirtualSource(seed=truth["seed"], size=truth["size"], effects=effects)
    taken = time.process_time()
    found = diagnose_measured(
        measure_channels(source), virtual_baseline(), campaign=truth["campaign"]
    )
    report = json.loads(json.dumps(found.to_report()))
    return report, {
        "cpu_s": round(time.process_time() - begin, 2),
        "diagnosis_cpu_s": round(time.process_time() - taken, 2),
    }


def take_trial(number: int, seed: int, work: Path, calibration: Calibration) -> Opened:
    """Seal one trial's truth, diagnose it, open it.

    Raises
    ------
    ValueError
        A truth that was sealed before is no longer what was committed to.
    """
    name = f"trial_{number:04d}"
    path, report = work / "truths" / f"{name}.json", work / "reports" / f"{name}.json"
    known = work / "commitments.json"
    with locked(work):
        commitment = (
            read_json(known, "file of commitments") if known.exists() else {}
        ).get(name)
    if commitment is None:
        truth = draw_truth(number, seed, calibration)
        with locked(work):
            seal(work / name, truth, path.parent)
    elif not path.exists() or digest(path) != commitment:
        raise ValueError(f"{path}: not the truth that was committed to")
    truth = read_json(path, "truth")
    if report.exists():
        made = read_json(report, "report")
    else:
        told, cost = diagnose_trial(truth)
        made = {"report": told, "cost": cost}
        report.parent.mkdir(parents=True, exist_ok=True)
        write_json(report, made)
    return Opened(truth, made["report"], made["cost"], digest(path))


def _seed_of(work: Path, seed: int | None) -> int:
    """The seed that all trials of a folder of work are drawn from; secret if none is given."""
    path = work / "seed.json"
    work.mkdir(parents=True, exist_ok=True)
    with locked(work):
        if not path.exists():
            write_json(path, {"seed": secrets.randbits(63) if seed is None else seed})
        kept = int(read_json(path, "seed")["seed"])
    if seed is not None and kept != seed:
        raise ValueError(f"{path}: seed = {kept}, not {seed}")
    return kept


@click.group()
def main() -> None:
    """Trials of the concealed challenge at channel level."""


def _part(text: str) -> tuple[int, int]:
    try:
        one, many = (int(t) for t in text.split("/"))
    except ValueError:
        one, many = 1, 0
    if not 0 <= one < many:
        raise click.UsageError(f"--part {text}: K/N, K from 0 to N - 1")
    return one, many


_OUTPUT = click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=RESULTS, show_default=True
)
_NAME = click.option(
    "--name", default="trials", show_default=True, help="Of the set of rows."
)


@main.command()
@click.option("--count", default=500, show_default=True)
@click.option("--seed", type=int, help="Fixes everything; secret and fresh if not given.")
@click.option(
    "--part", default="0/1", show_default=True, help="K/N: every N-th trial from K on."
)
@click.option("--work", type=click.Path(path_type=Path), default=Path("challenge_trials"),
              show_default=True, help="Sealed truths, commitments, reports.")  # fmt: skip
@_OUTPUT
@_NAME
def take(
    count: int, seed: int | None, part: str, work: Path, output: Path, name: str
) -> None:
    """Take trials that are not there yet; ended at any moment, it goes on where it was.

    \b
    Example:
      python -m validation.challenge.concealed_trials take --count 500 --work trials_2
    """
    one, many = _part(part)
    try:
        seed = _seed_of(work, seed)
        calibration = read_amplitudes()
        there = {(r["set"], r["commitment"]) for r in read_rows(output)}
        for number in tqdm(range(one, count, many), desc="trials"):
            sealed = work / "truths" / f"trial_{number:04d}.json"
            if sealed.exists() and (name, digest(sealed)) in there:
                continue
            opened = take_trial(number, seed, work, calibration)
            add_results(output, [to_row(opened, "channel", name)], f"{COMMAND} take")
    except ValueError as error:
        raise click.ClickException(str(error)) from None


@main.command()
@_OUTPUT
@_NAME
@click.option("--misses/--no-misses", default=True, show_default=True)
def show(output: Path, name: str, misses: bool) -> None:
    """Score the rows of a set anew and print the table beside the goals, then all misses.

    \b
    Example:
      python -m validation.challenge.concealed_trials show --no-misses
    """
    rows = [r for r in read_rows(output) if r["set"] == name]
    if not rows:
        raise click.ClickException(f"{output}: no rows of a set {name!r}")
    scores = [from_row(r) for r in rows]
    lines = tally(scores)
    write_summary(
        output.with_name(f"{output.stem}_summary.ecsv"),
        lines,
        name,
        "channel",
        f"{COMMAND} take",
    )
    print_lines(lines, click.echo)
    if misses:
        click.echo("\nMisses:")
        print_misses(scores, click.echo)


@main.command()
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=ALARMS, show_default=True
)
@click.option("--seed", default=1, show_default=True, help="Of the campaign.")
def alarms(output: Path, seed: int) -> None:
    """Find from which deviate on each family of statistics alarms, in a campaign without effects.

    What scans, chi-squares and shapes of effects have of the false alarms, by their number.

    \b
    Example:
      python -m validation.challenge.concealed_trials alarms
    """
    measured = measure_channels(VirtualSource(seed=seed, size="S", effects=[]))
    found = alarms_of(*fit_bounded(measured, virtual_baseline()))
    table = Table({"family": list(found), "alarm": list(found.values())})
    table["alarm"].format = ".3f"
    write_results(table, output, f"{COMMAND} alarms --seed {seed}")
    click.echo(
        f"{output}: {len(found)} families, {min(found.values()):.2f} to {max(found.values()):.2f}"
    )


@main.command()
@click.argument("truths", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True)
def snr(truths: Path, output: Path) -> None:
    """Find the projected SNR of each effect of campaigns made at pixel level.

    TRUTHS is the folder of NAME.json; to be run when reports are submitted.  What is there already
    in the output is not taken again.

    \b
    Example:
      python -m validation.challenge.concealed_trials snr sealed -o snr.json
      python -m validation.concealed open campaigns reports sealed --more snr.json
    """
    try:
        calibration = read_amplitudes()
        known = read_json(output, "file of SNRs") if output.exists() else {}
        for path in tqdm(sorted(truths.glob("*.json")), desc="campaigns"):
            truth = read_json(path, "truth")
            if truth["campaign"] in known:
                continue
            size = truth.get("size", "S")
            values = [snr_of(effect_of(e), calibration, size) for e in truth["effects"]]
            known[truth["campaign"]] = {"snr": [round(v, 3) for v in values]}
            write_json(output, known)
    except ValueError as error:
        raise click.ClickException(str(error)) from None


if __name__ == "__main__":
    main()
