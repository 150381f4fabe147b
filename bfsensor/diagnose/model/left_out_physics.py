"""Physics that a device's simulation may leave out, as candidate effects from solutions with it.

Each candidate is one change of the device, or of the calculation of light and charge in it.  Its
template is the difference of the boundary shifts with and without the change, at every wavelength
and back bias of the baseline; ``strength`` 0 is the baseline, 1 the whole change.
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
from bfsensor.effects.family import EffectFamily
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
from bfsensor.response.edge_response import LEVEL
from bfsensor.response.light import conversion_weights
from bfsensor.simulate.edge_field import front_plane, solve_edge
from bfsensor.simulate.edge_shift import trace_edge
from bfsensor.typing import Edges, FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

CELLS = FINE
"""Mesh cells per pixel of the templates' solutions, those of the device's own. Measured (commit
45435d9): with 16, templates of side diffusion and levels are off by more than 2 %, which an effect of
70 standard deviations turns into a mismatch outside the library; with 8, the nearest areas are 5 to
10 % off."""

BACKGROUNDS = LEVEL - SPAN, LEVEL, LEVEL + SPAN
"""Backgrounds of solutions whose change with level is needed [e-]."""

HOLES = 3.0
"""Rise of the quasi-Fermi level of the channel stops' holes at ``strength`` 1 [V]. Chosen: measured
on the ITL device (commit 45435d9), holes leave the barrier gates and a_10 falls by 35 %; twice as
large only halves the strength that is found, as long as the change is linear (at 5 V a_10 falls by 50
%)."""

SIDE = 1.1
"""Side diffusion of the channel stops at ``strength`` 1 [um].  Fitted value of the shipped
itl_sta3800c (its device.toml); twice as large only halves the strength that is found."""

RIPPLE = 0.01
"""Relative amplitude of the doping's ripple in the template of rings. Chosen: the displacements are
linear in it, so that twice as large only halves the strength that is found."""

PERIODS = np.geomspace(5.0, 200.0, 24)
"""Periods of ripples [pixel] at which displacements are calculated, 17 % apart; they are interpolated
between. Chosen: displacements vary smoothly with the period; steps twice as large quadruple the small
errors."""

GUARD = Edge("x", (EdgeStrip(50.0, 20.0, "none"), EdgeStrip(200.0)))
"""Edge of a device whose file describes none: a guard ring, 50 um wide at 20 V, and 200 um of bare
silicon. Chosen, to be derived: a usual layout; the strength that is found scales its
displacements."""

RIM = 40
"""Number of boundaries from the edge whose displacements are calculated.  Derived: a disturbance between
conducting planes decays as exp(-pi x / thickness), to 4e-6 over 400 um in 100 um of silicon; twice as
many change nothing."""

if TYPE_CHECKING:
    from bfsensor.sensor.drift_field import Drift

LEVEL_OF_HOLES = "operating_point.hole_quasi_fermi_level"
SPREAD_OF_STOPS = "channel_stop.side_diffusion"
"""Dotted names of the two quantities of a device that candidates change."""

SOURCE = "Differences of simulated tables with and without: {}"
"""Source of a candidate, as printed in reports."""


def physics_left_out(
    device: Device, baseline: Baseline, *, cells: int = CELLS, keep: Path | None = None
) -> tuple[EffectFamily, ...]:
    """Make candidate effects for physics that a device's baseline leaves out.

    Parameters
    ----------
    device : Device
        Device of the baseline, mirror-symmetric or with an edge.
    baseline : Baseline
        From :func:`~bfsensor.diagnose.model.device_baseline.baseline_of_device`.  Templates are made at
        its conditions; physics that it includes (levels, depths) is no candidate.
    cells : int
        Mesh cells per pixel.
    keep : Path, optional
        Folder where solutions are cached.

    Returns
    -------
    tuple of type
        Free holes, side diffusion of the stops, change with level and conversion depth (each where
        the baseline lacks it), diffusion in the field, rings of the doping, field of the edge
        (where the device allows it); for ``dataclasses.replace(baseline, pieces=...)``.

    Notes
    -----
    Changes are linear in the strength, and exact at 1.  Diffusion widens spots; its smoothing of
    the shifts is left out.  Rings and edge need a depleted device.
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
        """Differences of the shifts with a quantity raised, at every condition.

        The quantity is lowered instead, and the sign changed, where the raised device is refused.
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

    found: list[EffectFamily] = [
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
    # Devices that the solver of the edge's field refuses have no such candidate.
    with contextlib.suppress(DeviceError):
        found.append(_rim(device, here, list(colours)))
    return tuple(found)


def _less(new: Edges, old: Edges, sign: float = 1.0) -> Edges:
    return sign * (new[0] - old[0]), sign * (new[1] - old[1])


def _bent(walked: Walk, colour: float | None, kelvin: float) -> tuple[Edges, Edges] | None:
    """Change of the response with the level; None where it was calculated at one background."""
    return None if len(walked.backgrounds) == 1 else walked.bent(colour, kelvin)


def _as_bent(levels: list[tuple[Key, tuple[Edges, Edges]]]) -> QuadraticTemplate | None:
    """Derivatives by the level of all conditions as a template; None without any."""
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
) -> EffectFamily:
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
) -> EffectFamily:
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
    """Mean field above the conducting plane that represents the pixels."""
    # Imported here because the sensor package imports GalSim, which takes a second.
    from bfsensor.sensor.drift_field import solve_drift

    return solve_drift(
        device.to_toml(), device.operating_point.temperature, front_plane(device).height
    )


def _of_light(drift: Drift, values: FloatArray, wavelength: float, kelvin: float) -> float:
    """Mean of values by height, weighted by the fraction of light that converts there."""
    heights = drift.heights
    # Weights of values at these heights, linear between them.
    weights = conversion_weights(heights, wavelength, kelvin)
    return float(weights @ values)


def _diffusion(
    drifts: dict[float, Drift], colours: list[float], device: Device
) -> EffectFamily:
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
    r"""Calculate displacements by a ripple of the doping, against the height of conversion.

    A ripple :math:`\delta \cos k x` of the doping N between the plane that represents the
    pixels, at :math:`z_g`, and the back contact at L, both conducting, makes the potential

    .. math::
        \phi = \frac{\delta N}{\epsilon k^2} \left[ 1 -
        \frac{\sinh k(L-z) + \sinh k(z-z_g)}{\sinh k(L-z_g)} \right] \cos k x,

    and an electron on its way down moves sideways by :math:`\int E_x / E\, dz`.

    Parameters
    ----------
    device : Device
        Device, for doping, permittivity and pitch.
    drift : Drift
        Mean field of the device.
    front : float
        Height of the plane [um].
    periods : ndarray, shape (n,)
        Periods of the ripple [pixel].

    Returns
    -------
    shifts : ndarray, shape (n, heights)
        Amplitude of the displacement [pixel] by a relative ripple of :data:`RIPPLE`.
    """
    pitch = 0.5 * (device.pixel.pitch_x + device.pixel.pitch_y)
    z, field = drift.heights, drift.field
    k = 2 * np.pi / (periods[:, None] * pitch)
    high = z[-1]
    inside = z >= front
    # Ratios of sinh as exponentials, which do not overflow for large k.
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
) -> EffectFamily:
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


def _rim(device: Device, here: dict[float, Device], colours: list[float]) -> EffectFamily:
    kelvin = device.operating_point.temperature
    held = []
    for bias, one in here.items():
        depths, shifts = rim_shifts(dataclasses.replace(one, edge=device.edge or GUARD))
        for w in colours:
            weights = conversion_weights(depths, w, kelvin)
            held.append(((w, bias), weights @ shifts))
    return left_out(
        EdgeFieldLeftOut, "edge_rolloff", "simulated", Rim(tuple(held)),
        "Field of the device's edge, or of a guard ring at 20 V, field lines followed up",
    )  # fmt: skip


def rim_shifts(device: Device) -> tuple[FloatArray, FloatArray]:
    """Depths [um], and displacements inwards [pixel], shape (depths, n), near a device's edge."""
    field = solve_edge(device)
    high = float(field.z[-1])
    depths = np.array([field.front.height + 2.0, 20.0, 0.5 * high, 0.85 * high, high])
    return depths, trace_edge(field, depths).pixel_shifts[:, :RIM]
