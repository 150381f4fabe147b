"""How strong an effect must be for a projected SNR, by class and variant.

``python -m validation.challenge.trial_amplitudes [--check]`` takes twin campaigns of size S, with
and without an effect, all else the same; the difference of their residuals, the fit's parameters
projected out, is what the effect does, and its length the projected SNR, sqrt(2 Delta lnL).  Twins
of two chips are taken: what noise is left differs between them, and SNR^2 is the product of both,
over channels that both show (as in ``validation.location.diagnose_power``).  What an effect does at
random, such as the places of particle tracks, does not count; that it does so, does.

For each class and variant, with amplitudes at the top of their ranges and all other parameters in
the middle of theirs, the amplitude is lowered until the SNR is about 40, and once more to about 10:
a power law between the two.  ``--check`` takes one campaign of a third chip at SNR 10 and asks how
far the baseline's residuals go along the signature: 10 with an error of 1.  Rows go to
``validation/results/challenge_amplitudes.ecsv``; what is there is not taken again but with
``--again CLASS ...``: what a campaign tells changes with the channels and with what floats.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bfsensor.diagnose.data.measure_channels import MeasuredChannels, measure_channels
from bfsensor.diagnose.fit.baseline_fit import BaselineFit, fit_baseline
from bfsensor.diagnose.model.predictor import Predictor, used_channels
from validation.common.virtual_source import VirtualSource, virtual_baseline
from validation.concealed.card import NOMINAL
from validation.concealed.effect import Effect, Range
from validation.concealed.effects_silicon import DeviceParameter, Saturation
from validation.concealed.library import EFFECTS
from validation.concealed.plan import Geometry
from validation.concealed.rows import append_rows, read_rows
from validation.concealed.sensor import VirtualSensor
from validation.location.diagnose_power import (
    FOLDS,
    flux_of,
    residuals_at,
    without_parameters,
)

RESULTS = Path(__file__).parents[1] / "results" / "challenge_amplitudes.ecsv"
COMMAND = "python -m validation.challenge.trial_amplitudes"
SEEDS = 31_000, 31_001
"""Chips that signatures are taken from."""
CHECKED = 31_002
HIGH, LOW = (25.0, 60.0), (6.0, 16.0)
"""SNRs between which the two amplitudes of a calibration may lie."""
TRIES = 8


class Signal(NamedTuple):
    """What an effect does to the residuals of the baseline.

    Attributes
    ----------
    snr : float
        Projected.
    shown : tuple of str
        Channels that count.
    noise : float
        Square that differing noise adds in them to the length of one chip's difference.
    direction : ndarray
        Of length 1, or zero; priors' rows last.
    flux : dict of str to (float, float)
        Fluxes [e-] that hold the middle 90 % of the square, by channel of its own.
    """

    snr: float
    shown: tuple[str, ...]
    noise: float
    direction: NDArray[np.float64]
    flux: dict[str, tuple[float, float]]


def at_seed(effect: Effect, seed: int) -> Effect:
    """Return the effect as it must be on a chip to be as strong as on another.

    A full well counts against the brightest level, which the lamp's rate sets.
    """
    if not isinstance(effect, Saturation):
        return effect
    rate = VirtualSensor(Geometry(64), seed=seed).lamp.flat_rate
    return Saturation({"full_well": effect.parameters["full_well"] * rate / 2000.0})


def still(effect: Effect) -> tuple[Effect, ...]:
    """Return what the twin without the effect has: a device parameter told is not scattered."""
    if not isinstance(effect, DeviceParameter):
        return ()
    name = effect.variant
    return (DeviceParameter({name: NOMINAL[name] * (1 + 1e-9)}, name),)


def headroom(effect: Effect) -> float:
    """Return the factor at which the first amplitude meets the end of its range.

    Examples
    --------
    >>> from validation.concealed.library import make_effect
    >>> round(headroom(make_effect("cti_serial", {"cti": 1e-6})), 9)
    5.0
    """
    ranges = effect.variants[effect.variant]
    if isinstance(effect, Saturation):
        return (2e5 - ranges["full_well"].low) / (2e5 - effect.parameters["full_well"])
    if isinstance(effect, DeviceParameter):
        name = effect.variant
        return ranges[name].high / abs(effect.parameters[name] - NOMINAL[name])
    return min(r.high / abs(effect.parameters[n]) for n, r in ranges.items() if r.amplitude)


def strongest(word: str, variant: str) -> Effect:
    """Return an effect with amplitudes at the top and all else in the middle of its range."""
    kind = EFFECTS[word]
    effect = kind.draw(np.random.default_rng(8), 1.0, variant)
    if isinstance(effect, Saturation | DeviceParameter):
        return effect
    values = {
        n: r.high if r.amplitude else _middle(r) for n, r in kind.variants[variant].items()
    }
    return kind(values, variant)


def _middle(given: Range) -> float:
    if given.law == "log":
        return float(np.sqrt(given.low * given.high))
    middle = 0.5 * (given.low + given.high)
    return float(int(middle)) if given.law == "whole" else middle


@lru_cache(maxsize=16)
def _fitted(seed: int, word: str, size: str) -> tuple[MeasuredChannels, BaselineFit]:
    """The twin without the effect, and the baseline's fit; ``word`` names a device parameter."""
    told = DeviceParameter({word: NOMINAL[word]}, word) if word else None
    effects = () if told is None else still(told)
    measured = measure_channels(VirtualSource(seed=seed, size=size, effects=effects))
    predictor = Predictor(measured, virtual_baseline())
    return measured, fit_baseline(predictor, used_channels(measured.channels, FOLDS))


