"""Brighter-fatter effect that is not proportional to the stored charge."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Law, Parameter


class BrighterFatterNonlinear(Effect):
    """A charge Q moves boundaries by k Q (1 + b Q / 2).

    Packets rise and spread as they grow, which b stands for; covariances gain a term that
    grows with the cube of the level and has the shape in lags of the effect itself.
    """

    word = "bf_nonlinear"
    stage = "collect"
    parameters = (Parameter("b", "1/e-", 3e-7, 3e-6, signed=True, amplitude=True),)
    touches = ("flat_cov", "spot")
    of_levels = True
    source = (
        "Astier et al. 2019, A&A 629, A36, question shifts proportional to charge and fit a term "
        "a b; law of one b and range assumed"
    )

    def law(self) -> Law:
        return Law(bend=self["b"])
