"""Wings of spots: an extended halo of their light, as a sum of Gaussians."""

from __future__ import annotations

import numpy as np

from bfsensor.effects.effect import Effect, Halo, Layout, Parameter, Shot
from bfsensor.typing import FloatArray

FRAC = Parameter("frac", "", 1e-3, 0.05, amplitude=True)
"""Fraction of the light in the halo.  Chosen: projectors and antireflection coatings of test
benches; with a top twice as high the evidence of every detection falls by a sixth."""

WIDTHS = np.geomspace(0.3, 3.4, 5)
"""Widths of the Gaussians of an exponential halo over its length.  Measured: convolved with a spot of
1.25 pixels they give the halo to 2 % from 2 pixels to four lengths; with 4, to 5 %."""

BEYOND, RINGS = 85.0, 6
"""Width of the widest Gaussian of an aureole [pixel], and their number.  Chosen: an aureole of r^-2 has
no end, so that its fraction is that within about 128 pixels; with twice the width, a sixth of it is
beyond them.  Measured: 6 Gaussians give it to 4 %, 5 to 9 %."""


class PsfWings(Effect):
    """The fraction ``frac`` of the light of spots is in a wider Gaussian halo.

    The halo is the spot convolved with a Gaussian of ``sigma`` pixels.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``frac``: 0.001 to 0.05 (0 changes nothing); ``sigma`` [pixel]: 3 to 8.

    Examples
    --------
    >>> PsfWings({"frac": 0.007, "sigma": 5.0}).name
    'psf_wings'
    """

    word = "psf_wings"
    stage = "light"
    parameters = (FRAC, Parameter("sigma", "pixel", 3.0, 8.0))
    touches = ("spot",)
    source = "Assumed: scattered light of a projector, one Gaussian"

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, Halo]:
        del shot, layout
        return 0.0, _parts(self["frac"], np.ones(1), np.array([self["sigma"]]))


class ExponentialWings(PsfWings):
    r"""The fraction ``frac`` of the light of spots is in a halo exp(-r / ``length``).

    As a sum of Gaussians of the widths s: :math:`e^{-x} = \frac{2}{\sqrt{\pi}} \int_0^\infty e^{-u^2 -
    x^2 / (4 u^2)} \, du` with :math:`s = \sqrt{2}\, u` times the length.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``frac``: 0.001 to 0.05 (0 changes nothing); ``length`` [pixel]: 2 to 12.

    Examples
    --------
    >>> ExponentialWings({"frac": 0.007, "length": 4.0}).name
    'psf_wings:exponential'
    """

    variant = "exponential"
    parameters = (FRAC, Parameter("length", "pixel", 2.0, 12.0))
    source = (
        "Halo of thinned CCDs, exponential in radius: Sirianni et al. 2005, PASP 117, 1049; ranges "
        "assumed"
    )

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, Halo]:
        del shot, layout
        u = WIDTHS / np.sqrt(2)
        # The light of a Gaussian of the width s, in steps of the logarithm of s.
        part = u**3 * np.exp(-(u**2))
        return 0.0, _parts(self["frac"], part, self["length"] * WIDTHS)


class AureoleWings(PsfWings):
    r"""The fraction ``frac`` of the light of spots is in an aureole 1 / (``length``^2 + r^2).

    As a sum of Gaussians: :math:`1 / (L^2 + r^2) = \int_0^\infty e^{-t (L^2 + r^2)} \, dt`.  The
    fraction is that within some hundred pixels (:data:`BEYOND`).

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``frac``: 0.001 to 0.05 (0 changes nothing); ``length`` [pixel]: 1 to 10.

    Examples
    --------
    >>> AureoleWings({"frac": 0.007, "length": 4.0}).name
    'psf_wings:aureole'
    """

    variant = "aureole"
    parameters = (FRAC, Parameter("length", "pixel", 1.0, 10.0))
    source = (
        "Aureole that falls as r^-2: King 1971, PASP 83, 199; Racine 1996, PASP 108, 699; ranges "
        "assumed"
    )

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, Halo]:
        del shot, layout
        widths = np.geomspace(0.6 * self["length"], BEYOND, RINGS)
        part = np.exp(-((self["length"] / widths) ** 2) / 2)
        return 0.0, _parts(self["frac"], part, widths)


def _parts(frac: float, part: FloatArray, widths: FloatArray) -> Halo:
    """Gaussians of a halo, (fraction of the light, width [pixel]); none where the fraction is 0."""
    each = frac * part / part.sum()
    return tuple((float(f), float(w)) for f, w in zip(each, widths, strict=True) if frac)
