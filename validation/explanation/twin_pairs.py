"""Twins: effects that the usual recordings cannot tell apart, the recording that is advised, taken.

``python -m validation.explanation.twin_pairs`` takes campaigns of the virtual sensor with either
member of a pair on its pixels, and diagnoses them with the whole library: which class is reported,
which recording is advised.  Where the pair is tied, the recording is then taken (pixels of the same
chip, read as it says) and both explanations are held against it with parameters as they were fitted,
the light free.  The tie is broken if the wrong one is far worse and the true one fits.

    cti, memory       serial CTI and amplifier memory, of a campaign without overscans: of size M,
                      for in flats of size S CTI is not seen; all others are of size S
                      With overscans, as faint as real sensors have them, the pair is tied
    loss, curve       charge loss and a curved response
    variance, gain    noise of the light beyond Poisson's, which a gain absorbs: nothing is seen
                      until Fe55 tells the gain

Rows go to ``validation/results/twin_pairs.ecsv``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from bfsensor.diagnose.data.measure_channels import MeasuredChannels, measure_channels
from bfsensor.diagnose.diagnosis import diagnose_measured
from bfsensor.diagnose.model.predictor import Predictor
from bfsensor.diagnose.plan.catalogue import RULES
from bfsensor.diagnose.report.diagnosis_result import Diagnosis
from bfsensor.effects.effect import Effect
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.common.write_results import write_results
from validation.concealed.effect import Range
from validation.concealed.library import make_effect
from validation.concealed.outside import OutsideLibrary
from validation.concealed.plan import Geometry, Size
from validation.concealed.sensor import VirtualSensor

RESULTS = Path(__file__).parents[1] / "results" / "twin_pairs.ecsv"
COMMAND = "python -m validation.explanation.twin_pairs"
SEED = 52_701
ENOUGH = 25.0
"""Difference of the chi-squares from which on a tie is broken."""
LEVELS = Size(256, 4, 0, dithers=0, flat_seconds=(3.0, 9.0, 18.0, 27.0))
"""Flats of a recording that is advised: pairs at each of four times; at equal signal of pairs of
pixels half of the usual ones."""
LINE_ERROR = 1e-3
"""Relative error of a gain by Fe55 (assumed): gains are drawn with it, no clouds are simulated."""


class ReadOtherwise:
    """What is done to frames behind all transfers: an effect of the virtual sensor that is none."""

    def __init__(self, change: Any) -> None:
        self.change = change

    def __getattr__(self, name: str) -> Any:
        nothing = {"device": lambda d: d, "shifts": lambda s, c: s, "gain": lambda c: 1.0,
                   "displaced": lambda c: None, "light": lambda s, c: None}  # fmt: skip
        if name in ("laws", "spot_light"):
            return lambda c: {}
        return nothing.get(name, lambda frames, c: frames)

    def shift(self, frames: Any, context: Any) -> Any:
        """Frames after the register."""
        del context
        return [self.change(f) for f in frames]


def bin_columns(frame: NDArray[Any]) -> NDArray[Any]:
    """Two columns summed on the output node."""
    return np.asarray(frame[:, ::2] + frame[:, 1::2])


def binned(seed: int, effect: Any) -> VirtualSource:
    """Flats of a chip, read with two columns in one."""
    source = VirtualSource(
        seed=seed,
        size=LEVELS,
        effects=[effect, ReadOtherwise(bin_columns)],  # type: ignore[arg-type]
    )
    whole = source._geometry
    source._geometry = SimpleNamespace(  # type: ignore[assignment]
        pixels=whole.pixels, width=whole.width // 2, prescan=whole.prescan // 2,
        serial_overscan=whole.serial_overscan // 2, parallel_overscan=whole.parallel_overscan,
    )  # fmt: skip
    source.shape = whole.pixels, whole.pixels // 2
    return source


def with_overscan(seed: int, effect: Any) -> VirtualSource:
    """Flats of a chip with the overscans that the campaign lacked."""
    flats = replace(LEVELS, flat_seconds=(6.0, 18.0, 36.0, 54.0))
    return VirtualSource(seed=seed, size=flats, effects=[effect])  # type: ignore[arg-type]


def slowly(seed: int, effect: Any) -> VirtualSource:
    """Flats of a chip, read with twice the pixel time.

    What is left of a pixel when the next is sampled is the exponential of the pixel time: squared.
    Transfers leave behind what they did.
    """
    flats = replace(LEVELS, flat_seconds=(6.0, 18.0, 36.0, 54.0))
    if effect.word == "electronic_memory":
        effect = make_effect(effect.word, {"alpha": effect.parameters["alpha"] ** 2})
    return VirtualSource(seed=seed, size=flats, effects=[effect])


TAKEN = {"binned_serial": binned, "overscan": with_overscan, "pixel_time": slowly}


def without(measured: MeasuredChannels, *words: str) -> MeasuredChannels:
    """The same campaign without some channels."""
    return replace(
        measured, channels=tuple(c for c in measured.channels if c.word not in words)
    )


def held_against(
    measured: MeasuredChannels, effect: Effect, word: str
) -> tuple[float, int]:
    """Chi-square of one channel with an effect as it is, what is linear fitted; and its dof."""
    predictor = Predictor(measured, virtual_baseline(), [effect])
    square, number = 0.0, 0
    for channel in measured.channels:
        if channel.word != word:
            continue
        left = channel.whiten(channel.values - predictor.predict(channel, predictor.start))
        columns = predictor.linear(channel)
        free = [channel.whiten(c) for c in columns.values() if np.abs(c).max() > 0]
        if free:
            design = np.array(free).T
            left = left - design @ np.linalg.lstsq(design, left, rcond=None)[0]
        square += float(left @ left)
        number += len(left) - len(free)
    return square, number


def rivals_of(found: Diagnosis, pair: tuple[str, str]) -> dict[str, Effect]:
    """Best fit of each member of a pair, where both were judged in one place."""
    told = found.attribution
    assert told is not None
    out: dict[str, Effect] = {}
    for one in told.found:
        members = {one.effect.word: one.effect} | {
            r.word: r.effect for r in reversed(one.rivals) if r.word != one.effect.word
        }
        if set(pair) <= set(members):
            return {w: members[w] for w in pair}
        out |= members
    return {w: out[w] for w in pair if w in out}


@dataclass(frozen=True)
class Twin:
    """A pair, what is put on pixels, what the campaign lacks, and how the tie is broken."""

    pair: tuple[str, str]
    truths: tuple[Any, ...]
    lacks: tuple[str, ...] = ()
    taken: str = ""
    channel: str = "flat_mean"
    size: str = "S"


def take(twin: Twin, truth: Any) -> dict[str, Any]:
    """Diagnose one campaign of a pair, take the advised recording, hold both against it."""
    begin = time.process_time()
    baseline = virtual_baseline()
    source = VirtualSource(seed=SEED, size=twin.size, effects=[truth])
    found = diagnose_measured(without(measure_channels(source), *twin.lacks), baseline)
    told = found.attribution
    advised = [a for a in found.plan.advised if set(a.separates) == set(twin.pair)]
    row: dict[str, Any] = {
        "pair": " / ".join(twin.pair), "truth": truth.word, "lacks": " ".join(twin.lacks),
        "p": found.mismatch.p_value,
        "named": " ".join(f.effect.word for f in told.found) if told else "",
        "class": " ".join(told.tied) if told else "",
        "advised": " ".join(a.recording.name for a in advised),
        "exposures": advised[0].exposures if advised else 0,
        "expected": round(advised[0].expected, 1) if advised else np.nan,
    }  # fmt: skip
    members = rivals_of(found, twin.pair) if told else {}
    row["gained"], row["chi2_true"], row["dof"] = np.nan, np.nan, 0
    # Taken is only what was advised for a pair that was tied.
    if len(members) == 2 and row["advised"] == twin.taken:
        keeps = RULES[twin.taken].of if twin.taken in RULES else (lambda w: 1.0)
        taken = TAKEN[twin.taken](SEED, truth)
        gains = tuple(found.fit.values[: len(found.measured.amplifiers)])
        measured = replace(measure_channels(taken), gains=gains)
        squares = {}
        for word, effect in members.items():
            squares[word], row["dof"] = held_against(
                measured, effect.scaled(keeps(word)), twin.channel
            )
        wrong = next(w for w in squares if w != truth.word)
        row["chi2_true"] = round(squares[truth.word], 1)
        row["gained"] = round(squares[wrong] - squares[truth.word], 1)
    fits = row["chi2_true"] < row["dof"] + 5 * np.sqrt(2 * row["dof"])
    row["broken"] = bool(row["gained"] > ENOUGH and fits)
    row["cpu_s"] = round(time.process_time() - begin, 1)
    return row


@dataclass(frozen=True)
class Excess(OutsideLibrary):
    """Light whose number scatters more than Poisson's law by a part ``amp`` of its variance."""

    variants: ClassVar = {"": {"amp": Range(1e-3, 0.1, amplitude=True)}}

    def store(self, charge: Any, context: Any) -> Any:
        """Add white noise of a part of the signal's variance."""
        amp = self.parameters["amp"]
        noise = context.stream("excess").standard_normal(charge.shape)
        return charge + (np.sqrt(amp * np.maximum(charge, 0)) * noise).astype(charge.dtype)