def twin_of(
    effect: Effect, seed: int, size: str = "S"
) -> tuple[MeasuredChannels, BaselineFit]:
    """Return the twin without the effect: its channels and the baseline's fit of them."""
    word = effect.variant if isinstance(effect, DeviceParameter) else ""
    return _fitted(seed, word, size)


def change(effect: Effect, seed: int, size: str = "S") -> NDArray[np.float64]:
    """Return what an effect changes in the residuals, the fit's parameters projected out.

    Raises
    ------
    ValueError
        So strong that the channels no longer hold the same values.
    """
    null, fit = twin_of(effect, seed, size)
    source = VirtualSource(seed=seed, size=size, effects=[at_seed(effect, seed)])
    measured = measure_channels(source, ghosts=False)
    return without_parameters(fit, residuals_at(fit, measured) - residuals_at(fit, null))


def _rows(fit: BaselineFit, word: str) -> NDArray[np.bool_]:
    return np.append(fit.of(word), np.zeros(len(fit.basis) - len(fit.residuals), bool))


def _signal(effect, kept, square, shown, noise, seed, size="S") -> Signal:
    null, fit = twin_of(effect, seed, size)
    length = float(np.sqrt(kept @ kept))
    direction = kept / length if length else kept
    flux = {}
    for word in shown:
        alone = np.where(_rows(fit, word), direction, 0.0)[: len(fit.residuals)]
        gain = float(np.mean(fit.values[: len(null.amplifiers)]))
        if found := flux_of(fit, gain, alone):
            flux[word] = found[0]
    return Signal(float(np.sqrt(max(square, 0.0))), shown, noise, direction, flux)


def _kept(fit: BaselineFit, shown: Sequence[str]) -> NDArray[np.bool_]:
    """Rows of the channels that count, and those of the priors."""
    keep = np.zeros(len(fit.basis), bool)
    keep[len(fit.residuals) :] = True
    for word in shown:
        keep |= _rows(fit, word)
    return keep


def join_signal(effect: Effect, one: NDArray, two: NDArray, size: str = "S") -> Signal:
    """Make the signal of an effect from what it changes on two chips."""
    fit = twin_of(effect, SEEDS[0], size)[1]
    shown = []
    for word in dict.fromkeys(c.word for c in fit.channels):
        part = _rows(fit, word)
        a, b = one[part], two[part]
        like = a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-300)
        # Of independent noise the cosine is 0 +- 1 / sqrt(n).
        if like > min(3 / np.sqrt(part.sum()), 0.9):
            shown.append(word)
    keep = _kept(fit, shown)
    a, b = np.where(keep, one, 0.0), np.where(keep, two, 0.0)
    noise = float((a - b) @ (a - b)) / 2
    return _signal(effect, (a + b) / 2, a @ b, tuple(shown), noise, SEEDS[0], size)


def take_signal(effect: Effect, size: str = "S") -> Signal:
    """Take an effect's signal from twins of two chips."""
    return join_signal(effect, *(change(effect, s, size) for s in SEEDS), size)


def take_like(
    effect: Effect, shown: Sequence[str], noise: float, seed: int = SEEDS[0]
) -> Signal:
    """Take the signal of an effect from one chip, channels and noise as its class was calibrated."""
    one = change(effect, seed)
    kept = np.where(_kept(twin_of(effect, seed)[1], shown), one, 0.0)
    return _signal(effect, kept, kept @ kept - noise, tuple(shown), noise, seed)


class Amplitudes(NamedTuple):
    """Calibration of one class and variant; factors are of its strongest effect."""

    high: float
    snr_high: float
    low: float
    snr_low: float
    shown: tuple[str, ...]
    noise: float
    flux: dict[str, tuple[float, float]]

    @property
    def power(self) -> float:
        """Of the amplitude, that the SNR goes with between the two."""
        if min(self.snr_high, self.snr_low) <= 0 or self.high == self.low:
            return 1.0
        return float(np.log(self.snr_high / self.snr_low) / np.log(self.high / self.low))

    def factor_of(self, snr: float) -> float:
        """Factor of the strongest effect at which the SNR is this."""
        return float(self.high * (snr / self.snr_high) ** (1 / self.power))


