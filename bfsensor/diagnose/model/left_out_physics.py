"""Physics that a device's simulation may leave out, as candidate effects from solutions with it.

Each candidate is one change of the device, or of the calculation of light and charge in it.  Its
template is the difference of the boundary shifts with and without the change, at every wavelength
and back bias of the baseline; ``strength`` 0 is the baseline, 1 the whole change.
"""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.parts import Edge, EdgeStrip
from bfsensor.diagnose.model.baseline import Baseline, Key
from bfsensor.diagnose.model.cached_response import Walk, walk
from bfsensor.diagnose.model.device_baseline import VOLTAGES, WARMER
from bfsensor.diagnose.model.device_solver import (
    BACKGROUNDS,
    COARSE,
    FINE,
    PHASES,
    DeviceSolver,
    less,
)
from bfsensor.effects.changed_device import Moved, QuadraticTemplate, Quantity, Solution
from bfsensor.effects.charge_diffusion import charge_diffusion
from bfsensor.effects.device_parameter import DeviceParameter
from bfsensor.effects.effect import Parameter
from bfsensor.effects.family import EffectFamily, TemplateFamily
from bfsensor.effects.quantum_yield import quantum_yield
from bfsensor.effects.simulated_physics import (
    BentResponse,
    DiffusionWidths,
    DopingRings,
    EdgeFieldLeftOut,
    FieldDiffusion,
    MovedEdges,
    Rim,
    Rings,
    SiliconPhysics,
    left_out,
    ring_parameters,
)
from bfsensor.errors import ConvergenceError, DeviceError
from bfsensor.response.edge_response import LEVEL
from bfsensor.response.light import conversion_weights
from bfsensor.simulate.edge_field import front_plane, solve_edge
from bfsensor.simulate.edge_shift import trace_edge
from bfsensor.typing import Edges, FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

CELLS = FINE
"""Mesh cells per pixel of templates with a strength. Measured (commit 45435d9): with 16, templates of
levels are off by more than 2 %, which an effect of 70 standard deviations turns into a mismatch outside
the library; with 8, the nearest areas are 5 to 10 % off."""

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


class Piece(NamedTuple):
    """Physics of a quantity that devices may lack.

    Attributes
    ----------
    variant : str
        Name of the piece in reports.
    quantity : str
        Dotted name of the quantity.
    step : float
        Change [unit of device files] of the solution that candidates begin from.
    source : str
        Publication of the physics, and of the size of the step.
    """

    variant: str
    quantity: str
    step: float
    source: str


PIECES = (
    Piece("free_holes", "operating_point.hole_quasi_fermi_level", 3.0,
          "Free holes in channel stops: Lage, Bradshaw & Tyson 2017, section 3; 3 V make a_10 of "
          "itl_sta3800c smaller by 35 %"),
    Piece("stop_diffusion", "channel_stop.side_diffusion", 1.1,
          "Implants of channel stops spread sideways: device file of itl_sta3800c, 1.1 um"),
    Piece("oxide_charge", "channel.surface_charge", 2e11,
          "Fixed charge at the interface of oxide and silicon, 1e10 to 1e12 a cm2: Sze & Ng 2007, "
          "Physics of Semiconductor Devices, section 4.3.2"),
)  # fmt: skip
"""Pieces that a quantity of the device describes; twice the step doubles the first change that is
solved for, and no fitted value, which is solved for again."""

