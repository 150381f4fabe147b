"""Diffusion that widens with the charge stored below the drifting electrons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from bfsensor.effects.changed_device import add_edges, nearest_value
from bfsensor.effects.effect import Layout, Parameter, Seen, Shot
from bfsensor.effects.family import TemplateEffect, TemplateFamily
from bfsensor.effects.simulated_physics import DiffusionWidths
from bfsensor.typing import Edges, FloatArray

PER = 1e5
"""Stored charge that the growth is stated for [e-].  Defined: the level of a bright pixel; with twice as
much the same effect has twice the value."""

GROWTH = Parameter("growth", "% per 1e5 e-", 0.1, 20.0, amplitude=True)
"""Growth of the variance of diffusion by 1e5 e- in the pixel.

Measured (``python -m validation.silicon.pieces``): ITL's and E2V's solved fields give 0.2 to 0.5 %
for a pixel that is charged alone, and 1 to 2 % where all pixels are.  Chosen: the range begins below
that and ends ten times above; twice as wide at the top, evidence for the effect falls by 0.12."""


REACH = 2
"""Largest distance of pixels whose edges move [pixel].  Derived: at a width of 0.6 pixel, 1e-3 of the
electrons land two pixels away, and less farther; twice as far nothing changes."""


def landing(variance: float, side: int) -> FloatArray:
    r"""Give the fraction of electrons of uniform light that land at each lag along an axis.

    .. math:: B_i = H(i + 1) - 2 H(i) + H(i - 1), \qquad H(x) = x\,\Phi(x/s) + s\,\phi(x/s)

    for electrons that convert uniformly over a pixel and diffuse with the variance :math:`s^2`.

    Parameters
    ----------
    variance : float
        Variance of diffusion along the axis [pixel^2], above 0.
    side : int
        Number of pixels of a periodic line.

    Returns
    -------
    landed : ndarray, shape (side,)
        Fraction at lags 0, 1, ..., -1; their sum is 1.

    Examples
    --------
    >>> landing(0.1, 8).round(3)
    array([0.748, 0.126, 0.   , 0.   , 0.   , 0.   , 0.   , 0.126])
    """
    s = np.sqrt(variance)
    lags = np.arange(side)
    x = np.where(lags > side // 2, lags - side, lags)[:, None] + np.array([1.0, 0.0, -1.0])
    whole = x * norm.cdf(x, scale=s) + variance * norm.pdf(x, scale=s)
    return np.asarray(whole @ [1.0, -2.0, 1.0])


class ChargeDiffusion(TemplateEffect):
    r"""Electrons that convert above a pixel with the charge Q diffuse by :math:`v (1 + c Q)`.

    Stored charge lowers the field above it, drift takes longer, and Einstein's relation widens the
    diffusion.  A light density L crosses an edge between pixels p and q by

    .. math::
        \int_0^\infty L(-u)\,\Phi(-u/\sigma_p)\,du - \int_0^\infty L(u)\,\Phi(-u/\sigma_q)\,du
        = L\,\frac{\sigma_p - \sigma_q}{\sqrt{2\pi}}
        - \frac{\partial L}{\partial x}\,\frac{\sigma_p^2 + \sigma_q^2}{4} .

    The second term is diffusion by the mean variance of both pixels (:meth:`diffusion_growth`), which
    uniform light does not show.  The first moves the edge towards the pixel with more charge
    (:meth:`edges`): of uniform light the fraction :math:`B_i(v)` lands i pixels away along an axis,
    which by the diffusion equation changes as the flux through the edges,

    .. math::
        \frac{\partial B_i}{\partial v} = \tfrac12 [g(i + 1) - 2 g(i) + g(i - 1)], \qquad
        k^x_{ij} = \tfrac12 v c\, B_j\, [g(i + 1) - g(i)],

    with the normal density g of variance v, and the same along y: in micrometres x and y are alike.

    Parameters
    ----------
    values : mapping of str to float
        ``growth`` [% per 1e5 e-]: c at the reference's back bias, plausible from 0.1 to 20 (0 changes
        nothing).  At other back biases it is inversely proportional to the field, as the variance is.
    of : TemplateFamily
        Family of :func:`charge_diffusion`, with the variance of the empty device.

    Notes
    -----
    To first order in c Q, for widths of diffusion up to 0.6 pixel.  The field is taken to fall above the
    charged pixel alone, in a step at its edges; a solved field changes beyond them too, high above the
    gates, and steeply at them, low above the gates.  Spots of 1 pixel grow by 4 % less than a smooth
    change makes them grow, and by 16 % less than a step.

    Examples
    --------
    >>> widths = DiffusionWidths((((620.0, -50.0), 0.05),), 173.15)
    >>> effect = charge_diffusion(widths)({"growth": 3.0})
    >>> shot = Shot("flat", 0, 1.0, 620.0, -50.0, 173.15)
    >>> kx, _ = effect.edges(np.zeros((7, 7)), np.zeros((7, 7)), shot, Layout((9, 9), ()))
    >>> (kx[2:5, 2:4] * 1e8).round(3)
    array([[ 0.119, -0.119],
           [ 1.099, -1.099],
           [ 0.119, -0.119]])
    """

    stage = "collect"
    touches = ("flat_cov", "spot")
    in_images = False

    @classmethod
    def template_starts(
        cls, of: TemplateFamily, layout: Layout, seen: Sequence[Seen]
    ) -> list[dict[str, float]]:
        """Values from which fits begin: a variance that grows by 1 % per 1e5 e-."""
        del of, layout, seen
        return [{"growth": 1.0}]

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        """Move the edges of the charged pixel inwards, and those that continue them a little."""
        if self["growth"] == 0.0:
            return kx, ky
        at = self._at(shot, layout)
        lags = np.arange(-REACH - 1, REACH + 2)
        density = norm.pdf([lags, lags + 1], scale=np.sqrt(at.variance))
        landed = np.roll(landing(at.variance, len(lags)), len(lags) // 2)
        right = 0.5 * at.variance * at.growth * np.outer(landed, density[1] - density[0])
        # The outermost edges of shifts do not move.
        right[[0, -1]] = right[:, [0, -1]] = 0.0
        return add_edges((kx, ky), (right, right.T), 1.0)

    def diffusion_growth(self, shot: Shot, layout: Layout) -> float:
        """Growth of the variance of diffusion with the charge of a pixel [pixel^2/e-]."""
        if self["growth"] == 0.0:
            return 0.0
        at = self._at(shot, layout)
        return float(at.variance * at.growth)

    def _at(self, shot: Shot, layout: Layout) -> _Diffusion:
        """Variance [pixel^2] at a condition, and its relative growth there [1/e-]."""
        wavelength, back_bias, _ = layout.reference
        usual = shot._replace(wavelength=wavelength, back_bias=back_bias)
        held = self.template.held
        heat = shot.temperature / self.template.temperature
        # Both the field that charge takes away and what is left are in the relative change.
        weaker = nearest_value(
            held, usual._replace(back_bias=shot.back_bias)
        ) / nearest_value(held, usual)
        return _Diffusion(
            nearest_value(held, shot) * (heat if np.isfinite(heat) else 1.0),
            0.01 * self["growth"] / PER * weaker,
        )


class _Diffusion(NamedTuple):
    """Variance of diffusion [pixel^2], and its relative growth with charge [1/e-]."""

    variance: float
    growth: float


def charge_diffusion(widths: DiffusionWidths) -> TemplateFamily:
    """Make the family of effects of diffusion that widens with the stored charge.

    Parameters
    ----------
    widths : DiffusionWidths
        Variance of diffusion in the empty device [pixel^2], by wavelength and back bias.

    Returns
    -------
    family : TemplateFamily
        Of class ``silicon_physics`` and piece ``charge_diffusion``.

    Examples
    --------
    >>> family = charge_diffusion(DiffusionWidths((((620.0, -50.0), 0.05),), 173.15))
    >>> family.word, family.variant
    ('silicon_physics', 'charge_diffusion')
    """
    return TemplateFamily(
        ChargeDiffusion, "silicon_physics", "charge_diffusion", widths,
        "Einstein's relation over the drift in the field that stored charge lowers: Holland et al. "
        "2003, IEEE Trans. Electron Devices 50, 225; Lage, Bradshaw & Tyson 2017, section 4; range from "
        "the solved fields of two devices",
        (GROWTH,),
    )  # fmt: skip
