"""Summaries of devices and tables, as text for a terminal and as HTML for a notebook."""

from __future__ import annotations

import dataclasses
import html
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from bfsensor.device.parts import (
    BuriedChannel,
    ChannelStop,
    Edge,
    ElectronTransport,
    FittedCharge,
    GateStack,
    Implant,
    Material,
    OperatingPoint,
    Pixel,
    Provenance,
    Silicon,
    Well,
)
from bfsensor.device.written_units import from_internal
from bfsensor.units import to_celsius

MOST_LINES = 30
"""Largest number of lines of a summary; the rest is counted in its last line.

Chosen: a summary of twice as many would not fit a terminal's window."""

WIDTH = 88
"""Largest width of a line [characters].

Chosen for a terminal's window; at twice the width a device's summary has fewer, longer lines."""

Rows = Sequence[tuple[str, str]]
"""Rows of a summary: label and text."""


def format_summary(title: str, rows: Rows) -> str:
    """Write a title and rows below it, in at most :data:`MOST_LINES` lines."""
    column = max((len(label) for label, _ in rows), default=0) + 4
    lines = [title]
    for label, text in rows:
        first = f"  {label}".ljust(column)
        lines += textwrap.wrap(
            text, WIDTH, initial_indent=first, subsequent_indent=" " * column,
            break_on_hyphens=False, break_long_words=False,
        ) or [first.rstrip()]  # fmt: skip
    if len(lines) > MOST_LINES:
        lines[MOST_LINES - 1 :] = [f"  ... and {len(lines) - MOST_LINES + 1} lines more"]
    return "\n".join(lines)


def summary_to_html(title: str, rows: Rows) -> str:
    """Write a title and rows as an HTML table."""
    body = "".join(
        f'<tr><th style="text-align: left">{html.escape(label)}</th>'
        f'<td style="text-align: left">{html.escape(text)}</td></tr>'
        for label, text in rows
    )
    return f"<table><caption>{html.escape(title)}</caption>{body}</table>"


def device_title(name: str, silicon: Silicon, point: OperatingPoint) -> str:
    """Return a device's name with its thickness and voltages."""
    return (
        f"{name}, {silicon.thickness:g} um of silicon, back bias {point.back_bias:g} V, "
        f"gates {point.gate_low:g}/{point.gate_high:g} V"
    )


