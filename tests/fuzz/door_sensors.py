"""Doors of sensors: a report.json given as effects, and the arguments of both sensors."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import galsim
import numpy as np

from bfsensor import BrighterFatterSensor, SiliconSensor
from bfsensor.sensor.effect_reports import SCHEMA, make_layout, read_effects
from tests.fuzz.mutations import VALUES, close, mutate_text, mutate_tree, pick, short
from tests.fuzz.outcomes import Case, Door

REPORT = {
    "schema": SCHEMA,
    "effects": [
        {"class": "charge_loss", "parameters": {"q": {"value": 1e-7, "sigma": 1e-9}}},
        {"class": "cti_serial", "variant": "", "parameters": {"cti": {"value": 1e-6}}},
        {"class": "persistence", "parameters": {"frac": {"value": 1e-4}, "tau": {"value": 60.0}}},
        {"class": "interpixel_coupling", "parameters": {"ax": 1e-3, "ay": 2e-3}},
        {"class": "bf_nonlinear", "parameters": {}},
    ],
    "layout": {"shape": [40, 60], "segments": [[0, 0, 30, 40], [30, 0, 30, 40]],
               "reference": [620.0, -50.0, -100.0], "pixel": 10.0, "thickness": 100.0},
    "chi2": 1.5,
}  # fmt: skip
"""A report of the schema, with entries that sensors do not read."""

USUAL = {
    "reference": (620.0, -50.0, 173.0),
    "pixel": 10.0,
    "thickness": 100.0,
    "front": 1.0,
}


def usable() -> dict[str, Any]:
    """Return the report with the parameters that the library has."""
    from bfsensor.effects.library import LIBRARY

    report = json.loads(json.dumps(REPORT))
    kinds = {kind.word: kind for kind in reversed(LIBRARY)}
    for entry in report["effects"]:
        kind = kinds[entry["class"]]
        entry["variant"] = kind.variant
        entry["parameters"] = {
            p.name: {"value": 0.5 * (max(p.widest[0], -1e6) + min(p.widest[1], 1e6))}
            for p in kind.parameters
        }
    return report


class Report(Door):
    """A report.json; effects and layout are compared with the file's."""

    name = "report"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.report = usable()
        path = self.write("report.json", json.dumps(self.report).encode())
        assert _judge_report(_load(path), path) == ""

    def make(self, rng: np.random.Generator) -> Case:
        """Mutate an entry, or the text."""
        keeps = False
        if rng.random() < 0.7:
            plain = [v for v in VALUES if not isinstance(v, bytes | tuple | complex)]
            words, report = mutate_tree(rng, self.report, plain)
            data = json.dumps(report).encode()
        elif rng.random() < 0.1:
            words, data, keeps = (
                "other spaces",
                json.dumps(self.report, indent=3).encode(),
                True,
            )
        else:
            words, data, keeps = mutate_text(rng, json.dumps(self.report, indent=1))
        path = self.write("report.json", data)
        return Case(
            words, lambda: _load(path), lambda made: _judge_report(made, path),
            ("report.json", "layout"), keeps,
        )  # fmt: skip


def _load(path: Path) -> Any:
    """Read effects and layout as a sensor does, without its table."""
    effects, layout = read_effects(str(path))
    return effects, None if layout is None else make_layout(layout, USUAL)


def _judge_report(made: Any, path: Path) -> str:
    """Compare effects and layout with the file's."""
    effects, layout = made
    given = json.loads(path.read_text())
    if given.get("schema") != SCHEMA:
        return f"schema {short(given.get('schema'))}"
    if len(effects) != len(given["effects"]):
        return f"{len(effects)} effects for {len(given['effects'])}"
    for effect, entry in zip(effects, given["effects"], strict=True):
        if effect.word != entry["class"]:
            return f"{effect.word} for {entry['class']}"
        stated = {
            name: value["value"] if isinstance(value, dict) else value
            for name, value in entry.get("parameters", {}).items()
        }
        # A parameter that the file lacks has its neutral value.
        usual = {p.name: p.neutral for p in effect.parameters}
        if dict(effect.values) != {**usual, **stated}:
            return f"{effect.word}: {short(dict(effect.values))} for {short(stated)}"
        for p in effect.parameters:
            low, high = p.widest
            if not low <= effect[p.name] * (1 - 1e-8) and not low <= effect[p.name] <= high:
                return (
                    f"{effect.word}: {p.name} = {effect[p.name]} is outside {low} to {high}"
                )
    if given.get("layout") is None:
        return "" if layout is None else "a layout"
    stated = given["layout"]
    if extra := set(stated) - {
        "shape",
        "segments",
        "reference",
        "pixel",
        "thickness",
        "front",
    }:
        return f"layout: {short(extra)} were ignored"
    if list(layout.shape) != stated["shape"] or not all(_whole(n) for n in layout.shape):
        return f"layout: shape = {layout.shape} for {short(stated['shape'])}"
    for name in ("pixel", "thickness", "front"):
        value = stated.get(name, USUAL[name])
        right = isinstance(value, int | float) and not isinstance(value, bool) and value > 0
        if not (right and math.isfinite(value) and close(getattr(layout, name), value)):
            return f"layout: {name} = {getattr(layout, name)} for {short(value)}"
    segments = stated.get("segments") or [[0, 0, layout.shape[1], layout.shape[0]]]
    own = [[s.x, s.y, s.columns, s.rows] for s in layout.segments]
    if own != [s[:4] for s in segments] or not all(_whole(n) for s in own for n in s):
        return f"layout: segments {short(own)} for {short(segments)}"
    if any(s.columns < 1 or s.rows < 1 for s in layout.segments):
        return f"layout: segments without pixels, {short(own)}"
    wavelength, bias, celsius = stated.get("reference", (620.0, -50.0, -100.15))
    kelvin = celsius + 273.15
    if not all(
        type(a) is float
        and math.isfinite(a)
        and close(a, b, 1e-6)
        and not isinstance(c, str | bool)
        for a, b, c in zip(
            layout.reference,
            (wavelength, bias, kelvin),
            (wavelength, bias, celsius),
            strict=True,
        )
    ):
        return (
            f"layout: reference = {layout.reference} for {short(stated.get('reference'))}"
        )
    if wavelength <= 0 or kelvin <= 0:
        return f"layout: reference = {short(stated['reference'])} was accepted"
    return ""


