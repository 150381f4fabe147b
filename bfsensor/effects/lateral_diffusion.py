"""Lateral diffusion of drifting electrons beyond that of the baseline."""

from __future__ import annotations

import numpy as np

from bfsensor.device import silicon
from bfsensor.effects.effect import Effect, Halo, Layout, Parameter, Shot
from bfsensor.units import BOLTZMANN


class LateralDiffusion(Effect):
    """Spots gain the variance ``var`` [pixel^2] at the reference wavelength, bias and temperature.

    At other conditions it is proportional to kT and to the drift path, and inversely proportional
    to the voltage (Einstein's relation).  A width that is the same at all conditions belongs to the
    optics instead.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``var`` [pixel^2]: 0.005 to 0.2 (0 changes nothing).

    Examples
    --------
    >>> LateralDiffusion({"var": 0.03}).name
    'lateral_diffusion'
    """

    word = "lateral_diffusion"
    stage = "light"
    parameters = (Parameter("var", "pixel^2", 0.005, 0.2, amplitude=True),)
    touches = ("spot",)
    source = (
        "Einstein's relation over the drift path d in a slab of thickness L under V: variance "
        "2 (kT / q) d L / V; range assumed"
    )

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, Halo]:
        wavelength, back_bias, temperature = layout.reference
        usual = shot._replace(
            wavelength=wavelength, back_bias=back_bias, temperature=temperature
        )
        ratio = diffusion_variance(shot, layout) / diffusion_variance(usual, layout)
        return self["var"] * ratio, ()


def diffusion_variance(shot: Shot, layout: Layout) -> float:
    """Variance of diffusion along one axis, in the mean field of the silicon [pixel^2].

    It is the mean over the depths at which light converts.  The doping's gradient of the field
    changes it by a few per cent, and the ratio between conditions much less.

    Parameters
    ----------
    shot : Shot
        Wavelength, back bias and temperature.
    layout : Layout
        Thickness, pixel pitch, front potential and absorption lengths.

    Returns
    -------
    variance : float
        2 (kT / q) d L / V with the mean path d, the thickness L and the voltage V.

    Raises
    ------
    ZeroDivisionError
        The back bias equals the potential of the front.
    """
    heat = BOLTZMANN * shot.temperature
    volts = layout.front - shot.back_bias
    path = drift_path(shot.wavelength, layout)
    return float(2 * heat * path * layout.thickness / volts / layout.pixel**2)


def drift_path(wavelength: float, layout: Layout) -> float:
    """Mean length of the drift [um] of electrons from light of a wavelength [nm] to the gates."""
    thickness = layout.thickness
    length = absorption_length(wavelength, layout)
    # Mean depth of an exponential that ends at the gates.
    left = np.exp(-thickness / length)
    return float(thickness - length + thickness * left / (1 - left))


def absorption_length(wavelength: float, layout: Layout) -> float:
    """Absorption length [um] at a wavelength [nm].

    It is interpolated in its logarithm between those of the layout, constant beyond their ends;
    without any it is that of silicon at 173 K.
    """
    if not layout.absorption:
        return float(silicon.absorption_length(wavelength, 173.0))
    known = sorted(layout.absorption)
    lengths = np.log([layout.absorption[k] for k in known])
    return float(np.exp(np.interp(wavelength, known, lengths)))
