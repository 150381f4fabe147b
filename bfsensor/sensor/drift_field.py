r"""Diffusion during drift and the lateral shift by doping ripples, from the device's drift field.

An electron drifts from the height :math:`z` of its conversion to the wells in the field
:math:`E` of the empty device.  With Einstein's relation, whatever the mobility,

.. math:: \sigma^2(z) = 2 \frac{kT}{q} \int_{z_0}^{z} \frac{dz'}{E(z')},

from the height :math:`z_0` below which the field of the wells takes over.  A ripple of the
doping that is the same at all heights and long against the thickness :math:`L` pulls
sideways in proportion to :math:`z (L - z)`, so that its shift is

.. math:: s(z) / s(L) = \int_0^z \frac{z' (L - z')}{E(z')} dz' \Big/ \int_0^L \ldots
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from bfsensor.device.device import Device
from bfsensor.simulate.mean_field import STEPS, mean_drift_field
from bfsensor.typing import FloatArray


@dataclass(frozen=True)
class Drift:
    """Diffusion and ripple shift by height of conversion, on equal steps.

    Attributes
    ----------
    heights : ndarray, shape (STEPS + 1,)
        Heights above the gates [um].
    field : ndarray, shape (STEPS + 1,)
        Drift field averaged over a pixel [V/um].
    variance : ndarray, shape (STEPS + 1,)
        Variance of the landing position along one axis [um^2], by Einstein's relation.
    ripple : ndarray, shape (STEPS + 1,)
        Shift by a long doping ripple, relative to that from the back surface.
    """

    heights: FloatArray
    field: FloatArray
    variance: FloatArray
    ripple: FloatArray


@lru_cache(maxsize=16)
def solve_drift(
    device_text: str, temperature: float, start: float, known: tuple[float, ...] = ()
) -> Drift:
    """Integrate diffusion and ripple shift over the drift field of the empty device.

    Parameters
    ----------
    device_text : str
        Text of a device file.
    temperature : float
        Temperature of the silicon [K].
    start : float
        Height below which diffusion is neglected, because the wells hold the electrons [um].
    known : tuple of float
        The field [V/um], if it is known (:func:`bfsensor.simulate.mean_field.mean_drift_field`);
        otherwise the device is solved.

    Returns
    -------
    Drift
    """
    device = Device.from_toml(device_text)
    heights = np.linspace(0.0, device.silicon.thickness, STEPS + 1)
    field = np.array(known) if known else mean_drift_field(device)
    above = heights >= start
    inverse = np.zeros_like(field)
    inverse[above] = 1.0 / field[above]
    step = heights[1]
    kt = device.material.thermal_voltage(temperature)
    pull = heights * (heights[-1] - heights) * inverse
    ripple = _integral(pull, step)
    return Drift(heights, field, 2 * kt * _integral(inverse, step), ripple / ripple[-1])


def _integral(values: FloatArray, step: float) -> FloatArray:
    """Integral up to each of equal steps, by the trapezoidal rule."""
    return np.concatenate([[0.0], np.cumsum(0.5 * step * (values[1:] + values[:-1]))])
