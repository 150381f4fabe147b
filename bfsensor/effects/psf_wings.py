"""Wings of spots: an extended halo of their light."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Layout, Parameter, Shot


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
    parameters = (
        Parameter("frac", "", 1e-3, 0.05, amplitude=True),
        Parameter("sigma", "pixel", 3.0, 8.0),
    )
    touches = ("spot",)
    source = "Assumed: scattered light of a projector, one Gaussian for what is rather a power law"

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, float, float]:
        del shot, layout
        return 0.0, self["frac"], self["sigma"]
