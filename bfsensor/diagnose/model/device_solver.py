"""Solutions of a device with one quantity at another value, as changes of a baseline's shifts."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter, parameter_value
from bfsensor.device.quantities import quantities
from bfsensor.diagnose.model.cached_response import SPAN, Walk, walk
from bfsensor.diagnose.model.mesh_error import in_proportion
from bfsensor.effects.changed_device import Key, Moved, QuadraticTemplate
from bfsensor.errors import DeviceError
from bfsensor.response.edge_response import LEVEL
from bfsensor.typing import Edges

BACKGROUNDS = LEVEL - SPAN, LEVEL, LEVEL + SPAN
"""Backgrounds of solutions whose change with level is needed [e-]."""

COARSE, FINE = 16, 32
"""Mesh cells per pixel of derivatives and changes that candidates are found by, and of nominal devices
and of changes that are named.  Measured on itl_sta3800c, 3 um thicker, both on one mesh: the change of
a_00 is 7 %, of a_01 9 % smaller on 16 cells than on 32, and 2 and 1 % on 24.  Twice as many cells take
three times as long."""

PHASES = "gates.collecting_phases"
"""Number of gates under which a pixel collects, which no device file states an uncertainty of."""

OXIDES = "gates.gate_oxide", "gates.field_oxide"
"""Quantities of which no device has the second below the first."""

NONE: Mapping[str, float] = MappingProxyType({})
"""No quantities."""

HUGE, HALVINGS = 1e3, 30
"""Multiple of the nominal value that stands for an open end of a quantity's range, and steps that find
the end.  Derived: the steps leave 1e-6 of the nominal value; twice the multiple takes one more."""


@dataclass(frozen=True)
class DeviceSolver:
    """Solves a device with one quantity changed, at the conditions of a baseline.

    Attributes
    ----------
    text : str
        Device of the baseline, mirror-symmetric, as a device file.
    biases, wavelengths : tuple of float
        Back biases [V] and wavelengths [nm] of the baseline.
    levels, depths : bool
        Whether the baseline's shifts change with the level of flats, and with the wavelength.
    keep : Path, optional
        Folder where solutions are cached.

    Examples
    --------
    >>> solver = DeviceSolver(Device.load("itl_sta3800c").to_toml(), (-50.0,), (620.0,), True, True)
    >>> solver.unit("silicon.background_doping"), solver.range("gates.collecting_phases")
    ('cm-3', (1.0, 2.0))
    """

    text: str
    biases: tuple[float, ...]
    wavelengths: tuple[float, ...]
    levels: bool
    depths: bool
    keep: Path | None = None

    @cached_property
    def device(self) -> Device:
        """Device of the baseline."""
        return Device.from_toml(self.text)

    def unit(self, name: str) -> str:
        """Unit of a quantity in device files."""
        return "gates" if name == PHASES else quantities(self.device)[name].unit

    def nominal(self, name: str) -> float:
        """Nominal value of a quantity, in the unit of device files."""
        if name == PHASES:
            return float(self.device.gates.collecting_phases)
        return quantities(self.device)[name].number(parameter_value(self.device, name))

    def range(self, name: str) -> tuple[float, float]:
        """Least and greatest value that a quantity can have, in the unit of device files.

        Others keep their nominal values, which limits it too: a taper ends within the pixel.
        """
        if name == PHASES:
            return 1.0, self.device.gates.phases - 1.0
        own = quantities(self.device)[name]
        return (
            self._possible(name, own.number(own.low)), self._possible(name, own.number(own.high))
        )  # fmt: skip

    def _possible(self, name: str, end: float) -> float:
        """Value nearest to an end of the range with which a device can be built.

        The end itself where the nominal value is such a limit, as of two oxides of one thickness: then
        other quantities have to change, too.
        """
        nominal = inner = self.nominal(name)
        reach = HUGE * max(abs(inner), 1.0)
        outer = float(np.clip(end, inner - reach, inner + reach))
        if self._built(name, outer):
            return end
        for _ in range(HALVINGS):
            middle = 0.5 * (inner + outer)
            if self._built(name, middle):
                inner = middle
            else:
                outer = middle
        return end if inner == nominal else inner

    def _built(self, name: str, value: float) -> bool:
        """Whether a device with a quantity at a value can be built, all others nominal."""
        by = (value - self.nominal(name)) / quantities(self.device)[name].number(1.0)
        try:
            change_parameter(self.device, name, by)
        except DeviceError:
            return False
        return True

    def device_at(
        self, name: str, value: float, bias: float, beside: Mapping[str, float] = NONE
    ) -> Device:
        """Device with a quantity at a value [unit of device files], at one of the back biases [V].

        ``beside`` are values of other quantities.

        Raises
        ------
        DeviceError
            There is no such device.
        """
        if name != PHASES:
            return self.device_with({**beside, name: value}, bias)
        here = self.device_with(beside, bias)
        gates = dataclasses.replace(here.gates, collecting_phases=round(value))
        return dataclasses.replace(here, gates=gates)

    def device_with(self, values: Mapping[str, float], bias: float) -> Device:
        """Device with several quantities at given values, at one of the back biases [V].

        Raises
        ------
        DeviceError
            There is no such device.
        """
        own = self.device.operating_point.back_bias
        here = change_parameter(self.device, "operating_point.back_bias", bias - own)
        known = quantities(self.device)
        values = self._with_oxides(values)
        for name, value in values.items():
            by = (value - self.nominal(name)) / known[name].number(1.0)
            here = change_parameter(here, name, by)
        return here

    def _with_oxides(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Values with a field oxide at least as thick as the gate oxide, in an order that devices allow.

        Of a sensor whose two oxides are one film a thicker gate oxide is a thicker field oxide, too.
        """
        if not {*OXIDES} & values.keys():
            return values
        gate, field = (values.get(name, self.nominal(name)) for name in OXIDES)
        rest = {n: v for n, v in values.items() if n not in OXIDES}
        both = dict(zip(OXIDES, (gate, max(gate, field)), strict=True))
        order = OXIDES if gate <= self.nominal(OXIDES[0]) else OXIDES[::-1]
        return {**{name: both[name] for name in order}, **rest}

    def moved(
        self,
        name: str,
        value: float,
        *,
        cells: int = COARSE,
        levels: bool = False,
        beside: Mapping[str, float] = NONE,
    ) -> Moved:
        """Change of the shifts from the nominal device by a quantity at another value.

        Parameters
        ----------
        name : str
            Dotted name of the quantity.
        value : float
            Its value, in the unit of device files.
        cells : int
            Mesh cells a pixel of the shifts' change.
        levels : bool
            Whether its dependence on the level is solved too, on :data:`COARSE` cells at the first
            back bias; at others it is in proportion to the change.
        beside : mapping of str to float
            Values of other quantities that are not nominal.

        Returns
        -------
        Moved
            At all conditions.

        Raises
        ------
        DeviceError, ConvergenceError
            There is no such device, or it could not be solved.
        """
        kelvin = self.device.operating_point.temperature
        edges: list[tuple[Key, Edges]] = []
        slopes: list[tuple[Key, Edges]] = []
        bends: list[tuple[Key, Edges]] = []
        for bias in self.biases:
            pair = (
                self.device_at(name, value, bias, beside),
                self.device_at(name, self.nominal(name), bias),
            )
            new, old = self._both(*pair, cells, (LEVEL,))
            for w, colour in self._colours():
                edges.append(
                    ((w, bias), less(new.edges(colour, kelvin), old.edges(colour, kelvin)))
                )
            if levels and self.levels and bias == self.biases[0]:
                new, old = self._both(*pair, COARSE, BACKGROUNDS)
                for w, colour in self._colours():
                    (s, b), (s0, b0) = new.bent(colour, kelvin), old.bent(colour, kelvin)
                    slopes.append(((w, bias), less(s, s0)))
                    bends.append(((w, bias), less(b, b0)))
        if slopes:
            slopes, bends = (_at_all(changes, edges) for changes in (slopes, bends))
        bent = QuadraticTemplate(LEVEL, tuple(slopes), tuple(bends)) if slopes else None
        return Moved(tuple(edges), bent=bent)

    def _colours(self) -> list[tuple[float, float | None]]:
        """Wavelengths, and what light of each is simulated by; None: it converts at the back."""
        return [(w, w if self.depths else None) for w in self.wavelengths]

    def changed(self, values: Mapping[str, float]) -> dict[Key, Edges]:
        """Change of the shifts by several quantities at given values, at all conditions.

        Raises
        ------
        DeviceError, ConvergenceError
            There is no such device, or it could not be solved.
        """
        kelvin = self.device.operating_point.temperature
        out = {}
        for bias in self.biases:
            pair = self.device_with(values, bias), self.device_with({}, bias)
            new, old = self._both(*pair, FINE, (LEVEL,))
            for w, colour in self._colours():
                out[w, bias] = less(new.edges(colour, kelvin), old.edges(colour, kelvin))
        return out

    def _both(
        self, new: Device, old: Device, cells: int, backgrounds: tuple[float, ...]
    ) -> tuple[Walk, Walk]:
        """Response of the changed and of the nominal device, on one mesh where it can be moved."""
        solve = partial(walk, cells=cells, backgrounds=backgrounds, keep=self.keep)
        plain = solve(old)
        if new.gates.collecting_phases != old.gates.collecting_phases:
            return solve(new), plain
        try:
            return solve(new, laid_for=old), plain
        except DeviceError:
            # Surfaces that change their order need another mesh, or there is no such device.
            return solve(new), plain


def _at_all(
    of_first: list[tuple[Key, Edges]], edges: list[tuple[Key, Edges]]
) -> list[tuple[Key, Edges]]:
    """Changes with level at all conditions of ``edges``, from those at the first back bias."""
    known, bias = dict(of_first), of_first[0][0][1]
    shifts = dict(edges)
    return [
        (key, in_proportion(known[key[0], bias], shifts[key[0], bias], there))
        for key, there in edges
    ]


def less(new: Edges, old: Edges, factor: float = 1.0) -> Edges:
    """Difference of two shifts, times a factor."""
    return factor * (new[0] - old[0]), factor * (new[1] - old[1])
