"""A device as a baseline whose parameters float: our simulation run again at shifted values."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter, device_parameters, parameter_value
from bfsensor.diagnose.model.baseline import Baseline, Key
from bfsensor.diagnose.model.cached_response import SPAN, Walk, walk
from bfsensor.diagnose.model.table_baseline import WAVELENGTHS
from bfsensor.errors import DeviceError, DiagnosisError
from bfsensor.files import written_whole
from bfsensor.response.edge_response import LEVEL
from bfsensor.simulate.edge_field import front_plane
from bfsensor.typing import Edges
from bfsensor.units import to_celsius

CELLS, FINE = 16, 32
"""Cells a pixel of the tables whose differences are taken, and of the device's own, which has the
accuracy of shipped ones: a difference needs it less."""

TABLES = "nominal as shipped, differences at 16 cells, at every back bias, with levels"
"""How shifts are made: what was kept of others is not read again."""

STEP = 0.5
"""Shift of a parameter to either side [its uncertainty]."""

WARMER = 10.0
"""Between the temperatures whose difference tells how shifts change with it [K]."""

PARTS = ("levels", "depths")
"""What a baseline can be made without."""


def baseline_of_device(
    device: Device,
    *,
    parameters: Sequence[str] = (),
    back_biases: Sequence[float] = (),
    lacks: Sequence[str] = (),
    warming: bool = False,
    cells: int = FINE,
    keep: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Baseline:
    """Simulate the shifts of a device, and their change with its uncertain parameters.

    Parameters
    ----------
    device : Device
        Mirror-symmetric.
    parameters : sequence of str
        Which float, by their dotted names; ``('all',)`` for every quantity whose file states an
        uncertainty.
    back_biases : sequence of float
        Back biases to hold besides the device's own [V].
    lacks : sequence of str
        What is left out, as simpler simulations do, of :data:`PARTS`: 'levels', so that the
        response is the same at all levels; 'depths', so that all light converts at the back
        surface.
    warming : bool
        Whether shifts follow the temperature: absorption, and heat of the carriers.
    cells : int
        Of the device's own tables, a pixel.
    keep : Path, optional
        Folder where walks are kept (:func:`~bfsensor.diagnose.model.cached_response.walk`).
    progress : callable, optional
        Called with (walks made, walks in all).

    Returns
    -------
    Baseline
        Derivatives at every back bias and wavelength, from tables half an uncertainty to either
        side, or to the one side on which there is such a device.

    Raises
    ------
    DiagnosisError
        A parameter that the device does not have, or without uncertainty; names those that are.
        An unknown part to be left out.
    """
    known = device_parameters(device)
    chosen = list(known) if tuple(parameters) == ("all",) else list(parameters)
    for name in chosen:
        if name not in known:
            raise DiagnosisError(
                f"{device.name} states no uncertainty for {name!r}; it does for {', '.join(known)}"
            )
    for part in lacks:
        if part not in PARTS:
            raise DiagnosisError(
                f"lacks = {part!r} must be one of {', '.join(PARTS)}; what else a device lacks is "
                "for its file to say"
            )
    own = float(device.operating_point.back_bias)
    biases = [
        own,
        *(b for b in dict.fromkeys(map(float, back_biases)) if abs(b - own) > 0.5),
    ]
    total, done = len(biases) * (1 + warming + 2 * len(chosen)), 0

    def walked(changed: Device, cells: int, levels: Sequence[float] = (LEVEL,)) -> Walk:
        nonlocal done
        found = walk(changed, cells=cells, backgrounds=levels, keep=keep)
        done += 1
        if progress is not None:
            progress(done, total)
        return found

    kelvin = device.operating_point.temperature
    backgrounds = (LEVEL,) if "levels" in lacks else (LEVEL - SPAN, LEVEL, LEVEL + SPAN)
    colours = {w: None if "depths" in lacks else w for w in WAVELENGTHS}
    held: dict[Key, dict[str, Edges]] = {}
    edges: dict[Key, Edges] = {}
    slopes: dict[Key, Edges] = {}
    bends: dict[Key, Edges] = {}
    warmer: dict[Key, Edges] = {}
    for bias in biases:
        here = change_parameter(device, "operating_point.back_bias", bias - own)
        found = walked(here, cells, backgrounds)
        sides = {name: _sides(here, name, known[name], walked) for name in chosen}
        if warming:
            hot = change_parameter(here, "operating_point.temperature", WARMER)
            warm, cold = walked(hot, CELLS), walk(here, cells=CELLS, keep=keep)
        for wavelength, colour in colours.items():
            key = wavelength, bias
            edges[key] = found.edges(colour, kelvin)
            if "levels" not in lacks:
                slopes[key], bends[key] = found.bent(colour, kelvin)
            held[key] = {
                name: _slope(up.edges(colour, kelvin), down.edges(colour, kelvin), apart)
                for name, (up, down, apart) in sides.items()
            }
            if warming:
                warmer[key] = _slope(
                    warm.edges(colour, kelvin + WARMER), cold.edges(colour, kelvin), WARMER
                )
    reference = 620.0, own
    return Baseline(
        device.name, edges, held[reference], {n: known[n] for n in chosen}, reference,
        nominal={n: parameter_value(device, n) for n in chosen}, held=held, slopes=slopes,
        bends=bends, level=LEVEL if slopes else 0.0, spots_bend=bool(slopes), warming=warmer,
        temperature=kelvin, card=_card(device),
    )  # fmt: skip


def _sides(
    device: Device, name: str, spread: float, walked: Callable[..., Walk]
) -> tuple[Walk, Walk, float]:
    """Walks with a quantity higher and lower, and how far apart they are."""
    sides: dict[float, Walk] = {}
    refused = ""
    for by in (STEP * spread, -STEP * spread):
        try:
            sides[by] = walked(change_parameter(device, name, by), CELLS)
        except DeviceError as error:
            # At the end of what can be, such as oxides of equal thickness: from one side.
            refused = str(error)
    if not sides:
        raise DiagnosisError(f"{device.name}: {name!r} cannot float: {refused}")
    if len(sides) == 1:
        sides[0.0] = walked(device, CELLS)
    (high, up), (low, down) = sorted(sides.items(), key=lambda s: -s[0])
    return up, down, high - low


def _slope(up: Edges, down: Edges, apart: float) -> Edges:
    return (up[0] - down[0]) / apart, (up[1] - down[1]) / apart


def _card(device: Device) -> dict[str, float]:
    """What a card says of a device: pitch and thickness [um], voltage of the front [V]."""
    return {
        "pixel": 0.5 * (device.pixel.pitch_x + device.pixel.pitch_y),
        "thickness": device.silicon.thickness,
        "front": front_plane(device).potential,
    }


def write_edges(baseline: Baseline, path: str | os.PathLike[str]) -> None:
    """Write a baseline's shifts, derivatives and spreads as :func:`read_edges` reads them.

    The spread goes into the same file: it is its own device card.
    """

    def lists(pair: Edges, names: tuple[str, str]) -> dict[str, list]:
        return {n: np.asarray(a).tolist() for n, a in zip(names, pair, strict=True)}

    changes = "dkx", "dky"
    # The reference's first.
    ordered = {baseline.reference: baseline.derivatives, **baseline.held}
    text = {
        "note": "edge displacements per electron of a device, right / upper edge; spreads included",
        "conditions": {
            f"{w:g}_{b:g}": lists(pair, ("kx", "ky"))
            for (w, b), pair in baseline.edges.items()
        },
        **{
            f"derivatives_{w:g}_{b:g}".replace("-", "m"): {
                name: lists(pair, changes) for name, pair in of_key.items()
            }
            for (w, b), of_key in ordered.items()
        },
        **{
            word: {f"{w:g}_{b:g}": lists(pair, changes) for (w, b), pair in given.items()}
            for word, given in (
                ("slopes", baseline.slopes), ("bends", baseline.bends),
                ("warming", baseline.warming),
            )
        },
        "level": baseline.level,
        "spots_bend": baseline.spots_bend,
        "temperature": to_celsius(baseline.temperature) if baseline.warming else None,
        "spread_1sigma": dict(baseline.spread),
        "nominal": dict(baseline.nominal),
        "card": dict(baseline.card),
    }  # fmt: skip
    with written_whole(Path(path), DiagnosisError) as beside:
        Path(beside).write_text(json.dumps(text))
