r"""Full-depletion voltage and depletion depth of a device, estimated without solving it.

Above the implants of the front the mean potential of a uniform array obeys
:math:`\epsilon \phi'' = -N`, with N the background doping (acceptors negative).  Let
:math:`V_0` be its value at the height :math:`z_0` where the implants end.  The field that drives
electrons to the gates vanishes at the back contact (acceptors) or at :math:`z_0` (donors) when
the back bias is

.. math:: V_{fd} = V_0 - \frac{|N|\, (T - z_0)^2}{2 \epsilon},

the full-depletion voltage; a lower (more negative) bias depletes all of the silicon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.surfaces import Surfaces
from bfsensor.device.written_units import from_internal
from bfsensor.errors import DeviceError, TableError
from bfsensor.typing import FloatArray
from bfsensor.units import VACUUM_PERMITTIVITY

if TYPE_CHECKING:
    from bfsensor.device.device import Device
    from bfsensor.device.parts import BuriedChannel, ChannelStop, ChannelStopDots, Implant

_COLUMNS = 32
"""Columns of a pixel in x and in y.

Chosen while looking at the Poisson solver's voltages of 31 variants of the built-in devices:
it has not converged.  With 64 the voltage of the built-in devices falls by 0.1 to 0.6 V, and
the estimate takes some 40 times as long."""

_HOLES = 1e5
"""Density of holes in undepleted acceptors [1/um^3].

Chosen, of the order of the acceptors' peak density in channel stops (5e4 in itl_sta3800c).  The
holes' potential falls
by kT ln 2 = 0.01 V at 173 K with twice as many, the voltage of the built-in devices by as
much at most."""

_END_SIGMA = 1.5
"""End of a Gaussian implant [sigma beyond its peak], to which holes fill the channel stops.

