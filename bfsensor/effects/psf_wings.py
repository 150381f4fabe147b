"""Wings of the spots: an extended halo of their light."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Layout, Parameter, Shot


class PsfWings(Effect):
    """``frac`` of a spot's light lies in a Gaussian halo, ``sigma`` pixels wider in quadrature."""

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
