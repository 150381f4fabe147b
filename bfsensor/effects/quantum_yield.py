"""Photons of blue and near-ultraviolet light that make more than one electron."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import irfft2, rfft2

from bfsensor.effects.changed_device import nearest_value
from bfsensor.effects.charge_diffusion import landing
from bfsensor.effects.effect import Axes, Layout, Parameter, Seen, Shot
from bfsensor.effects.family import TemplateEffect, TemplateFamily
from bfsensor.effects.simulated_physics import DiffusionWidths
from bfsensor.typing import FloatArray

_HC = 1239.841984
"""Energy of a photon times its vacuum wavelength [eV nm], exact by definition (CODATA 2022)."""

ENERGIES = np.array(
    [2.7, 2.8, 2.9, 3.0, 3.1, 3.2, 3.3, 3.4, 3.5, 3.6, 3.7, 3.8, 3.9, 4.0, 4.2, 4.4, 4.6, 4.8, 5.0]
)  # fmt: skip
"""Energies of photons of :data:`SECOND` [eV].  Chosen: half as far apart they would show ripples of the
published table that are noise of its Monte Carlo."""

SECOND = np.array([
    0.0, 0.00143, 0.00327, 0.00594, 0.0115, 0.00798, 0.01494, 0.03455, 0.02338, 0.02746, 0.02225,
    0.02338, 0.02912, 0.04367, 0.07135, 0.10421, 0.11885, 0.13794, 0.16293,
])  # fmt: skip
"""Probability that a photon makes two electrons.

Published: Ramanathan & Kurinsky 2020, Phys. Rev. D 102, 063026, table of their model for silicon at
100 K; 0.0007 at 2.7 eV is taken as 0, three electrons (below 1e-4) are left out.  Only its shape is
used: twice the values give the same prediction at the same value at :data:`REFERENCE`."""

REFERENCE = 350.0
"""Wavelength at which the number of electrons is stated [nm].  Chosen: in the middle of the near
ultraviolet of cameras; at twice the wavelength there is no effect."""

BLUEST = float(_HC / ENERGIES[0])
"""Wavelength below which photons can make two electrons [nm].  Published, see :data:`SECOND`: at twice
the wavelength a photon has not even the energy of two gaps."""

EXTRA = Parameter("extra", "e-/photon", 0.002, 0.1, amplitude=True)
"""Mean number of electrons of a photon of 350 nm, less one.