def _probe(effect: Effect, known: dict[float, NDArray[np.float64]]) -> float:
    """Find the factor at which one chip's difference is about 40 long, or the largest there is."""
    factor, lengths = 1.0, {}
    for _ in range(TRIES):
        try:
            known[factor] = change(effect.scaled(factor), SEEDS[0])
        except ValueError:
            # so strong that values are missing: less of it
            lengths[factor] = np.inf
        else:
            lengths[factor] = float(np.sqrt(known[factor] @ known[factor]))
        if HIGH[0] <= lengths[factor] <= HIGH[1] or (
            factor == 1.0 and lengths[1.0] < HIGH[0]
        ):
            return factor
        above = min(f for f, n in lengths.items() if n > HIGH[1])
        below = [f for f, n in lengths.items() if n < HIGH[0]]
        factor = float(_between(above, lengths[above], max(below, default=0.0), lengths))
    return max(known)


def _between(
    above: float, length: float, below: float, lengths: dict[float, float]
) -> float:
    """Next factor to try: by proportion from above, halfway between on a logarithmic scale."""
    if below:
        return float(np.sqrt(above * below))
    return above * (0.5 if np.isinf(length) else max(40 / length, 0.02))


def calibrate(word: str, variant: str) -> tuple[Amplitudes, Signal]:
    """Find two amplitudes of a class and variant; gives the signal at the larger one too."""
    effect = strongest(word, variant)
    known: dict[float, NDArray[np.float64]] = {}
    high = _probe(effect, known)
    second = change(effect.scaled(high), SEEDS[1])
    best = join_signal(effect, known[high], second)
    fit = twin_of(effect, SEEDS[0])[1]
    across = np.where(_kept(fit, best.shown), second, 0.0)

    def fainter(factor: float) -> float:
        # across chips, so that what is left of noise and chance does not count
        found = change(effect.scaled(factor), SEEDS[0]) @ across
        return float(found / best.snr) if best.snr > 0 else 0.0

    low = high * (min(10 / best.snr, 0.5) if best.snr > 0 else 0.5)
    snr = fainter(low)
    if best.snr > HIGH[0] and not LOW[0] <= snr <= LOW[1]:
        # not in proportion: once more, by the power of the two
        power = np.log(best.snr / max(snr, 1.0)) / np.log(high / low)
        low = high * (10 / best.snr) ** (1 / power)
        snr = fainter(low)
    return Amplitudes(high, best.snr, low, snr, best.shown, best.noise, best.flux), best


def seen_along(effect: Effect, direction: NDArray[np.float64], seed: int) -> float:
    """Fit the signature's amplitude to one campaign's residuals: its SNR with an error of 1."""
    effects = [at_seed(effect, seed)]
    measured = measure_channels(VirtualSource(seed=seed, effects=effects))
    predictor = Predictor(measured, virtual_baseline())
    fit = fit_baseline(predictor, used_channels(measured.channels, FOLDS))
    n = len(fit.residuals)
    if n + len(predictor.space.prior_rows) != len(direction):
        return float("nan")
    priors = [-fit.values[k] for k in predictor.space.prior_rows]
    return float(fit.residuals @ direction[:n] + priors @ direction[n:])


def read_amplitudes(path: str | Path = RESULTS) -> dict[tuple[str, str], Amplitudes]:
    """Read the calibration by class and variant."""
    return {
        (r["effect"], r["variant"]): Amplitudes(
            r["high"], r["snr_high"], r["low"], r["snr_low"], tuple(r["shown"].split()),
            r["noise"], {k: tuple(v) for k, v in json.loads(r["flux"]).items()},
        )
        for r in read_rows(path)
    }  # fmt: skip


def main() -> None:
    """Calibrate what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="A third chip's campaign each."
    )
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    parser.add_argument(
        "--again",
        nargs="+",
        default=[],
        metavar="CLASS",
        help="Take these, and only these.",
    )
    options = parser.parse_args()
    if unknown := set(options.again) - set(EFFECTS):
        parser.error(f"--again {' '.join(sorted(unknown))}: not among {', '.join(EFFECTS)}")
    for word, kind in EFFECTS.items():
        for variant in sorted(kind.variants):
            there = (word, variant) in read_amplitudes(options.output)
            if word not in options.again if options.again else there:
                continue
            begin = time.process_time()
            told, best = calibrate(word, variant)
            row: dict[str, Any] = {
                "effect": word, "variant": variant, "high": float(f"{told.high:.5g}"),
                "snr_high": round(told.snr_high, 3), "low": float(f"{told.low:.5g}"),
                "snr_low": round(told.snr_low, 3), "power": round(told.power, 3),
                "shown": " ".join(told.shown), "noise": round(told.noise, 2),
                "flux": json.dumps({k: [round(x) for x in v] for k, v in told.flux.items()}),
            }  # fmt: skip
            factor = min(told.factor_of(10.0), 1.0)
            row["expected"] = round(told.snr_high * (factor / told.high) ** told.power, 2)
            row["seen"] = float("nan")
            if options.check:
                effect = strongest(word, variant).scaled(factor)
                row["seen"] = round(seen_along(effect, best.direction, CHECKED), 2)
            row["cpu_s"] = round(time.process_time() - begin, 1)
            append_rows(
                options.output, [row], COMMAND, key=("effect", "variant"), replace=True
            )
            print(*row.values(), flush=True)


if __name__ == "__main__":
    main()
