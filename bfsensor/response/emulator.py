r"""Emulator of the differential response of devices near a given one, without solving them.

It is of second order in the parameters about the device's values, in units of their spreads:

.. math::
    k(t) = k_0 + \sum_n g_n t_n + \tfrac12 \sum_{nm} H_{nm} t_n t_m

with the derivatives :math:`g` of the linearised solve, and :math:`H` from solutions one spread
to either side of every parameter, and derivatives there by those that change a_ij most, on one mesh
that moves with the device.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

import bfsensor
from bfsensor.device.condition import Condition
from bfsensor.device.depletion import check_depleted
from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter, device_parameters, parameter_value
from bfsensor.errors import ConvergenceError, DeviceError, FitError
from bfsensor.files import written_whole
from bfsensor.response.edge_response import (
    LEVEL,
    REFINE_Z,
    area_matrix,
    solve_response,
)
from bfsensor.response.emulator_nodes import Node, make_node, solve_nodes
from bfsensor.response.expansion import (
    EmulatorCheck,
    ExpandedResponse,
    Expansion,
    expand,
    steepest,
)
from bfsensor.response.light import conversion_depths, mixed
from bfsensor.typing import FloatArray

SCHEMA = "bfsensor emulator 1"
"""Name and version of the file format."""

VOLTAGES = ("back_bias", "gate_high", "gate_low", "temperature")
"""Quantities of the operating point that a condition may state."""

_BY_DEPTH = ("silicon.thickness", "operating_point.temperature")


DERIVED = 8
"""Number of parameters, those that change a_ij most, at whose neighbours the device is differentiated.

