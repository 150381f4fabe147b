"""What a device's simulation may leave out, as candidates: the road walked again with it.

Each piece is one change of the device, or of how light and charge are followed in it; the
difference of the tables with and without is its template, at every light and back bias that the
baseline holds.  ``strength`` 1 is all of it, 0 the baseline as it is.
"""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.device.parts import Edge, EdgeStrip
from bfsensor.diagnose.model.baseline import Baseline, Key
from bfsensor.diagnose.model.cached_response import SPAN, Walk, walk
from bfsensor.diagnose.model.device_baseline import FINE, WARMER
from bfsensor.effects.effect import Effect
from bfsensor.effects.simulated_physics import (
    BentResponse,
    DiffusionWidths,
    DopingRings,
    EdgeFieldLeftOut,
    FieldDiffusion,
    Moved,
    MovedEdges,
    QuadraticTemplate,
    Rim,
    Rings,
    left_out,
    ring_parameters,
)
from bfsensor.errors import DeviceError
from bfsensor.response.edge_response import LEVEL, conversion_weights
from bfsensor.simulate.edge_field import front_plane, solve_edge
from bfsensor.simulate.edge_shift import trace_edge
from bfsensor.typing import Edges, FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

CELLS = FINE
"""Of the meshes of templates, a pixel: as fine as the device's own tables.  From 16 cells templates of
side diffusion and levels left more than 2 % of themselves, which at 70 standard deviations is
said to be outside the library; at 8 cells the nearest areas are 5 to 10 % off."""

BACKGROUNDS = LEVEL - SPAN, LEVEL, LEVEL + SPAN

HOLES = 3.0
"""Rise of the quasi-Fermi level of the stops' holes that is all of the piece [V]: 3 V below 0 V,
holes of the ITL device leave the barrier gates and a_10 is 35 % smaller; at 5 V it is 50 %."""

SIDE = 1.1
"""Side diffusion of the stops that is all of the piece [um]: that of the published ITL device."""

RIPPLE = 0.01
"""Relative amplitude of the doping's ripple of which the rings' template is."""

PERIODS = np.geomspace(5.0, 200.0, 24)
"""Of ripples [pixel] at which displacements are held; between them they go smoothly."""

GUARD = Edge("x", (EdgeStrip(50.0, 20.0, "none"), EdgeStrip(200.0)))
"""Where a device's file says nothing of its edge: a guard ring at 20 V and free silicon beyond."""

RIM = 40
"""Boundaries from the edge of which displacements are held."""

if TYPE_CHECKING:
    from bfsensor.sensor.drift_field import Drift

LEVEL_OF_HOLES = "operating_point.hole_quasi_fermi_level"
SPREAD_OF_STOPS = "channel_stop.side_diffusion"

SOURCE = "Differences of our own tables with and without: {}"


def physics_left_out(
    device: Device, baseline: Baseline, *, cells: int = CELLS, keep: Path | None = None
) -> tuple[type[Effect], ...]:
    """Make the candidates for what a device's baseline leaves out.

    Parameters
    ----------
    device : Device
        That the baseline was made of, mirror-symmetric or with an edge.
    baseline : Baseline
        From :func:`~bfsensor.diagnose.model.device_baseline.baseline_of_device`: its conditions are
        those of the templates; what it already holds (levels, depths) is no candidate.
    cells : int
        Of the meshes, a pixel.
    keep : Path, optional
        Folder where walks are kept.

    Returns
    -------
    tuple of type
        Free holes, side diffusion of the stops, response by level (where the baseline has
        none), conversion depth (where it has none), diffusion in the field, rings of the
        doping, field of the edge; for ``dataclasses.replace(baseline, pieces=...)``.

    Notes
    -----
    Straight in their strength, which at 1 is exact.  Diffusion widens spots; that it smooths
    the shifts themselves is left out.  Rings and edge need a depleted device.
    """
    plain = dataclasses.replace(
        device, edge=None, silicon=dataclasses.replace(device.silicon, ripples=())
    )
    own = baseline.reference[1]
    kelvin = device.operating_point.temperature
    colours = dict.fromkeys(w for w, _ in baseline.edges)
    surface = len(colours) > 1 and all(
        np.array_equal(a, b)
        for bias in dict.fromkeys(b for _, b in baseline.edges)
        for a, b in zip(
            baseline.edges[min(colours), bias],
            baseline.edges[max(colours), bias],
            strict=True,
        )
    )
    here = {
        bias: change_parameter(plain, "operating_point.back_bias", bias - own)
        for bias in dict.fromkeys(b for _, b in baseline.edges)
    }
    seen = {w: None if surface else w for w in colours}

    bent = bool(baseline.slopes)

    def walked(one: Device) -> Walk:
        return walk(
            one, cells=cells, backgrounds=BACKGROUNDS if bent else (LEVEL,), keep=keep
        )

    def changed(quantity: str, by: float) -> dict[float, Walk]:
        return {b: walked(change_parameter(one, quantity, by)) for b, one in here.items()}

    def differences(quantity: str, all_of_it: float) -> Moved:
        """Of the shifts, with so much more of a quantity, at every condition.

        Or with so much less, and turned round, where a device cannot have more of it.
        """
        less = {b: walked(one) for b, one in here.items()}
        sign = 1.0
        try:
            more = changed(quantity, all_of_it)
        except DeviceError:
            sign, more = -1.0, changed(quantity, -all_of_it)
        edges: list[tuple[Key, Edges]] = []
        levels: list[tuple[Key, tuple[Edges, Edges]]] = []
        for bias in here:
            for w, colour in seen.items():
                (new, high), (old, low) = (
                    (d[bias].edges(colour, kelvin), _bent(d[bias], colour, kelvin))
                    for d in (more, less)
                )
                edges.append(((w, bias), _less(new, old, sign)))
                if high is not None and low is not None:
                    both = _less(high[0], low[0], sign), _less(high[1], low[1], sign)
                    levels.append(((w, bias), both))
        return Moved(tuple(edges), bent=_as_bent(levels))

    found: list[type[Effect]] = [
        left_out(
            MovedEdges, "free_holes", "", differences(LEVEL_OF_HOLES, HOLES),
            SOURCE.format(f"quasi-Fermi level of the stops' holes {HOLES:g} V higher"),
        ),
        left_out(
            MovedEdges, "stop_diffusion", "", differences(SPREAD_OF_STOPS, SIDE),
            SOURCE.format(f"side diffusion of the channel stops {SIDE:g} um more"),
        ),
    ]  # fmt: skip
    if not baseline.slopes:
        found.append(_levels(here, seen, kelvin, cells, keep))
    if surface:
        found.append(_depths(here, list(colours), kelvin, cells, keep, bent))
    drifts = {bias: _drift(one) for bias, one in here.items()}
    found.append(_diffusion(drifts, list(colours), device))
    found.append(_rings(drifts, list(colours), plain))
    # Of a device that the edge's field cannot hold there is no such candidate.
    with contextlib.suppress(DeviceError):
        found.append(_rim(device, here, list(colours)))
    return tuple(found)


