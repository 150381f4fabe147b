"""Common parts of the direct simulation's spots and flats: plans, their keys, runs and files."""

from __future__ import annotations

import hashlib
import io
import time
import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from bfsensor.device.depletion import check_depleted
from bfsensor.direct import light
from bfsensor.direct.build_up import build_up
from bfsensor.errors import DeviceError, SimulationError, in_one_line
from bfsensor.files import written_whole
from bfsensor.simulate.well import full_well
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device
    from bfsensor.direct.transport import Transport


class ExposurePlan:
    """Base class of the plans of spots and of flats, which are frozen dataclasses."""

    KIND: ClassVar[str]
    """Name of the exposures in messages, ``'spots'`` or ``'flats'``."""
    SCHEMA: ClassVar[str]
    """Name and version of the file format, which is also part of the key."""
    KEYED: ClassVar[tuple[str, ...]]
    """Fields of the plan that enter the key beside the device, in this order."""
    CHARGE: ClassVar[str]
    """Field with the largest charge of a pixel [e-], which the full well limits."""

    device: Device
    steps: int
    pixels: int
    cells: int
    depth: float | None
    transport: Transport
    seed: int

    @property
    def conversion_height(self) -> float:
        """Height of conversion above the gates [um]; 5 um below the back surface by default."""
        return self.device.silicon.thickness - 5.0 if self.depth is None else self.depth

    @property
    def key(self) -> str:
        """Digest of the device and all settings, equal only for plans with equal results."""
        fields = [f"{name}={getattr(self, name)!r}" for name in self.KEYED]
        text = "\n".join([self.SCHEMA, self.device.to_toml(), *fields])
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def check_full_well(self) -> None:
        """Refuse a charge above the full well of the device, on the mesh of the plan.

        The field is solved for any charge, but electrons that spill are not followed.
        The full well is solved once per process for each device and mesh, in 0.4 CPU s at 8 cells
        per pixel and 1.3 at 16, some 1 % of a spot.  With 8 cells it is 13 % lower than with
        16 (ITL and E2V at -50 V), and it is that of a full pixel among empty ones: in a flat
        of that level the barrier is still 0.2 V higher.

        Raises
        ------
        SimulationError
            The charge is above the full well.
        DeviceError
            The barrier of the empty well is below the device's spill barrier, or the device
            cannot be solved.
        """
        charge = getattr(self, self.CHARGE)
        most = _full_well(self.device.to_toml(), self.cells)
        if charge > most:
            raise SimulationError(
                f"{self.KIND}: {self.CHARGE} = {charge:g} e- must be below the full well of "
                f"{self.device.name}, {most:.0f} e-: electrons that spill are not followed"
            )

    def _check(self, **limits: tuple[float, float]) -> None:
        """Refuse values outside their limits, and devices that are not fully depleted.

        The given limits are checked first, then those of the fields that both kinds share.
        """
        limits |= {
            "steps": (1, 100_000),
            "pixels": (3, 63),
            "cells": (8, 64),
            "depth": (light.LOWEST, self.device.silicon.thickness),
            "seed": (0, 2**63),
        }
        for name, (low, high) in limits.items():
            value = self.conversion_height if name == "depth" else getattr(self, name)
            if not low <= value <= high:
                raise DeviceError(
                    f"{self.KIND}: {name} = {in_one_line(value, 40)} must be from {low:g} to {high:g}"
                )
            if name in ("steps", "pixels", "cells", "seed") and int(value) != value:
                raise DeviceError(f"{self.KIND}: {name} = {value} must be a whole number")
        if self.pixels % 2 == 0:
            raise DeviceError(
                f"{self.KIND}: pixels = {self.pixels} must be odd: one is in the middle"
            )
        check_depleted(self.device)


@lru_cache(maxsize=16)
def _full_well(device_text: str, cells: int) -> float:
    """Full well of a device on a mesh [e-], cached."""
    from bfsensor.device.device import Device

    return full_well(Device.from_toml(device_text), cells=cells)


def step_ends(electrons: int, steps: int) -> NDArray[np.int64]:
    """Number of electrons that have come after each of equal steps, from 0 before the first."""
    return np.round(np.linspace(0, electrons, steps + 1)).astype(np.int64)