Measured at 24 random devices of ITL's 21 quantities: errors of a_00, a_01, a_10, a_11 of 0.2, 0.3, 0.4,
0.3 % (median) as with derivatives at all neighbours on both sides, in a third of the time; with 5 they
are 0.3, 0.3, 0.9, 0.5 %, and without second order 0.7, 0.5, 1.2, 0.8 %.  Twice as many gain nothing."""


class DeviceEmulator:
    """Emulated response of devices whose parameters differ a little from a given device's.

    It is made by :meth:`build` or :meth:`read`; the constructor takes finished expansions.

    Parameters
    ----------
    device : Device
        Device about which the response is expanded.
    spreads : mapping of str to float
        Standard deviations of the parameters by dotted name [internal units], above 0.
    level : float
        Electrons in every pixel about which the response is taken [e-].
    cells, refine_z : int
        Mesh cells per pixel, and number of times that the mesh in z is halved.
    expansions : mapping
        Expansion of the shifts by operating point, in the order of :data:`VOLTAGES`.

    Attributes
    ----------
    parameters : tuple of str
        Dotted names of the parameters.
    nominal, spread : ndarray, shape (p,)
        Values and standard deviations of the parameters [internal units].
    """

    def __init__(
        self,
        device: Device,
        spreads: Mapping[str, float],
        level: float,
        cells: int,
        refine_z: int,
        expansions: Mapping[tuple[float | None, ...], Expansion],
    ) -> None:
        self.device = device
        self.parameters = tuple(spreads)
        self.spread = np.array([spreads[n] for n in spreads], float)
        self.nominal = np.array([parameter_value(device, n) for n in spreads], float)
        self.level, self.cells, self.refine_z = float(level), int(cells), int(refine_z)
        self._expansions = dict(expansions)

    @classmethod
    def build(
        cls,
        device: Device,
        parameters: Sequence[str] | Mapping[str, float] | None = None,
        *,
        conditions: Sequence[Condition] = (Condition(),),
        level: float = LEVEL,
        cells: int = 16,
        refine_z: int = REFINE_Z,
        keep: Path | None = None,
        executor: Executor | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> DeviceEmulator:
        """Solve a device and its neighbours.

        Each condition takes one solution and up to two per parameter, one spread to either side.

        Parameters
        ----------
        device : Device
            Mirror-symmetric device.
        parameters : sequence of str, or mapping of str to float
            Names whose uncertainties the device states, or names with their spreads [internal
            units]; by default all quantities with stated uncertainty.
        conditions : sequence of Condition
            Operating points at which the response will be predicted.  Quantities that a condition
            does not state are the device's own; wavelengths need no solutions of their own.
        level : float
            Electrons in every pixel [e-], 0 or more.
        cells : int
            Mesh cells per pixel in x and in y, even, at least 8.
        refine_z : int
            Number of times that the mesh in z is halved, 0 or more.
        keep : Path, optional
            Folder in which finished solutions are kept; a later run reads them from there.
        executor : Executor, optional
            Executor that solves the devices; by default this process, one after another.
        progress : callable, optional
            Function that is called with (solutions made, solutions in all).

        Returns
        -------
        emulator : DeviceEmulator
            Emulator for the conditions.

        Raises
        ------
        FitError
            No condition is given, a parameter has no uncertainty, or there is no solution one
            spread to either side of it.
        DeviceError
            The device is not fully depleted at a condition.
        ConvergenceError
            There is no solution of the device itself at a condition.
        """
        spreads = _spreads(device, parameters)
        points = list(dict.fromkeys(_point(c) for c in conditions))
        if not points:
            raise FitError("an emulator needs a condition; Condition() is the device's own")
        for point in points:
            check_depleted(_operated(device, point))
        solve = partial(solve_nodes, keep=keep, progress=progress, executor=executor)
        heres = [_operated(device, point) for point in points]
        owned = [{n: s for n, s in spreads.items() if not _held(n, p)} for p in points]
        solved = solve(
            [
                make_node(here, here, level, cells, refine_z, own, (number, -1, 0))
                for number, (here, own) in enumerate(zip(heres, owned, strict=True))
            ]
        )
        nodes: list[Node] = []
        for number, (here, own) in enumerate(zip(heres, owned, strict=True)):
            units = np.array(list(own.values()))
            derived = set(steepest(*solved[number, -1, 0], units, DERIVED).tolist())
            for n, (name, spread) in enumerate(own.items()):
                for side in (1, -1):
                    try:
                        there = change_parameter(here, name, side * spread)
                    except DeviceError:
                        continue  # one side is enough for the second derivatives
                    by = own if n in derived else {}
                    derived.discard(n)  # derivatives on one side are enough as well
                    at = number, n, side
                    nodes.append(make_node(there, here, level, cells, refine_z, by, at))
        solved |= solve(nodes)
        expansions = {}
        for number, point in enumerate(points):
            free = [n for n, name in enumerate(spreads) if not _held(name, point)]
            names = [list(spreads)[n] for n in free]
            units = np.array([spreads[n] for n in names])
            of_point = {at[1:]: s for at, s in solved.items() if at[0] == number}
            expansions[point] = expand(of_point, np.array(free, int), names, units)
        return cls(device, spreads, level, cells, refine_z, expansions)

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """Operating points for which the emulator was built."""
        return tuple(
            Condition(back_bias=bias, gate_high=high, gate_low=low, temperature=kelvin)
            for bias, high, low, kelvin in self._expansions
        )

    def predict(
        self, values: ArrayLike, condition: Condition | None = None
    ) -> ExpandedResponse:
        """Predict the response at values of the parameters.

        Parameters
        ----------
        values : array_like, shape (p,)
            Values in the order of ``parameters`` [internal units], finite; the value of a
            parameter that the condition states is ignored.
        condition : Condition, optional
            Operating point for which the emulator was built, at any wavelength [nm]; without a
            wavelength all light converts at the back surface.  A filter is ignored.

        Returns
        -------
        response : ExpandedResponse
            Shifts of edges and area changes per electron, and their derivatives.

        Raises
        ------
        FitError
            A value is not a finite number, or the emulator was not built for the condition.
        """
        asked = condition if condition is not None else Condition()
        given = np.asarray(values, float)
        if given.shape != self.nominal.shape or not np.all(np.isfinite(given)):
            raise FitError(
                f"values = {given.tolist()} must be {len(self.nominal)} finite numbers: "
                f"{', '.join(self.parameters)}"
            )
        if asked.level not in (None, self.level):
            raise FitError(
                f"the emulator was built at a level of {self.level:g} e-, not {asked.level:g} e-"
            )
        found = self._expansions.get(_point(asked))
        if found is None:
            known = "; ".join(str(c) for c in self.conditions)
            raise FitError(f"the emulator was not built for {asked}; it was for: {known}")
        t = ((given - self.nominal) / self.spread)[found.free]
        shifts, slopes = found.at(t)
        edges = np.stack(self._mixed(shifts, given, asked))
        derivatives = np.zeros((len(given), *edges.shape))
        by_depth = np.stack(self._mixed(np.moveaxis(slopes, 1, 0), given, asked), 1)
        derivatives[found.free] = by_depth / self.spread[found.free, None, None, None]
        for n in found.free:
            # Thickness and temperature change the conversion depths as well: differenced, as
            # the weights of the depths are cheap.
            if self.parameters[n] in _BY_DEPTH and asked.wavelength is not None:
                step = 1e-3 * self.spread[n] * (np.arange(len(given)) == n)
                up, down = (
                    np.stack(self._mixed(shifts, given + s * step, asked)) for s in (1, -1)
                )
                derivatives[n] += (up - down) / (2 * step[n])
        areas = area_matrix(edges[0], edges[1])
        jacobian = area_matrix(derivatives[:, 0], derivatives[:, 1])
        return ExpandedResponse(
            edges[0], edges[1], _lags(areas), _lags(jacobian), derivatives[:, 0],
            derivatives[:, 1],
        )  # fmt: skip

    def _mixed(
        self, shifts: FloatArray, values: FloatArray, condition: Condition
    ) -> tuple[FloatArray, FloatArray]:
        """Average shifts (2, ..., nd, ny, nx) over the conversion depths of a condition's light."""
        device = _operated(self.device, _point(condition))
        for name in _BY_DEPTH:
            if name in self.parameters and not _held(name, _point(condition)):
                own = values[self.parameters.index(name)] - parameter_value(device, name)
                device = change_parameter(device, name, own)
        return mixed(
            shifts[0], shifts[1], np.array(conversion_depths(device)), condition.wavelength,
            device.operating_point.temperature,
        )  # fmt: skip

    def device_at(self, values: ArrayLike, condition: Condition | None = None) -> Device:
        """Make the device with given values of the parameters, at a condition.

        Parameters
        ----------
        values : array_like, shape (p,)
            Values in the order of ``parameters`` [internal units].
        condition : Condition, optional
            Operating point; quantities that it does not state are the device's own.

        Returns
        -------
        device : Device
            Device with these values.

        Raises
        ------
        DeviceError
            The values are not those of a valid device.
        """
        point = _point(condition if condition is not None else Condition())
        out = _operated(self.device, point)
        for name, value, nominal in zip(
            self.parameters, np.asarray(values, float), self.nominal, strict=True
        ):
            if not _held(name, point) and value != nominal:
                out = change_parameter(out, name, value - nominal)
        return out

    def check(
        self,
        points: int,
        seed: int,
        *,
        condition: Condition | None = None,
        remeshed: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ) -> EmulatorCheck:
        """Compare predictions with full solutions at random points of the prior volume.

        Parameters
        ----------
        points : int
            Number of points, 1 or more.
        seed : int
            Seed of the values, which are normal about the nominal ones; values of no valid device
            are drawn again.
        condition : Condition, optional
            Operating point for which the emulator was built.
        remeshed : bool
            True: each device gets a mesh of its own, whose error then counts; False: each is
            solved on the emulator's mesh, moved.
        progress : callable, optional
            Function that is called with (points solved, points).

        Returns
        -------
        check : EmulatorCheck
            Solved and emulated a_ij of each point.

        Raises
        ------
        DeviceError, ConvergenceError
            More than ten times as many points as asked for have no solution.
        """
        asked = condition if condition is not None else Condition()
        rng = np.random.default_rng(seed)
        laid_for = _operated(self.device, _point(asked))
        values: list[FloatArray] = []
        solved, emulated = [], []
        unsolved = 0
        while len(values) < points:
            drawn = self.nominal + self.spread * rng.standard_normal(len(self.nominal))
            try:
                device = self.device_at(drawn, asked)
            except DeviceError:
                continue
            try:
                found = solve_response(
                    device, level=self.level, cells=self.cells, refine_z=self.refine_z,
                    laid_for=None if remeshed else laid_for,
                )  # fmt: skip
            except (DeviceError, ConvergenceError):
                unsolved += 1
                if unsolved > 10 * points:
                    raise
                continue
            edges = found.edges(asked.wavelength, device.operating_point.temperature)
            values.append(drawn)
            solved.append(_lags(area_matrix(*edges)))
            emulated.append(self.predict(drawn, asked).areas)
            if progress is not None:
                progress(len(values), points)
        return EmulatorCheck(
            np.array(values), np.array(solved), np.array(emulated), unsolved
        )

    # -- files -------------------------------------------------------------------------

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the emulator to one file, whole or not at all.

        Parameters
        ----------
        path : path-like
            File in the format of numpy's ``.npz``; one that exists is replaced.

        Raises
        ------
        FitError
            The file cannot be written.
        """
        header = {
            "schema": SCHEMA,
            "version": bfsensor.__version__,
            "device": self.device.to_toml(),
            "parameters": dict(zip(self.parameters, self.spread.tolist(), strict=True)),
            "level": self.level,
            "cells": self.cells,
            "refine_z": self.refine_z,
            "points": list(self._expansions),
        }
        arrays = {
            f"{name}_{n}": getattr(e, name)
            for n, e in enumerate(self._expansions.values())
            for name in ("free", "value", "first", "second")
        }
        with written_whole(path, FitError) as beside, open(beside, "wb") as stream:
            np.savez_compressed(stream, header=json.dumps(header), **arrays)

    @classmethod
    def read(
        cls, path: str | os.PathLike[str], *, device: Device | None = None
    ) -> DeviceEmulator:
        """Read an emulator that :meth:`write` wrote.

        Parameters
        ----------
        path : path-like
            File to read.
        device : Device, optional
            Device about which the emulator must have been built.

        Returns
        -------
        emulator : DeviceEmulator
            Emulator of the file.

        Raises
        ------
        FitError
            The file is not an emulator, is of another version of bfsensor, or of another device.
        """
        try:
            with open(path, "rb") as stream, np.load(stream) as data:
                header = json.loads(str(data["header"]))
                if header["schema"] != SCHEMA or header["version"] != bfsensor.__version__:
                    raise FitError(
                        f"{path}: {header['schema']} of bfsensor {header['version']}, not {SCHEMA} "
                        f"of {bfsensor.__version__}: build it again"
                    )
                expansions = {
                    tuple(point): Expansion(
                        *(
                            data[f"{name}_{n}"]
                            for name in ("free", "value", "first", "second")
                        )
                    )
                    for n, point in enumerate(header["points"])
                }
        except FitError:
            raise
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise FitError(f"{path}: not a file of an emulator ({error})") from None
        if (
            device is not None
            and device.physics != Device.from_toml(header["device"]).physics
        ):
            raise FitError(
                f"{path}: the emulator was built for another device than {device.name}, or for "
                "other values of its quantities"
            )
        return cls(
            Device.from_toml(header["device"]), header["parameters"], header["level"],
            header["cells"], header["refine_z"], expansions,
        )  # fmt: skip


def _spreads(
    device: Device, parameters: Sequence[str] | Mapping[str, float] | None
) -> dict[str, float]:
    known = device_parameters(device)
    if parameters is None:
        return known
    if isinstance(parameters, Mapping):
        given = {name: float(spread) for name, spread in parameters.items()}
        for name, spread in given.items():
            parameter_value(device, name)
            if not spread > 0:
                raise FitError(f"spread of {name} = {spread:g} must be above 0")
        return given
    for name in parameters:
        if name not in known:
            raise FitError(
                f"{device.name} states no uncertainty for {name!r}; it does for {', '.join(known)}"
            )
    return {name: known[name] for name in parameters}


def _point(condition: Condition) -> tuple[float | None, ...]:
    """Operating point that a condition states; None for quantities that it leaves to the device."""
    return tuple(
        None if getattr(condition, v) is None else float(getattr(condition, v))
        for v in VOLTAGES
    )


def _held(name: str, point: tuple[float | None, ...]) -> bool:
    """Whether an operating point states a parameter, which is then not free."""
    section, _, quantity = name.partition(".")
    return (
        section == "operating_point"
        and quantity in VOLTAGES
        and point[VOLTAGES.index(quantity)] is not None
    )


def _operated(device: Device, point: tuple[float | None, ...]) -> Device:
    out = device
    for name, value in zip(VOLTAGES, point, strict=True):
        key = f"operating_point.{name}"
        if value is not None and value != parameter_value(out, key):
            out = change_parameter(out, key, value - parameter_value(out, key))
    return out


def _lags(areas: FloatArray) -> FloatArray:
    """Area changes at non-negative lags [j, i]; the last ring, which lacks outer edges, is cut off."""
    middle = areas.shape[-1] // 2
    return areas[..., middle:-1, middle:-1]