Chosen while looking at the Poisson solver's voltages of 31 variants of the built-in devices.
Beyond it lies the last 7 % of the dose, which is taken as depleted.  At 1 the voltage of the
built-in devices rises by 0.2 to 0.3 V, at 2 it falls by 0.2 to 0.3 V, at 3 by 0.5 to 0.8 V."""


@dataclass(frozen=True)
class Depletion:
    """Full-depletion voltage of a device, and the silicon that its own back bias depletes.

    Attributes
    ----------
    full_depletion_voltage : float
        Back bias at and below which all of the silicon is depleted [V].
    depth : float
        Thickness of the depleted silicon between the end of the implants and the back [um].
    lowest, highest : float
        Heights above the gates between which the silicon is depleted [um]: from 0 for acceptors,
        up to the back for donors.
    front_potential : float
        Mean potential [V] at the end of the implants when all of the silicon is just depleted.
    """

    full_depletion_voltage: float
    depth: float
    lowest: float
    highest: float
    front_potential: float


def find_depletion(device: Device) -> Depletion:
    r"""Estimate full-depletion voltage and depletion depth without solving the device.

    .. math::
        V_{fd} = V_0 - \frac{|N|\, (T - z_0)^2}{2 \epsilon}, \qquad
        w = \sqrt{\frac{2 \epsilon\, (V_0 - V_b)}{|N|}} \le T - z_0 .

    The depleted part begins at the end of the implants for acceptors (the back stays neutral)
    and at the back contact for donors (the front does).  Gates and channel contribute through
    :math:`V_0`; voltages are signed as in device files, so that a device is fully depleted
    where its back bias is at or below :math:`V_{fd}`.

    Parameters
    ----------
    device : Device
        Any.  Pixels are taken as empty; edge strips and ripples of the doping are ignored.

    Returns
    -------
    Depletion
        Voltage and depths; within 1 V of the Poisson solver for the devices of the notes.

    Notes
    -----
    :math:`V_0` is the mean over the columns of a pixel, each a capacitor of oxide and silicon:

    .. math::
        V = V_g + \frac{t_{ox}}{\epsilon_{ox}} \Big(\sum_i Q_i + Q_{bulk}\Big)
            + \sum_i \frac{Q_i d_i}{\epsilon} + \frac{N s\, (L - s / 2)}{\epsilon},

    with gate voltage, oxide, doses :math:`Q_i` (donors positive, charge at the interface
    included) of mean depth :math:`d_i`, the thickness s of the column's silicon below
    :math:`z_0`, and the thickness L of the silicon whose charge ends at the gate: for acceptors
    all of it, for donors s.  Neither the surface nor a column falls below
    :math:`\phi_h - kT \ln (p / n_i)`, where free holes hold it; columns that would (channel
    stops) stay at that potential.  The others exchange charge through the field between them.
    A Fourier component of wavenumber k of their potentials draws the charge density
    :math:`\epsilon k` from the half-space above :math:`z_0` and :math:`\epsilon k^2 h / 3` from
    the layer of height h below it.

    For the built-in devices (-2.6 to -14.2 V), and for variants at 200 um, at twice the doping
    and with gates 4 V higher, the voltage lies within 1 V of the back bias at which the Poisson
    solver's field vanishes at the back contact (``tests/device/test_depletion.py``).  That is no
    independent check: two constants were chosen while looking at such devices.  Without channel
    stops and holes the formula is exact.  It was not tried with stops wider than the channels or
    implants deeper than a third of the pitch.

    Stored charge lowers :math:`V_0`, and the device then needs a more negative back bias: by the
    Poisson solver 0.5 V (itl_sta3800c) and 1.1 V (e2v_ccd250) more with 1e5 e- in every pixel,
    in proportion to the charge.  Whether the back bias keeps the holes of the channel stops in
    them is not checked here; the solver refuses devices where it does not.

    References
    ----------
    Sze & Ng 2007, Physics of Semiconductor Devices, 3rd ed., section 2.2, for the depletion width
    of uniform doping; Holland et al. 2003, IEEE Trans. Electron Devices 50, 225, for thick CCDs
    that a back bias depletes.  The columns, their holes and the field between them are in
    neither: they are this package's estimate, compared only with its Poisson solver.

    Examples
    --------
    >>> from bfsensor import Device
    >>> found = find_depletion(Device.load("e2v_ccd250"))
    >>> bool(-15 < found.full_depletion_voltage < -13), found.highest
    (True, 100.0)
    """
    thickness, doping = device.silicon.thickness, device.silicon.background_doping
    permittivity = device.material.permittivity_silicon * VACUUM_PERMITTIVITY
    low = _implant_end(device)
    bulk = thickness - low
    front = _front_potential(device, low)
    curvature = abs(doping) / (2 * permittivity)
    voltage = front - curvature * bulk**2
    drop = max(front - device.operating_point.back_bias, 0.0)
    depth = bulk
    if device.operating_point.back_bias > voltage:
        depth = float(np.sqrt(drop / curvature)) if curvature else 0.0
    lowest, highest = 0.0, thickness
    if depth < bulk and doping <= 0:
        highest = low + depth
    elif depth < bulk:
        lowest = thickness - depth
    return Depletion(voltage, depth, lowest, highest, front)


def check_depleted(device: Device, depths: Sequence[float] = ()) -> None:
    """Refuse a device that its back bias does not fully deplete.

    The check precedes solutions that take seconds to minutes, and takes 13 to 45 ms of CPU time
    for the built-in devices.

    Parameters
    ----------
    device : Device
        Any.
    depths : sequence of float
        Conversion depths that were asked for [um above the gates].

    Raises
    ------
    TableError
        One of the depths lies in undepleted silicon, where no field drives electrons to the gates.
    DeviceError
        Other silicon is not depleted.  Both messages name the back bias, the full-depletion
        voltage, the thickness and the doping.
    """
    found = find_depletion(device)
    if device.operating_point.back_bias <= found.full_depletion_voltage:
        return
    reason = _reason(device, found)
    for depth in depths:
        if not found.lowest <= depth <= found.highest:
            raise TableError(
                f"depth = {depth:g} um lies in undepleted silicon of {device.name}: {reason}"
            )
    raise DeviceError(f"{device.name}: {reason}")


def _reason(device: Device, found: Depletion) -> str:
    """Say which silicon a back bias above the full-depletion voltage leaves undepleted."""
    silicon = device.silicon
    if silicon.background_doping <= 0:
        where = f"above {found.highest:.3g} um"
    else:
        where = f"below {found.lowest:.3g} um"
    # 1 to 2 V below the estimate, whose error is about 1 V: the solver then accepts it too.
    wanted = np.floor(found.full_depletion_voltage) - 1
    doping = from_internal(float(f"{silicon.background_doping:.3g}"), "density", "cm-3")
    return (
        f"back_bias = '{device.operating_point.back_bias:g} V' does not deplete the silicon "
        f"{where}: thickness = '{silicon.thickness:g} um' with background_doping = '{doping}' "
        f"is fully depleted at about {found.full_depletion_voltage:.1f} V (give back_bias = "
        f"'{wanted:g} V' or lower, or less thickness or background_doping)"
    )


def _implant_end(device: Device) -> float:
    """Height above the gates where the implants of the stops, or else of the channel, end [um]."""
    surfaces, stop = Surfaces.of(device), device.channel_stop
    dots = () if stop.dots is None else stop.dots.implants
    stops, height = (*stop.implants, *dots), surfaces.silicon_stop
    if not stops:
        stops, height = device.channel.implants, surfaces.silicon_channel
    return height + max(
        (
            min(implant.reach, (implant.peak or 0.0) + _END_SIGMA * (implant.sigma or 0.0))
            if implant.shape == "gaussian"
            else implant.reach
            for implant in stops
        ),
        default=0.0,
    )


def _moments(implants: Sequence[Implant]) -> tuple[float, float]:
    """Dose [e/um^2] of implants and its moment about the surface [e/um]."""
    moment = 0.0
    # The cumulative dose exists in closed form and ends where the implant is cut; the density
    # would have to be integrated across that step.
    for implant in implants:
        depth = np.linspace(0.0, implant.reach, 401)
        # int z dQ = Q z - int Q dz
        passed = implant.cumulative(depth)
        inside = 0.5 * (passed[1:] + passed[:-1]) @ np.diff(depth)
        moment += float(implant.dose * depth[-1] - inside)
    return sum(implant.dose for implant in implants), moment


def _front_potential(device: Device, low: float) -> float:
    """Mean potential [V] at the height where the implants end, with the bulk just depleted."""
    material, doping = device.material, device.silicon.background_doping
    silicon = material.permittivity_silicon * VACUUM_PERMITTIVITY
    oxide = material.permittivity_oxide * VACUUM_PERMITTIVITY
    columns = _PixelColumns.of(device)
    below = np.maximum(low - columns.surface, 0.0)
    held = device.silicon.thickness - columns.surface if doping <= 0 else below
    point = device.operating_point
    heat = material.thermal_voltage(point.temperature)
    floor = point.hole_quasi_fermi_level - heat * np.log(
        _HOLES / material.intrinsic_density(point.temperature)
    )
    across_oxide = columns.oxide / oxide
    surface = columns.gate + across_oxide * (columns.dose + doping * held)
    across_oxide = np.where(surface < floor, 0.0, across_oxide)
    potential = (
        np.maximum(surface, floor)
        + columns.moment / silicon
        + doping * below * (held - below / 2) / silicon
    )
    # Holes fill implanted acceptors up to their end; elsewhere they lie at the surface only.
    filled = (potential <= floor) & (columns.moment < 0)
    potential = np.where(filled, floor, potential)
    resistance = across_oxide + below / silicon
    # Holes at a surface without implants hold their column as well.
    held_fast = filled | (resistance <= 0)
    return float(_share(potential, held_fast, resistance, silicon, device).mean())


@dataclass(frozen=True)
class _PixelColumns:
    """Columns of a pixel, arrays ``[y, x]``.

    Gate voltage [V], oxide thickness and height of the silicon surface [um], dose [e/um^2] and
    its moment about the surface [e/um].
    """

    gate: FloatArray
    oxide: FloatArray
    surface: FloatArray
    dose: FloatArray
    moment: FloatArray

    @classmethod
    def of(cls, device: Device) -> _PixelColumns:
        """Cut a pixel into columns, its stop at x = 0."""
        surfaces, stop, pixel = Surfaces.of(device), device.channel_stop, device.pixel
        middles = (np.arange(_COLUMNS) + 0.5) / _COLUMNS
        x, y = middles[None] * pixel.pitch_x, middles[:, None] * pixel.pitch_y
        distance = np.minimum(x, pixel.pitch_x - x)
        in_stop = 1.0 - surfaces.ramp(distance, surfaces.side_diffusion)
        in_channel = (surfaces.ramp(distance, surfaces.taper) >= 1.0).astype(float)
        parts: list[tuple[BuriedChannel | ChannelStop | ChannelStopDots, FloatArray]] = [
            (device.channel, in_channel), (stop, in_stop),
        ]  # fmt: skip
        if stop.dots is not None:
            in_dot = np.abs(y - stop.dots.centre) < stop.dots.height / 2
            parts.append((stop.dots, in_stop * in_dot))
        dose = np.zeros((_COLUMNS, _COLUMNS))
        moment = np.zeros_like(dose)
        for doped, share in parts:
            own, about = _moments(doped.implants)
            dose += (own + doped.surface_charge) * share
            moment += about * share
        collecting = np.abs(y - pixel.pitch_y / 2) < max(
            device.gates.edges_y(pixel.pitch_y)
        )
        point = device.operating_point
        whole = np.ones_like(dose)
        surface = surfaces.silicon(distance)
        return cls(
            np.where(collecting, point.gate_high, point.gate_low) * whole,
            (surface - surfaces.gate(distance)) * whole, surface * whole, dose, moment,
        )  # fmt: skip


def _share(
    potential: FloatArray,
    fixed: NDArray[np.bool_],
    resistance: FloatArray,
    permittivity: float,
    device: Device,
) -> FloatArray:
    """Potential [V] of every column with the field between columns; ``fixed`` ones keep theirs."""
    free = ~fixed
    # Equal columns exchange no charge.
    if not fixed.any() and np.ptp(potential) < 1e-6:
        return potential
    layer = float(resistance.mean()) * permittivity
    kx, ky = (
        2 * np.pi * np.fft.fftfreq(_COLUMNS, pitch / _COLUMNS)
        for pitch in (device.pixel.pitch_x, device.pixel.pitch_y)
    )
    k = np.hypot(kx[None], ky[:, None])
    coupling = np.fft.ifft2(permittivity * (k + layer / 3 * k**2)).real
    rows, cols = np.nonzero(free)
    all_rows, all_cols = np.indices(free.shape).reshape(2, -1)
    # Negative differences index the periodic pixel from its other end.
    links = coupling[rows[:, None] - all_rows, cols[:, None] - all_cols]
    to_gate = 1.0 / resistance[free]
    matrix = links[:, free.ravel()] + np.diag(to_gate)
    known = links[:, fixed.ravel()] @ potential[fixed]
    out = potential.copy()
    out[free] = np.linalg.solve(matrix, to_gate * potential[free] - known)
    return out
