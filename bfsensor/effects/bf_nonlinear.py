"""Boundary shifts that are quadratic in the stored charge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from bfsensor.effects.effect import Effect, Law, Layout, Parameter, Seen
from bfsensor.typing import Edges, FloatArray


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
    needs: ClassVar[tuple[str, ...]] = ("levels",)
    source = (
        "Astier et al. 2019, A&A 629, A36, question shifts proportional to charge and fit a term "
        "a b; law of one b and range assumed"
    )

    law_name = "packet_height"

    def law(self) -> Law:
        return Law(bend=self["b"])


class EdgesNonlinear(Effect):
    r"""A charge Q moves each boundary by k Q (1 + c Q / 2), with its own coefficient c.

    .. math:: c = b\, e^{-n (r - 1/2)}

    r is the distance of an edge's middle from the charge [pixel], and b is ``b`` for edges between
    columns, ``b_y`` for those between rows.  ``near`` n is 0 where all edges have the same, above 0
    where those beside the charge feel its height most.

    Parameters
    ----------
    values : mapping of str to float
        Plausible ranges: ``b`` [1/e-]: 3e-07 to 3e-06 in magnitude, either sign (0 changes nothing);
        ``b_y`` [1/e-]: 3e-07 to 3e-06 in magnitude, either sign (0 changes nothing); ``near``
        [1/pixel]: 0 to 2.

    Examples
    --------
    >>> EdgesNonlinear({"b": 9e-07, "b_y": -9e-07, "near": 0.0}).law_name
    'two_axes'
    """

    word = "bf_nonlinear"
    variant = "edges"
    stage = "collect"
    parameters = (
        Parameter("b", "1/e-", 3e-7, 3e-6, signed=True, amplitude=True),
        Parameter("b_y", "1/e-", 3e-7, 3e-6, signed=True, amplitude=True),
        Parameter("near", "1/pixel", 0.0, 2.0, law="flat", ends=(0.0, np.inf)),
    )
    touches = ("flat_cov", "spot")
    needs: ClassVar[tuple[str, ...]] = ("levels",)
    source = (
        "Coefficients b_ij differ between lags: Astier & Regnault 2023, A&A 670, A118; higher "
        "orders evolve anisotropically with flux: Broughton et al. 2024, PASP 136, 045003; exponential "
        "and range assumed"
    )

    @property
    def law_name(self) -> str:
        """'own_edges' if the second pixel's edges have less than half of the first's, or 'two_axes'."""
        return "own_edges" if self["near"] > np.log(2.0) else "two_axes"

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        return [
            {"b": 1e-6, "b_y": b_y, "near": near}
            for b_y, near in ((1e-6, 1.0), (0.0, 0.0), (-1e-6, 0.0), (3e-6, 0.0))
        ]

    def bend_edges(self, kx: FloatArray, ky: FloatArray) -> Edges | None:
        lag = np.arange(len(kx)) - len(kx) // 2
        # Right edges lie half a pixel farther in x, upper ones in y.
        fallen = np.exp(-self["near"] * (np.hypot(lag + 0.5, lag[:, None]) - 0.5))
        return self["b"] * fallen * kx, self["b_y"] * fallen.T * ky