def _less(new: Edges, old: Edges, sign: float = 1.0) -> Edges:
    return sign * (new[0] - old[0]), sign * (new[1] - old[1])


def _bent(walked: Walk, colour: float | None, kelvin: float) -> tuple[Edges, Edges] | None:
    """Change with the level, where it was walked."""
    return None if len(walked.backgrounds) == 1 else walked.bent(colour, kelvin)


def _as_bent(levels: list[tuple[Key, tuple[Edges, Edges]]]) -> QuadraticTemplate | None:
    """Slopes and bends of all conditions; None of none."""
    if not levels:
        return None
    slopes, bends = (tuple((k, pair[n]) for k, pair in levels) for n in range(2))
    return QuadraticTemplate(LEVEL, slopes, bends)


def _levels(
    here: dict[float, Device],
    seen: dict[float, float | None],
    kelvin: float,
    cells: int,
    keep: Path | None,
) -> type[Effect]:
    levels: list[tuple[Key, tuple[Edges, Edges]]] = []
    for bias, one in here.items():
        walked = walk(one, cells=cells, backgrounds=BACKGROUNDS, keep=keep)
        levels += [((w, bias), walked.bent(colour, kelvin)) for w, colour in seen.items()]
    return left_out(
        BentResponse, "bf_nonlinear", "simulated", _as_bent(levels),
        SOURCE.format("response at three backgrounds"),
    )  # fmt: skip


def _depths(
    here: dict[float, Device],
    colours: list[float],
    kelvin: float,
    cells: int,
    keep: Path | None,
    bent: bool,
) -> type[Effect]:
    edges: list[tuple[Key, Edges]] = []
    warming: list[tuple[Key, Edges]] = []
    levels: list[tuple[Key, tuple[Edges, Edges]]] = []
    for bias, one in here.items():
        levels_too = BACKGROUNDS if bent else (LEVEL,)
        walked = walk(one, cells=cells, backgrounds=levels_too, keep=keep)
        top, above = walked.edges(None, kelvin), _bent(walked, None, kelvin)
        for w in colours:
            now, hot = walked.edges(w, kelvin), walked.edges(w, kelvin + WARMER)
            edges.append(((w, bias), _less(now, top)))
            warming.append(((w, bias), _less(hot, now, 1 / WARMER)))
            there = _bent(walked, w, kelvin)
            if there is not None and above is not None:
                both = _less(there[0], above[0]), _less(there[1], above[1])
                levels.append(((w, bias), both))
    told = Moved(tuple(edges), tuple(warming), kelvin, _as_bent(levels))
    return left_out(
        MovedEdges, "bf_chromatic", "simulated", told,
        SOURCE.format("light converts where it is absorbed, not at the back surface"),
    )  # fmt: skip


def _drift(device: Device) -> Drift:
    """The mean field above the plane that stands for the pixels."""
    # Sensors import GalSim, which takes a second.
    from bfsensor.sensor.drift_field import solve_drift

    return solve_drift(
        device.to_toml(), device.operating_point.temperature, front_plane(device).height
    )


