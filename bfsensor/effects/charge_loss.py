"""Charge loss: the collection efficiency falls with the charge already collected."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Law, Parameter


class ChargeLoss(Effect):
    r"""Light is collected with the efficiency :math:`e^{-q Q}`, Q the charge already in the pixel.

    The mean of a flat falls behind the light, its variance falls by the fraction :math:`2 q \mu`,
    and neighbours gain nothing.  To first order a non-linear converter has the same effect.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``q`` [1/e-]: 1e-08 to 3e-07 (0 changes nothing).

    Examples
    --------
    >>> ChargeLoss({"q": 5e-08}).name
    'charge_loss'
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
