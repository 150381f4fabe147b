"""Quantities of a device by dotted name: value, unit, allowed range, and prior in a fit."""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any, NamedTuple

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.parameters import UNUSED
from bfsensor.device.parts import Provenance
from bfsensor.device.written_units import INTERNAL, to_internal
from bfsensor.errors import DeviceError, FitError

DIFFUSION = "transport.diffusion"
"""Name of the width of the diffusion over that by Einstein's relation, which moves no pixel boundary
and is a free parameter also of a device whose file does not state it."""

DIFFUSION_SPREAD = 0.5
"""Spread of the prior of that ratio, about 1, where the device file states none.

Chosen: the published simulations have 2.12, which is 2.2 spreads above Einstein's 1; with twice
the spread the prior would hold the ratio half as strongly."""


ABSORPTION = "light.absorption_length"
"""Name of the length in which light is absorbed over that of silicon at its wavelength: a free parameter
of recordings that state a wavelength, which no device file states."""

ABSORPTION_SPREAD = 0.1
"""Spread of the prior of that ratio, about 1.

Chosen: at 173 K the length grows by 1.4 % per nm at 910 nm and 1.7 % at 935 nm, so that it is meant for
wavelengths known to 6 or 7 nm; with twice the spread the prior would hold the ratio half as strongly."""

OFF_DEVICE = (DIFFUSION, ABSORPTION)
"""Free parameters of a fit that move no pixel boundary and are no quantity of a device file that does
not state them."""


class Quantity(NamedTuple):
    """One quantity of a device and the range that it may have.

    Attributes
    ----------
    value : float
        Its value [internal unit].
    kind : str
        A key of :data:`bfsensor.device.written_units.INTERNAL`.
    unit : str
        Unit in which device files write it.
    low, high : float
        Bounds [internal unit]; a dose or density that is not 0 also keeps its sign.

    Examples
    --------
    >>> Quantity(100.0, "length", "um", 5.0, 1e3).number(100.0)
    100.0
    """

    value: float
    kind: str
    unit: str
    low: float
    high: float

    def text(self, value: float, digits: int = 4) -> str:
        """Write a value [internal unit] in the unit of device files, rounded to some digits.

        Examples
        --------
        >>> Quantity(100.0, "length", "um", 5.0, 1e3).text(101.23456)
        '101.2 um'
        """
        return f"{self.number(value):.{digits}g} {self.unit}".rstrip()

    def number(self, value: float) -> float:
        """Convert a value [internal unit] to the unit of device files."""
        return float(value * INTERNAL[self.kind].to(self.unit))


_EINSTEIN = Quantity(1.0, "number", "", 0.0, 10.0)
"""The ratio :data:`DIFFUSION` of a device that does not state it: Einstein's, by definition, and the
range of device files."""

_SILICON = Quantity(1.0, "number", "", 0.2, 5.0)
"""The ratio :data:`ABSORPTION`: that of silicon, by definition.  Chosen: beyond its range light is of
another colour; twice as far the same."""


@dataclasses.dataclass(frozen=True)
class Prior:
    """Prior of a free parameter of a fit: a Gaussian within bounds.

    Attributes
    ----------
    name : str
        Dotted name of the quantity.
    mean : float
        Mean [internal unit], within the bounds.
    spread : float
        Standard deviation [internal unit], above 0 and finite.
    low, high : float
        Bounds [internal unit]; beyond them no device can be built (thickness below its range, a
        dose of the other sign).

    Raises
    ------
    FitError
        The spread is not above 0, or the mean is outside the bounds.

    Examples
    --------
    >>> Prior("silicon.thickness", 100.0, 5.0, low=5.0, high=1000.0).spread
    5.0
    """

    name: str
    mean: float
    spread: float
    low: float = -np.inf
    high: float = np.inf

    def __post_init__(self) -> None:
        if not (np.isfinite(self.spread) and self.spread > 0):
            raise FitError(
                f"{self.name}: spread of the prior {self.spread!r} must be above 0"
            )
        if not self.low <= self.mean <= self.high:
            raise FitError(
                f"{self.name}: {self.mean:g} lies outside {self.low:g} to {self.high:g}"
            )


def quantities(device: Device) -> dict[str, Quantity]:
    """Collect every quantity of a device that has a value, by dotted name.

    Examples
    --------
    >>> quantities(Device.load("itl_sta3800c"))["channel_stop.implant[0].dose"].high
    -0.0
    """
    out: dict[str, Quantity] = {}
    for spec in dataclasses.fields(device):
        part = getattr(device, spec.name)
        if dataclasses.is_dataclass(part):
            _collect(part, spec.name, out)
    return out


def _collect(part: Any, path: str, out: dict[str, Quantity]) -> None:
    """Add the quantities of a part, and of the parts in it, to ``out``."""
    for spec in dataclasses.fields(part):
        value = getattr(part, spec.name)
        if isinstance(value, tuple):
            # A file's key names one implant, the Python field the tuple of all.
            for n, member in enumerate(value):
                _collect(member, f"{path}.{spec.name[:-1]}[{n}]", out)
        elif dataclasses.is_dataclass(value):
            _collect(value, f"{path}.{spec.name}", out)
        elif spec.metadata and value is not None:
            known = spec.metadata
            low = -np.inf if known["low"] is None else float(known["low"])
            high = np.inf if known["high"] is None else float(known["high"])
            if known["kind"] in ("dose", "density") and value:
                # A fit must not turn acceptors into donors.
                low, high = (max(low, 0.0), high) if value > 0 else (low, min(high, -0.0))
            out[f"{path}.{spec.name}"] = Quantity(
                float(value), known["kind"], known["unit"], low, high
            )


