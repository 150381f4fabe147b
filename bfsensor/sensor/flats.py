"""Flats drawn without photons, from the pixel areas of a sensor, in small steps of charge."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import galsim
import numpy as np
from numpy.typing import NDArray

from bfsensor.effects.effect import Law
from bfsensor.errors import SensorError, SensorTypeError
from bfsensor.sensor.applied_effects import AppliedEffects
from bfsensor.sensor.base import EngineSensor, make_rng
from bfsensor.sensor.effect_sensor import EffectSensor
from bfsensor.sensor.options import (
    HIGHEST_CHARGE,
    check_array,
    check_instance,
    check_shape,
    check_whole,
    shown,
    to_float,
    wrong_value,
)
from bfsensor.typing import FloatArray

_STEPS = 1e6
"""Largest number of steps of a flat.  Chosen: a small flat takes minutes with so many, and twice
as long with twice as many."""


def draw_flat(
    sensor: EngineSensor,
    shape: tuple[int, int],
    level: float,
    *,
    step: float = 1000.0,
    rng: galsim.BaseDeviate | None = None,
    illumination: FloatArray | None = None,
    border: int | None = None,
    dtype: type = np.float32,
) -> galsim.Image:
    """Draw a flat with the correlations that follow from the sensor's pixel areas.

    In each step every pixel collects a Poisson number of electrons, whose mean is its area times
    the step; the areas are those of the charge expected in the middle of the step.  All
    light converts near the back surface; a flat in the far red needs photons.  Effects of the
    sensor act as on an exposure of the kind 'flat' that begins at its first pixel, those of
    :meth:`BrighterFatterSensor.finish` included.

    Parameters
    ----------
    sensor : BrighterFatterSensor or SiliconSensor
        Sensor whose areas are used, with its rings and maps.
    shape : tuple of int
        Rows and columns of the image, at least 1.
    level : float
        Mean charge of a pixel [e-], above 0, at most 1e9.
    step : float
        Mean charge of a pixel in a step [e-], above 0; at most a million steps.  The response
        to a step's own fluctuations is added in the next step: with n steps the correlations are too
        small by a part 1 / n^2, not 1 / n.
    rng : galsim.BaseDeviate, optional
        Source of the seed.
    illumination : ndarray, shape ``shape``, optional
        Relative illumination, at least 0; by default 1.
    border : int, optional
        Width [pixel] of a frame that is drawn around the image and cut off, 0 to 10,000.  By
        default 8, because without charge outside pixels of the last rows and columns would be too
        small, and 0 with ``surroundings='mirrored'``, by which they are not.
    dtype : type
        Type of the pixels, float32 or float64.

    Returns
    -------
    galsim.Image
        The flat [e-], lower left pixel (1, 1).

    Raises
    ------
    SensorError
        An argument of another type, a level or step that is not above 0, an illumination of
        another shape or negative, or pixels that reach the full well of effects.

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
    border: int | None = None,
    dtype: type = np.float32,
) -> Iterator[galsim.Image]:
    """Draw a flat as :func:`draw_flat` does, with the image after every step.

    Parameters
    ----------
    sensor, shape, level, step, rng, illumination, border, dtype
        As for :func:`draw_flat`.

    Yields
    ------
    galsim.Image
        View of the image [e-] after a step; it changes with the next step.  The last one holds
        all charge, but effects at the end of an exposure have not acted.

    Raises
    ------
    SensorError
        As for :func:`draw_flat`.

    Examples
    --------
    >>> from bfsensor import SiliconSensor
    >>> levels = [flat.array.mean() for flat in iterate_flat(SiliconSensor(), (16, 16), 3000.0)]
    >>> len(levels)
    3
    """
    check_instance(
        "sensor",
        sensor,
        EngineSensor,
        "a BrighterFatterSensor or SiliconSensor of bfsensor",
    )
    shape = ny, nx = check_shape("shape", shape)
    level, step = _check_charge("level", level), _check_charge("step", step)
    if level > HIGHEST_CHARGE or level / step > _STEPS:
        raise SensorError(
            f"level = {level:g} e- in steps of step = {step:g} e- must be at most "
            f"{HIGHEST_CHARGE:g} e-, in {_STEPS:g} steps"
        )
    if border is None:
        border = 0 if sensor.surroundings == "mirrored" else 8
    border = check_whole("border", border, low=0, high=10_000)
    _check_kind(dtype)
    light = _light(shape, illumination, border)
    seed = make_rng(rng).raw()
    generator = np.random.Generator(np.random.SFC64(seed))
    law = Law()
    if sensor._applied is not None:
        law = sensor._applied.law
        light *= _light_of_effects(sensor._applied, shape, border, seed)
    whole = galsim.Image(light.shape[1], light.shape[0], dtype=dtype)
    inside = galsim.BoundsI(border + 1, border + nx, border + 1, border + ny)
    steps = int(np.ceil(level / step))
    each = level / steps
    # Rings and maps are placed by the coordinates of the image without its border.
    centre = galsim.PositionI(-border, -border)
    areas: NDArray[np.floating] = sensor.calculate_pixel_areas(
        whole, centre, use_flux=False
    ).array
    excess: FloatArray = np.zeros(light.shape)
    for _ in range(steps):
        middle = whole.copy()
        # The areas of a step do not know its own fluctuations, which on average act during half
        # of it: the next step counts half of them once more.
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


def _check_charge(name: str, value: float) -> float:
    """Return a charge [e-]; refuse what is no finite number above 0."""
    charge = to_float(value)
    if not (charge > 0 and np.isfinite(charge)):
        raise wrong_value(
            value, f"{name} = {shown(value)} e- must be a finite number above 0 e-"
        )
    return charge


def _check_kind(dtype: Any) -> None:
    """Refuse pixels of another type than float32 and float64."""
    with contextlib.suppress(TypeError):
        if dtype is not None and np.dtype(dtype) in (np.float32, np.float64):
            return
    raise SensorTypeError(f"dtype = {shown(dtype)} must be float32 or float64")


def _light(
    shape: tuple[int, int], illumination: FloatArray | None, border: int
) -> FloatArray:
    """Relative light on a flat with its border; nearest pixels outside, 1 by default."""
    if illumination is None:
        return np.ones((shape[0] + 2 * border, shape[1] + 2 * border))
    given = check_array("illumination", illumination)
    if given.shape != tuple(shape):
        raise SensorError(
            f"illumination has the shape {given.shape}, the flat {tuple(shape)}"
        )
    if not np.all((given >= 0) & np.isfinite(given)):
        raise SensorError("illumination must be finite, and not negative")
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