WIDEST = 5.0
"""Largest plausible change of a quantity without a prior [steps of its piece].  Chosen: twice as large,
evidence for the piece falls by a factor of two."""

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
        Mesh cells per pixel of templates with a strength.
    keep : Path, optional
        Folder where solutions are cached.

    Returns
    -------
    tuple of type
        Quantities of :data:`PIECES`, and voltages, that are no parameters of the baseline, other
        numbers of collecting gates, change with level and conversion depth (each where the
        baseline lacks it), diffusion in the field and its growth with charge, photons that make two
        electrons, rings of the doping, field of the edge (where the device allows it); for
        ``dataclasses.replace(baseline, pieces=...)``.

    Notes
    -----
    Quantities are linear in their value until a diagnosis that names one solves the device there
    (:mod:`bfsensor.diagnose.explain.solved_again`).  Diffusion widens spots; its smoothing of
    the shifts is left out.  Rings and edge need a depleted device.
    """
    plain = dataclasses.replace(
        device, edge=None, silicon=dataclasses.replace(device.silicon, ripples=())
    )
    kelvin = device.operating_point.temperature
    colours = list(dict.fromkeys(w for w, _ in baseline.edges))
    biases = tuple(dict.fromkeys(b for _, b in baseline.edges))
    surface = len(colours) > 1 and all(
        np.array_equal(a, b)
        for bias in biases
        for a, b in zip(
            baseline.edges[min(colours), bias],
            baseline.edges[max(colours), bias],
            strict=True,
        )
    )
    seen = {w: None if surface else w for w in colours}
    bent = bool(baseline.slopes)
    solver = DeviceSolver(plain.to_toml(), biases, tuple(colours), bent, not surface, keep)
    here = {bias: solver.device_at(PHASES, solver.nominal(PHASES), bias) for bias in biases}
    found = [
        made
        for piece in PIECES
        if piece.quantity not in baseline.parameters
        for made in [_changed(solver, piece, min(cells, COARSE))]
        if made is not None
    ]
    found += _voltages(solver, baseline)
    found += _phases(solver)
    if not bent:
        found.append(_levels(here, seen, kelvin, cells, keep))
    if surface:
        found.append(_depths(here, colours, kelvin, cells, keep, bent))
    drifts = {bias: _drift(one) for bias, one in here.items()}
    widths = _diffusion_widths(drifts, colours, device)
    found.append(left_out(
        FieldDiffusion, "lateral_diffusion", "simulated", widths,
        "Einstein's relation integrated through the device's own field",
    ))  # fmt: skip
    # Electrons diffuse as the device's file says, which may exceed Einstein's relation.
    actual = tuple((key, plain.diffusion**2 * variance) for key, variance in widths.held)
    found += [charge_diffusion(widths._replace(held=actual))]
    found += [quantum_yield(widths._replace(held=actual))]
    found.append(_rings(drifts, colours, plain))
    # Devices that the solver of the edge's field refuses have no such candidate.
    with contextlib.suppress(DeviceError):
        found.append(_rim(device, here, colours))
    return tuple(found)


def _changed(solver: DeviceSolver, piece: Piece, cells: int) -> EffectFamily | None:
    """Candidate for a quantity without a prior; None for a device that cannot have it changed."""
    nominal, (low, high) = solver.nominal(piece.quantity), solver.range(piece.quantity)
    for value in (nominal + piece.step, nominal - piece.step):
        try:
            moved = solver.moved(piece.quantity, value, cells=cells)
        except (DeviceError, ConvergenceError):
            continue
        wide = WIDEST * piece.step
        ends = max(low, nominal - wide), min(high, nominal + wide)
        return _family(solver, piece, Solution(value, moved), ends)
    return None


def _voltages(solver: DeviceSolver, baseline: Baseline) -> list[EffectFamily]:
    """Candidates for voltages other than the device file states, by the baseline's derivatives."""
    found: list[EffectFamily] = []
    for name, typical in VOLTAGES.items():
        if name in baseline.parameters or name not in baseline.held.get(
            baseline.reference, {}
        ):
            continue
        slopes = tuple((key, baseline.derivative(name, key)) for key in baseline.edges)
        nominal, (low, high) = solver.nominal(name), solver.range(name)
        ends = max(low, nominal - WIDEST * typical), min(high, nominal + WIDEST * typical)
        value = Parameter(
            name,
            "V",
            *ends,
            neutral=nominal,
            law="flat",
            signed=True,
            amplitude=True,
            ends=ends,
        )
        found.append(TemplateFamily(
            SiliconPhysics, DeviceParameter.word, name, Quantity(name, nominal, typical, slopes),
            DeviceParameter.source, (value,),
        ))  # fmt: skip
    return found


def _phases(solver: DeviceSolver) -> list[EffectFamily]:
    """Candidates for charge that is stored under one gate fewer or more, a part of the time."""
    nominal, (low, high) = solver.nominal(PHASES), solver.range(PHASES)
    found: list[EffectFamily] = []
    for variant, value in (("fewer_gates", nominal - 1), ("more_gates", nominal + 1)):
        if not low <= value <= high:
            continue
        edges: list[tuple[Key, Edges]] = []
        biases = []
        for bias in solver.biases:
            # Where one back bias cannot be solved, templates are those of the nearest one.
            with contextlib.suppress(DeviceError, ConvergenceError):
                one = dataclasses.replace(solver, biases=(bias,))
                edges += one.moved(PHASES, value).edges
                biases.append(bias)
        if not edges:
            continue
        words = f"{value:g} collecting gates"
        if len(biases) < len(solver.biases):
            words += f", at {', '.join(f'{b:g} V' for b in biases)} alone"
        piece = Piece(variant, PHASES, 1.0, SOURCE.format(words))
        ends = min(value, nominal), max(value, nominal)
        found.append(_family(solver, piece, Solution(value, Moved(tuple(edges))), ends))
    return found


def _family(
    solver: DeviceSolver, piece: Piece, solved: Solution, ends: tuple[float, float]
) -> EffectFamily:
    """Family of effects by the value of a quantity, linear between nominal and solved value."""
    nominal = solver.nominal(piece.quantity)
    template = Quantity(piece.quantity, nominal, abs(solved.value - nominal), (), solved)
    value = Parameter(
        piece.quantity, solver.unit(piece.quantity), *ends, neutral=nominal, law="flat",
        signed=True, amplitude=True, ends=ends,
    )  # fmt: skip
    return TemplateFamily(
        SiliconPhysics, SiliconPhysics.word, piece.variant, template, piece.source, (value,)
    )


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
            edges.append(((w, bias), less(now, top)))
            warming.append(((w, bias), less(hot, now, 1 / WARMER)))
            there = _bent(walked, w, kelvin)
            if there is not None and above is not None:
                both = less(there[0], above[0]), less(there[1], above[1])
                levels.append(((w, bias), both))
    template = Moved(tuple(edges), tuple(warming), kelvin, _as_bent(levels))
    return left_out(
        MovedEdges, "bf_chromatic", "simulated", template,
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


def _diffusion_widths(
    drifts: dict[float, Drift], colours: list[float], device: Device
) -> DiffusionWidths:
    """Variance of diffusion in the empty device, by wavelength and back bias."""
    kelvin = device.operating_point.temperature
    area = device.pixel.pitch_x * device.pixel.pitch_y
    held = tuple(
        ((w, bias), _of_light(drift, drift.variance, w, kelvin) / area)
        for bias, drift in drifts.items() for w in colours
    )  # fmt: skip
    return DiffusionWidths(held, kelvin)


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