def take_excess(amp: float = 0.02) -> dict[str, Any]:
    """A variance excess: absorbed by the gains, until Fe55 tells them."""
    begin = time.process_time()
    truth = Excess({"amp": amp})
    source = VirtualSource(seed=SEED, effects=[truth])
    found = diagnose_measured(measure_channels(source), virtual_baseline())
    plain = diagnose_measured(
        measure_channels(VirtualSource(seed=SEED)), virtual_baseline(), explain=False
    )
    n = len(found.measured.amplifiers)
    gains, errors = found.fit.values[:n], found.fit.errors[:n]
    # Clouds of one photon hold as many electrons whatever the light does: their mean in ADU
    # is the gain, by the chip's own converter.
    true = np.array(VirtualSensor(Geometry(256), seed=SEED).electronics.gain)
    rng = np.random.default_rng(SEED)
    measured = true * (1 + LINE_ERROR * rng.standard_normal(n))
    pulls = (gains - measured) / np.hypot(errors, LINE_ERROR * true)
    # With the excess the gains are larger by it: what is measured of photons' noise is not theirs.
    right = (gains * (1 + amp) - measured) / np.hypot(errors * (1 + amp), LINE_ERROR * true)
    told = [t["recording"] for t in found.to_report()["not_tested"]]
    return {
        "pair": "variance excess / gain", "truth": f"variance excess {amp:g}", "lacks": "",
        "p": found.mismatch.p_value,
        "named": " ".join(f.effect.word for f in found.attribution.found)
        if found.attribution else "",
        "class": "", "advised": "fe55" if any("Fe55" in t for t in told) else "",
        "exposures": 50, "expected": float(n * (amp / LINE_ERROR) ** 2),
        "gained": round(float(pulls @ pulls), 1),
        "chi2_true": round(float(right @ right), 2),
        "dof": n,
        "broken": bool(
            pulls @ pulls - right @ right > ENOUGH and right @ right < n + 5 * (2 * n) ** 0.5
        ),
        "cpu_s": round(time.process_time() - begin, 1),
    } | {"gain_ratio": round(float((gains / plain.fit.values[:n]).mean()), 4)}  # fmt: skip