class Exposed(NamedTuple):
    """Images with the effect and without, (steps, ny, nx) [e-], and the CPU time they took [s]."""

    on: NDArray[np.int32]
    off: NDArray[np.int32]
    cpu_seconds: float


def expose(
    plan: ExposurePlan,
    electrons: int,
    starts: Callable[[NDArray[np.int64]], FloatArray],
    *,
    seed: int,
    reference: Literal["empty", "even"] = "empty",
    progress: Callable[[int], None] | None,
) -> Exposed:
    """Build up an exposure of a plan, as :func:`~bfsensor.direct.build_up.build_up` does.

    Raises
    ------
    SimulationError
        The plan has more charge than the full well.
    ConvergenceError
        A potential did not converge, or an electron found no well.
    """
    plan.check_full_well()
    begin = time.process_time()
    on, off = build_up(
        plan.device, step_ends(electrons, plan.steps), starts, pixels=plan.pixels,
        cells=plan.cells, transport=plan.transport, seed=seed, reference=reference,
        progress=progress,
    )  # fmt: skip
    return Exposed(on, off, time.process_time() - begin)


# -- files -----------------------------------------------------------------------------


def write_exposure(
    path: str | Path,
    schema: str,
    keywords: Mapping[str, Any],
    on: NDArray[np.int32],
    off: NDArray[np.int32],
) -> None:
    """Write both images of an exposure to FITS, whole or not at all.

    Parameters
    ----------
    path : path-like
        File to write; one that exists is replaced.
    schema : str
        Name and version of the file format, the header's SCHEMA.
    keywords : mapping
        Values, or pairs of value and comment, by header keyword.
    on, off : ndarray, shape (steps, ny, nx)
        Images with the effect and without [e-].

    Raises
    ------
    SimulationError
        The file cannot be written.
    """
    header = fits.Header()
    header["SCHEMA"] = schema
    for name, value in keywords.items():
        header[name] = value
    images = [fits.ImageHDU(on, name="ON"), fits.ImageHDU(off, name="OFF")]
    for hdu in images:
        hdu.header["BUNIT"] = "electron"
    with written_whole(path, SimulationError) as beside:
        fits.HDUList([fits.PrimaryHDU(header=header), *images]).writeto(
            beside, overwrite=True, checksum=True
        )


def read_exposure(
    path: str | Path, schema: str, keywords: Mapping[str, type], what: str
) -> tuple[dict[str, Any], NDArray[np.int32], NDArray[np.int32]]:
    """Read an exposure that :func:`write_exposure` wrote.

    Parameters
    ----------
    path : path-like
        File to read.
    schema : str
        File format that is expected, the header's SCHEMA.
    keywords : mapping of str to type
        Types of the header keywords that the file must hold.
    what : str
        Name of the content for errors, such as 'a spot of the direct simulation'.

    Returns
    -------
    values : dict
        Values by header keyword.
    on, off : ndarray, shape (steps, ny, nx)
        Images with the effect and without [e-].

    Raises
    ------
    SimulationError
        The file has another format or is damaged; the message names it.
    """
    # The whole file is read first: astropy would keep a damaged one open.
    content = io.BytesIO(Path(path).read_bytes())
    try:
        with warnings.catch_warnings(), fits.open(content, checksum=True) as hdus:
            warnings.simplefilter("error")  # checksums
            header = hdus[0].header
            if header.get("SCHEMA") != schema:
                raise SimulationError(f"{path}: not {what}")
            values = {name: kind(header[name]) for name, kind in keywords.items()}
            on, off = (hdus[name].data.astype(np.int32) for name in ("ON", "OFF"))
    except (OSError, KeyError, TypeError, ValueError, AttributeError, UserWarning) as error:
        if isinstance(error, SimulationError):
            raise
        raise SimulationError(f"{path}: not {what}, or damaged") from error
    if on.shape != off.shape or on.ndim != 3:
        raise SimulationError(
            f"{path}: its images {on.shape} and {off.shape} are not (steps, rows, columns)"
        )
    return values, on, off
