"""Levels of a distortion table, solved one by one with Poisson's equation.

A level is one source charge on one background.  Levels do not depend on each other,
not even as starting points: any number of processes gives the same bits, and a run that
was interrupted goes on with the levels that are missing.
"""

from __future__ import annotations

import time
import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bfsensor.errors import TableError
from bfsensor.files import written_whole
from bfsensor.response.light import storage_height
from bfsensor.response.periodic_images import PERIOD, SAMPLES, Images
from bfsensor.response.vertices import vertex_fractions
from bfsensor.simulate.boundaries import find_boundaries
from bfsensor.simulate.far_field import FarField
from bfsensor.simulate.mesh import Surfaces
from bfsensor.simulate.pixel_array import PixelArray
from bfsensor.table.table_plan import TablePlan
from bfsensor.typing import FloatArray


@dataclass(frozen=True)
class Level:
    """Displacements by one source charge on one background at all depths, and their cost.

    Attributes
    ----------
    corners, horizontal, vertical : ndarray
        Displacements [um] as in :class:`~bfsensor.table.table.DistortionTable`, by depth.
    newton, linear_iterations : int
        Newton steps and linear iterations of the solver.
    error_volts : float
        Error of the potential that the iteration leaves [V].
    cpu_seconds : float
        CPU time [s].
    image_share : float
        Largest share of the displacements that was subtracted as the effect of periodic images.
    """

    corners: FloatArray
    horizontal: FloatArray
    vertical: FloatArray
    newton: int
    linear_iterations: int
    error_volts: float
    cpu_seconds: float
    image_share: float

    def write(self, path: Path) -> None:
        """Write an .npz file, whole or not at all."""
        with written_whole(path, TableError) as beside, open(beside, "wb") as stream:
            np.savez(stream, **self.__dict__)

    @classmethod
    def read(cls, path: Path) -> Level:
        """Read the file of a level; TableError where it is damaged or of another kind."""
        try:
            with path.open("rb") as stream, np.load(stream) as data:
                values = {name: data[name] for name in data.files}
            scalars = {k: v.item() for k, v in values.items() if v.ndim == 0}
            return cls(**{**values, **scalars})
        except (ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise TableError(
                f"{path}: not a finished level; delete it to solve it again ({error})"
            ) from None


@lru_cache(maxsize=1)
def _workshop(device_text: str, cells: int, refine_z: int) -> tuple[Any, PixelArray]:
    """Build device and solvers; cached, so that a process does it once for all its levels."""
    from bfsensor.device.device import Device

    device = Device.from_toml(device_text)
    return device, PixelArray(device, period=PERIOD, cells=cells, refine_z=refine_z)


@lru_cache(maxsize=8)
def _images(plan: TablePlan, background: float) -> Images:
    """Sum the periodic images of a charge's far field, which the levels of a background share."""
    device, array = _workshop(plan.device.to_toml(), plan.cells, plan.refine_z)
    mesh, ground = array.mesh, Surfaces.of(device).silicon_stop
    depths = np.array(plan.depths)
    far = FarField.of(array.unit(background), depths, ground, 5 * max(mesh.period))
    fractions = vertex_fractions(plan.vertices)
    return Images.of(far, plan.reach, mesh.pitch, mesh.period, fractions)


def solve_level(plan: TablePlan, charge: float, background: float) -> Level:
    """Solve one level of a plan.

    Parameters
    ----------
    plan : TablePlan
        Plan from :func:`~bfsensor.table.table_plan.plan_table`.
    charge, background : float
        Source charge and charge of all other pixels [e-]; where they are equal nothing moves.

    Returns
    -------
    Level
        Displacements at the plan's depths; 0 at and below the height of the stored charge.
    """
    began = time.process_time()
    device, array = _workshop(plan.device.to_toml(), plan.cells, plan.refine_z)
    n = 2 * plan.reach + 1
    nd = len(plan.depths)
    fractions = vertex_fractions(plan.vertices)
    shapes = (
        (nd, n + 1, n + 1, 2),
        (nd, n + 1, n, plan.vertices, 2),
        (nd, n, n + 1, plan.vertices, 2),
    )
    if charge == background:
        corners, horizontal, vertical = (np.zeros(s) for s in shapes)
        return Level(
            corners, horizontal, vertical, 0, 0, 0.0, time.process_time() - began, 0.0
        )
    potential = array.solve(charge, background)
    depths = np.array(plan.depths)
    fixed = depths <= storage_height(device) + 1e-9
    moved = tuple(np.zeros(shape) for shape in shapes)
    if not fixed.all():
        lines = find_boundaries(
            potential, depths[~fixed], reach=plan.reach, samples=SAMPLES
        )
        for whole, found in zip(
            moved, lines.vertices(plan.vertices, fractions), strict=True
        ):
            whole[~fixed] = found
    (corners, horizontal, vertical), share = _images(plan, background).taken_off(moved)
    return Level(
        corners, horizontal, vertical, len(potential.history), potential.linear_iterations,
        potential.error_volts, time.process_time() - began, share,
    )  # fmt: skip
