r"""The differential response around a device, without solving it again.

To second order in the parameters about the device's values, in units of their spreads:

.. math::
    k(t) = k_0 + \sum_n g_n t_n + \tfrac12 \sum_{nm} H_{nm} t_n t_m

with the derivatives :math:`g` of the linearised solve, and :math:`H` from solutions one spread
to either side of every parameter and their derivatives, on one mesh that moves with the device.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
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
    mixed,
    response_depths,
    solve_response,
)
from bfsensor.response.emulator_nodes import Node, make_node, solve_nodes
from bfsensor.response.expansion import EmulatorCheck, ExpandedResponse, Expansion, expand
from bfsensor.typing import FloatArray

SCHEMA = "bfsensor emulator 1"
VOLTAGES = ("back_bias", "gate_high", "gate_low", "temperature")
"""Of the operating point, which conditions may state."""

_BY_DEPTH = ("silicon.thickness", "operating_point.temperature")


class DeviceEmulator:
    """Response of a device for any values of its parameters near its own.

    Made by :meth:`build`, or read from a file.

    Attributes
    ----------
    device : Device
        About which it holds.
    parameters : tuple of str
        Dotted names.
    nominal, spread : ndarray, shape (p,)
        Values and standard deviations [internal units].
    level : float
        Electrons in every pixel, about which the response is taken [e-].
    cells, refine_z : int
        Of the mesh: cells a pixel, and halvings in z.
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
        """Solve a device and its neighbours, with all derivatives.

        Parameters
        ----------
        device : Device
            Mirror-symmetric.
        parameters : sequence of str, or mapping of str to float
            Names, whose uncertainties the device states, or names with their spreads; by
            default all quantities with stated uncertainty.
        conditions : sequence of Condition
            At which responses will be asked for.  What they do not state is the device's own;
            wavelengths need no solutions of their own.
        level : float
            Electrons in every pixel [e-].
        cells : int
            Of the mesh, a pixel.
        refine_z : int
            Halvings of its steps in z.
        keep : Path, optional
            Folder that keeps finished solutions; a run that finds them goes on from there.
        executor : Executor, optional
            Where they are solved; by default here, one after another.
        progress : callable, optional
            Called with (solutions made, solutions in all).

        Returns
        -------
        DeviceEmulator

        Raises
        ------
        FitError
            A parameter without uncertainty, or one that cannot be moved to either side.
        DeviceError, ConvergenceError
            The device is not fully depleted at a condition, or there is no solution there.
        """
        spreads = _spreads(device, parameters)
        points = list(dict.fromkeys(_point(c) for c in conditions))
        if not points:
            raise FitError("an emulator needs a condition; Condition() is the device's own")
        for point in points:
            check_depleted(_operated(device, point))
        nodes: list[Node] = []
        for number, point in enumerate(points):
            here = _operated(device, point)
            own = {n: s for n, s in spreads.items() if not _held(n, point)}
            nodes.append(
                make_node(here, here, level, cells, refine_z, own, (number, -1, 0))
            )
            for n, (name, spread) in enumerate(own.items()):
                for side in (1, -1):
                    try:
                        there = change_parameter(here, name, side * spread)
                    except DeviceError:
                        continue  # the other side tells
                    nodes.append(
                        make_node(
                            there, here, level, cells, refine_z, own, (number, n, side)
                        )
                    )
        solved = solve_nodes(nodes, keep=keep, progress=progress, executor=executor)
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
        """Operating points that it holds."""
        return tuple(
            Condition(back_bias=bias, gate_high=high, gate_low=low, temperature=kelvin)
            for bias, high, low, kelvin in self._expansions
        )

    def predict(
        self, values: ArrayLike, condition: Condition | None = None
    ) -> ExpandedResponse:
        """Response at values of the parameters.

        Parameters
        ----------
        values : array_like, shape (p,)
            [internal units], in the order of ``parameters``; the nominal ones for what the
            condition states are not looked at.
        condition : Condition, optional
            One of those it was built for, at any wavelength; without a wavelength all light
            converts at the back surface.  A filter is not looked at.

        Raises
        ------
        FitError
            Values that are not numbers, or a condition that it was not built for.
        """
        asked = condition if condition is not None else Condition()
        given = np.asarray(values, float)
        if given.shape != self.nominal.shape or not np.all(np.isfinite(given)):
            raise FitError(
                f"values = {given.tolist()} must be {len(self.nominal)} finite numbers: "
                f"{', '.join(self.parameters)}"
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
            # Where light converts changes as well.
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
        """Shifts (2, ..., nd, ny, nx) weighted by where the light of a condition converts."""
        device = _operated(self.device, _point(condition))
        for name in _BY_DEPTH:
            if name in self.parameters and not _held(name, _point(condition)):
                own = values[self.parameters.index(name)] - parameter_value(device, name)
                device = change_parameter(device, name, own)
        return mixed(
            shifts[0], shifts[1], np.array(response_depths(device)), condition.wavelength,
            device.operating_point.temperature,
        )  # fmt: skip

    def device_at(self, values: ArrayLike, condition: Condition | None = None) -> Device:
        """Give the device with values of the parameters, at a condition.

        Raises
        ------
        DeviceError
            There is no such device.
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
        """Solve at random points of the prior volume, and compare.

        Parameters
        ----------
        points : int
            How many.
        seed : int
            Of their values: normal about the nominal ones, where there is such a device.
        condition : Condition, optional
            One of those it was built for.
        remeshed : bool
            Whether each device gets a mesh of its own, whose error then counts, or the
            emulator's, moved.
        progress : callable, optional
            Called with (points solved, points).
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
        """Write everything to one file (.npz), whole or not at all."""
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
        """Read what :meth:`write` wrote.

        Parameters
        ----------
        path : path-like
            The file.
        device : Device, optional
            Whose emulator it must be.

        Raises
        ------
        FitError
            Not such a file, of another version, or of another device.
        """
        try:
            with open(path, "rb") as stream, np.load(stream) as data:
                header = json.loads(str(data["header"]))
                if header["schema"] != SCHEMA or header["version"] != bfsensor.__version__:
                    raise FitError(
                        f"{path}: {header['schema']} of bfsensor {header['version']}, not {SCHEMA} "
                        f"of {bfsensor.__version__}: build it anew"
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
            raise FitError(f"{path}: not an emulator ({error})") from None
        if (
            device is not None
            and device.physics != Device.from_toml(header["device"]).physics
        ):
            raise FitError(
                f"{path}: of another device than {device.name}, or of other values"
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
    """What a condition states of the operating point."""
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
    """Areas by lag [j, i] from (0, 0), as far as they are complete."""
    middle = areas.shape[-1] // 2
    return areas[..., middle:-1, middle:-1]
