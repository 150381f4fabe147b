"""The solutions that an emulator is made of: a device and its neighbours, with derivatives."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import bfsensor
from bfsensor.device.device import Device
from bfsensor.device.parameters import change_parameter
from bfsensor.errors import ConvergenceError, DeviceError, FitError
from bfsensor.files import written_whole
from bfsensor.response.edge_response import (
    CHARGE,
    PRECISION,
    REACH,
    VERTICES,
    EdgeResponse,
    solve_response,
)
from bfsensor.typing import FloatArray

STEP = 1e-4
"""Step of a parameter over which the device is differentiated, relative to its spread.

Chosen: only the right-hand side of a linear system is differenced, at a fixed potential; twice as
large doubles its error of first order and halves that of round-off."""

Solved = tuple[FloatArray, FloatArray]
"""Shifts [pixel/e-], shape (2, nd, ny, nx), and derivatives, shape (p, 2, nd, ny, nx)."""


@dataclass(frozen=True)
class Node:
    """One device to solve, with the parameters by which it is differentiated; picklable.

    Attributes
    ----------
    device, laid_for : str
        Device to solve, and device for which its mesh is made, as text.
    level : float
        Electrons in every pixel [e-].
    cells, refine_z : int
        Mesh cells per pixel, and number of times that the mesh in z is halved.
    names : tuple of str
        Parameters to differentiate by.
    steps : tuple of float
        Step of each parameter [internal units].
    at : tuple of int
        Number of the condition, number of the parameter that is moved (-1: none) and the side
        to which it is moved (1, -1; 0: none).
    """

    device: str
    laid_for: str
    level: float
    cells: int
    refine_z: int
    names: tuple[str, ...]
    steps: tuple[float, ...]
    at: tuple[int, int, int]
    precision: float = PRECISION

    @property
    def key(self) -> str:
        """Digest of everything that determines the result."""
        text = "\n".join([
            "node 3", bfsensor.__version__, self.device, self.laid_for,
            f"{self.level:.9g} {self.cells} {self.refine_z} {self.precision:g}",
            f"{CHARGE} {VERTICES} {REACH}",
            *(f"{n} {s:.9g}" for n, s in zip(self.names, self.steps, strict=True)),
        ])  # fmt: skip
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def make_node(
    device: Device,
    laid_for: Device,
    level: float,
    cells: int,
    refine_z: int,
    spreads: dict[str, float],
    at: tuple[int, int, int],
) -> Node:
    """Prepare a solution, with steps to the side on which there is such a device."""
    steps = []
    for name, spread in spreads.items():
        step = STEP * spread
        try:
            change_parameter(device, name, step)
        except DeviceError:
            step = -step
        steps.append(step)
    return Node(
        device.physics,
        laid_for.physics,
        level,
        cells,
        refine_z,
        tuple(spreads),
        tuple(steps),
        at,
    )


def solve_node(node: Node) -> EdgeResponse:
    """Solve one device; a function of the module, so that any executor can pickle it."""
    device, laid_for = (Device.from_toml(t) for t in (node.device, node.laid_for))
    changed = [
        (change_parameter(device, name, step), step)
        for name, step in zip(node.names, node.steps, strict=True)
    ]
    return solve_response(
        device,
        level=node.level,
        cells=node.cells,
        refine_z=node.refine_z,
        laid_for=laid_for,
        changed=changed,
        precision=node.precision,
    )


def solve_nodes(
    nodes: Sequence[Node],
    *,
    keep: Path | None,
    progress: Callable[[int, int], None] | None,
    executor: Executor | None,
) -> dict[tuple[int, int, int], Solved]:
    """Solve all nodes that are not kept in the folder already.

    A node at which a moved device has no solution is left out of the result.

    Raises
    ------
    DeviceError, ConvergenceError
        The device itself has no solution at a condition.
    FitError
        A kept file is not a finished solution.
    """
    out: dict[tuple[int, int, int], Solved] = {}
    paths = {n.at: None if keep is None else keep / f"node_{n.key}.npz" for n in nodes}
    done = 0

    def told() -> None:
        if progress is not None:
            progress(done, len(nodes))

    def arrived(node: Node, found: EdgeResponse) -> None:
        solved = np.stack([found.kx, found.ky]), np.stack([found.dkx, found.dky], 1)
        path = paths[node.at]
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(path, FitError) as beside, open(beside, "wb") as stream:
                np.savez(stream, shifts=solved[0], derivatives=solved[1])
        out[node.at] = solved

    missing = []
    for node in nodes:
        path = paths[node.at]
        if path is not None and path.exists():
            out[node.at] = _read(path)
            done += 1
        else:
            missing.append(node)
    told()
    for node, result in _solved(missing, executor):
        try:
            arrived(node, result())
        except (DeviceError, ConvergenceError):
            if node.at[1] < 0:
                raise
        done += 1
        told()
    return out


def _solved(
    nodes: list[Node], executor: Executor | None
) -> Iterator[tuple[Node, Callable[[], EdgeResponse]]]:
    """Pairs of a node and a function that returns its result, as results become available."""
    if executor is None:
        for node in nodes:
            yield node, lambda node=node: solve_node(node)  # type: ignore[misc]
        return
    futures = {executor.submit(solve_node, node): node for node in nodes}
    try:
        for future in as_completed(futures):
            yield futures[future], future.result
    finally:
        for future in futures:
            future.cancel()


def _read(path: Path) -> Solved:
    try:
        with path.open("rb") as stream, np.load(stream) as data:
            return data["shifts"], data["derivatives"]
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FitError(
            f"{path}: not a finished solution; delete it to solve it again ({error})"
        ) from None