def describe(name: str) -> str:
    """Name a quantity in words, implants counted from 1.

    Examples
    --------
    >>> describe("silicon.background_doping"), describe("channel.implant[0].dose")
    ('background doping', 'channel implant 1 dose')
    """
    words = []
    for part in name.split("."):
        word, _, number = part.partition("[")
        words.append(word.replace("_", " "))
        if number:
            words[-1] += f" {int(number[:-1]) + 1}"
    if words[0] in ("silicon", "gates", "operating point", "well", "transport", "material"):
        words = words[1:]
    return " ".join(words).replace("quasi fermi", "quasi-Fermi")


def choose_priors(
    device: Device, asked: tuple[str, ...] = (), *, more: tuple[str, ...] = ()
) -> tuple[Prior, ...]:
    """Choose the free parameters of a fit and their priors.

    Parameters
    ----------
    device : Device
        Gives the means (its values) and the spreads (their uncertainties).
    asked : tuple of str
        Names of the free parameters, dotted or the end of a dotted name where that is unique.
        After a colon a name may state its spread, ``'back_bias:5 V'``, or mean and spread,
        ``'background_doping:-1.7e12 cm-3 +- 0.7e12 cm-3'``.  'all' stands for all quantities
        with an uncertainty except ``well.spill_barrier``, which only saturation depends on,
        ``transport.diffusion``, which only diffusion widths depend on, and
        ``light.absorption_length``, which only recordings of a stated wavelength depend on.
        If empty, the quantities with an uncertainty whose origin is 'guessed' are free.
    more : tuple of str
        Dotted names of further free parameters; those without an uncertainty are ignored.

    Returns
    -------
    priors : tuple of Prior
        At least one; means and spreads in internal units.

    Raises
    ------
    FitError
        No such quantity, a quantity without an uncertainty and without a stated spread, a
        spread that is not a quantity of that dimension, or nothing free.

    Examples
    --------
    >>> device = Device.load("itl_sta3800c")
    >>> [p.name for p in choose_priors(device)]
    ['operating_point.hole_quasi_fermi_level']
    >>> choose_priors(device, ("back_bias:5 V",))[0].spread
    5.0
    >>> choose_priors(device, ("thickness:98 um +- 2 um",))[0].mean
    98.0
    """
    known = {DIFFUSION: _EINSTEIN, ABSORPTION: _SILICON, **quantities(device)}
    spreads = {
        key: float(known_of.uncertainty)
        for key, known_of in device.provenance.items()
        if known_of.uncertainty
    }
    by_name = {DIFFUSION: DIFFUSION_SPREAD, ABSORPTION: ABSORPTION_SPREAD, **spreads}
    chosen: dict[str, float] = {}
    means: dict[str, float] = {}
    for text in asked:
        name, _, spread = text.partition(":")
        if name == "all":
            chosen |= {k: s for k, s in spreads.items() if k not in UNUSED}
            continue
        key = _resolve(name, known)
        if spread:
            kind = known[key].kind
            mean, sign, width = spread.partition("+-")
            try:
                if sign:
                    means[key], spread = to_internal(mean.strip(), kind), width.strip()
                chosen[key] = abs(to_internal(spread, kind))
            except DeviceError as error:
                raise FitError(f"--free {text}: {error}") from None
        elif key in by_name:
            chosen[key] = by_name[key]
        else:
            raise FitError(
                f"{device.name} states no uncertainty of {key}: give one, such as "
                f"{key}:{known[key].text(0.1 * abs(known[key].value) or 1.0)}"
            )
    if not asked:
        chosen = {
            k: s for k, s in spreads.items() if device.provenance[k].origin == "guessed"
        }
    for key in more:
        if key in by_name:
            chosen.setdefault(key, by_name[key])
    if not chosen:
        raise FitError(
            f"{device.name}: no quantity has the origin 'guessed', so nothing is free by default; "
            f"name the free parameters: all, or {', '.join(spreads)}"
        )
    return tuple(
        Prior(
            key, means.get(key, known[key].value), spread, known[key].low, known[key].high
        )
        for key, spread in chosen.items()
    )


def _resolve(name: str, known: dict[str, Quantity]) -> str:
    """Full dotted name of a quantity, given its end."""
    if name in known:
        return name
    ends = [key for key in known if key.endswith(f".{name}")]
    if len(ends) == 1:
        return ends[0]
    close = ends or difflib.get_close_matches(name, known, 3, 0.5)
    hint = f"; did you mean {' or '.join(close)}?" if close else ""
    raise FitError(f"no quantity {name!r} in the device{hint}")


def with_priors(device: Device, priors: tuple[Prior, ...]) -> Device:
    """Return a copy of the device with the priors' spreads as its uncertainties.

    Parameters
    ----------
    device : Device
        Any.
    priors : tuple of Prior
        From :func:`choose_priors`; those :data:`OFF_DEVICE`, which move no boundary, are left
        out.

    Returns
    -------
    Device
        Copy with the same values; uncertainties of quantities without a prior stay.

    Examples
    --------
    >>> device = Device.load("itl_sta3800c")
    >>> priors = choose_priors(device, ("back_bias:5 V",))
    >>> with_priors(device, priors).provenance["operating_point.back_bias"].uncertainty
    5.0
    """
    known = dict(device.provenance)
    for prior in priors:
        if prior.name not in OFF_DEVICE:
            old = known.get(prior.name, Provenance())
            known[prior.name] = dataclasses.replace(old, uncertainty=prior.spread)
    return dataclasses.replace(device, provenance=known)
