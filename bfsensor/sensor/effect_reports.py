"""Readers of a sensor's arguments ``effects``, ``layout`` and ``conditions``."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bfsensor.effects.effect import STAGES, Effect, Layout, Segment, Shot
from bfsensor.errors import EffectError, SensorError
from bfsensor.sensor.options import check_shape, shown, to_float
from bfsensor.text_files import one_line
from bfsensor.units import ZERO_CELSIUS, to_celsius, to_kelvin

SCHEMA = "bfsensor-diagnosis-1"
"""Schema of the report.json that ``bfsensor diagnose`` writes."""

STORED = STAGES[:4]
"""Stages that a sensor applies, by definition all before the readout electronics."""

_INTERNAL = ("type", "index_key", "rng_num", "rng_index_key")
"""Keys that GalSim's configuration adds to a dict."""

_LAYOUT = ("shape", "segments", "reference", "pixel", "thickness", "front")
_NUMBERS = tuple(n for n in Shot._fields if n != "kind")
_LOWEST = {"wavelength": 0.0, "seconds": 0.0, "temperature": -ZERO_CELSIUS}
"""Lowest wavelength [nm], exposure time [s] and temperature [C] of conditions, by definition."""

_KINDS = ("bias", "dark", "flat", "spot")


def read_effects(given: Any) -> tuple[tuple[Effect, ...], Mapping[str, Any] | None]:
    """Read the effects of a diagnosis for a sensor.

    Parameters
    ----------
    given : path-like, mapping, or sequence
        Path of a report.json; a mapping with its key 'effects'; or a list, of entries with 'class'
        and 'parameters' or of :class:`bfsensor.effects.effect.Effect` objects.

    Returns
    -------
    effects : tuple of Effect
        Effects in the order given.
    layout : mapping or None
        The report's 'layout'; None where it has none.

    Raises
    ------
    SensorError
        A file that is no report of this schema, an unknown class, or parameters that the class
        does not have; the message names file, entry and key.

    Examples
    --------
    >>> block = [{"class": "charge_loss", "parameters": {"q": {"value": 1e-7}}}]
    >>> effects, layout = read_effects({"effects": block})
    >>> effects[0].name, effects[0]["q"], layout
    ('charge_loss', 1e-07, None)
    """
    where, layout = "effects", None
    if isinstance(given, str | os.PathLike):
        where = os.fspath(given)
        given = _read_report(where)
        if given.get("schema") != SCHEMA:
            raise SensorError(
                f"{where}: schema = {given.get('schema')!r} must be {SCHEMA!r}, as in the "
                "report.json of bfsensor diagnose"
            )
    if isinstance(given, Mapping):
        if given.get("schema", SCHEMA) != SCHEMA:
            raise SensorError(f"{where}: schema = {given['schema']!r} must be {SCHEMA!r}")
        layout = given.get("layout")
        given = given.get("effects")
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise SensorError(
            f"{where}: effects must be a list of effects or of entries with 'class' and "
            f"'parameters', not {type(given).__name__}"
        )
    found = [
        entry if isinstance(entry, Effect) else _make(entry, f"{where}: effects[{n}]")
        for n, entry in enumerate(given)
    ]
    return tuple(found), layout


def _read_report(path: str) -> dict[str, Any]:
    """Read a report.json; anything but an object is refused."""
    try:
        report = json.loads(Path(path).read_text())
    except OSError as error:
        raise SensorError(
            f"effects: {path}: cannot be read: {error.strerror or error}"
        ) from None
    # Endless brackets leave no stack, whole numbers of thousands of digits are ValueErrors.
    except (ValueError, RecursionError) as error:
        raise SensorError(f"{path}: not a report.json: {one_line(error)}") from None
    if not isinstance(report, dict):
        raise SensorError(f"{path}: not a report.json: it holds no object")
    return report


def _make(entry: Any, where: str) -> Effect:
    """Make the effect of an entry; without a 'variant' the names of the parameters choose it."""
    # Not at the top: all classes and scipy's filters, which sensors without effects do not need.
    from bfsensor.effects.library import LIBRARY, make_effect

    if not isinstance(entry, Mapping) or not isinstance(entry.get("class"), str):
        raise SensorError(f"{where} must be an effect, or have a 'class', not {entry!r}")
    word = entry["class"]
    parameters = entry.get("parameters", {})
    if not isinstance(parameters, Mapping):
        raise SensorError(f"{where}: {word}: parameters must be an object with names")
    values = {}
    for name, given in parameters.items():
        value = given.get("value") if isinstance(given, Mapping) else given
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise SensorError(
                f"{where}: {word}: {name} = {given!r} has no number as 'value'"
            )
        values[name] = to_float(value)
    variant = entry.get("variant")
    if variant is None:
        own = [
            kind.variant for kind in LIBRARY
            if kind.word == word and {p.name for p in kind.parameters} == set(values)
        ]  # fmt: skip
        variant = own[0] if len(own) == 1 else ""
    try:
        effect = make_effect(word, values, variant)
    except EffectError as error:
        raise SensorError(f"{where}: {error}") from None
    for p in effect.parameters:
        low, high = p.widest
        # Reports hold numbers of 12 digits, also at the end of a range.
        more = 1e-9 * max(abs(low), abs(high))
        if not low - more <= effect[p.name] <= high + more:
            raise SensorError(
                f"{where}: {effect.name}: {p.name} = {effect[p.name]:g} must be from {low:g} to "
                f"{high:g}, the range of fits"
            )
    return effect


