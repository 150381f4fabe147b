"""Boundary shifts that are quadratic in the stored charge."""

from __future__ import annotations

from bfsensor.effects.effect import Effect, Law, Parameter


class BrighterFatterNonlinear(Effect):
    """A charge Q moves boundaries by k Q (1 + b Q / 2).

    The coefficient ``b`` describes that the stored charge spreads and rises in the well as it
    grows.  Covariances gain a term that is cubic in the level, with the same dependence on lag as
    the linear effect.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``b`` [1/e-]: 3e-07 to 3e-06 in magnitude, either sign (0 changes
        nothing).

    Examples
    --------
    >>> BrighterFatterNonlinear({"b": 9e-07}).name
    'bf_nonlinear'
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