TWINS = (
    Twin(
        ("cti_serial", "electronic_memory"),
        (make_effect("cti_serial", {"cti": 2e-5}), make_effect("electronic_memory", {"alpha": 4e-3})),
        ("serial_overscan",), "overscan", "serial_overscan", "M",
    ),
    Twin(
        ("cti_serial", "electronic_memory"),
        (make_effect("cti_serial", {"cti": 1e-7}), make_effect("electronic_memory", {"alpha": 1.3e-5})),
        (), "pixel_time", "serial_overscan",
    ),
    Twin(
        ("charge_loss", "gain_nonlinearity"),
        (make_effect("charge_loss", {"q": 1e-7}),
         make_effect("gain_nonlinearity", {"c2": -0.01, "c3": 0.0})),
        (), "binned_serial", "flat_mean",
    ),
)  # fmt: skip


def main() -> None:
    """Take all pairs."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    rows = []
    for twin in TWINS:
        for truth in twin.truths:
            rows.append(take(twin, truth))
            print(rows[-1], flush=True)
    rows.append(take_excess())
    print(rows[-1], flush=True)
    names = dict.fromkeys(n for r in rows for n in r)
    table = Table(rows=[[r.get(n, np.nan) for n in names] for r in rows], names=list(names))
    write_results(table, str(RESULTS), COMMAND, seed=SEED)


if __name__ == "__main__":
    main()