def write_entries(effects: Iterable[Effect]) -> list[dict[str, Any]]:
    """Return the entries of a report that :func:`read_effects` reads as these effects."""
    return [
        {
            "class": e.word,
            "variant": e.variant,
            "parameters": {n: {"value": v} for n, v in e.values.items()},
        }
        for e in effects
    ]


def make_layout(given: Any, usual: Mapping[str, Any]) -> Layout:
    """Make the layout of a sensor.

    Parameters
    ----------
    given : Layout or mapping
        'shape' (rows, columns) and any of 'segments', 'reference', 'pixel', 'thickness',
        'front', as in :class:`bfsensor.effects.effect.Layout`, except that the temperature of a
        mapping's 'reference' is in deg C.  Without segments one amplifier covers the sensor.
    usual : mapping
        Values for the keys that are not given, temperature in K.

    Returns
    -------
    Layout
        Temperature in K.

    Raises
    ------
    SensorError
        An unknown key, a value of another type, or segments outside the sensor.
    """
    if isinstance(given, Layout):
        return given
    if not isinstance(given, Mapping):
        raise SensorError(f"layout must have 'shape', not be {shown(given)}")
    values = {k: v for k, v in given.items() if k not in _INTERNAL}
    for name in values:
        if name not in _LAYOUT:
            raise SensorError(f"layout: {name!r} must be one of {', '.join(_LAYOUT)}")
    try:
        ny, nx = check_shape("layout: shape", values["shape"])
        segments = tuple(
            _whole(Segment(**s) if isinstance(s, Mapping) else Segment(*s))
            for s in values.get("segments") or ()
        )
        reference = tuple(_plain(n) for n in values.get("reference", usual["reference"]))
        pixel, thickness, front = (
            _plain(values.get(k, usual[k])) for k in ("pixel", "thickness", "front")
        )
    except SensorError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SensorError(f"layout = {shown(values)} is no layout: {error!r}") from None
    if "reference" in values and len(reference) == 3:
        reference = (*reference[:2], to_kelvin(reference[2]))
    if len(reference) != 3 or not (
        all(map(math.isfinite, reference)) and reference[0] > 0 and reference[2] > 0
    ):
        raise SensorError(
            f"layout: reference = {shown(values['reference'])} must be wavelength [nm], back bias [V] "
            "and temperature [C]"
        )
    for name, number in (("pixel", pixel), ("thickness", thickness), ("front", front)):
        if not 0 < number < math.inf:
            raise SensorError(
                f"layout: {name} = {shown(values[name])} must be a number above 0"
            )
    for s in segments:
        if s.x < 0 or s.y < 0 or s.x + s.columns > nx or s.y + s.rows > ny:
            raise SensorError(f"layout: {s} does not lie in {ny} rows x {nx} columns")
    return Layout(
        (ny, nx),
        segments or (Segment(0, 0, nx, ny),),
        reference=(reference[0], reference[1], reference[2]),
        pixel=pixel,
        thickness=thickness,
        front=front,
        absorption=usual.get("absorption", {}),
    )


def _plain(value: Any) -> float:
    """Number as a float; nan for anything else, also for texts."""
    return math.nan if isinstance(value, str) else to_float(value)


def _whole(segment: Segment) -> Segment:
    """Segment with whole numbers of pixels, of at least 1 column and row; refuse any other."""
    numbers = [_plain(n) for n in segment[:4]]
    if not all(n.is_integer() for n in numbers) or min(numbers[2:]) < 1:
        raise SensorError(
            f"layout: segment {shown(tuple(segment))} must be whole numbers: x, y, columns and rows, "
            "of these at least 1"
        )
    x, y, columns, rows = map(int, numbers)
    return segment._replace(x=x, y=y, columns=columns, rows=rows)


def make_conditions(given: Any) -> dict[str, Any]:
    """Check the conditions of exposures.

    Parameters
    ----------
    given : mapping, Shot or None
        Fields of :class:`bfsensor.effects.effect.Shot` by name; the temperature of a mapping is
        in deg C.

    Returns
    -------
    conditions : dict
        The fields that are given, temperature in deg C; empty for None.

    Raises
    ------
    SensorError
        An unknown name, or a value that is no number.
    """
    if given is None:
        return {}
    if isinstance(given, Shot):
        given = given._replace(temperature=to_celsius(given.temperature))
        given = {k: v for k, v in given._asdict().items() if v == v}
    if not isinstance(given, Mapping):
        raise SensorError(f"conditions must be names and values, not {shown(given)}")
    out: dict[str, Any] = {}
    for name, value in given.items():
        if name in _INTERNAL:
            continue
        number = math.nan if isinstance(value, bool | str) else to_float(value)
        if name == "kind" and isinstance(value, str) and value in _KINDS:
            out[name] = value
        elif (
            name in _NUMBERS
            and math.isfinite(number)
            and number >= _LOWEST.get(name, number)
            and (name != "number" or number.is_integer())
        ):
            out[name] = int(number) if name == "number" else number
        else:
            raise SensorError(
                f"conditions: {name} = {shown(value)} must be one of {', '.join(_NUMBERS)} with a "
                f"finite number, or kind with one of {', '.join(_KINDS)}"
            )
    return out