Published: 0.025 in the model of Ramanathan & Kurinsky (2020), and less in the measurements of Lewis et
al. (2025), Eur. Phys. J. C 85.  Chosen: the range reaches from a tenth to four times that; twice as wide
at the top, evidence for the effect falls by 0.16."""


def extra_electrons(wavelength: ArrayLike) -> FloatArray:
    """Give the mean number of electrons of a photon, less one, by the published model.

    Parameters
    ----------
    wavelength : array_like
        Vacuum wavelength [nm]; the law holds from 248 nm, and is 0 above 459 nm and where the
        wavelength is not known (nan).

    Returns
    -------
    extra : ndarray, shape of ``wavelength``
        Electrons per photon; below 248 nm the value there.

    Examples
    --------
    >>> extra_electrons([350.0, 400.0, 620.0]).round(4)
    array([0.0251, 0.0115, 0.    ])
    """
    energy = _HC / np.asarray(wavelength, float)
    return np.where(np.isnan(energy), 0.0, np.interp(energy, ENERGIES, SECOND))


class QuantumYield(TemplateEffect):
    r"""A photon of short wavelength makes a second electron with a probability p.

    A pixel's electrons then scatter more than their number: with :math:`\langle n \rangle = 1 + p`
    electrons a photon, each of which diffuses on its own, flats of the level m have the covariance

    .. math:: C_{ij} = m \left[\delta_{ij} + f B_{ij}\right], \qquad
        f = \frac{\langle n (n - 1) \rangle}{\langle n \rangle} = \frac{2 p}{1 + p},

    with the probability :math:`B_{ij}` that both arrive at pixels at that lag, as their distance has
    twice the variance of diffusion (:func:`~bfsensor.effects.charge_diffusion.landing`).  The
    brighter-fatter effect then acts on it as on the noise of photons.

    Parameters
    ----------
    values : mapping of str to float
        ``extra`` [e-/photon]: p at 350 nm, plausible from 0.002 to 0.1 (0 changes nothing).  At
        other wavelengths it is in proportion to :func:`extra_electrons`.
    of : TemplateFamily
        Family of :func:`quantum_yield`, with the variance of diffusion.

    Notes
    -----
    Valid from 248 to 459 nm, where a photon makes at most two electrons.  The gain of an amplifier is
    the same at all wavelengths: flats of red light separate the effect from it.  Charge of dark current,
    which has no such pairs, is taken as light.

    Examples
    --------
    >>> widths = DiffusionWidths((((400.0, -50.0), 0.05),), 173.15)
    >>> effect = quantum_yield(widths)({"extra": 0.02})
    >>> axes = {"wavelength": np.array([350.0]), "back_bias": np.array([-50.0])}
    >>> white = np.zeros((1, 8, 8))
    >>> white[0, 0, 0] = 1e5
    >>> effect.covariances(white, axes, Layout((9, 9), ()))[0, :2, 1].round(-1)
    array([370.,  60.])
    """

    stage = "light"
    touches = ("flat_cov",)
    needs = ("blue",)
    in_images = False

    @classmethod
    def template_starts(
        cls, of: TemplateFamily, layout: Layout, seen: Sequence[Seen]
    ) -> list[dict[str, float]]:
        """Values from which fits begin: the published model's."""
        del of, layout, seen
        return [{"extra": float(extra_electrons(REFERENCE))}]

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        """Let the two electrons of a photon raise the covariances of flats."""
        del layout
        # A fit may try more than the one further electron that a photon can make.
        share = self["extra"] / float(extra_electrons(REFERENCE))
        second = np.minimum(share * extra_electrons(axes["wavelength"]), 1.0)
        lit = second != 0.0
        if not lit.any():
            return c
        side = c.shape[-1]
        out = c.copy()
        power = rfft2(c[lit])
        paired = np.array([self._shared(axes, int(n), side) for n in np.flatnonzero(lit)])
        factor = (2 * second[lit] / (1 + second[lit]))[:, None, None]
        out[lit] = irfft2(power * (1 + factor * rfft2(paired).real), s=c.shape[-2:])
        return out

    def _shared(self, axes: Axes, row: int, side: int) -> FloatArray:
        """Probability by lag that both electrons of a photon arrive there, for one flat."""
        known: Mapping[str, float] = {
            k: float(axes[k][row])
            for k in ("wavelength", "back_bias", "temperature") if k in axes
        }  # fmt: skip
        shot = Shot("flat", 0, 1.0, **known)
        heat = shot.temperature / self.template.temperature
        heat = heat if np.isfinite(heat) else 1.0
        line = landing(2 * heat * nearest_value(self.template.held, shot), side)
        return np.asarray(line[:, None] * line)


def quantum_yield(widths: DiffusionWidths) -> TemplateFamily:
    """Make the family of effects of photons that make two electrons.

    Parameters
    ----------
    widths : DiffusionWidths
        Variance of diffusion [pixel^2], by wavelength and back bias.

    Returns
    -------
    family : TemplateFamily
        Of class ``silicon_physics`` and piece ``quantum_yield``.

    Examples
    --------
    >>> family = quantum_yield(DiffusionWidths((((400.0, -50.0), 0.05),), 173.15))
    >>> family.word, family.needs
    ('silicon_physics', ('blue',))
    """
    return TemplateFamily(
        QuantumYield, "silicon_physics", "quantum_yield", widths,
        "Ramanathan & Kurinsky 2020, Phys. Rev. D 102, 063026, probability of two electrons at 100 K; "
        "Lewis et al. 2025, Eur. Phys. J. C 85, measure less; covariances: derived",
        (EXTRA,),
    )  # fmt: skip
