"""Brighter-fatter strength whose dependence on wavelength differs from the baseline's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from bfsensor.effects.effect import Effect, Layout, Parameter, Seen, Shot
from bfsensor.effects.lateral_diffusion import absorption_length
from bfsensor.typing import Edges, FloatArray

ZERO, STEP = 620.0, 330.0
"""Wavelength [nm] at which nothing changes, and interval [nm] over which shifts change by kappa.

Defined as the parameter's scale: kappa is the relative change from 620 to 950 nm."""


class BrighterFatterChromatic(Effect):
    """Shifts are (1 + kappa (wavelength - 620 nm) / 330 nm) times the baseline's.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``kappa``: 0.01 to 0.2 in magnitude, either sign (0 changes nothing).

    Examples
    --------
    >>> BrighterFatterChromatic({"kappa": 0.04}).name
    'bf_chromatic'
    """

    word = "bf_chromatic"
    stage = "collect"
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("kappa", "", 0.01, 0.2, signed=True, amplitude=True),
    )
    touches = ("flat_cov", "spot")
    law_name = "wavelength"
    source = (
        "Light that converts deeper is pushed over a shorter path (Astier & Regnault 2023, A&A "
        "670, A118, model the bands of one camera); law and range assumed"
    )

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        factor = 1 + self["kappa"] * self._part(shot.wavelength, layout)
        return (kx, ky) if factor == 1.0 else (factor * kx, factor * ky)

    def _part(self, wavelength: float, layout: Layout) -> float:
        """Change of the shifts at a wavelength over that at 950 nm."""
        del layout
        return (wavelength - ZERO) / STEP


class AbsorptionChromatic(BrighterFatterChromatic):
    """Shifts change by kappa (l^power - 1) / (l_950^power - 1), l absorption length over that at 620 nm.

    A power of 1 is a change in proportion to the depth of conversion, as where long drift paths
    matter; -1 one that only light absorbed near the back surface sees, as where the field is weak
    there.  At a power of 0 the change goes with the logarithm of the length.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``kappa``: 0.01 to 0.2 in magnitude, either sign (0 changes nothing);
        ``power``: -1 to 1.

    Examples
    --------
    >>> AbsorptionChromatic({"kappa": 0.04, "power": -1.0}).name
    'bf_chromatic:absorption'
    """

    variant = "absorption"
    law_name = "absorption"
    parameters = (
        *BrighterFatterChromatic.parameters,
        Parameter("power", "", -1.0, 1.0, law="flat"),
    )
    source = (
        "Shifts by depth of conversion: Rasmussen et al. 2014, JINST 9, C04027 (drift field near the "
        "back window); Astier & Regnault 2023, A&A 670, A118 (bands); the power and its range assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"kappa": 0.03, "power": power} for power in (-0.9, 0.5)]

    def _part(self, wavelength: float, layout: Layout) -> float:
        zero, end, here = (
            float(np.log(absorption_length(w, layout)))
            for w in (ZERO, ZERO + STEP, wavelength)
        )
        power = self["power"]
        if abs(power) < 1e-6:
            return (here - zero) / (end - zero)
        return float(np.expm1(power * (here - zero)) / np.expm1(power * (end - zero)))