def _whole(number: Any) -> bool:
    """Whether a number of pixels is an int of at most a million."""
    return type(number) is int and number <= 1_000_000


def _range(low: float, high: float, *, whole: bool = False, none: bool = False) -> Any:
    """Make a test whether a value is a number within limits, or its text as GalSim takes one."""

    def right(value: Any, own: Any) -> bool:
        if value is None:
            return none
        if isinstance(value, bool):
            value = int(value)
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            return False
        fits = low <= number <= high and (not whole or number.is_integer())
        return fits and (own == number or close(own, number))

    return right


def _flag(value: Any, own: Any) -> bool:
    number = isinstance(value, int | float | bool | np.number)
    return number and value in (0, 1) and own is bool(value)


def _words(*allowed: str) -> Any:
    return lambda value, own: value in allowed and own == value


ARGUMENTS: dict[str, tuple[float | str | bool | None, Any]] = {
    "strength": (1.1, _range(-1e6, 1e6)), "diffusion_factor": (0.9, _range(0.0, 1e6)),
    "qdist": (2, _range(0, 4, whole=True, none=True)), "nrecalc": (5000.0, _range(0.0, math.inf)),
    "transpose": (True, _flag), "charge_response": (False, _flag), "background": (False, _flag),
    "depth": (False, _flag), "red": ("kept", _words("lost", "kept")), "predict": (False, _flag),
    "absorption": ("galsim", _words("law", "galsim")),
    "temperature": (170.0, _range(77.0, 400.0, none=True)),
    "diffusion": (1.5, lambda v, o: (v == o and v in ("device", "einstein"))
                  or _range(0.0, 1e6)(v, o)),
    "full_well": (1e5, lambda v, o: v is None or (_range(0.0, math.inf)(v, o) and o > 0)),
    "beyond": ("error", _words("hold", "error")), "conversion_depth": (2.0, _range(0.0, 100.0)),
    "surroundings": ("mirrored", lambda v, o: (v == o and v in ("none", "mirrored"))
                     or _range(0.0, 1e9)(v, o)),
    "threads": (1, _range(1, math.inf, whole=True, none=True)),
}  # fmt: skip
"""Arguments of the sensor: a valid value, and a test of a value and the attribute."""

COMMON = (
    "strength", "diffusion_factor", "qdist", "nrecalc", "transpose", "surroundings", "threads",
)  # fmt: skip
"""Arguments that both sensors have."""

MORE = (
    galsim.PositionD(0, 0), galsim.GaussianDeviate(3), np.arange(3), np.float64(2.0), object(), len,
    "1" * 5000, "\n", np.array(5), np.float32(np.nan), np.int64(1), [1], {"value": 1},
)  # fmt: skip
"""Objects in place of an argument."""

CONDITIONS = (
    "level",
    "number",
    "wavelength",
    "back_bias",
    "temperature",
    "seconds",
    "kind",
    "hour",
)


class Arguments(Door):
    """Arguments of the sensors; the attribute must be the value, within its limits."""

    name = "arguments"

    def make(self, rng: np.random.Generator) -> Case:
        """Give one argument another value, or one that does not exist."""
        if rng.random() < 0.2:
            return self._conditions(rng)
        kind = pick(rng, (BrighterFatterSensor, BrighterFatterSensor, SiliconSensor))
        name = pick(rng, list(ARGUMENTS) if kind is BrighterFatterSensor else COMMON)
        valid, right = ARGUMENTS[name]
        number = isinstance(valid, float | int) and not isinstance(valid, bool)
        way = rng.random()
        if number and way < 0.3:
            value: Any = valid * float(pick(rng, (-1, 0.5, 2, 1.01, 1e3, 1e-3, 1e9)))
        elif way < 0.7:
            value = pick(rng, VALUES)
        else:
            value = pick(rng, MORE)

        def judge(made: Any) -> str:
            own = getattr(made, name)
            return "" if right(value, own) else f"{name} = {short(own)} for {short(value)}"

        what = "galsim's" if kind is SiliconSensor else "own"
        return Case(
            f"{what} sensor: {name} = {short(value)}",
            lambda: kind(**{name: value}),
            judge,
            (name,),
        )

    def _conditions(self, rng: np.random.Generator) -> Case:
        """Give one of the conditions another value."""
        name = pick(rng, CONDITIONS)
        value = pick(rng, (*VALUES, *MORE, 620.0, -50.0, "flat", "spot"))
        given = {name: value}
        from bfsensor.sensor.effect_reports import make_conditions

        def judge(made: Any) -> str:
            if name == "kind":
                right = made == given and value in ("bias", "dark", "flat", "spot")
            else:
                number = not isinstance(value, str | bool) and name in CONDITIONS[:-2]
                right = number and close(made[name], value) and math.isfinite(made[name])
                if name in ("wavelength", "seconds"):
                    right = right and made[name] >= 0
                if name == "temperature":
                    right = right and made[name] > -273.15
            return "" if right else f"{name} = {short(made.get(name))} for {short(value)}"

        return Case(
            f"conditions: {name} = {short(value)}",
            lambda: make_conditions(given),
            judge,
            (name,),
        )
