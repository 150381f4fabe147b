"""More lateral diffusion of drifting electrons than the baseline has."""

from __future__ import annotations

import numpy as np

from bfsensor.device import silicon
from bfsensor.effects.effect import Effect, Layout, Parameter, Shot
from bfsensor.units import BOLTZMANN


class LateralDiffusion(Effect):
    """Spots are wider by the variance ``var`` at the reference's light, voltage and temperature.

    Elsewhere it goes with kT, with the path from where light converts, and inversely with the
    voltage (Einstein's relation): a width that all conditions share is the optics'.
    """

    word = "lateral_diffusion"
    stage = "light"
    parameters = (Parameter("var", "pixel^2", 0.005, 0.2, amplitude=True),)
    touches = ("spot",)
    source = (
        "Einstein's relation over the drift path d in a slab of thickness L under V: variance "
        "2 (kT / q) d L / V; range assumed"
    )

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, float, float]:
        wavelength, back_bias, temperature = layout.reference
        usual = shot._replace(
            wavelength=wavelength, back_bias=back_bias, temperature=temperature
        )
        ratio = diffusion_variance(shot, layout) / diffusion_variance(usual, layout)
        return self["var"] * ratio, 0.0, 1.0


def diffusion_variance(shot: Shot, layout: Layout) -> float:
    """Variance of thermal spreading in the mean field of the slab, one axis [pixel^2].

    The mean over the depths at which light converts; the doping's slope of the field changes
    it by a few per cent, and hardly the ratio between conditions.

    Raises
    ------
    ZeroDivisionError
        No voltage over the slab.
    """
    thickness = layout.thickness
    length = absorption_length(shot.wavelength, layout)
    # Mean depth of an exponential that ends at the gates.
    left = np.exp(-thickness / length)
    depth = length - thickness * left / (1 - left)
    heat = BOLTZMANN * shot.temperature
    volts = layout.front - shot.back_bias
    path = thickness - depth
    return float(2 * heat * path * thickness / volts / layout.pixel**2)


def absorption_length(wavelength: float, layout: Layout) -> float:
    """Absorption length [um], log-linear between the layout's own; silicon at 173 K without."""
    if not layout.absorption:
        return float(silicon.absorption_length(wavelength, 173.0))
    known = sorted(layout.absorption)
    lengths = np.log([layout.absorption[k] for k in known])
    return float(np.exp(np.interp(wavelength, known, lengths)))