def _of_light(drift: Drift, values: FloatArray, wavelength: float, kelvin: float) -> float:
    """Mean of what depends on the height of conversion, over where light converts."""
    heights = drift.heights
    # At the heights themselves; linear between.
    weights = conversion_weights(heights, float(heights[-1]), wavelength, kelvin)
    return float(weights @ values)


def _diffusion(
    drifts: dict[float, Drift], colours: list[float], device: Device
) -> type[Effect]:
    kelvin = device.operating_point.temperature
    area = device.pixel.pitch_x * device.pixel.pitch_y
    held = tuple(
        ((w, bias), _of_light(drift, drift.variance, w, kelvin) / area)
        for bias, drift in drifts.items() for w in colours
    )  # fmt: skip
    return left_out(
        FieldDiffusion, "lateral_diffusion", "simulated", DiffusionWidths(held, kelvin),
        "Einstein's relation integrated through the device's own field",
    )  # fmt: skip


def ring_shifts(
    device: Device, drift: Drift, front: float, periods: FloatArray
) -> FloatArray:
    r"""Displacements by a ripple of the doping, against the height of conversion.

    A ripple :math:`\delta \cos k x` of the doping N between the plane that stands for the
    pixels, at :math:`z_g`, and the back contact at L, both conducting, makes

    .. math::
        \phi = \frac{\delta N}{\epsilon k^2} \left[ 1 -
        \frac{\sinh k(L-z) + \sinh k(z-z_g)}{\sinh k(L-z_g)} \right] \cos k x,

    and an electron on its way down moves sideways by :math:`\int E_x / E\, dz`.

    Parameters
    ----------
    device : Device
        For doping, permittivity and pitch.
    drift : Drift
        Its mean field.
    front : float
        Height of the plane [um].
    periods : ndarray, shape (n,)
        [pixel].

    Returns
    -------
    shifts : ndarray, shape (n, heights)
        Amplitude [pixel], of :data:`RIPPLE`.
    """
    pitch = 0.5 * (device.pixel.pitch_x + device.pixel.pitch_y)
    z, field = drift.heights, drift.field
    k = 2 * np.pi / (periods[:, None] * pitch)
    high = z[-1]
    inside = z >= front
    # sinh of far apart places, without overflow.
    up, down, whole = high - z, z - front, high - front
    scale = 1 - np.exp(-2 * k * whole)
    one = np.exp(-k * (whole - up)) * (1 - np.exp(-2 * k * up))
    two = np.exp(-k * (whole - down)) * (1 - np.exp(-2 * k * down))
    density = RIPPLE * abs(device.silicon.background_doping)
    permittivity = device.material.permittivity_silicon * VACUUM_PERMITTIVITY
    across = density / (permittivity * k) * (1 - (one + two) / scale)
    pull = np.where(inside, across / np.where(inside, field, 1.0), 0.0)
    step = z[1] - z[0]
    total = np.cumsum(0.5 * step * (pull[:, 1:] + pull[:, :-1]), axis=1)
    return np.concatenate([np.zeros((len(periods), 1)), total], axis=1) / pitch


def _rings(
    drifts: dict[float, Drift], colours: list[float], device: Device
) -> type[Effect]:
    kelvin = device.operating_point.temperature
    held = []
    for bias, drift in drifts.items():
        shifts = ring_shifts(device, drift, front_plane(device).height, PERIODS)
        for w in colours:
            size = np.array([_of_light(drift, s, w, kelvin) for s in shifts])
            held.append(((w, bias), size))
    told = Rings(PERIODS, tuple(held))
    usual = float(np.interp(30.0, PERIODS, held[0][1]))
    return left_out(
        DopingRings, "tree_rings", "simulated", told,
        f"Ripple of {RIPPLE:g} of the doping in the slab above the pixels, drift in its field",
        ring_parameters(usual),
    )  # fmt: skip


def _rim(device: Device, here: dict[float, Device], colours: list[float]) -> type[Effect]:
    kelvin = device.operating_point.temperature
    held = []
    for bias, one in here.items():
        depths, shifts = rim_shifts(dataclasses.replace(one, edge=device.edge or GUARD))
        for w in colours:
            weights = conversion_weights(depths, float(depths[-1]), w, kelvin)
            held.append(((w, bias), weights @ shifts))
    return left_out(
        EdgeFieldLeftOut, "edge_rolloff", "simulated", Rim(tuple(held)),
        "Field of the device's edge, or of a guard ring at 20 V, field lines followed up",
    )  # fmt: skip


def rim_shifts(device: Device) -> tuple[FloatArray, FloatArray]:
    """Depths [um] and displacements inwards [pixel], shape (depths, n), of a device's edge."""
    field = solve_edge(device)
    high = float(field.z[-1])
    depths = np.array([field.front.height + 2.0, 20.0, 0.5 * high, 0.85 * high, high])
    return depths, trace_edge(field, depths).pixel_shifts[:, :RIM]
