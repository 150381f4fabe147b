"""Charge loss: the collection efficiency falls with the charge already collected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bfsensor.effects.effect import Effect, Law, Layout, Parameter, Seen


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


class PowerLoss(Effect):
    r"""Light is collected with the efficiency :math:`e^{-q Q_0 (Q/Q_0)^p}`, Q_0 = 1e5 e-.

    Traps that lie at the surface of the packet see more of it as the packet grows: with its area,
    p = 1/2, or more slowly.  The plain law is p = 1.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``q`` [1/e-]: 1e-08 to 3e-07 (0 changes nothing); ``power``: 0.2 to 2.

    Examples
    --------
    >>> float(PowerLoss({"q": 1e-7, "power": 0.5}).law().lost(2.5e4).round(6))
    0.005
    """

    word = "charge_loss"
    variant = "power"
    stage = "collect"
    parameters = (
        Parameter("q", "1/e-", 1e-8, 3e-7, amplitude=True),
        Parameter("power", "", 0.2, 2.0, law="flat", ends=(0.0, np.inf)),
    )
    touches = ("flat_mean", "flat_cov", "spot")
    source = (
        "Capture rate of traps that the packet's surface meets: Shockley & Read 1952, Phys. Rev. 87, "
        "835; volume and surface of packets as powers of the charge: Short et al. 2013, MNRAS 430, "
        "3078; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"q": 5e-8, "power": power} for power in (0.4, 0.8, 1.5)]

    def law(self) -> Law:
        return Law(losses=((self["q"], self["power"], np.inf),))


class FillingLoss(Effect):
    r"""Light is collected with the efficiency :math:`e^{-q Q / (1 + Q/K)}`: traps that fill up.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``q`` [1/e-]: 1e-08 to 1e-06 (0 changes nothing); ``knee`` [e-]: 3000
        to 300000, K.

    Examples
    --------
    >>> FillingLoss({"q": 1e-7, "knee": 3e4}).name
    'charge_loss:filling'
    """

    word = "charge_loss"
    variant = "filling"
    stage = "collect"
    parameters = (
        Parameter("q", "1/e-", 1e-8, 1e-6, amplitude=True),
        Parameter("knee", "e-", 3e3, 3e5),
    )
    touches = ("flat_mean", "flat_cov", "spot")
    source = (
        "Langmuir's isotherm of a limited number of surface states: Janesick 2001, Scientific "
        "Charge-Coupled Devices, SPIE Press, section 5; ranges assumed"
    )

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [{"q": 1e-7, "knee": knee} for knee in (1e4, 1e5)]

    def law(self) -> Law:
        return Law(losses=((self["q"], 1.0, self["knee"]),))
