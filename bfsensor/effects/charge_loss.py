"""Charge loss: light is collected the less, the more charge is there."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Law, Parameter


class ChargeLoss(Effect):
    r"""Light is collected with :math:`e^{-q Q}`, Q the charge that is there already.

    The mean of a flat lags behind the light, its variance falls by :math:`2 q \mu` of itself
    and no neighbour gains: to first order the twin of a converter that bends.
    """

    word = "charge_loss"
    stage = "collect"
    parameters = (Parameter("q", "1/e-", 1e-8, 3e-7, amplitude=True),)
    touches = ("flat_mean", "flat_cov", "spot")
    source = (
        "Variance deficit without excess covariance of neighbours: Astier & Regnault 2023, A&A "
        "670, A118 (the remainder that shifts do not explain); range assumed"
    )

    def law(self) -> Law:
        return Law(loss=self["q"])
