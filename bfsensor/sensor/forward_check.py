"""Forward check of a correction: corrected images drawn through the sensor once more."""

from __future__ import annotations

from typing import Literal, NamedTuple

import galsim
import numpy as np
from numpy.typing import ArrayLike

from bfsensor.device.silicon import absorption_length
from bfsensor.errors import MeasurementError, SensorError
from bfsensor.measure.arrays import to_floats
from bfsensor.sensor.brighter_fatter import BrighterFatterSensor
from bfsensor.sensor.options import check_table, read_device
from bfsensor.table.table import DistortionTable
from bfsensor.typing import FloatArray

PARTS = 4
"""Parts of a pixel along each side, in which light is linear.

Derived: over a quarter of a pixel a Gaussian with a sigma of 0.95 pixel leaves its line by 0.3 %; with
twice as many parts by a quarter of that."""

NEAR = 15
"""Pixels along each side whose charges give the light inside one, odd.

Measured: in a Gaussian with a sigma of 1.1 pixel light is right within 0.8 % of its peak, of 1.3 pixel
within 0.2 %; with 7 within 2.6 and 1.2 %."""

MOST = 10**9
"""Largest number of photons of an image.  Chosen: they take an hour; twice as many take two."""

BLOCKS = 500
"""Renewals of the boundaries while an image is drawn.

Chosen: between them boundaries lag behind the charge by 0.1 %; twice as many take twice the time in
images of few pixels and leave half of that."""

BATCH = 2_000_000
"""Photons that are made together.  Chosen: they take 0.1 GB, and twice as many twice as much."""


class DrawnAgain(NamedTuple):
    """A corrected image that was drawn again.

    Attributes
    ----------
    image : ndarray, shape (ny, nx)
        Charge that the sensor collects from the light of the corrected image [e-], on average.
    errors : ndarray, shape (ny, nx)
        Standard errors of that by the photons [e-], from the scatter of the repeats.
    """

    image: FloatArray
    errors: FloatArray


def draw_again(
    corrected: ArrayLike,
    table: DistortionTable,
    *,
    wavelengths: ArrayLike | None = None,
    photons: ArrayLike | None = None,
    surroundings: float | Literal["none", "mirrored"] = "mirrored",
    repeats: int = 2,
    rng: galsim.BaseDeviate | None = None,
) -> DrawnAgain:
    """Draw a corrected image through the sensor, photon by photon, to be compared with the recorded one.

    Light inside pixels is the polynomial through the charges around them.  It has diffused before and
    does not diffuse again.  The same photons are collected with the effect and without: the difference
    is what the effect does, and is added to the corrected image.

    Parameters
    ----------
    corrected : array_like, shape (ny, nx)
        Corrected image with its sky [e-]; every pixel finite, charges below 0 count as 0.
    table : DistortionTable
        Table of the correction.
    wavelengths, photons : array_like, shape (n,), optional
        As those of the correction.
    surroundings : float, 'none' or 'mirrored'
        As those of the correction.
    repeats : int
        Number of times that the image is drawn, 2 or more; errors fall as its root.
    rng : galsim.BaseDeviate, optional
        Source of the seed.

    Returns
    -------
    DrawnAgain

    Raises
    ------
    MeasurementError
        The image is not two-dimensional, smaller than 2 pixels, holds values that are not finite, or
        more charge than :data:`MOST`.
    SensorError
        There are less than two repeats, or the sensor refuses an option.

    Notes
    -----
    This takes as long as the drawing of so many photons: it is for stamps of stars, not for whole
    sensors.

    Examples
    --------
    >>> from bfsensor import correct_table
    >>> table = DistortionTable.load("itl_sta3800c")
    >>> star = 3e4 * np.exp(-0.5 * np.hypot(*np.indices((21, 21)) - 10) ** 2 / 1.5**2)
    >>> corrected = correct_table(star, table)
    >>> again = draw_again(corrected, table, rng=galsim.BaseDeviate(55))
    >>> bool(abs(again.image[10, 10] - star[10, 10]) < 0.2 * (corrected - star)[10, 10])
    True
    """
    light = to_floats(corrected, "corrected")
    if light.ndim != 2 or min(light.shape) < 2:
        raise MeasurementError(
            f"corrected has the shape {light.shape}, not two sides of 2 pixels or more"
        )
    if not np.all(np.isfinite(light)):
        raise MeasurementError(
            f"corrected holds {np.sum(~np.isfinite(light))} values that are not finite: cut a stamp "
            "without them"
        )
    total = float(np.maximum(light, 0.0).sum())
    if not 0 < total <= MOST:
        raise MeasurementError(
            f"corrected holds {total:g} e- above 0, which must be above 0 and at most {MOST:g} e-: cut "
            "a stamp"
        )
    if not (isinstance(repeats, int | np.integer) and repeats >= 2):
        raise SensorError(f"repeats = {repeats!r} must be a whole number from 2 on")
    check_table(table)
    seed = galsim.BaseDeviate(rng).raw()
    colours = None if wavelengths is None else np.atleast_1d(np.asarray(wavelengths, float))
    shares = None if photons is None else np.asarray(photons, float) / np.sum(photons)
    inside = _light_inside(light)
    moved = []
    for n in range(int(repeats)):
        # One seed for both: the photons are the same, and so is what happens to them.
        drawn = [
            _draw(inside, table, strength, surroundings, colours, shares, seed + 7919 * n)
            for strength in (1.0, 0.0)
        ]
        moved.append(drawn[0] - drawn[1])
    scatter = np.std(moved, axis=0, ddof=1) / np.sqrt(repeats)
    return DrawnAgain(light + np.mean(moved, axis=0), np.asarray(scatter))