def device_rows(
    *,
    pixel: Pixel,
    material: Material,
    silicon: Silicon,
    gates: GateStack,
    channel: BuriedChannel,
    channel_stop: ChannelStop,
    operating_point: OperatingPoint,
    well: Well,
    transport: ElectronTransport,
    edge: Edge | None,
    image_charge: FittedCharge | None,
    provenance: Mapping[str, Provenance],
) -> list[tuple[str, str]]:
    """Return the rows of a device's summary, with the uncertainties that its file states."""

    def value(part: Any, key: str) -> str:
        """Write a quantity and its uncertainty, by the dotted name of the device file."""
        spec = {f.name: f for f in dataclasses.fields(part)}[key.rpartition(".")[2]]
        kind, unit = spec.metadata["kind"], spec.metadata["unit"]
        number = from_internal(getattr(part, spec.name), kind, unit)
        known = provenance.get(key)
        if known is None or known.uncertainty is None:
            return number
        plain, _, unit_text = number.partition(" ")
        error = from_internal(known.uncertainty, kind, unit).partition(" ")[0]
        return f"{plain} +- {error} {unit_text}".rstrip()

    def implants(parts: Iterable[Implant], where: str) -> list[str]:
        out = []
        for n, part in enumerate(parts):
            key = f"{where}.implant[{n}]"
            dose = f"{part.shape} implant of {value(part, f'{key}.dose')}"
            if part.shape == "box":
                out.append(f"{dose} down to {value(part, f'{key}.depth')}")
            else:
                peak, sigma = value(part, f"{key}.peak"), value(part, f"{key}.sigma")
                out.append(f"{dose}, peak at {peak}, sigma {sigma}")
        return out

    def surface(part: Any, where: str) -> list[str]:
        key = f"{where}.surface_charge"
        return [f"surface charge {value(part, key)}"] if part.surface_charge else []

    doping = value(silicon, "silicon.background_doping")
    kind = "donors" if silicon.background_doping > 0 else "acceptors"
    rows = [
        (
            "pixel",
            f"{pixel.pitch_x:g} um (x, serial) by {pixel.pitch_y:g} um (y, parallel)",
        ),
        ("thickness", value(silicon, "silicon.thickness")),
        ("doping", f"{doping} ({kind})" if silicon.background_doping else doping),
    ]
    if silicon.ripples:
        rows.append(("ripples", f"{len(silicon.ripples)} of the doping (tree rings)"))
    rows += [
        ("gates", f"{gates.phases} phases, {gates.collecting_phases} of them collecting"),
        (
            "oxides",
            f"gates {value(gates, 'gates.gate_oxide')}, channel stops "
            f"{value(gates, 'gates.field_oxide')}",
        ),
        (
            "channel",
            "; ".join(surface(channel, "channel") + implants(channel.implants, "channel"))
            or "no implant",
        ),
        (
            "channel stop",
            "; ".join([
                f"{value(channel_stop, 'channel_stop.width')} wide",
                *surface(channel_stop, "channel_stop"),
                *implants(channel_stop.implants, "channel_stop"),
            ]),
        ),
    ]  # fmt: skip
    if channel_stop.dots is not None:
        dots, where = channel_stop.dots, "channel_stop.dots"
        rows.append((
            "dots in it",
            "; ".join([
                f"{value(dots, f'{where}.height')} high",
                *surface(dots, where), *implants(dots.implants, where),
            ]),
        ))  # fmt: skip
    point = operating_point
    rows += [
        ("back bias", value(point, "operating_point.back_bias")),
        (
            "gates at",
            f"{value(point, 'operating_point.gate_low')} (low), "
            f"{value(point, 'operating_point.gate_high')} (high, collecting)",
        ),
        ("holes at", value(point, "operating_point.hole_quasi_fermi_level")),
        ("temperature", f"{point.temperature:g} K ({to_celsius(point.temperature):.0f} C)"),
        (
            "full well",
            "reached when the barrier along the column has fallen to "
            + value(well, "well.spill_barrier"),
        ),
        (
            "material",
            f"permittivity {material.permittivity_silicon:g} (silicon), "
            f"{material.permittivity_oxide:g} (oxide); band gap {material.band_gap:g} V",
        ),
    ]
    if transport.diffusion is not None:
        times = value(transport, "transport.diffusion")
        rows.append(("diffusion", f"{times} times the width by Einstein's relation"))
    if image_charge is not None:
        where, one = "image_charge", image_charge
        rows.append((
            "image charges",
            f"fitted to covariances, in place of what is solved: charge at "
            f"{value(one, f'{where}.charge_height')}, rows fixed below "
            f"{value(one, f'{where}.row_height')}, columns below "
            f"{value(one, f'{where}.column_height')}, half sides "
            f"{value(one, f'{where}.half_width_x')} (x) and {value(one, f'{where}.half_width_y')} "
            f"(y), drift field {value(one, f'{where}.drift_field_front')} at the gates, "
            f"{value(one, f'{where}.drift_field_back')} at the back",
        ))  # fmt: skip
    if edge is not None:
        widths = ", ".join(f"{strip.width:g} um" for strip in edge.strips)
        rows.append(("edge", f"along {edge.side}, strips of {widths}"))
    origins = Counter(known.origin for known in provenance.values() if known.origin)
    if origins:
        counted = [f"{number} {origin}" for origin, number in sorted(origins.items())]
        rows.append(("origins", f"{', '.join(counted)} (of the quantities that say so)"))
    return rows
