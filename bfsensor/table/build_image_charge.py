"""Construction of a distortion table from image charges, the analytic engine.

:mod:`bfsensor.table.build` solves Poisson's equation instead.  The two engines share no code
but the types of the boundaries and of the table, so that each checks the other.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

import bfsensor
from bfsensor.errors import TableError
from bfsensor.response.vertices import vertex_fractions
from bfsensor.simulate.charge_field import TOLERANCE, ImageCharge
from bfsensor.simulate.image_charge import displace_boundaries, trace_boundaries
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

ENGINE = "image charges (Astier & Regnault 2023), first order: linear in charge"

SMALL_CHARGE = 100.0
"""Charge [e-] at which the vertices of the table are placed.

Chosen: vertices keep the areas between displaced lines, to which the shifts of the corners
contribute in second order, 1.5 % of the shifts of LSST's devices at 100,000 e- and so 1.5e-5
here; twice the charge doubles that."""


FITTED_CHARGES = (0.0, 200_000.0)
"""Source charges [e-] of the table of a device that was fitted to covariances.

Chosen: two hold a response that is linear in charge, and the full wells of 10 and 15 um pixels lie
below the second; twice as large, nothing changes but the error in the header, which is for it."""


def default_depths(model: ImageCharge) -> tuple[float, ...]:
    """Return conversion depths [um above the gates] between which shifts interpolate well.

    They are the sealed heights, steps above them that double, and the back surface.
    """
    low, high = sorted((model.row_height, model.column_height))
    pitch = 0.5 * (model.pitch_x + model.pitch_y)
    above = high + pitch * np.array([0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2])
    inner = above[above < 0.8 * model.thickness]
    return tuple(float(depth) for depth in np.unique([low, high, *inner, model.thickness]))


def build_image_charge_table(
    model: ImageCharge,
    *,
    charges: Sequence[float] = (0.0, 100_000.0),
    backgrounds: Sequence[float] = (0.0,),
    depths: Sequence[float] | None = None,
    vertices: int = 32,
    pixels: int = 9,
) -> DistortionTable:
    """Compute a distortion table with the analytic engine.

    Displacements are those of one electron times the charge over the background, so that two
    charges and one background hold the whole model.

    Parameters
    ----------
    model : ImageCharge
        Parameters of the model [um, V/um].
    charges, backgrounds : sequence of float
        Source charges and charges of all other pixels [e-], at least 0, ascending.
    depths : sequence of float, optional
        Conversion depths [um above the gates], ascending; by default
        :func:`default_depths`.
    vertices : int
        Vertices a side between the corners, at least 2.
    pixels : int
        Width of the table [pixel], odd, at least 3.

    Returns
    -------
    DistortionTable
        Table with the engine and its parameters in the header; its errors are the terms beyond
        first order at the largest charge, and the bound of the image series.

    Raises
    ------
    TableError
        ``pixels`` is even or below 3, ``vertices`` is below 2, or the charges are not finite, do
        not ascend or equal the backgrounds everywhere; the message names the limit.

    Examples
    --------
    >>> from bfsensor.simulate.charge_field import ImageCharge
    >>> table = build_image_charge_table(ImageCharge(0.5, 1.4, 3.2, 1.5, 3.0), pixels=3)
    >>> table.provenance["engine"]
    'image charges (Astier & Regnault 2023), first order: linear in charge'
    """
    if pixels % 2 == 0 or pixels < 3:
        raise TableError(f"pixels = {pixels} must be odd and at least 3")
    if vertices < 2:
        raise TableError(f"vertices = {vertices} must be at least 2 a side")
    levels = np.array(default_depths(model) if depths is None else depths, float)
    excess = _excess(charges, backgrounds)
    largest = float(np.abs(excess).max())
    reach = pixels // 2
    lines = displace_boundaries(model, levels, charge=SMALL_CHARGE, reach=reach)
    unit = [
        array / SMALL_CHARGE
        for array in lines.vertices(vertices, vertex_fractions(vertices))
    ]
    # Below the sealed heights nothing moves; the fit of the lines leaves round-off, 1e-12 um.
    for array in unit:
        array[levels <= model.column_height, ..., 0] = 0.0
        array[levels <= model.row_height, ..., 1] = 0.0
    corners, horizontal, vertical = (
        excess[:, :, None, None, None, None] * array
        if array.ndim == 4
        else excess[:, :, None, None, None, None, None] * array
        for array in unit
    )
    slowest = float(model.drift_at(np.linspace(levels[0], model.thickness, 201)).min())
    return DistortionTable(
        charges=np.array(charges, float),
        backgrounds=np.array(backgrounds, float),
        depths=levels,
        pitch=(model.pitch_x, model.pitch_y),
        thickness=model.thickness,
        vertices=vertices,
        reach=reach,
        corners=corners,
        horizontal=horizontal,
        vertical=vertical,
        errors={
            "first order, largest charge [um]": _beyond_first_order(
                model, levels, reach, largest
            ),
            "image series, bound [um]": TOLERANCE * largest * model.thickness / slowest,
        },
        provenance={
            "version": bfsensor.__version__,
            "engine": ENGINE,
            "parameters [um, V/um]": json.dumps(dataclasses.asdict(model)),
        },
        symmetric=True,
    )


def build_fitted_table(
    device: Device,
    *,
    charges: Sequence[float] | None = None,
    backgrounds: Sequence[float] | None = None,
    depths: Sequence[float] | None = None,
    vertices: int = 32,
    pixels: int = 9,
    provenance: Mapping[str, str] | None = None,
) -> DistortionTable:
    """Compute the distortion table of a device whose image charges were fitted to covariances.

    Parameters
    ----------
    device : Device
        Device with a section ``image_charge``.
    charges, backgrounds, depths : sequence of float, optional
        Levels as for :func:`build_image_charge_table`; by default :data:`FITTED_CHARGES`, an empty
        background, and :func:`default_depths`.
    vertices, pixels : int
        As for :func:`build_image_charge_table`.
    provenance : mapping of str to str, optional
        Further entries for the header.

    Returns
    -------
    DistortionTable
        Table with the device.  Its full well is not known: covariances do not say it.

    Raises
    ------
    DeviceError
        The device has no such section.
    TableError
        As :func:`build_image_charge_table`.
    """
    table = build_image_charge_table(
        ImageCharge.of_device(device), charges=charges or FITTED_CHARGES,
        backgrounds=backgrounds or (0.0,), depths=depths, vertices=vertices, pixels=pixels,
    )  # fmt: skip
    return dataclasses.replace(
        table,
        device_text=device.to_toml(),
        provenance={**table.provenance, **(provenance or {})},
    )


def _excess(charges: Sequence[float], backgrounds: Sequence[float]) -> FloatArray:
    """Charges over the backgrounds [e-], shape (nq, nb); at least one must differ from 0."""
    excess = np.subtract.outer(np.array(charges, float), np.array(backgrounds, float))
    if not excess.size or not np.any(excess) or not np.all(np.isfinite(excess)):
        raise TableError(
            f"charges = {list(charges)} e- and backgrounds = {list(backgrounds)} e- must be finite "
            "and differ somewhere: where they are equal nothing moves"
        )
    return np.asarray(excess)


def _beyond_first_order(
    model: ImageCharge, depths: FloatArray, reach: int, charge: float
) -> float:
    """Largest difference of a boundary from traced field lines [um]; nan where tracing fails."""
    first = displace_boundaries(model, depths, charge=charge, reach=reach, samples=4)
    try:
        traced = trace_boundaries(model, depths, charge=charge, reach=reach, samples=4)
    except TableError:
        return float("nan")
    return max(
        float(np.abs(traced.columns - first.columns)[..., 0].max()),
        float(np.abs(traced.rows - first.rows)[..., 1].max()),
    )