def _draw(
    inside: FloatArray,
    table: DistortionTable,
    strength: float,
    surroundings: float | Literal["none", "mirrored"],
    colours: FloatArray | None,
    shares: FloatArray | None,
    seed: int,
) -> FloatArray:
    """Collect photons of a light distribution (ny * PARTS, nx * PARTS) in an image."""
    rng = np.random.default_rng([seed, 5417])
    ny, nx = (side // PARTS for side in inside.shape)
    if colours is not None:
        # What crosses the silicon makes no charge: of red light more photons come.
        temperature = read_device(table, "the drawing").operating_point.temperature
        lengths = np.asarray(absorption_length(colours, temperature), float)
        converts = -np.expm1(-table.thickness / lengths)
        inside = inside / np.average(converts, weights=shares)
    sensor = BrighterFatterSensor(
        table=table, strength=strength, diffusion_factor=0.0, surroundings=surroundings,
        nrecalc=max(inside.sum() / BLOCKS, 20.0), rng=galsim.BaseDeviate(seed),
    )  # fmt: skip
    image = galsim.ImageD(nx, ny)
    counts = rng.poisson(inside.ravel())
    # In random order: light comes everywhere at the same rate.
    where = rng.permutation(np.repeat(np.arange(counts.size, dtype=np.int32), counts))
    slopes = [_slope_in_parts(inside, axis).ravel() for axis in (1, 0)]
    for start in range(0, len(where), BATCH):
        cells = where[start : start + BATCH]
        at = []
        for index, slope in zip(
            (cells % inside.shape[1], cells // inside.shape[1]), slopes, strict=True
        ):
            at.append((index + _linear(rng.random(len(cells)), slope[cells])) / PARTS + 0.5)
        some = galsim.PhotonArray(len(cells), at[0], at[1], np.ones(len(cells)))
        if colours is not None:
            some.wavelength = rng.choice(colours, len(cells), p=shares)
        if start == 0:
            sensor.accumulate(some, image)
        else:
            sensor.accumulate(some, image, resume=True)
    return np.array(image.array)


def _light_inside(light: FloatArray) -> FloatArray:
    """Light in the parts of pixels; the sum in a pixel is its charge, none below 0."""
    half = NEAR // 2
    weights = _part_weights()
    padded = np.pad(np.maximum(light, 0.0), half, mode="symmetric")
    for axis in (0, 1):
        moving = np.lib.stride_tricks.sliding_window_view(padded, NEAR, axis=axis)
        parts = np.moveaxis(moving @ weights.T, -1, axis + 1)
        shape = list(padded.shape)
        shape[axis] = (shape[axis] - 2 * half) * PARTS
        padded = parts.reshape(shape)
    found = np.maximum(padded, 0.0)
    ny, nx = light.shape
    blocks = found.reshape(ny, PARTS, nx, PARTS)
    sums = blocks.sum((1, 3), keepdims=True)
    # Where the polynomial fell below 0 the rest keeps the pixel's charge.
    wanted = np.maximum(light, 0.0)[:, None, :, None]
    scaled = np.where(sums > 0, blocks * wanted / np.where(sums > 0, sums, 1.0), 0.0)
    return np.asarray(scaled.reshape(ny * PARTS, nx * PARTS))


def _part_weights() -> FloatArray:
    """Weights (parts, pixels) of the pixels around one for the light in its parts."""
    edges = np.arange(NEAR + 1.0) - 0.5 * NEAR
    power = np.arange(1, NEAR + 1)
    # Powers of a variable that stays below 1 keep the matrix well behaved.
    scale = 0.5 * NEAR
    integrals = (
        (edges[1:, None] / scale) ** power - (edges[:-1, None] / scale) ** power
    ) / power
    inner = np.linspace(-0.5, 0.5, PARTS + 1)[:, None] / scale
    wanted = (inner[1:] ** power - inner[:-1] ** power) / power
    return np.asarray(wanted @ np.linalg.inv(integrals))


def _slope_in_parts(inside: FloatArray, axis: int) -> FloatArray:
    """Change of the light across each part over its value, at most 2 in size."""
    before, after = np.roll(inside, 1, axis), np.roll(inside, -1, axis)
    edge = (
        np.moveaxis(before, axis, 0),
        np.moveaxis(after, axis, 0),
        np.moveaxis(inside, axis, 0),
    )
    edge[0][0], edge[1][-1] = edge[2][0], edge[2][-1]
    change = 0.5 * (after - before)
    return np.clip(change / np.where(inside > 0, inside, 1.0), -2.0, 2.0)


def _linear(uniform: FloatArray, slope: FloatArray) -> FloatArray:
    """Places from 0 to 1 with the density 1 + slope (u - 1/2), from uniform numbers."""
    # The root of slope u^2 / 2 + (1 - slope / 2) u = p that is also right for a slope of 0.
    b = 1 - 0.5 * slope
    return np.asarray(2 * uniform / (b + np.sqrt(b * b + 2 * slope * uniform)))
