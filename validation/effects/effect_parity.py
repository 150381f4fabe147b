"""Parity: each effect's prediction in every channel against what it does to pixels.

``python -m validation.effects.effect_parity [WORD ...]`` takes every effect of the library (or those of
the words given) at the low end, the middle and the high end of its amplitudes' ranges, its other
parameters walking through theirs, and puts it on the pixels of the virtual sensor: our own
effect, and the sensor's own one of the same parameters, which shares conventions and no code.
Two campaigns with and without the effect share all noise; the baseline's parameters are taken
off both what is seen and what is predicted.  A row for each channel:

    said     length of the prediction [standard deviations]
    factor   on the prediction that fits the pixels best, and its error
    left     rms of what is not predicted; of noise that is drawn anew it is 1.4

What is there already is not made again; delete rows to have them made anew.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.table import Table, vstack

from bfsensor.effects.effect import Effect, Parameter
from bfsensor.effects.library import LIBRARY
from validation.common.write_results import write_results
from validation.concealed.library import EFFECTS, make_effect
from validation.effects.effects_on_pixels import compare, null_campaign

PATH = Path(__file__).parents[1] / "results" / "effect_parity.ecsv"
COMMAND = "python -m validation.effects.effect_parity"
PLACES = {"low": 0.0, "middle": 0.5, "high": 1.0}
ENGINES = ("ours", "sensor's own")
SEED = 31_000


class Parity(NamedTuple):
    """One channel of one comparison."""

    channel: str
    said: float
    factor: float
    error: float
    left: float
    count: int


def value_at(p: Parameter, place: float) -> float:
    """Give a place of a parameter's range; signed ones are negative in the middle.

    Shapes stay off the ends of their range, where fits begin anywhere but there.
    """
    if p.law == "whole":
        return float(round(p.low + place * (p.high - p.low)))
    part = place if p.amplitude else 0.25 + 0.5 * place
    size = (
        p.low * (p.high / p.low) ** part
        if p.law == "log"
        else p.low + part * (p.high - p.low)
    )
    return p.neutral + (-size if p.signed and place == 0.5 else size)


NEAR = {
    "tree_rings": {"xc": -95.0, "yc": 330.0, "period": 24.0},
    "tree_rings:uneven": {"xc": -95.0, "yc": 330.0, "period": 24.0, "length": 400.0},
    "tearing": {"column": 55 / 128},
    "tearing:divisadero": {"column": 55 / 128},
}
"""Shapes whose ranges reach far beyond a small sensor, or far off the middle of one."""

OWN = {
    "trap_serial": {"reach": 0.0},
    "tree_rings": {"phase": 0.0},
    "mask_stitch": {"phase": 0.0},
    "tearing": {"open": 0.4},
    "tearing:divisadero": {"open": 0.4},
    "fringing": {"tilt": 0.6, "xx": 0.7, "xy": -0.5, "yy": 0.4, "phase": 0.0},
    "dark_hot:hot": {f"x{n}": n * 0.61803 % 1 for n in range(1, 7)},
}
"""What the sensor's own effects leave no choice of; columns as parts of the sensor's width."""


def effect_at(kind: type[Effect], place: float, width: int = 256) -> Effect:
    """Make an effect with all parameters at a place of their ranges.

    What the sensor's own effects leave no choice of is theirs, on a sensor of so many columns.
    """
    # The sensor's own effects have the plain law: what is more general stays plain.
    values = {
        p.name: value_at(p, place) if p.plain is None else p.plain for p in kind.parameters
    }
    name = f"{kind.word}:{kind.variant}".rstrip(":")
    values |= NEAR.get(name, {}) | OWN.get(name, {})
    if name == "dark_hot:hot":
        count = int(values["columns"])
        values |= {
            f"x{n}": float(int(values[f"x{n}"] * width)) if n <= count else 0.0
            for n in range(1, 7)
        }
    return kind(values)


def known_to_the_sensor(kind: type[Effect]) -> bool:
    """Whether the virtual sensor has the effect too."""
    return kind.word in EFFECTS and kind.variant in EFFECTS[kind.word].variants


def own_effect(effect: Effect) -> Any:
    """Give the sensor's own effect of the same parameters, which shares no code."""
    fixed = set(OWN.get(effect.name, ()))
    fixed |= {p.name for p in effect.parameters if p.plain is not None}
    values = {k: v for k, v in effect.values.items() if k not in fixed}
    return make_effect(effect.word, values, effect.variant)


def compare_at(
    effect: Effect, engine: str, size: Any = "S", seed: int = SEED
) -> list[Parity]:
    """Hold an effect against pixels, channel by channel.

    Parameters
    ----------
    effect : Effect
        With its parameters.
    engine : str
        Whose effect is on the pixels, of :data:`ENGINES`.
    size, seed
        Of the campaigns.
    """
    own = None
    if engine != ENGINES[0]:
        own = own_effect(effect)
    fit = null_campaign(seed, size)[1]
    out = []
    for word, (said, factor, error) in compare(effect, seed, size, own).items():
        count = int(fit.of(word).sum())
        left = error * said if factor else error / max(count, 1) ** 0.5
        out.append(Parity(word, said, factor, error if factor else 0.0, left, count))
    return out


def there(rows: Table | None, **values: str) -> bool:
    """Whether a comparison has been made."""
    if rows is None:
        return False
    return bool(np.any(np.logical_and.reduce([rows[k] == v for k, v in values.items()])))


def main() -> None:
    """Make what is missing."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*", help="Classes; all by default.")
    words = parser.parse_args().words
    for kind in LIBRARY:
        if words and kind.word not in words:
            continue
        for name, place in PLACES.items():
            effect = effect_at(kind, place)
            for engine in ENGINES[: 1 + known_to_the_sensor(kind)]:
                old = Table.read(PATH, format="ascii.ecsv") if PATH.exists() else None
                key = {"effect": effect.name, "amplitude": name, "engine": engine}
                if there(old, **key):
                    continue
                begin = time.process_time()
                rows = compare_at(effect, engine)
                cpu = round(time.process_time() - begin, 1)
                told = ", ".join(f"{k} = {v:.4g}" for k, v in effect.values.items())
                new = Table(rows=[
                    {**key, "parameters": told, "channel": r.channel, "said": round(r.said, 3),
                     "factor": round(r.factor, 4), "error": round(r.error, 4),
                     "left": round(r.left, 3), "values": r.count, "cpu_s": cpu}
                    for r in rows
                ])  # fmt: skip
                both = (
                    new if old is None else vstack([old, new], metadata_conflicts="silent")
                )
                write_results(both, PATH, COMMAND, added=True, size="S", seed=SEED)
                worst = max(
                    rows, key=lambda r: abs(r.factor - 1) * r.said if r.factor else 0
                )
                print(effect.name, name, engine, told, worst, flush=True)


if __name__ == "__main__":
    main()
