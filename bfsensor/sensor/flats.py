"""Flats without photons: areas follow charge, charge follows areas, step by step."""

from __future__ import annotations

from collections.abc import Iterator

import galsim
import numpy as np
from numpy.typing import NDArray

from bfsensor.effects.effect import Law
from bfsensor.errors import SensorError
from bfsensor.sensor.applied_effects import AppliedEffects
from bfsensor.sensor.base import EngineSensor
from bfsensor.sensor.effect_sensor import EffectSensor
from bfsensor.typing import FloatArray


def draw_flat(
    sensor: EngineSensor,
    shape: tuple[int, int],
    level: float,
    *,
    step: float = 1000.0,
    rng: galsim.BaseDeviate | None = None,
    illumination: FloatArray | None = None,
    border: int = 8,
    dtype: type = np.float32,
) -> galsim.Image:
    """Draw a flat with the correlations that the sensor's areas give it.

    In each step every pixel collects a Poisson number of electrons about its area times the
    step; the areas are those of the charge in the middle of the step, as expected.  All
    light converts near the back surface; a flat in the far red needs photons.  Effects of the
    sensor act as on an exposure of the kind 'flat' that begins at its first pixel,
    :meth:`BrighterFatterSensor.finish` included.

    Parameters
    ----------
    sensor : BrighterFatterSensor or SiliconSensor
        Gives the areas, rings and maps among them.
    shape : tuple of int
        Rows and columns of the image.
    level : float
        Mean electrons a pixel.
    step : float
        Mean electrons a pixel and step.  What a step's own fluctuations do to it is made up
        in the next: of n steps the correlations lack 1 / n^2, not 1 / n.
    rng : galsim.BaseDeviate, optional
        Source of the seed.
    illumination : ndarray, optional
        Relative illumination, of the given shape.
    border : int
        Pixels drawn around the image and cut off: without light from outside the last rows
        and columns would be too small.
    dtype : type
        float32 or float64.

    Returns
    -------
    galsim.Image
        Electrons.

    Raises
    ------
    SensorError
        A value that is not allowed.

    Examples
    --------
    >>> import galsim
    >>> from bfsensor import SiliconSensor
    >>> flat = draw_flat(SiliconSensor(), (64, 64), 20000.0, rng=galsim.BaseDeviate(55))
    >>> bool(abs(flat.array.mean() / 20000.0 - 1) < 0.001)
    True
    """
    *_, image = iterate_flat(
        sensor, shape, level, step=step, rng=rng, illumination=illumination, border=border,
        dtype=dtype,
    )  # fmt: skip
    if isinstance(sensor, EffectSensor):
        sensor.finish(image)
    return image


def iterate_flat(
    sensor: EngineSensor,
    shape: tuple[int, int],
    level: float,
    *,
    step: float = 1000.0,
    rng: galsim.BaseDeviate | None = None,
    illumination: FloatArray | None = None,
    border: int = 8,
    dtype: type = np.float32,
) -> Iterator[galsim.Image]:
    """Draw a flat as :func:`draw_flat` does, giving the image after every step.

    Parameters
    ----------
    sensor, shape, level, step, rng, illumination, border, dtype
        As for :func:`draw_flat`.

    Yields
    ------
    galsim.Image
        A view of the image as it is; of the last all charge is collected, and effects at the
        end of an exposure have not acted.
    """
    _check_request(shape, level, step, border)
    ny, nx = shape
    light = _light(shape, illumination, border)
    seed = galsim.BaseDeviate(rng).raw()
    generator = np.random.Generator(np.random.SFC64(seed))
    law = Law()
    if sensor._applied is not None:
        law = sensor._applied.law
        light *= _light_of_effects(sensor._applied, shape, border, seed)
    whole = galsim.Image(light.shape[1], light.shape[0], dtype=dtype)
    inside = galsim.BoundsI(border + 1, border + nx, border + 1, border + ny)
    steps = int(np.ceil(level / step))
    each = level / steps
    # Rows of photons' coordinates are those of the image without its border.
    centre = galsim.PositionI(-border, -border)
    areas: NDArray[np.floating] = sensor.calculate_pixel_areas(
        whole, centre, use_flux=False
    ).array
    excess: FloatArray = np.zeros(light.shape)
    for _ in range(steps):
        middle = whole.copy()
        # Half of the last step's fluctuations count twice: they were not felt in their own.
        kept = np.exp(-law.loss * whole.array.astype(float)) if law.loss else 1.0
        middle.array[...] += (0.5 * each) * light * areas * kept + 0.5 * excess
        areas = sensor.calculate_pixel_areas(middle, centre).array
        expected = np.maximum(each * light * areas, 0.0)
        if law.loss:
            expected *= np.exp(-law.loss * middle.array.astype(float))
        came = generator.poisson(expected).astype(float)
        whole.array[...] += came
        excess = came - expected
        if whole.array.max() > law.full_well:
            raise SensorError(
                f"level = {level} e-: pixels reach the full well of effects, "
                f"{law.full_well:.0f} e-; flats from areas do not spill, photons do"
            )
        flat = whole[inside]
        flat.setOrigin(1, 1)
        yield flat


def _check_request(shape: tuple[int, int], level: float, step: float, border: int) -> None:
    """Refuse flats that cannot be."""
    if not (level > 0 and np.isfinite(level)):
        raise SensorError(f"level = {level} e- must be a finite number above 0 e-")
    if not (step > 0 and np.isfinite(step)):
        raise SensorError(f"step = {step} e- must be a finite number above 0 e-")
    if min(shape) < 1 or border < 0:
        raise SensorError(f"shape = {shape} and border = {border} must not be negative")


def _light(
    shape: tuple[int, int], illumination: FloatArray | None, border: int
) -> FloatArray:
    """Relative light on a flat with its border; nearest pixels outside, 1 by default."""
    if illumination is None:
        return np.ones((shape[0] + 2 * border, shape[1] + 2 * border))
    given = np.asarray(illumination, float)
    if given.shape != tuple(shape):
        raise SensorError(
            f"illumination has the shape {given.shape}, the flat {tuple(shape)}"
        )
    if not np.all(given >= 0):
        raise SensorError("illumination must not be negative or nan")
    return np.pad(given, border, mode="edge")


def _light_of_effects(
    applied: AppliedEffects, shape: tuple[int, int], border: int, seed: int
) -> FloatArray:
    """Factor of effects on the light of a flat, with its border; nearest pixels outside."""
    factor = applied.light_map("flat", np.random.default_rng(seed))
    if factor is None:
        return np.ones((1, 1))
    rows, columns = (
        np.clip(np.arange(-border, n + border), 0, whole - 1)
        for n, whole in zip(shape, factor.shape, strict=True)
    )
    return np.asarray(factor[rows[:, None], columns])
